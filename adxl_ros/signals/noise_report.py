# SPDX-License-Identifier: Apache-2.0

"""The noise of a sensor for people: tables, settings of other programs, warnings, curves."""

from __future__ import annotations

from collections.abc import Sequence
import csv
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.files.parameter_file import float_text
from adxl_ros.model.constants import G0_MPS2, TINY
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.figures import AXIS_COLOURS, new_figure
from adxl_ros.report.quantities import duration
from adxl_ros.report.screen import row
from adxl_ros.signals.allan_deviation import StillStretch
from adxl_ros.signals.noise_parameters import AxisNoise, RecordingNoise
from adxl_ros.signals.reading_units import AXIS_UNITS
from adxl_ros.wording import option
import numpy as np
import yaml

_MICRO_G = 1e6 / G0_MPS2  # 1 m/s² in µg
_NAMES = ('white noise N', 'bias instability B', 'random walk K')  # Names of the terms
TERMS = ('white', 'instability', 'walk')  # Their fields in `NoiseFit`
_SAME_NOISE = float(np.log(1.6))
"""Logarithm of the ratio of the noise of two axes in one unit. Chosen: datasheets state up to 1.5
for z, and the ratio of g and m/s² is far above its square."""
_LEVEL_G = 0.5  # Largest reading of an axis whose unit gravity does not show, g: 30° of tilt
_YAML_COLUMNS = 60  # Columns after which a list is wrapped; its last number may be beyond
_PX4_HZ = 100.0  # Rate of the filter of PX4, Hz: EKF2_PREDICT_US is 10 000
_INCHES = (5.0, 4.4)
"""Width and height of the plot of an axis, inches. Chosen: three fit beside each other."""


class _ReadingUnits(NamedTuple):
    """The units of a sensor's readings."""

    symbol: str  # Unit of the files, as the samples have it
    small: str  # Unit for people
    factor: float  # How many of the latter are one of the former
    column: str  # Unit at the end of a column's name
    letter: str  # Begin of that name


_ACCEL = _ReadingUnits('m/s²', 'µg', _MICRO_G, 'mps2', 'a')
_GYRO = _ReadingUnits('rad/s', 'm°/s', float(np.degrees(1e3)), 'radps', 'g')


class SensorAtRest(NamedTuple):
    """One sensor at rest."""

    name: str
    rest: StillStretch
    axes: Sequence[AxisNoise]
    unit: _ReadingUnits


def sensors_at_rest(result: RecordingNoise) -> list[SensorAtRest]:
    """Return the accelerometer, and the gyroscope if there is one."""
    shown = [SensorAtRest('accelerometer', result.rest, result.axes, _ACCEL)]
    if result.gyro_rest is not None:
        shown.append(SensorAtRest('gyroscope', result.gyro_rest, result.gyro, _GYRO))
    return shown


def head(result: RecordingNoise) -> list[str]:
    """Return the recording, and how long it rests."""
    rest = result.rest
    axes = ' '.join(noise.axis for noise in result.axes)
    return [result.path, f'{duration(rest.span_s)} at rest, {rest.rate_hz:.5g} Hz, axes {axes}']


def tables(result: RecordingNoise) -> list[str]:
    """Return the tables of each sensor."""
    rows: list[str] = []
    for shown in sensors_at_rest(result):
        if result.gyro:
            rows += ['', shown.name] if rows else [shown.name]
        rows += _table(shown)
    return rows


def _table(shown: SensorAtRest) -> list[str]:
    """Return the terms with intervals, then in SI units and by sample, 79 columns at most."""
    wide = (6, 25, 25, 25)
    narrow = (6, 12, 12, 12, 13, 13, 9)
    si = shown.unit.symbol
    small = shown.unit.small
    rows = [
        row((' axis', *_NAMES), wide),
        row(('', f'{small}/√Hz (90 %)', f'{small} (90 %)', f'{small}/√s (90 %)'), wide),
        *(row((f' {noise.axis}', *intervals(noise, shown.unit)), wide) for noise in shown.axes),
        *_walk_lines(shown),
        '',
        row(('', 'N', 'B', 'K', 'N by sample', 'K by sample', 'datasheet'), narrow),
        row((' axis', f'{si}/√Hz', si, f'{si}/√s', si, si, f'{small}/√Hz'), narrow),
    ]
    rate = np.sqrt(shown.rest.rate_hz)
    for noise in shown.axes:
        white, _, walk = noise.estimates
        estimates = (
            *noise.estimates,
            white.scaled(rate),
            walk.scaled(1 / rate),
            white.scaled(ONE_SIDED * shown.unit.factor),
        )
        rows.append(
            row(
                (
                    f' {noise.axis}',
                    *(f'{e.value:.3g}' if e.is_seen else f'< {e.high:.3g}' for e in estimates),
                ),
                narrow,
            )
        )
    return rows


def _walk_lines(shown: SensorAtRest) -> list[str]:
    """Return the bounds of the walks."""
    rows = []
    for noise in shown.axes:
        time_s = noise.fit.bound_s
        k = shown.unit.factor * noise.fit.walk.value
        if np.isfinite(time_s):
            rows.append(
                f' {noise.axis}: the walk has bounds, {k * np.sqrt(time_s / 2):.3g} '
                f'{shown.unit.small} rms; correlation time {time_s:.3g} s'
            )
    return rows


def intervals(noise: AxisNoise, unit: _ReadingUnits) -> list[str]:
    """Return the estimates with their intervals, or their upper limits."""
    return [
        f'{e.value:.3g} ({e.low:.3g} to {e.high:.3g})' if e.is_seen else f'below {e.high:.3g}'
        for e in (estimate.scaled(unit.factor) for estimate in noise.estimates)
    ]


class _Figure(NamedTuple):
    """A figure of a sensor for programs that have one value for all axes."""

    values: list[float]  # One, or the rows of a matrix
    note: str = ''  # That it is an upper limit, for people


def _figures(noises: Sequence[AxisNoise], rate_hz: float) -> dict[str, _Figure]:
    """Return N, u/√Hz, and K, u/√s, of the loudest axis, and the variances of a sample, u²."""
    loudest = max(noises, key=lambda noise: noise.sample_white)
    walk = max((noise.fit.walk for noise in noises), key=lambda walk: walk.value)
    k = walk.value if walk.is_seen else max(noise.fit.walk.high for noise in noises)
    variances = [noise.sample_std**2 for noise in noises]
    limit = ', an upper limit'
    return {
        'white': _Figure([loudest.sample_white], '' if loudest.fit.white.is_seen else limit),
        'walk': _Figure([k], '' if walk.is_seen else limit),
        'matrix': _Figure(np.diag((variances + [UNMEASURED_VARIANCE] * 3)[:3]).ravel().tolist()),
        'rate': _Figure([rate_hz]),
    }


def paste_lines(result: RecordingNoise) -> list[str]:
    """
    Return the settings of other programs in YAML, ready to paste.

    program_settings.csv has them. kalibr takes N and K as they are. VINS-Fusion and PX4 add the
    variance of a value times the square of the time step, so they take N·√rate and K·√rate, at
    the rate of their filter. robot_localization takes the variance of a sample from the message.
    Programs that have one value for all axes get the largest one. A term that is not seen is its
    upper limit.
    """
    rate_hz = result.rest.rate_hz
    sensors = {'acc': _figures(result.axes, rate_hz)}
    if result.gyro:
        sensors['gyr'] = _figures(result.gyro, rate_hz)
    factors = {'': 1.0, 'samples': rate_hz**0.5, 'PX4': _PX4_HZ**0.5}
    text = Path(__file__).with_name('program_settings.csv').read_text(encoding='utf-8')
    lines = []
    program = ''
    for stated in csv.DictReader(text.splitlines()):
        if stated['sensor'] not in sensors:
            continue
        if stated['program'] != program:
            program = stated['program']
            lines.append(f'# {program.format(rate_hz=rate_hz)}')
        if not stated['figure']:
            lines += [f'# {stated["unit"]}', stated['setting']]
            continue
        figure = sensors[stated['sensor']][stated['figure']]
        values = [factors[stated['filter']] * value for value in figure.values]
        lines += [f'# {stated["unit"]}{figure.note}', *_yaml_lines(stated['setting'], values)]
    return lines


def _yaml_lines(name: str, values: Sequence[float]) -> list[str]:
    """Return a number, or a list of several, as lines of YAML."""
    rounded = [float(f'{value:.{6 if value >= 1 else 3}g}') for value in values]
    if len(rounded) == 1:
        return [f'{name}: {float_text(rounded[0])}']
    entry = yaml.safe_dump({name: rounded}, width=_YAML_COLUMNS, default_flow_style=None)
    return entry.splitlines()


def warnings(result: RecordingNoise) -> list[str]:
    """Return what is wrong with the rest, what it does not show, and how long to record."""
    rest = result.rest
    texts = [*result.doubts]
    if rest.beyond_range:
        texts.append(f'{rest.beyond_range}.')
    if rest.motion_s:
        begin_s, end_s = rest.motion_s[0][:2]
        texts.append(
            f'not still or interrupted {len(rest.motion_s)} times, first from '
            f'{begin_s:.5g} s to {end_s:.5g} s. Used is the longest rest, '
            f'{duration(rest.span_s)} of {duration(rest.recorded_s)}. Record again '
            'without touching the sensor.'
        )
    for shown in sensors_at_rest(result):
        # The accelerometer is meant where no sensor is named.
        begin = f'{shown.name} ' if shown.unit is _GYRO else ''
        for noise in shown.axes:
            warnings = _axis_warnings(rest.span_s, noise, shown.unit)
            texts += [f'{begin}{noise.axis}: {text}' for text in warnings]
    return texts + _unit_warnings(result)


def _unit_warnings(result: RecordingNoise) -> list[str]:
    """Say which axes may be in another unit than the one that reads gravity, by their noise."""
    means_mps2 = result.rest.means.mean(axis=0)
    upright = result.axes[int(np.argmin(np.abs(np.abs(means_mps2) - G0_MPS2)))]
    texts = []
    for noise, mean_mps2 in zip(result.axes, means_mps2):
        ratio = noise.sample_std / max(upright.sample_std, TINY)
        for unit in AXIS_UNITS:
            factor = unit.gravity / G0_MPS2
            is_near = abs(np.log(max(ratio, TINY) / factor)) < _SAME_NOISE
            # Gravity along the axis would show its unit.
            if is_near and abs(mean_mps2) < _LEVEL_G * unit.gravity:
                n = _MICRO_G * noise.sample_white
                other_n = _MICRO_G * upright.sample_white
                texts.append(
                    f'{noise.axis}: N is {n:.3g} µg/√Hz, {ratio:.3g} times that of {upright.axis} '
                    f'({other_n:.3g}), as if it were in {unit.name}; gravity, which is along '
                    f'{upright.axis}, does not show the unit of {noise.axis}: if it is another, '
                    f'state it by {option("columns")}'
                )
    return texts


def filter_warning(stated: Sensor, fresh: Sensor) -> list[str]:
    """Say that the noise refutes the stated filter, and what the file states in its place."""
    if 'rc_capacitance_f' in stated.unstated or fresh.rc_s == stated.rc_s:
        return []
    found = f'a filter of {fresh.rc_s * 1e3:.3g} ms' if fresh.rc_s else 'no filter'
    return [
        f'the noise at {fresh.rate_hz:.5g} Hz shows {found}, not the stated one of '
        f'{stated.rc_s * 1e3:.3g} ms. The new file states what the noise shows.'
    ]


def _axis_warnings(span_s: float, noise: AxisNoise, unit: _ReadingUnits) -> list[str]:
    """Return what an axis does not show, and what to do, one text each."""
    texts = []
    for term, name in enumerate(_NAMES):
        if not (noise.estimates[term].is_seen or noise.is_coarse):
            needed_s = noise.fit.needed_s(term)
            texts.append(
                f'{duration(span_s)} is too short to see the {name}. '
                + (
                    'The other terms hide it, in longer recordings, too.'
                    if np.isinf(needed_s)
                    else f'To see half of the limit above, record about {duration(needed_s)}.'
                )
            )
    if noise.is_coarse:
        texts.append(
            f'samples change in steps of {noise.resolution * unit.factor:.3g} {unit.small}, '
            'which hide the noise. N, B and K are upper limits. Choose a smaller range.'
        )
    if not noise.fit.white.is_seen:
        texts.append(
            f'N is not determined. A parameter file keeps the figure of {option("sensor")}, or '
            'states no white noise.'
        )
    return texts


def curves(result: RecordingNoise) -> Any:
    """Draw the axes of each sensor beside each other."""
    sensors = sensors_at_rest(result)
    most = max(len(shown.axes) for shown in sensors)
    figure = new_figure(figsize=(_INCHES[0] * most, _INCHES[1] * len(sensors)))
    rows = figure.subplots(len(sensors), most, squeeze=False, sharey='row')
    for shown, plots in zip(sensors, rows):
        name = shown.name if result.gyro else 'axis'
        for number, (noise, plot) in enumerate(zip(shown.axes, plots)):
            draw(plot, shown, number, 'measured')
            _draw_terms(plot, shown, number)
            plot.legend(fontsize=8)
            plot.set_title(f'{name} {noise.axis}')
        for unused in plots[len(shown.axes) :]:
            unused.set_visible(False)
        plots[0].set_ylabel(f'Allan deviation, {shown.unit.small}')
    return figure


def _draw_terms(plot: Any, shown: SensorAtRest, number: int) -> None:
    """Draw the terms of an axis that are seen, and their sum."""
    tau_s = shown.rest.allan.tau_s
    noise = shown.axes[number]
    factor = shown.unit.factor
    for name, line, estimate in zip(_NAMES, noise.fit.lines(tau_s), noise.estimates):
        if estimate.is_seen:
            plot.plot(tau_s, line * factor, '--', lw=1, label=name)
    draw_sum(plot, shown, number, color='#222', label='all three')


def draw_sum(plot: Any, shown: SensorAtRest, number: int, **looks: str) -> None:
    """Draw the Allan deviation that the terms of an axis have together."""
    tau_s = shown.rest.allan.tau_s
    noise = shown.axes[number]
    plot.plot(tau_s, noise.fit.allan_deviation(tau_s) * shown.unit.factor, lw=1, **looks)


def draw(plot: Any, shown: SensorAtRest, number: int, label: str) -> None:
    """Draw the Allan deviation of an axis; the plot has room for those of all axes."""
    allan = shown.rest.allan
    measured = allan.deviation * shown.unit.factor
    of_axis = measured[:, number]
    plot.errorbar(
        allan.tau_s,
        of_axis,
        yerr=of_axis * allan.relative_error.clip(max=0.9),
        fmt='o',
        ms=4,
        color=AXIS_COLOURS[shown.axes[number].axis],
        label=label,
    )
    plot.set(
        xscale='log',
        yscale='log',
        xlabel='averaging time τ, s',
        ylim=(measured.min() / 3, measured.max() * 2),
    )
    plot.grid(True, which='both', alpha=0.3)
