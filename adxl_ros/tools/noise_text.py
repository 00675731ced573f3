# SPDX-License-Identifier: Apache-2.0

"""The text and JSON of `noise`."""

from __future__ import annotations

from typing import Any

from adxl_ros.calibrate.value_text import duration
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.signals.axis_noise import AxisNoise, density_g_per_rthz, RecordingNoise, TERMS
from adxl_ros.signals.noise_drift import Drift, DriftKind
from adxl_ros.signals.noise_names import settings
from adxl_ros.signals.noise_parameters import Estimate
from adxl_ros.signals.still_stretch import StillStretch
import numpy as np

MICRO_G = 1e6 / G0_MPS2
"""1 m/s² in µg."""

_LARGEST_STD_MPS2 = 0.3
"""Noise of a sample from which a sensor vibrates, m/s². Chosen: three times that of a low-cost
IMU at 1 kHz."""

_LARGEST_RATIO = 1.25
"""Ratio of measured and fitted power from which it is reported. Chosen: less changes N by 10 %."""

_LARGEST_FILLED = 0.01
"""Share of missing samples from which white noise changes visibly. Chosen."""

NAMES = {'white': 'white noise N', 'instability': 'bias instability B', 'walk': 'random walk K'}
"""Names of the terms."""

_UNITS = {'white': 'm/s^2/sqrt(Hz)', 'instability': 'm/s^2', 'walk': 'm/s^2/sqrt(s)'}
"""Units of the terms in JSON."""


def head(result: RecordingNoise) -> list[str]:
    """Return which samples are used."""
    rest, axes = result.rest, ' '.join(noise.axis for noise in result.axes)
    return [result.path, f'{duration(rest.span_s)} at rest, {rest.rate_hz:.5g} Hz, axes {axes}']


def tables(result: RecordingNoise) -> list[str]:
    """Return the terms with intervals, then in SI units and by sample, 79 columns at most."""
    rows = [f' {"axis":5}' + ''.join(f'{name:25}' for name in (
            f'{NAMES[term]}' for term in TERMS)).rstrip(),
            f' {"":5}{"µg/√Hz (90 %)":25}{"µg (90 %)":25}µg/√s (90 %)']
    for noise in result.axes:
        cells = [interval(estimate.scaled(MICRO_G)) for estimate in noise.estimates]
        rows.append(f' {noise.axis:5}' + ''.join(f'{cell:25}' for cell in cells).rstrip())
    rows += _walk_lines(result)
    rows += ['', f' {"":5}{"N":12}{"B":12}{"K":12}{"N by sample":13}{"K by sample":13}'
             'datasheet',
             f' {"axis":5}{"m/s²/√Hz":12}{"m/s²":12}{"m/s²/√s":12}{"m/s²":13}{"m/s²":13}µg/√Hz']
    rate = np.sqrt(result.rest.rate_hz)
    for noise in result.axes:
        white, instability, walk = noise.estimates
        cells = [value(white), value(instability), value(walk), value(white.scaled(rate)),
                 value(walk.scaled(1 / rate)),
                 value(white.scaled(1e6 * ONE_SIDED / G0_MPS2))]
        widths = (12, 12, 12, 13, 13, 0)
        rows.append(f' {noise.axis:5}' + ''.join(f'{cell:{width}}' for cell, width
                                                 in zip(cells, widths)).rstrip())
    return rows


def _walk_lines(result: RecordingNoise) -> list[str]:
    """Return the bounds of the walks, and for which times K holds."""
    rows = []
    for noise in result.axes:
        time_s, walk = noise.fit.correlation, noise.fit.walk
        if time_s is not None:
            std = MICRO_G * walk.value * np.sqrt(time_s.value / 2)
            rows.append(f' {noise.axis}: the walk has bounds, {std:.3g} µg rms; correlation time '
                        f'{interval(time_s)} s')
    if any(noise.fit.walk.is_seen for noise in result.axes):
        rows.append(f' K holds for times up to {duration(result.rest.span_s)}, those of the '
                    'recording.')
    return rows


def interval(estimate: Estimate) -> str:
    """Return an estimate with its interval, or its upper limit."""
    if not estimate.is_seen:
        return f'below {estimate.high:.3g}'
    return f'{estimate.value:.3g} ({estimate.low:.3g} to {estimate.high:.3g})'


def value(estimate: Estimate) -> str:
    """Return an estimate, or its upper limit."""
    return f'{estimate.value:.3g}' if estimate.is_seen else f'< {estimate.high:.3g}'


def paste_lines(result: RecordingNoise) -> list[str]:
    """Return the settings of other programs, ready to paste."""
    lines = []
    for program, entries in settings(result.axes, result.rest.rate_hz).items():
        lines.append(f'# {program}')
        for setting in entries:
            lines += setting.lines()
    return lines


def comments(result: RecordingNoise) -> list[str]:
    """Return the comments of the parameter file."""
    return [f'Noise measured in {duration(result.rest.span_s)} at rest of {result.path}.',
            'Density: over positive frequencies, as datasheets state it.',
            *tables(result)]


def warnings(result: RecordingNoise) -> list[str]:
    """Return what limits the result, and what to do about it."""
    rest, texts = result.rest, []
    if rest.motion_s:
        texts.append(f'{_motion(rest)} Used is the longest rest, {duration(rest.span_s)} of '
                     f'{duration(rest.recorded_s)}. Record again without touching the sensor.')
    if rest.filled > _LARGEST_FILLED * rest.count:
        texts.append(f'{rest.filled} samples ({100 * rest.filled / rest.count:.2g} %) are '
                     'missing. They are filled by straight lines, which lowers N.')
    texts += _too_short(result)
    for noise in result.axes:
        if noise.drift is not None:
            texts.append(_drift_text(rest, noise, noise.drift))
        else:
            texts += _unexplained(noise)
        if noise.is_coarse:
            texts.append(f'{noise.axis}: samples change in steps of '
                         f'{noise.resolution * MICRO_G:.3g} µg, which hide the noise. N, B and K '
                         'are upper limits. Choose a smaller range.')
        if not noise.fit.white.is_seen:
            texts.append(f'{noise.axis}: N is not determined. A parameter file keeps the figure '
                         'of --params, or states no white noise.')
        if noise.sample_std > _LARGEST_STD_MPS2:
            texts.append(f'{noise.axis}: one sample has a noise of {noise.sample_std:.2g} m/s², '
                         f'expected less than {_LARGEST_STD_MPS2:g}. The sensor seems to '
                         'vibrate.')
    return texts


def _motion(rest: StillStretch) -> str:
    """Return when the sensor moves."""
    first = rest.motion_s[0]
    others = len(rest.motion_s) - 1
    repeated = {0: '', 1: ' and once again'}.get(others, f' and at {others} further times')
    return f'not still or interrupted from {first[0]:.5g} s to {first[1]:.5g} s{repeated}.'


def _too_short(result: RecordingNoise) -> list[str]:
    """Return which terms the time does not show, and how long it must be."""
    texts = []
    for name in TERMS:
        needed_s = {noise.axis: noise.needed_s[name] for noise in result.axes
                    if name in noise.needed_s}
        if needed_s:
            longest_s = max(needed_s.values())
            further = 'To see half of the limit above, record about ' \
                f'{duration(_two_digits(longest_s))}.' if np.isfinite(longest_s) else \
                'The other terms hide it, in longer recordings, too.'
            texts.append(f'{duration(result.rest.span_s)} is too short to see the {NAMES[name]} '
                         f'of {", ".join(needed_s)}. {further}')
    return texts


def _two_digits(seconds: float) -> float:
    """Round a time to two digits of its unit."""
    unit_s = next((unit_s for unit_s in (86400.0, 3600.0, 60.0) if seconds >= 2 * unit_s), 1.0)
    return float(f'{seconds / unit_s:.2g}') * unit_s


def _unexplained(noise: AxisNoise) -> list[str]:
    """Return at which frequencies N, B and K do not describe the noise."""
    texts = []
    octaves = [octave for octave in noise.fit.octaves
               if abs(np.log(octave.ratio)) > np.log(_LARGEST_RATIO)]
    for is_excess, advice in ((True, 'Look for a fan, mains or a person nearby.'),
                              (False, 'The noise is none of these three there.')):
        part = [octave for octave in octaves if (octave.ratio > 1) == is_excess]
        if part:
            ratio = max(part, key=lambda octave: abs(np.log(octave.ratio))).ratio
            texts.append(f'{noise.axis}: from {part[0].low_hz:.3g} to {part[-1].high_hz:.3g} Hz '
                         f'the power is {"up" if is_excess else "down"} to {ratio:.2g} times that '
                         f'of N, B and K. {advice}')
    return texts


def _micro_or_milli_g(size_mps2: float, unit: str) -> str:
    """Return a drift with its sign in µg or mg."""
    size = size_mps2 * MICRO_G
    return f'{size:+.3g} µg{unit}' if abs(size) < 1000 else f'{size / 1000:+.3g} mg{unit}'


def _drift_text(rest: StillStretch, noise: AxisNoise, drift: Drift) -> str:
    """Return what the axis follows, and the random walk without it."""
    if drift.kind is DriftKind.TEMPERATURE:
        assert rest.temperature_c is not None
        text = (f'follows the temperature by {_micro_or_milli_g(drift.size, "/K")} '
                f'({np.ptp(rest.temperature_c):.2g} K in all)')
    elif drift.kind is DriftKind.TREND:
        text = f'drifts by {_micro_or_milli_g(3600 * drift.size, "/h")} throughout'
    else:
        at_s = rest.start_s + drift.cell * rest.step_s
        text = f'has a step of {_micro_or_milli_g(drift.size, "")} at {at_s:.6g} s'
    without = [interval(estimate.scaled(MICRO_G))
               for estimate in (drift.without.instability, drift.without.walk)]
    return (f'{noise.axis}: {text}. B and K contain this drift. Without it B is {without[0]} µg, '
            f'and K is {without[1]} µg/√s.')


def as_json(result: RecordingNoise) -> dict[str, Any]:
    """Return the result for programs, in SI units."""
    return {
        'schema': 1,
        'recording': result.path,
        'rate_hz': result.rest.rate_hz,
        'samples': result.rest.count,
        'filled_samples': result.rest.filled,
        'rest_s': [result.rest.start_s, result.rest.stop_s],
        'recorded_s': result.rest.recorded_s,
        'axes': {noise.axis: _axis_json(noise) for noise in result.axes},
        'allan_deviation': {
            'tau_s': result.rest.allan.tau_s.tolist(),
            **{noise.axis: result.rest.allan.deviation[:, i].tolist()
               for i, noise in enumerate(result.axes)}},
        'settings': {program: {setting.name: setting.values[0] if len(setting.values) == 1
                               else list(setting.values) for setting in entries}
                     for program, entries in settings(result.axes, result.rest.rate_hz).items()},
        'warnings': warnings(result),
    }


def _axis_json(noise: AxisNoise) -> dict[str, Any]:
    """Return the noise of an axis for programs."""
    terms = {name: {'value': estimate.value if estimate.is_seen else None,
                    'ci': [estimate.low, estimate.high], 'unit': _UNITS[name]}
             for name, estimate in zip(TERMS, noise.estimates)}
    time_s = noise.fit.correlation
    return {**terms, 'correlation_s': time_s and {'value': time_s.value,
                                                  'ci': [time_s.low, time_s.high]},
            'rounding': noise.rounding, 'density_g_per_rthz': density_g_per_rthz(noise),
            'sample_std_mps2': noise.sample_std, 'resolution_mps2': noise.resolution,
            'lowest': {'tau_s': noise.lowest_s, 'deviation_mps2': noise.lowest},
            'fitted_below_hz': noise.fit.highest_hz}
