# SPDX-License-Identifier: Apache-2.0

"""
Calibration over temperature: blocks of a resting sensor in, its parameter file out.

- Which parts of a wanted range the temperature has passed, and the error to expect there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

from adxl_ros.calibrate.calibration import CalibrationResult
from adxl_ros.calibrate.fits import thermal_fit
from adxl_ros.calibrate.fits.thermal_fit import ThermalBlocks, ThermalFit
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.provenance import with_provenance
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import G0_MPS2, NOMINAL_TEMPERATURE_C, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.filters import play
from adxl_ros.model.sensor import Sensor
import numpy as np

PARTS = 10
"""Parts of the wanted range that are to be passed in each direction. Chosen: a curve of degree two
is certain between them."""
_STEADY_K = 0.25
"""Change of temperature, K, that is no change of direction. Chosen: above the noise of a
thermometer."""


@dataclass(frozen=True)
class Passed:
    """Parts of the wanted range that the temperature has passed."""

    middles_c: np.ndarray  # Middle of each part, °C, (parts,)
    # warming, cooling: Whether the temperature has passed it in that direction, (parts,) bool
    warming: np.ndarray
    cooling: np.ndarray
    rises: bool  # Whether the temperature rose last

    @property
    def complete(self) -> bool:
        """Return whether all parts are passed in both directions."""
        return bool(self.warming.all() and self.cooling.all())

    def advice(self) -> str:
        """Return what to do next, for people."""
        half_c = (self.middles_c[1] - self.middles_c[0]) / 2
        open_warm, open_cool = self.middles_c[~self.warming], self.middles_c[~self.cooling]
        if self.complete:
            return 'both directions are covered'
        if len(open_warm) and (self.rises or not len(open_cool)):
            if self.rises:
                return f'warm it to {open_warm[-1] + half_c:.0f} °C'
            return (f'cool it to {open_warm[0] - half_c:.0f} °C, then warm it to '
                    f'{open_warm[-1] + half_c:.0f} °C')
        if not self.rises:
            return f'cool it to {open_cool[0] - half_c:.0f} °C'
        return (f'warm it to {open_cool[-1] + half_c:.0f} °C, then cool it to '
                f'{open_cool[0] - half_c:.0f} °C')


def passed(temperatures_c: np.ndarray, range_c: tuple[float, float]) -> Passed:
    """
    Return which parts of a range the temperature has passed.

    temperatures_c: temperatures in the order of time, °C, (k,).
    """
    low_c, high_c = range_c
    middles_c = low_c + (high_c - low_c) * (np.arange(PARTS) + 0.5) / PARTS
    steady_c = play(np.asarray(temperatures_c, float), _STEADY_K, {})
    before_c, after_c = steady_c[:-1, None], steady_c[1:, None]
    warming = ((before_c < middles_c) & (middles_c <= after_c)).any(axis=0)
    cooling = ((after_c <= middles_c) & (middles_c < before_c)).any(axis=0)
    changes = np.diff(steady_c)
    changes = changes[changes != 0]
    rises = bool(not len(changes) or changes[-1] > 0)
    return Passed(middles_c, np.asarray(warming), np.asarray(cooling), rises)


def expected_error_mg(fit: ThermalFit, covered: Passed, calibrated_c: float) -> float:
    """
    Return the expected error of the zero-g of the worst axis at the worst part of a range.

    A part that is not passed in both directions may have a loop of typical width.
    """
    typical_g = parameter_of(Coefficient('thermal_hysteresis', 'half_width_g', 'x')).scale
    unseen_g = np.where(covered.warming & covered.cooling, 0.0, typical_g)
    return 1e3 * float(np.hypot(fit.error_g(covered.middles_c, calibrated_c), unseen_g).max())


BLOCK_S = 10.0
"""Length of a block, s. Chosen: short beside the lag of a thermometer."""
_FEWEST_SAMPLES = 10
"""Fewest samples of a block. Chosen: their scatter shows whether the sensor rests."""
_MOST_BLOCKS = 2000
"""Largest number of blocks. Chosen: a fit of less than a second."""
_MOVING = 3.0
"""Scatter of a block, divided by the median of all blocks, above which the sensor moves. Chosen:
far above the scatter of a standard deviation of ten samples."""
_SAME_ORIENTATION_G = 0.1
"""Range of the block means, g, up to which a recording has one orientation. Chosen: above any
zero-g over temperature."""
_RIVAL_SHARE = 0.5
"""Gain of an effect, divided by that of the best one, from which the two are not separated.
Chosen: neither form is exact."""


def rest_blocks(recording: Recording, unit: Sensor) -> Poses | None:
    """Cut a recording of a resting sensor into blocks with a temperature."""
    temperature_c = recording.columns.get('temperature_c')
    if temperature_c is None or not np.isfinite(temperature_c).any():
        return None
    volts, time_s = recording.volts(unit), recording.time_s
    span_s = float(time_s[-1] - time_s[0])
    block_s = max(BLOCK_S, span_s / _MOST_BLOCKS,
                  _FEWEST_SAMPLES * float(np.median(np.diff(time_s))))
    edges = np.unique(np.searchsorted(time_s, time_s[0] + block_s * np.arange(
        int(span_s / block_s) + 1)))
    parts = [slice(a, b) for a, b in pairwise(edges)
             if b - a >= _FEWEST_SAMPLES and np.isfinite(temperature_c[a:b]).any()
             and np.isfinite(volts[a:b]).all()]
    if not parts:
        return None
    mean_v = np.array([volts[p].mean(axis=0) for p in parts])
    scatter_v = np.array([volts[p].std(axis=0) for p in parts])
    at_rest = (scatter_v <= _MOVING * np.median(scatter_v, axis=0) + unit.lsb_v).all(axis=1)
    counts = np.array([p.stop - p.start for p in parts])[:, None]
    missing = np.full(len(parts), np.nan)
    poses = Poses(
        volts=mean_v, std_v=scatter_v / np.sqrt(counts), alpha_rad=missing, beta_rad=missing,
        time_s=np.array([[time_s[p.start], time_s[p.stop - 1]] for p in parts]),
        check=np.zeros(len(parts), bool),
        temperature_c=np.array([np.nanmean(temperature_c[p]) for p in parts])).subset(at_rest)
    range_g = np.ptp(poses.volts, axis=0) / unit.nominal_scale_v_per_g if len(poses) else 0.0
    return poses if len(poses) and np.max(range_g) < _SAME_ORIENTATION_G else None


def blocks_of(poses: Poses) -> ThermalBlocks:
    """Return the poses with a temperature as blocks, in the order of time."""
    order = np.argsort(poses.time_s[:, 0], kind='stable')
    order = order[np.isfinite(poses.temperature_c[order])]
    return ThermalBlocks(poses.time_s[order].mean(axis=1), poses.temperature_c[order],
                         poses.volts[order])


def calibrated_temperature_c(base: Sensor) -> float:
    """Return the temperature at which a unit was calibrated, °C; else that of the datasheet."""
    range_c = base.envelope.temperature_c
    return float(np.mean(range_c)) if range_c else NOMINAL_TEMPERATURE_C


def calibrate(base: Sensor, poses: Poses, source: str, data_sha256: str = '',
              range_c: tuple[float, float] | None = None) -> CalibrationResult:
    """Fit zero-g over temperature, and the slope of the scale factor where orientations allow."""
    blocks = blocks_of(poses)
    fit = thermal_fit.fit(base, blocks)
    calibrated_c = calibrated_temperature_c(base)
    fitted = thermal_fit.applied(base, fit, calibrated_c)
    has_scale = any(name.effect == 'temperature_scale' for name in fit.names)
    low_c, high_c = range_c or fit.span_c
    misfit_mps2 = float(np.sqrt(np.mean(fit.residual_g ** 2))) * G0_MPS2
    fitted = replace(fitted, envelope=replace(
        base.envelope, temperature_c=fit.span_c, zero_g_per_k=0.0,
        scale_per_k=0.0 if has_scale else base.envelope.scale_per_k,
        misfit_mps2=float(np.hypot(base.envelope.misfit_mps2, misfit_mps2))))
    fitted = with_provenance(fitted, source, poses, data_sha256, {
        'reference': 'rest over temperature', 'base': base.provenance.get('id', base.serial),
        'residual_mg': f'{misfit_mps2 / G0_MPS2 * 1e3:.4f}',
        'sweep': f'{len(blocks.time_s)} blocks at rest, {fit.span_c[0]:.1f} to '
                 f'{fit.span_c[1]:.1f} degC'})
    error_mg = expected_error_mg(fit, passed(blocks.temperature_c, (low_c, high_c)), calibrated_c)
    lines = [
        f'zero-g over temperature: {len(blocks.time_s)} blocks at rest, '
        f'{fit.span_c[0]:.1f} to {fit.span_c[1]:.1f} °C',
        *_slope_lines(fitted, fit),
        'residual ' + ', '.join(f'{axis} {value * 1e3:.2g}' for axis, value in zip(
            base.axes, fit.residual_g)) + ' mg rms',
        *_history_lines(fit),
        f'expected error of the zero-g over {low_c:.0f} to {high_c:.0f} °C: {error_mg:.2g} mg',
        f'zero-g stays as calibrated at {calibrated_c:.1f} °C']
    if not has_scale:
        lines.append('scale factor over temperature: not fitted, it needs a second orientation')
    return CalibrationResult(nominal=base, fitted=fitted, poses=poses, report_lines=lines,
                             summary_lines=lines)


def _slope_lines(fitted: Sensor, fit: ThermalFit) -> list[str]:
    """Return slope and curvature of each axis with half of their 90 % intervals."""
    std = dict(zip(fit.names, Z_90 * np.sqrt(np.diag(fit.covariance))))
    lines = []
    for axis in fitted.axes:
        slope, curvature = (Coefficient('temperature_bias', parameter, axis)
                            for parameter in ('per_k', 'per_k2'))
        k, k2 = get(fitted, [slope, curvature])
        lines.append(f'  {axis}  {k * 1e3:+.3f} ± {std[slope] * 1e3:.3f} mg/K at 25 °C, '
                     f'{k2 * 1e6:+.2f} ± {std[curvature] * 1e6:.2f} µg/K²')
    return lines


def _history_lines(fit: ThermalFit) -> list[str]:
    """Say which dependence on the history the blocks support."""
    if not fit.gains:
        return ['history of the temperature: not tested, it needs warming and cooling']
    effect = fit.history.effect
    if not effect:
        return ['warming and cooling agree: no thermal_lag, no thermal_hysteresis']
    unit = 's' if effect == 'thermal_lag' else 'K'
    line = f'warming and cooling differ: {effect} ({fit.history.shape:.3g} {unit})'
    rivals = [other for other, gain in fit.gains.items()
              if other != effect and gain > _RIVAL_SHARE * fit.gains[effect]]
    return [line, *(f'{other} explains it nearly as well: these blocks do not separate them'
                    for other in rivals)]
