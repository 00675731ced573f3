# SPDX-License-Identifier: Apache-2.0

"""Noise of the front door: white noise, bias instability and random walk of a sensor at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.api.recordings import one_recording, RecordingInput
from adxl_ros.api.result import as_json, FirstScreen, no_progress, Progress, Result
from adxl_ros.api.sensors import as_input, SensorInput
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording as recording_files
from adxl_ros.files.atomic_write import make_folder, require_own, write_bytes
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.figures import axes_for, AXIS_COLOURS, new_figure, png
from adxl_ros.report.quantities import duration
from adxl_ros.report.screen import row
from adxl_ros.signals import noise_parameters
from adxl_ros.signals.allan_deviation import StillStretch
from adxl_ros.signals.noise_parameters import AxisNoise, RecordingNoise, settings
import numpy as np
import yaml

PLOT = 'allan.png'  # Name of the curve in the folder of a report
TABLE = 'allan.csv'  # Name of its table
BLOCK_ROWS = 65536  # Samples that are read at a time (chosen: some MB)
MICRO_G = 1e6 / G0_MPS2  # 1 m/s² in µg
_NAMES = ('white noise N', 'bias instability B', 'random walk K')  # Names of the terms
_FIELDS = ('white', 'instability', 'walk')  # Their fields in `NoiseFit`


class _Unit(NamedTuple):
    """The units of a sensor's readings."""

    symbol: str  # Unit of the files, as the samples have it
    small: str  # Unit for people
    factor: float  # How many of the latter are one of the former
    column: str  # Unit at the end of a column's name


_ACCEL = _Unit('m/s²', 'µg', MICRO_G, 'mps2')
_GYRO = _Unit('rad/s', 'm°/s', float(np.degrees(1e3)), 'radps')


class _Shown(NamedTuple):
    """One sensor at rest."""

    name: str
    rest: StillStretch
    axes: Sequence[AxisNoise]
    unit: _Unit


def _sensors(result: RecordingNoise) -> list[_Shown]:
    """Return the accelerometer, and the gyroscope if there is one."""
    shown = [_Shown('accelerometer', result.rest, result.axes, _ACCEL)]
    if result.gyro_rest is not None:
        shown.append(_Shown('gyroscope', result.gyro_rest, result.gyro, _GYRO))
    return shown


_YAML_COLUMNS = 60  # Columns after which a list is wrapped; its last number may be beyond


def _head(result: RecordingNoise) -> list[str]:
    rest, axes = result.rest, ' '.join(noise.axis for noise in result.axes)
    return [result.path, f'{duration(rest.span_s)} at rest, {rest.rate_hz:.5g} Hz, axes {axes}']


def _tables(result: RecordingNoise) -> list[str]:
    """Return the tables of each sensor."""
    rows: list[str] = []
    for shown in _sensors(result):
        if result.gyro:
            rows += [*[''] * bool(rows), shown.name]
        rows += _table(shown)
    return rows


def _table(shown: _Shown) -> list[str]:
    """Return the terms with intervals, then in SI units and by sample, 79 columns at most."""
    wide, narrow = (6, 25, 25, 25), (6, 12, 12, 12, 13, 13, 9)
    si, small = shown.unit.symbol, shown.unit.small
    rows = [
        row((' axis', *_NAMES), wide),
        row(('', f'{small}/√Hz (90 %)', f'{small} (90 %)', f'{small}/√s (90 %)'), wide),
        *(row((f' {noise.axis}', *_intervals(noise, shown.unit)), wide) for noise in shown.axes),
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


def _walk_lines(shown: _Shown) -> list[str]:
    """Return the bounds of the walks."""
    rows = []
    for noise in shown.axes:
        time_s, k = noise.fit.bound_s, shown.unit.factor * noise.fit.walk.value
        if np.isfinite(time_s):
            rows.append(
                f' {noise.axis}: the walk has bounds, {k * np.sqrt(time_s / 2):.3g} '
                f'{shown.unit.small} rms; correlation time {time_s:.3g} s'
            )
    return rows


def _intervals(noise: AxisNoise, unit: _Unit) -> list[str]:
    """Return the estimates with their intervals, or their upper limits."""
    return [
        f'{e.value:.3g} ({e.low:.3g} to {e.high:.3g})' if e.is_seen else f'below {e.high:.3g}'
        for e in (estimate.scaled(unit.factor) for estimate in noise.estimates)
    ]


def _paste_lines(result: RecordingNoise) -> list[str]:
    """Return the settings of other programs in YAML, ready to paste."""
    lines = []
    for program, entries in settings(result.axes, result.rest.rate_hz, result.gyro).items():
        lines.append(f'# {program}')
        for name, values, unit in entries:
            if isinstance(values, str):
                lines += [f'# {unit}', f'{name}: {values}']
                continue
            rounded = [float(f'{value:.{6 if value >= 1 else 3}g}') for value in values]
            is_one = len(rounded) == 1
            lines += [
                f'# {unit}',
                *yaml.safe_dump(
                    {name: rounded[0] if is_one else rounded},
                    width=_YAML_COLUMNS,
                    default_flow_style=False if is_one else None,
                ).splitlines(),
            ]
    return lines


def _warnings(result: RecordingNoise) -> list[str]:
    rest, texts = result.rest, [*result.doubts]
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
    for shown in _sensors(result):
        # The accelerometer is meant where no sensor is named.
        begin = 'gyroscope ' * (shown.unit is _GYRO)
        texts += [
            f'{begin}{noise.axis}: {text}'
            for noise in shown.axes
            for text in _axis_warnings(rest.span_s, noise, shown.unit)
        ]
    return texts


def _filter_warning(stated: Sensor, fresh: Sensor) -> list[str]:
    """Say that the noise refutes the stated filter, and what the file states in its place."""
    if 'rc_capacitance_f' in stated.unstated or fresh.rc_s == stated.rc_s:
        return []
    found = f'a filter of {fresh.rc_s * 1e3:.3g} ms' if fresh.rc_s else 'no filter'
    return [
        f'the noise at {fresh.rate_hz:.5g} Hz shows {found}, not the stated one of '
        f'{stated.rc_s * 1e3:.3g} ms. The new file states what the noise shows.'
    ]


def _axis_warnings(span_s: float, noise: AxisNoise, unit: _Unit) -> list[str]:
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
            'which hide '
            'the noise. N, B and K are upper limits. Choose a smaller range.'
        )
    if not noise.fit.white.is_seen:
        texts.append(
            'N is not determined. A parameter file keeps the figure of --params, or '
            'states no white noise.'
        )
    return texts


@dataclass(frozen=True, repr=False)
class Noise(Result):
    """
    The noise of a sensor in the longest rest of a recording.

    `print` shows the screen of the tool `noise`. Other verbs take it in place of the sensor.
    """

    axes: tuple[AxisNoise, ...]
    """By axis: `fit.white` N, m/s²/√Hz; `fit.instability` B, m/s²; `fit.walk` K, m/s²/√s, each
    with `value`, `low` and `high` of its 90 % interval; `sample_std` and `resolution`, m/s². N²
    is the density over positive and negative frequencies."""
    span_s: float
    """Time at rest, s."""
    rate_hz: float
    """Sample rate by the stamps, Hz."""
    tau_s: np.ndarray
    """Averaging times of the Allan deviation, s, (k,)."""
    allan_deviation_mps2: np.ndarray
    """Allan deviation of each axis, m/s², (k, m)."""
    gyro: tuple[AxisNoise, ...]
    """The gyroscope by axis, as `axes` in rad/s; empty without one."""
    gyro_allan_deviation_radps: np.ndarray
    """Allan deviation of the gyroscope at `tau_s`, rad/s, (k, 3); (k, 0) without one."""
    warnings: tuple[str, ...]
    """What is not seen, what hides it, and how long to record."""
    result: RecordingNoise
    """All steps between the samples and the noise."""

    @cached_property
    def sensor(self) -> Sensor:
        """Return the sensor of the parameter file with the measured noise."""
        stated, name = _sensor(self.result), Path(self.result.path).name
        fresh = noise_parameters.with_noise(stated, self.result.axes, self.result.rest)
        return replace(
            fresh,
            gyro=noise_parameters.with_gyro_noise(stated.gyro, self.gyro),
            provenance={**fresh.provenance, 'noise_from': name, 'rate_from': name},
        )

    @property
    def refuted_filter(self) -> list[str]:
        """Return that the noise refutes the stated filter, one line; none where it does not."""
        return _filter_warning(_sensor(self.result), self.sensor)

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        warnings = [f'WARNING {text}' for text in self.warnings]
        return [
            *_head(self.result),
            '',
            *_tables(self.result),
            '',
            *_paste_lines(self.result),
            '',
            *warnings,
            *[''] * bool(warnings),
        ]

    @property
    def first_screen(self) -> FirstScreen:
        """Return what a notebook shows."""
        tiles = [
            (
                f'white noise, {shown.name} {noise.axis}',
                f'{_intervals(noise, shown.unit)[0]} {shown.unit.small}/√Hz',
            )
            for shown in _sensors(self.result)
            for noise in shown.axes
        ]
        return FirstScreen(
            'amber' if self.warnings else 'green', 'Noise', _head(self.result)[1], tiles
        )

    def save(self, path: str | os.PathLike, *, overwrite: bool = False) -> None:
        """
        Write a parameter file with the measured noise.

        overwrite: whether a file is replaced that this package did not write, or that was
        changed since.
        """
        require_own(path, overwrite)
        parameter_file.save(
            path,
            self.sensor,
            [
                f'Noise measured in {duration(self.span_s)} at rest of {self.result.path}.',
                'Density: over positive frequencies, as datasheets state it.',
                *_tables(self.result),
            ],
        )

    def report(self, folder: str | os.PathLike, *, overwrite: bool = False) -> Path:
        """
        Write the curve into a folder, allan.png and allan.csv, and return the path of the former.

        overwrite: as `save`.
        """
        for name in (PLOT, TABLE):
            require_own(Path(folder) / name, overwrite)
        path = make_folder(folder)
        write_bytes(path / PLOT, png(_plot(self.result)))
        with csv_writer(path / TABLE) as append:
            append(self.curve())
        return path / PLOT

    def curve(self) -> dict[str, np.ndarray]:
        """
        Return the Allan deviation as columns, (k,) each.

        By averaging time `tau_s`: relative standard deviation of a point, then by axis what was
        measured and what is fitted, m/s² and rad/s.
        """
        columns = {
            'tau_s': self.tau_s,
            'relative_std': self.result.rest.allan.relative_error,
        }
        for shown in _sensors(self.result):
            for noise, deviation in zip(shown.axes, shown.rest.allan.deviation.T):
                name = f'{"g" if shown.unit is _GYRO else "a"}{noise.axis}'
                columns[f'{name}_{shown.unit.column}'] = deviation
                columns[f'{name}_fitted_{shown.unit.column}'] = noise.fit.allan_deviation(
                    self.tau_s
                )
        return columns

    def to_dict(self) -> dict[str, Any]:
        """Return terms with their intervals, m/s², rad/s and s; what is not finite is None."""
        sensors = [
            {
                noise.axis: {
                    name: estimate._asdict() for name, estimate in zip(_FIELDS, noise.estimates)
                }
                for noise in each
            }
            for each in (self.axes, self.gyro)
        ]
        axes, gyro = sensors
        return as_json(
            {
                'schema': 1,
                'recording': self.result.path,
                'span_s': self.span_s,
                'rate_hz': self.rate_hz,
                'warnings': self.warnings,
                'axes': axes,
                'gyroscope': gyro,
                'allan_deviation': self.curve(),
            }
        )

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each sensor, axis and term: value, 90 % interval."""
        from pandas import DataFrame

        rows = []
        for shown in _sensors(self.result):
            for noise in shown.axes:
                for name, estimate in zip(_FIELDS, noise.estimates):
                    rows.append((shown.name, noise.axis, name, *estimate))
        return DataFrame(rows, columns=['sensor', 'axis', 'term', 'value', 'low', 'high'])

    def plot(self, ax: Any = None) -> Any:
        """Draw the accelerometer's Allan deviations, µg, and fits, into axes of matplotlib."""
        ax = axes_for(ax)
        for number, noise in enumerate(self.axes):
            _draw(ax, _sensors(self.result)[0], number, noise.axis)
        ax.set_ylabel('Allan deviation, µg')
        return ax


def noise(
    recording: RecordingInput | Callable[[], Iterable[Recording]],
    sensor: SensorInput | None = None,
    *,
    progress: Progress = no_progress,
) -> Noise:
    """
    Find the noise of a sensor that rests.

    Parameters
    ----------
    recording
        The recording, a DataFrame or a path; or a function that yields its blocks, for one that
        is larger than the memory. The longest rest in it is used.
    sensor
        The other values of the sensor: a Sensor, a datasheet's name or the path of a parameter
        file. None for the nominal sensor, or any IMU.
    progress
        Called with the share of the work that is done, 0 to 1, and the name of the stage.

    Returns
    -------
    Noise
        White noise, bias instability and random walk by axis, with 90 % intervals.

    Raises
    ------
    UserError
        The rest is too short.

    """
    read: Callable[[], Iterable[Recording]]
    if isinstance(recording, (str, os.PathLike)):
        read = partial(recording_files.blocks, recording, BLOCK_ROWS)
    elif callable(recording):
        read = recording
    else:
        read = partial(iter, [one_recording(recording)])

    result = noise_parameters.recording_noise(
        read, as_input(sensor), lambda done: progress(done, 'fit')
    )
    rest = result.rest
    return Noise(
        tuple(result.axes),
        rest.span_s,
        rest.rate_hz,
        rest.allan.tau_s,
        rest.allan.deviation,
        tuple(result.gyro),
        result.gyro_rest.allan.deviation
        if result.gyro_rest
        else np.zeros((len(rest.allan.tau_s), 0)),
        tuple(_warnings(result)),
        result,
    )


_INCHES = (5.0, 4.4)
"""Width and height of the plot of an axis, inches. Chosen: three fit beside each other."""


def _plot(result: RecordingNoise) -> Any:
    """Draw the axes of each sensor beside each other."""
    sensors = _sensors(result)
    most = max(len(shown.axes) for shown in sensors)
    figure = new_figure(figsize=(_INCHES[0] * most, _INCHES[1] * len(sensors)))
    rows = figure.subplots(len(sensors), most, squeeze=False, sharey='row')
    for shown, plots in zip(sensors, rows):
        for number, (noise, plot) in enumerate(zip(shown.axes, plots)):
            _draw(plot, shown, number, 'measured')
            plot.set_title(
                f'axis {noise.axis}' if not result.gyro else f'{shown.name} {noise.axis}'
            )
        for plot in plots[len(shown.axes) :]:
            plot.set_visible(False)
        plots[0].set_ylabel(f'Allan deviation, {shown.unit.small}')
    return figure


def _draw(plot: Any, shown: _Shown, number: int, label: str) -> None:
    """Draw the Allan deviation of an axis with the terms that are seen."""
    allan, noise, factor = shown.rest.allan, shown.axes[number], shown.unit.factor
    tau_s, measured = allan.tau_s, allan.deviation[:, number] * factor
    plot.errorbar(
        tau_s,
        measured,
        yerr=measured * allan.relative_error.clip(max=0.9),
        fmt='o',
        ms=4,
        color=AXIS_COLOURS[noise.axis],
        label=label,
    )
    for name, line, estimate in zip(_NAMES, noise.fit.lines(tau_s), noise.estimates):
        if estimate.is_seen:
            plot.plot(tau_s, line * factor, '--', lw=1, label=name)
    plot.plot(
        tau_s, noise.fit.allan_deviation(tau_s) * factor, color='#222', lw=1, label='all three'
    )
    plot.set(
        xscale='log',
        yscale='log',
        xlabel='averaging time τ, s',
        ylim=(measured.min() / 3, measured.max() * 2),
    )
    plot.grid(True, which='both', alpha=0.3)
    plot.legend(fontsize=8)


def _sensor(result: RecordingNoise) -> Sensor:
    """Return the sensor of the parameter file, with the axes and rate of the recording."""
    sensor, unit = result.sensor, result.nominal
    if sensor.effects and sensor.axes != unit.axes:
        raise UserError(
            f'{result.path}: has the axes {unit.axes}, but the parameters of '
            f'{sensor.serial} are for {sensor.axes}; name the parameter file of this '
            'sensor'
        )
    return replace(
        sensor if sensor.effects else unit,
        serial=unit.serial,
        rate_hz=round(result.rest.rate_hz, 6),
    )
