# SPDX-License-Identifier: Apache-2.0

"""Noise parameters under the names and in the units of other software, ready to paste."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.files.exports import kalibr_settings
from adxl_ros.signals.axis_noise import AxisNoise
import numpy as np

_PX4_HZ = 100.0
"""Rate of the filter of PX4, Hz: EKF2_PREDICT_US is 10 000."""


@dataclass(frozen=True)
class Setting:
    """A line of another program's settings."""

    name: str  # Name of the setting
    values: tuple[float, ...]  # Its values: one, or nine of a matrix
    unit: str  # Their unit, and what they are

    def lines(self) -> list[str]:
        """Return the setting in YAML, with its unit as a comment."""
        texts = [_yaml_number(value) for value in self.values]
        if len(texts) == 1:
            return [f'{self.name}: {texts[0]}  # {self.unit}']
        rows = [', '.join(texts[i:i + 3]) for i in range(0, len(texts), 3)]
        return [f'{self.name}:  # {self.unit}', f'  [{rows[0]},',
                *(f'   {row},' for row in rows[1:-1]), f'   {rows[-1]}]']


def _yaml_number(value: float) -> str:
    """Return a value as YAML reads a floating-point number: 4.0e-05, not 4e-05."""
    if value >= 1:
        return repr(float(f'{value:.6g}'))
    mantissa, e, exponent = f'{value:.3g}'.partition('e')
    return f'{mantissa if "." in mantissa else f"{mantissa}.0"}{e}{exponent}'


def settings(noises: list[AxisNoise], rate_hz: float) -> dict[str, list[Setting]]:
    """
    Return the settings of other programs.

    kalibr takes N and K as they are. VINS-Fusion and PX4 add the variance of a value times the
    square of the time step, so they take N·√rate and K·√rate, at the rate of their filter.
    robot_localization takes the variance of a sample from the message. Programs that have one
    value for all axes get the largest one. A term that is not seen is its upper limit.

    Parameters
    ----------
    noises
        The noise by axis.
    rate_hz
        Sample rate, Hz.

    Returns
    -------
    dict
        Settings by program.

    """
    loudest = max(noises, key=lambda noise: noise.sample_white)
    white = loudest.sample_white
    white_limit = '' if loudest.fit.white.is_seen else ', an upper limit'
    walk = max((noise.fit.walk for noise in noises), key=lambda walk: walk.value)
    limit = ''
    if not walk.is_seen:
        walk = max((noise.fit.walk for noise in noises), key=lambda walk: walk.high)
        limit = ', an upper limit'
    k = walk.value if walk.is_seen else walk.high
    variances = [noise.sample_std ** 2 for noise in noises]
    matrix = np.diag((variances + [1e6] * 3)[:3]).ravel()
    return {
        'kalibr, imu.yaml': [
            Setting(name, (value,), unit + note) for (name, value, unit), note
            in zip(kalibr_settings(white, k, rate_hz), (white_limit, limit, ''))],
        f'VINS-Fusion, at {rate_hz:.4g} Hz': [
            Setting('acc_n', (white * np.sqrt(rate_hz),), f'm/s^2{white_limit}'),
            Setting('acc_w', (k * np.sqrt(rate_hz),), f'm/s^3{limit}')],
        'robot_localization, in sensor_msgs/Imu of the driver': [
            Setting('linear_acceleration_covariance', tuple(matrix.tolist()), '(m/s^2)^2')],
        'PX4, its filter at 100 Hz; vibration in flight needs more': [
            Setting('EKF2_ACC_NOISE', (white * np.sqrt(_PX4_HZ),),
                    f'm/s^2, at least 0.01{white_limit}'),
            Setting('EKF2_ACC_B_NOISE', (k * np.sqrt(_PX4_HZ),), f'm/s^3{limit}')],
    }
