# SPDX-License-Identifier: Apache-2.0

"""Compensation of the front door: acceleration and tilt from the sensor alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.api.recordings import one_recording, RecordingInput
from adxl_ros.api.result import as_json, FirstScreen, Result
from adxl_ros.api.sensors import sensor_of, SensorInput
from adxl_ros.compensate.estimators import Estimates, RecordingEstimator
from adxl_ros.compensate.live_stream import ImuFields
from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import require_own
from adxl_ros.files.bag_writer import angular_velocity, tilt_bag
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.recording_columns import GYRO, Recording
from adxl_ros.files.stream_info import check_same_sensor
from adxl_ros.model.constants import AXES
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.effects import base, effect_named
from adxl_ros.model.gyroscope import Gyroscope, NO_TURN
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.report.figures import axes_for
from adxl_ros.report.quantities import mg
from adxl_ros.report.screen import Tile
from adxl_ros.signals.gravity_at_rest import require_unit
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.recorded_sensor import BeyondRange, measured_lines
from adxl_ros.wording import option
import numpy as np

BLOCK_ROWS = 8192  # Samples that are corrected at a time (chosen: their arrays stay in the cache)
INVERSES = ('exact', 'paper')
_COUNTED = {
    'unsolved': 'have no solution: their cells are empty, and a bag leaves them out',
    'outside': 'lie outside of the validity range (temperature or force): their standard '
    'deviations are raised',
    'at_rail': 'have the ADC at its rail: their standard deviations are inf, in a bag '
    f'their variances {UNMEASURED_VARIANCE:g}',
}
"""What is said of counted samples, by the field of `Estimates`."""


class CorrectedPart(NamedTuple):
    """Some samples, and what follows from them."""

    samples: Recording
    estimates: Estimates


class Correction:
    """Corrects a recording block by block, and counts what its user must know."""

    def __init__(
        self,
        first: Recording,
        sensor: SensorInput | None,
        *,
        inverse: str = INVERSES[0],
        undo_filter: bool = False,
    ) -> None:
        """Prepare for the recording that begins with a block; see `apply`."""
        if inverse not in INVERSES:
            raise UserError(f'{option(inverse=inverse)}: expected {" or ".join(INVERSES)}')
        given = sensor_of(sensor, first)
        self.sensor = given.sensor if given.sensor.effects else with_axes(given.sensor, first.axes)
        self.measured = given.measured
        check_same_sensor(first.stream_info, first.axes, self.sensor)
        self._before = list(_effects_that_stay(self.sensor, undo_filter))
        if self.sensor.mounting.get('rpy_rad'):
            self._before.append(
                'force and angles are those of the case: only the compensation '
                'turns them by mounting.rpy_rad of the parameters'
            )
        self._estimator = RecordingEstimator(self.sensor, first, inverse == 'paper', undo_filter)
        self._counts: Counter[str] = Counter()
        self._beyond = BeyondRange()
        self._look = RecordingLook(self.sensor, first)
        self._path = first.path
        self._has_gyro = first.gyro_radps is not None
        self._doubts: list[str] = []  # What is wrong with gravity, or between samples

    def blocks(self, recording: Iterable[Recording]) -> Iterator[CorrectedPart]:
        """Yield each block with its estimates; refuse readings in another unit at the end."""
        for block, estimates in self._estimator.blocks(recording):
            yield CorrectedPart(block, estimates)
            explained = ~(estimates.unsolved | estimates.at_rail)
            self._beyond.add(estimates.volts[explained], self.sensor)
            self._look.feed(block)
            self._counts['rows'] += len(block)
            for name in _COUNTED:
                self._counts[name] += int(getattr(estimates, name).sum())
        self._doubts = [
            *require_unit(self._look.gravity(), self._path),
            *self._look.faults(),
        ]

    @property
    def notes(self) -> list[str]:
        """Return what a user must know of the samples so far, one line each."""
        counted = [
            f'{self._counts[name]} of {self._counts["rows"]} samples {statement}'
            for name, statement in _COUNTED.items()
            if self._counts[name]
        ]
        notes = [*self._before, *counted, self._beyond.describe(self.sensor)]
        return [note for note in notes if note]

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        by_what = (
            f'the {self.sensor.model} calibration of {self.sensor.serial}'
            if self.sensor.effects
            else 'the datasheet values: the sensor is not calibrated'
        )
        lines = [
            f'Corrected {self._counts["rows"]} samples by {by_what}.',
            *(f'WARNING {text}' for text in self._doubts),
            *self._estimator.assumed,
        ]
        if self._has_gyro:
            lines.append(_gyro_text(self.sensor.gyro))
        return [*lines, *measured_lines([*self.measured])]


def _gyro_text(gyro: Gyroscope) -> str:
    """Say what is done to a gyroscope."""
    if not gyro.is_calibrated:
        return 'Gyroscope: kept as it is, because the parameters state no bias of it.'
    by_temperature = ' by temperature' if gyro.follows_temperature else ''
    return f'Gyroscope: its bias is subtracted{by_temperature}.'


def _effects_that_stay(sensor: Sensor, undo_filter: bool) -> Iterator[str]:
    """Name the effects that are not undone."""
    for effect in map(effect_named, sensor.effects):
        acts_on_samples = (
            effect.acts_on is base.ActsOn.MEAN
            and effect.place < base.Place.CLOCK
            and effect.concern is not base.Concern.STAGE
        )
        is_undone = effect.invertible or (undo_filter and base.Need.FILTER in effect.needs)
        if acts_on_samples and not is_undone:
            yield f'{effect.name} is not undone: a single sample does not determine it'


@contextmanager
def writer(
    path: str | os.PathLike, sensor: Sensor
) -> Iterator[Callable[[Recording, Estimates], None]]:
    """
    Open a CSV file or a bag, and yield a function that appends a block with its estimates.

    sensor: what the samples are corrected by.
    """
    if Path(path).suffix == '.csv':
        with csv_writer(path) as append_rows:
            yield lambda block, estimates: append_rows(
                {
                    'time_s': block.epoch_ns * 1e-9 + block.time_s,
                    **_columns(estimates),
                    **_gyro_columns(block, sensor.gyro),
                }
            )
    else:
        fields = ImuFields()
        with tilt_bag(path) as append:

            def append_block(block: Recording, estimates: Estimates) -> None:
                solved = ~estimates.unsolved
                imu, tilt_rad = fields(estimates)
                gyro_radps, std_radps = less_bias(block, sensor.gyro)
                if gyro_radps is not None:
                    # A variance of 0 says that it is not known.
                    imu |= angular_velocity(gyro_radps[solved], std_radps[solved] ** 2)
                append(block.stamp_ns[solved], imu, tilt_rad)

            yield append_block


def less_bias(block: Recording, gyro: Gyroscope) -> tuple[np.ndarray | None, np.ndarray]:
    """
    Return a gyroscope without its bias, rad/s, (n, 3), None where there is none, and its std.

    The standard deviation is that of the bias and of the noise that the file states; 0 for none.
    """
    gyro_radps = block.gyro_radps
    temperature_c = block.columns.get('temperature_c', np.full(len(block), np.nan))
    density = np.array(gyro.noise_density_radps_per_rthz or NO_TURN)
    noise_radps = density * np.sqrt(block.rate_hz / 2) if len(block) > 1 else density
    std_radps = np.hypot(gyro.bias_std_at(temperature_c), noise_radps)
    std_radps = np.broadcast_to(std_radps, (len(block), len(AXES)))
    if gyro_radps is None:
        return None, std_radps
    return gyro_radps - gyro.bias_at(temperature_c), std_radps


def _gyro_columns(block: Recording, gyro: Gyroscope) -> dict[str, np.ndarray]:
    """Return the columns of a gyroscope without its bias, (n,) each; none without one."""
    gyro_radps, std_radps = less_bias(block, gyro)
    if gyro_radps is None:
        return {}
    columns = dict(zip(GYRO, gyro_radps.T))
    if gyro.is_calibrated:
        names = [name.replace('_', '_std_') for name in GYRO]
        columns |= dict(zip(names, std_radps.T))
    return columns


def _columns(estimates: Estimates) -> dict[str, np.ndarray]:
    """Return the columns of a table of estimates, (n,) each."""
    columns = {f'a{axis}_mps2': force for axis, force in zip(AXES, estimates.force_mps2)}
    columns |= {f'a{axis}_std_mps2': std for axis, std in zip(AXES, estimates.force_std_mps2)}
    for names in (('roll', 'pitch', 'inclination'), ('alpha', 'beta')):
        columns |= {f'{name}_rad': getattr(estimates.tilt, name) for name in names}
        columns |= {f'{name}_std_rad': getattr(estimates.tilt, f'{name}_std') for name in names}
    return columns


@dataclass(frozen=True, repr=False, eq=False)
class Corrected(Result):
    """
    Acceleration and tilt of n samples, with their standard deviations.

    What a sample does not determine is NaN, and its standard deviation is inf. The standard
    deviations hold noise, quantisation, and the uncertainty of the calibration.

    Attributes
    ----------
    time_s
        Stamps, s since `epoch_ns`, (n,).
    epoch_ns
        Origin of the stamps, ns since 1970; 0 where they count from a start.
    force_mps2
        Specific force in the frame of the case (REP-103), m/s², (n, 3): +g upward at rest.
    force_std_mps2
        Its standard deviations, m/s², (n, 3).
    force_covariance
        Its covariance, (m/s²)², (n, 3, 3); very large for an axis that is not measured.
    columns
        Columns of the tool's table, (n,) each: the force as `ax_mps2`, `ax_std_mps2`, ..., m/s²,
        and the angles `roll_rad`, `pitch_rad`, `inclination_rad`, and `alpha_rad`, `beta_rad` as a
        stage has them, with `roll_std_rad`, ..., rad. Angles hold at rest. A gyroscope without its
        bias is `gx_radps`, `gx_std_radps`, ..., rad/s.
    at_rail
        Whether the ADC is at a rail, (n,) bool.
    outside
        Whether temperature or force lie outside of the calibrated range, (n,) bool.
    unsolved
        Whether no force explains the sample, (n,) bool.
    sensor
        The sensor that the samples were corrected by.
    notes : tuple of str
        Effects that stay, and how many samples are at a rail, outside or without a solution.
    screen_lines
        What the tool shows.
    parts
        Samples and estimates, block by block.

    """

    time_s: np.ndarray
    epoch_ns: int
    force_mps2: np.ndarray
    force_std_mps2: np.ndarray
    force_covariance: np.ndarray
    columns: Mapping[str, np.ndarray]
    at_rail: np.ndarray
    outside: np.ndarray
    unsolved: np.ndarray
    sensor: Sensor
    notes: tuple[str, ...]
    screen_lines: tuple[str, ...]
    parts: tuple[CorrectedPart, ...]

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        return [*self.screen_lines, *self.notes]

    @property
    def first_screen(self) -> FirstScreen:
        """Return what a notebook shows."""
        std_mg = mg(np.median(self.force_std_mps2, axis=0))
        tiles = [
            Tile(f'{axis}, standard deviation', f'{value:.2g} mg')
            for axis, value in zip(AXES, std_mg)
            if np.isfinite(value)
        ]
        return FirstScreen('grey', f'{len(self.time_s)} samples', ' '.join(self.screen), tiles)

    def to_dict(self) -> dict[str, Any]:
        """Return the columns of `to_pandas` as lists, None where not finite, with the notes."""
        return as_json(
            {
                'schema': 1,
                'serial': self.sensor.serial,
                'notes': self.notes,
                'epoch_ns': self.epoch_ns,
                'time_s': self.time_s,
                **self.columns,
            }
        )

    def to_pandas(self) -> Any:
        """Return a DataFrame with the columns of the tool's table, m/s² and rad."""
        from pandas import DataFrame

        return DataFrame({'time_s': self.time_s, **self.columns})

    def plot(self, ax: Any = None) -> Any:
        """Draw roll and pitch over time, degrees, into axes of matplotlib."""
        ax = axes_for(ax)
        for name in ('roll', 'pitch'):
            ax.plot(self.time_s, np.degrees(self.columns[f'{name}_rad']), lw=0.8, label=name)
        ax.set(xlabel='time, s', ylabel='tilt, °')
        ax.legend()
        return ax

    def save(self, path: str | os.PathLike, *, overwrite: bool = False) -> None:
        """
        Write a table NAME.csv, or a bag NAME.mcap or a folder with imu/data and tilt.

        overwrite: whether a file or a bag is replaced that this package did not write, or that
        was changed since; a folder with other files never is.
        """
        require_own(path, overwrite)
        with writer(path, self.sensor) as append:
            for part in self.parts:
                append(part.samples, part.estimates)


def apply(
    recording: RecordingInput,
    sensor: SensorInput | None = None,
    *,
    inverse: str = INVERSES[0],
    undo_filter: bool = False,
) -> Corrected:
    """
    Correct a recording by a calibration: acceleration and tilt from the sensor alone.

    Parameters
    ----------
    recording
        A Recording, a DataFrame, or the path of one that is read as it is. Stage angles in it are
        not used, temperature and supply are.
    sensor
        The calibrated sensor: a `Fit`, a Sensor, or the path of a parameter file. None for the
        nominal sensor, or any IMU.
    inverse
        'exact', or 'paper' for the approximation of the paper (equations 14 to 21).
    undo_filter
        Whether the RC filter is undone, amplitude and phase, for a sensor that moves.

    Returns
    -------
    Corrected
        Specific force in the frame of the case, m/s², and tilt, rad, with standard deviations.

    Raises
    ------
    UserError
        The recording is of another unit, or has no samples.

    """
    read = one_recording(recording)
    if not len(read):
        raise UserError(f'{read.path}: has no samples to correct')
    correction = Correction(read, sensor, inverse=inverse, undo_filter=undo_filter)
    starts = range(0, len(read), BLOCK_ROWS)
    parts = tuple(correction.blocks(read.rows(start, start + BLOCK_ROWS) for start in starts))

    def joined(name: str) -> np.ndarray:
        """Return a field of the estimates of all blocks; its last axis becomes the first."""
        arrays = [getattr(part.estimates, name) for part in parts]
        return np.moveaxis(np.concatenate(arrays, -1), -1, 0)

    tables = [
        {**_columns(part.estimates), **_gyro_columns(part.samples, correction.sensor.gyro)}
        for part in parts
    ]
    columns = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    return Corrected(
        time_s=read.time_s,
        epoch_ns=read.epoch_ns,
        force_mps2=joined('force_mps2'),
        force_std_mps2=joined('force_std_mps2'),
        force_covariance=joined('covariance'),
        columns=columns,
        at_rail=joined('at_rail'),
        outside=joined('outside'),
        unsolved=joined('unsolved'),
        sensor=correction.sensor,
        notes=tuple(correction.notes),
        screen_lines=tuple(correction.screen),
        parts=parts,
    )
