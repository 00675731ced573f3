# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""
Motion that a smooth reference lacks, as a part of the noise.

The sensor has more band than an optical tracker or a smoothed recording. What the reference lacks
cannot be simulated. In motion it adds to the noise of every hypothesis, so that all of them are
compared on the same samples, and each frequency counts by what the reference knows of it.

The spectrum of the lost motion is that of the part of the recording that no linear filter of the
reference predicts (multiple coherence; Bendat and Piersol 2010, section 7.3). What the reference
has attenuated is restored with an error, which adds a share of it. A filter with the smallest
phase, switched on in motion, gives noise with lost motion the spectrum of noise alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from adxl_ros.diagnose.angle_errors import AngleErrorFilter
from adxl_ros.diagnose.baseline_comparison import BaselineComparison
from adxl_ros.model import noise
import numpy as np
import scipy

_WINDOW_S = 2.0
"""Length of the windows of the spectra, s. Chosen: a filter of an optical tracker is shorter."""
_FEWEST_WINDOWS = 12
"""Fewest windows in motion. Chosen: three axes of a reference then predict a quarter by chance."""
_OVERLAP_SHARE = 0.6
"""Independent windows divided by the windows, which overlap by half. Chosen: that of a Hann
window."""
_RESTORING_ERROR = 0.1
"""Error of restored motion, divided by what the reference lacks of it. Chosen: the forms of
filters differ by some per cent, and the reference has noise."""
_RIDGE = 1e-9
"""Ridge on the spectra of the reference, divided by their mean. Chosen: above rounding errors."""
_LOWEST_NOISE_V = 1e-7
"""Smallest standard deviation of the noise, V. Chosen: below that of any ADC."""


@dataclass(frozen=True)
class LostMotionFilter:
    """
    A filter that gives noise with lost motion the spectrum of noise without it.

    Attributes
    ----------
    moves
        Samples in motion, (n,) bool; at rest nothing is lost.
    taps
        Impulse response of the filter, (k,).
    lost_rms_v
        Rms of the lost motion over all samples, V.
    before
        Filter for errors of angles and rounding, which comes first; None without any.

    """

    moves: np.ndarray
    taps: np.ndarray
    lost_rms_v: float
    before: AngleErrorFilter | None = None

    @property
    def rms_v(self) -> float:
        """Return the rms of the errors, V."""
        return float(np.hypot(self.lost_rms_v, self.before.rms_v if self.before else 0.0))

    @cached_property
    def scale(self) -> np.ndarray:
        """Return the standard deviation of the noise over that of the innovation, (n,)."""
        scale = np.where(self.moves, self.taps[0], 1.0)
        return scale if self.before is None else scale * self.before.scale

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Filter k series, (k, n)."""
        before = values if self.before is None else self.before(values)
        return np.where(self.moves, scipy.signal.lfilter(self.taps, [1.0], before), before)


def lost_motion_filter(comparison: BaselineComparison, axis: int, before: AngleErrorFilter | None
                       ) -> LostMotionFilter | None:
    """
    Return the filter for one axis of a recording.

    Parameters
    ----------
    comparison
        The recording, at the rate of the search.
    axis
        Index of the measured axis.
    before
        Filter for errors of angles and rounding.

    Returns
    -------
    LostMotionFilter or None
        The filter; None where the reference does not fade, or motion is too short.

    """
    if not comparison.reference_fades:
        return None
    moves = ~comparison.at_rest
    size = round(_WINDOW_S * comparison.sensor.rate_hz) // 2 * 2
    usable = comparison.used & moves
    starts = [i for i in range(0, len(usable) - size + 1, size // 2) if usable[i:i + size].all()]
    if len(starts) < _FEWEST_WINDOWS:
        return None
    rows = np.array(starts)[:, None] + np.arange(size)
    recorded = _spectra(comparison.volts[:, axis:axis + 1], rows)[:, :, 0]
    stated = _spectra(comparison.simulated_v(comparison.sensor), rows)
    lacking = np.mean(np.abs(recorded) ** 2 - np.abs(stated[:, :, axis]) ** 2, axis=1)
    density_v2 = 2 * comparison.dt_s * (_unpredicted(recorded, stated) + _RESTORING_ERROR ** 2
                                        * np.maximum(lacking, 0.0))
    noise_v2 = _noise_density_v2(comparison, axis, size)
    lost_v2 = np.maximum(density_v2 - noise_v2, 0.0)
    step_hz = 1 / (size * comparison.dt_s)
    lost_rms_v = float(np.sqrt(lost_v2.sum() * step_hz * (usable.sum() / comparison.used.sum())))
    return LostMotionFilter(moves, _minimum_phase(np.sqrt(noise_v2 / (noise_v2 + lost_v2))),
                            lost_rms_v, before)


def _spectra(volts: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the spectra of windows by frequency, (frequencies, windows, m), of unit power."""
    taper = np.hanning(rows.shape[1])
    windows = scipy.signal.detrend(volts[rows], axis=1) * taper[None, :, None]
    return np.moveaxis(np.fft.rfft(windows, axis=1), 1, 0) / np.sqrt(np.sum(taper ** 2))


def _unpredicted(recorded: np.ndarray, stated: np.ndarray) -> np.ndarray:
    """
    Return the power of a recording that no linear filter of the reference predicts.

    `recorded` is (frequencies, windows), `stated` (frequencies, windows, m). What the reference
    predicts by chance is made up for.
    """
    windows, inputs = stated.shape[1:]
    gram = np.einsum('fwi,fwj->fij', stated.conj(), stated)
    cross = np.einsum('fwi,fw->fi', stated.conj(), recorded)
    ridge = _RIDGE * np.trace(gram, axis1=1, axis2=2).real.mean() * np.eye(inputs)
    gain = np.linalg.solve(gram + ridge, cross[:, :, None])
    rest = recorded - np.einsum('fwi,fi->fw', stated, gain[:, :, 0])
    free = max(_OVERLAP_SHARE * windows - inputs, 1.0)
    return np.mean(np.abs(rest) ** 2, axis=1) * _OVERLAP_SHARE * windows / free


def _noise_density_v2(comparison: BaselineComparison, axis: int, size: int) -> np.ndarray:
    """Return the one-sided density of noise and rounding by frequency, V²/Hz."""
    sensor = comparison.sensor
    rc_s = float(noise.electronics(sensor).rc_s[axis])
    pole = float(np.exp(-comparison.dt_s / rc_s)) if rc_s else 0.0
    std_v = max(float(noise.analog_std_v(sensor)[axis]), _LOWEST_NOISE_V)
    angle = 2 * np.pi * np.arange(size // 2 + 1) / size
    coloured = std_v ** 2 * (1 - pole ** 2) / np.abs(1 - pole * np.exp(-1j * angle)) ** 2
    return 2 * comparison.dt_s * (coloured + noise.rounding(sensor, axis).white_v2)


def _minimum_phase(gain: np.ndarray) -> np.ndarray:
    """Return the impulse response of the smallest phase with a gain, by its cepstrum."""
    cepstrum = np.fft.irfft(np.log(gain))
    half = len(cepstrum) // 2
    cepstrum[1:half] *= 2
    cepstrum[half + 1:] = 0.0
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))[:half]
