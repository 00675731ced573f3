# SPDX-License-Identifier: Apache-2.0

"""Noise of the front door: white noise, bias instability and random walk of a sensor at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property, partial
import os
from pathlib import Path
from typing import Any

from adxl_ros.api.recordings import one_recording, RecordingInput
from adxl_ros.api.result import as_json, FirstScreen, no_progress, Progress, Result
from adxl_ros.api.sensors import as_input, SensorInput
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording as recording_files
from adxl_ros.files.atomic_write import make_folder, require_own, write_bytes
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.figures import axes_for, AXIS_COLOURS, new_figure, png
from adxl_ros.report.quantities import duration
from adxl_ros.report.screen import row
from adxl_ros.signals import noise_parameters
from adxl_ros.signals.noise_parameters import AxisNoise, RecordingNoise, settings
import numpy as np
import yaml

PLOT = 'allan.png'  # Name of the curve in the folder of a report
BLOCK_ROWS = 65536  # Samples that are read at a time (chosen: some MB)
MICRO_G = 1e6 / G0_MPS2  # 1 m/s² in µg
_NAMES = ('white noise N', 'bias instability B', 'random walk K')  # Names of the terms
_FIELDS = ('white', 'instability', 'walk')  # Their fields in `NoiseFit`
_YAML_COLUMNS = 60  # Columns after which a list is wrapped; its last number may be beyond


def _head(result: RecordingNoise) -> list[str]:
    rest, axes = result.rest, ' '.join(noise.axis for noise in result.axes)
    return [result.path, f'{duration(rest.span_s)} at rest, {rest.rate_hz:.5g} Hz, axes {axes}']


def _tables(result: RecordingNoise) -> list[str]:
    """Return the terms with intervals, then in SI units and by sample, 79 columns at most."""
    wide, narrow = (6, 25, 25, 25), (6, 12, 12, 12, 13, 13, 9)
    rows = [
        row((' axis', *_NAMES), wide),
        row(('', 'µg/√Hz (90 %)', 'µg (90 %)', 'µg/√s (90 %)'), wide),
        *(row((f' {noise.axis}', *_micro_g_intervals(noise)), wide) for noise in result.axes),
        *_walk_lines(result),
        '',
        row(('', 'N', 'B', 'K', 'N by sample', 'K by sample', 'datasheet'), narrow),
        row((' axis', 'm/s²/√Hz', 'm/s²', 'm/s²/√s', 'm/s²', 'm/s²', 'µg/√Hz'), narrow),
    ]
    rate = np.sqrt(result.rest.rate_hz)
    for noise in result.axes:
        white, _, walk = noise.estimates
        shown = (
            *noise.estimates,
            white.scaled(rate),
            walk.scaled(1 / rate),
            white.scaled(1e6 * ONE_SIDED / G0_MPS2),
        )
        rows.append(
            row(
                (
                    f' {noise.axis}',
                    *(f'{e.value:.3g}' if e.is_seen else f'< {e.high:.3g}' for e in shown),
                ),
                narrow,
            )
        )
    return rows


def _walk_lines(result: RecordingNoise) -> list[str]:
    """Return the bounds of the walks."""
    rows = []
    for noise in result.axes:
        time_s, k = noise.fit.bound_s, MICRO_G * noise.fit.walk.value
        if np.isfinite(time_s):
            rows.append(
                f' {noise.axis}: the walk has bounds, {k * np.sqrt(time_s / 2):.3g} µg '
                f'rms; correlation time {time_s:.3g} s'
            )
    return rows


def _micro_g_intervals(noise: AxisNoise) -> list[str]:
    """Return the estimates with their intervals, or their upper limits."""
    return [
        f'{e.value:.3g} ({e.low:.3g} to {e.high:.3g})' if e.is_seen else f'below {e.high:.3g}'
        for e in (estimate.scaled(MICRO_G) for estimate in noise.estimates)
    ]


def _paste_lines(result: RecordingNoise) -> list[str]:
    """Return the settings of other programs in YAML, ready to paste."""
    lines = []
    for program, entries in settings(result.axes, result.rest.rate_hz).items():
        lines.append(f'# {program}')
        for name, values, unit in entries:
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
    for noise in result.axes:
        texts += [f'{noise.axis}: {text}' for text in _axis_warnings(rest.span_s, noise)]
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


def _axis_warnings(span_s: float, noise: AxisNoise) -> list[str]:
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
            f'samples change in steps of {noise.resolution * MICRO_G:.3g} µg, which hide '
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
            fresh, provenance={**fresh.provenance, 'noise_from': name, 'rate_from': name}
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
            (f'white noise of {noise.axis}', f'{_micro_g_intervals(noise)[0]} µg/√Hz')
            for noise in self.axes
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
        """Write the curve allan.png into a folder, and return its path; overwrite: as `save`."""
        require_own(Path(folder) / PLOT, overwrite)
        path = make_folder(folder) / PLOT
        write_bytes(path, png(_plot(self.result)))
        return path

    def to_dict(self) -> dict[str, Any]:
        """Return terms with their intervals, m/s² and s; what is not finite is None."""
        axes = {
            noise.axis: {
                name: estimate._asdict() for name, estimate in zip(_FIELDS, noise.estimates)
            }
            for noise in self.axes
        }
        return as_json(
            {
                'schema': 1,
                'recording': self.result.path,
                'span_s': self.span_s,
                'rate_hz': self.rate_hz,
                'warnings': self.warnings,
                'axes': axes,
            }
        )

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each axis and term: value and 90 % interval."""
        from pandas import DataFrame

        rows = []
        for noise in self.axes:
            rows += [
                (noise.axis, name, *estimate) for name, estimate in zip(_FIELDS, noise.estimates)
            ]
        return DataFrame(rows, columns=['axis', 'term', 'value', 'low', 'high'])

    def plot(self, ax: Any = None) -> Any:
        """Draw the Allan deviations, µg, and what is fitted, into axes of matplotlib."""
        ax = axes_for(ax)
        for number, noise in enumerate(self.axes):
            _draw(ax, self.result, number, noise.axis)
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
        tuple(_warnings(result)),
        result,
    )


_INCHES = (5.0, 4.4)
"""Width and height of the plot of an axis, inches. Chosen: three fit beside each other."""


def _plot(result: RecordingNoise) -> Any:
    """Draw the axes beside each other."""
    figure = new_figure(figsize=(_INCHES[0] * len(result.axes), _INCHES[1]))
    plots = figure.subplots(1, len(result.axes), squeeze=False, sharey=True)[0]
    for number, (noise, plot) in enumerate(zip(result.axes, plots)):
        _draw(plot, result, number, 'measured')
        plot.set_title(f'axis {noise.axis}')
    plots[0].set_ylabel('Allan deviation, µg')
    return figure


def _draw(plot: Any, result: RecordingNoise, number: int, label: str) -> None:
    """Draw the Allan deviation of an axis with the terms that are seen."""
    allan, noise = result.rest.allan, result.axes[number]
    tau_s, measured = allan.tau_s, allan.deviation[:, number] * MICRO_G
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
            plot.plot(tau_s, line * MICRO_G, '--', lw=1, label=name)
    plot.plot(
        tau_s, noise.fit.allan_deviation(tau_s) * MICRO_G, color='#222', lw=1, label='all three'
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
    sensor, unit = result.sensor, result.unit
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
