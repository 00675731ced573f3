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
from adxl_ros.files.atomic_write import own_folder, require_own, write_bytes
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.tables import BLOCK_ROWS
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.figures import axes_for, AXIS_COLOURS, png
from adxl_ros.report.quantities import duration
from adxl_ros.report.screen import Tile
from adxl_ros.signals import noise_parameters, noise_report as words
from adxl_ros.signals.noise_parameters import AxisNoise, RecordingNoise
import numpy as np

PLOT = 'allan.png'  # Name of the curve in the folder of a report
TABLE = 'allan.csv'  # Name of its table


@dataclass(frozen=True, repr=False, eq=False)
class Noise(Result):
    """
    The noise of a sensor in the longest rest of a recording.

    `print` shows the screen of the tool `noise`. Other verbs take it in place of the sensor.

    Attributes
    ----------
    axes
        By axis: `fit.white` N, m/s²/√Hz; `fit.instability` B, m/s²; `fit.walk` K, m/s²/√s, each
        with `value`, `low` and `high` of its 90 % interval; `sample_std` and `resolution`, m/s².
        N² is the density over positive and negative frequencies.
    span_s
        Time at rest, s.
    rate_hz
        Sample rate by the stamps, Hz.
    tau_s
        Averaging times of the Allan deviation, s, (k,).
    allan_deviation_mps2
        Allan deviation of each axis, m/s², (k, m).
    gyro
        The gyroscope by axis, as `axes` in rad/s; empty without one.
    gyro_allan_deviation_radps
        Allan deviation of the gyroscope at `tau_s`, rad/s, (k, 3); (k, 0) without one.
    warnings
        What is not seen, what hides it, and how long to record.
    result
        All steps between the samples and the noise.

    """

    axes: tuple[AxisNoise, ...]
    span_s: float
    rate_hz: float
    tau_s: np.ndarray
    allan_deviation_mps2: np.ndarray
    gyro: tuple[AxisNoise, ...]
    gyro_allan_deviation_radps: np.ndarray
    warnings: tuple[str, ...]
    result: RecordingNoise

    @cached_property
    def sensor(self) -> Sensor:
        """Return the sensor of the parameter file with the measured noise."""
        stated = _sensor(self.result)
        name = Path(self.result.path).name
        fresh = noise_parameters.with_noise(stated, self.result.axes, self.result.rest)
        return replace(
            fresh,
            gyro=noise_parameters.with_gyro_noise(stated.gyro, self.gyro),
            provenance={**fresh.provenance, 'noise_from': name, 'rate_from': name},
        )

    @property
    def refuted_filter(self) -> list[str]:
        """Return that the noise refutes the stated filter, one line; none where it does not."""
        return words.filter_warning(_sensor(self.result), self.sensor)

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        lines = [
            *words.head(self.result),
            '',
            *words.tables(self.result),
            '',
            *words.paste_lines(self.result),
            '',
        ]
        if self.warnings:
            lines += [*(f'WARNING {text}' for text in self.warnings), '']
        return lines

    @property
    def first_screen(self) -> FirstScreen:
        """Return what a notebook shows."""
        tiles = []
        for shown in words.sensors_at_rest(self.result):
            for noise in shown.axes:
                white = words.intervals(noise, shown.unit)[0]
                label = f'white noise, {shown.name} {noise.axis}'
                tiles.append(Tile(label, f'{white} {shown.unit.small}/√Hz'))
        colour = 'amber' if self.warnings else 'green'
        return FirstScreen(colour, 'Noise', words.head(self.result)[1], tiles)

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
                *words.tables(self.result),
            ],
        )

    def report(self, folder: str | os.PathLike, *, overwrite: bool = False) -> Path:
        """
        Write the curve into a folder, allan.png and allan.csv, and return the path of the former.

        overwrite: as `save`.
        """
        path = own_folder(folder, [PLOT, TABLE], overwrite)
        write_bytes(path / PLOT, png(words.curves(self.result)))
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
        for shown in words.sensors_at_rest(self.result):
            for noise, deviation in zip(shown.axes, shown.rest.allan.deviation.T):
                name = f'{shown.unit.letter}{noise.axis}'
                columns[f'{name}_{shown.unit.column}'] = deviation
                columns[f'{name}_fitted_{shown.unit.column}'] = noise.fit.allan_deviation(
                    self.tau_s
                )
        return columns

    def to_dict(self) -> dict[str, Any]:
        """Return terms with their intervals, m/s², rad/s and s; what is not finite is None."""
        return as_json(
            {
                'schema': 1,
                'recording': self.result.path,
                'span_s': self.span_s,
                'rate_hz': self.rate_hz,
                'warnings': self.warnings,
                'axes': _terms(self.axes),
                'gyroscope': _terms(self.gyro),
                'allan_deviation': self.curve(),
            }
        )

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each sensor, axis and term: value, 90 % interval."""
        from pandas import DataFrame

        rows = []
        for shown in words.sensors_at_rest(self.result):
            for noise in shown.axes:
                for name, estimate in zip(words.TERMS, noise.estimates):
                    rows.append((shown.name, noise.axis, name, *estimate))
        return DataFrame(rows, columns=['sensor', 'axis', 'term', 'value', 'low', 'high'])

    def plot(self, ax: Any = None) -> Any:
        """Draw the accelerometer's Allan deviations, µg, and fits, into axes of matplotlib."""
        ax = axes_for(ax)
        accelerometer = words.sensors_at_rest(self.result)[0]
        for number, noise in enumerate(self.axes):
            words.draw(ax, accelerometer, number, noise.axis)
            words.draw_sum(ax, accelerometer, number, color=AXIS_COLOURS[noise.axis])
        ax.legend()
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
    no_gyro = np.zeros((len(rest.allan.tau_s), 0))
    return Noise(
        axes=tuple(result.axes),
        span_s=rest.span_s,
        rate_hz=rest.rate_hz,
        tau_s=rest.allan.tau_s,
        allan_deviation_mps2=rest.allan.deviation,
        gyro=tuple(result.gyro),
        gyro_allan_deviation_radps=(
            result.gyro_rest.allan.deviation if result.gyro_rest else no_gyro
        ),
        warnings=tuple(words.warnings(result)),
        result=result,
    )


def _terms(axes: Iterable[AxisNoise]) -> dict[str, dict[str, Any]]:
    """Return the terms of each axis with their intervals."""
    terms = {}
    for noise in axes:
        estimates = zip(words.TERMS, noise.estimates)
        terms[noise.axis] = {name: estimate._asdict() for name, estimate in estimates}
    return terms


def _sensor(result: RecordingNoise) -> Sensor:
    """Return the sensor of the parameter file, with the axes and rate of the recording."""
    sensor = result.sensor
    unit = result.nominal
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
