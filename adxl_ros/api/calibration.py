# SPDX-License-Identifier: Apache-2.0

"""Calibration of the front door: from recordings of one unit to its parameter file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.api.recordings import each_recording, RecordingInput, RobotInput
from adxl_ros.api.result import as_json, FirstScreen, no_progress, Progress, Result
from adxl_ros.api.sensors import effect_names, GivenSensor, sensor_of, SensorInput
from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.fits import thermal_fit
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.recorded_poses import (
    estimate_filters,
    extract_poses,
    poses_of_means,
    with_table_angles,
)
from adxl_ros.calibrate.report import acceptance, certificate_data, gum, page
from adxl_ros.calibrate.report.held_out import HeldOutErrors
from adxl_ros.calibrate.result import CalibrationResult, compare, errors_in_words, gyro_lines
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, sweep_journal
from adxl_ros.files.atomic_write import own_folder, require_own
from adxl_ros.files.recording_columns import recorded_nominal, Recording
from adxl_ros.files.stream_info import nominal_of
from adxl_ros.files.surroundings import Surroundings
from adxl_ros.files.tables import read_pose_table
from adxl_ros.model.constants import Z_90
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import get, parameter_of, Sensor, with_axes
from adxl_ros.report.figures import axes_for, AXIS_COLOURS, QUIET_COLOUR
from adxl_ros.report.quantities import mg, with_half_width
from adxl_ros.signals.gravity_at_rest import require_unit
from adxl_ros.signals.gyroscope_at_rest import rest_turns, RestTurns, with_bias
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.recorded_sensor import BeyondRange, measured_lines
from adxl_ros.wording import option

_READING = 0.3  # Share of the work until the fit begins (chosen: a sweep of minutes)
_MEANS_LACK = (
    'a table of means shows no noise, filter or range: they are measured from the '
    'first recording that the file corrects'
)


class FittedCoefficient(NamedTuple):
    """A coefficient of a calibration."""

    name: str  # 'effect.parameter', as in the parameter file
    axis: str  # x, y or z; '' for a coefficient of all axes
    label: str  # The coefficient in words
    value: float  # The parameter, in `unit`: an `offset` departs from the nominal value
    half_width: float  # Half of its 90 % interval, in `unit`
    unit: str  # Unit of the parameter file
    shown: str  # For people: zero-g and scale factor as a whole, angles in degrees


@dataclass(frozen=True, repr=False, eq=False)
class Fit(Result):
    """
    A calibrated unit.

    `print` shows the screen of the tool `fit`, a notebook the top of its page. Other verbs take
    it in place of the sensor.

    Attributes
    ----------
    sensor
        The unit with its fitted coefficients, their covariance and its validity range.
    outcome
        PASS, NOT SHOWN or FAIL: the calibration error against the limit of the datasheet.
    coefficients
        Fitted coefficients with the halves of their 90 % intervals.
    held_out
        Errors on poses that the fit has not seen, by model, the datasheet's first: rms, largest
        and 90 % interval of `tilt_deg`, degrees, and of `accel_mg`, mg. Empty against gravity.
    poses
        Number of poses that were used.
    outliers
        Indices of the poses that the fit leaves out.
    warnings
        What is wrong with the poses or the fit, and why no richer model was fitted.
    measured
        What was measured, as no parameter file states it.
    notes : tuple of str
        Readings beyond the stated range, by recording, and what a table of means lacks.
    is_over_temperature
        Whether temperature effects were fitted to a sensor at rest.
    result
        All steps between the poses and the coefficients.

    """

    sensor: Sensor
    outcome: str
    coefficients: tuple[FittedCoefficient, ...]
    held_out: tuple[HeldOutErrors, ...]
    poses: int
    outliers: tuple[int, ...]
    warnings: tuple[str, ...]
    measured: tuple[str, ...]
    notes: tuple[str, ...]
    is_over_temperature: bool
    result: CalibrationResult

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        fitted = self.sensor
        lines = []
        if not self.is_over_temperature:
            lines = [
                errors_in_words(fitted),
                '',
                f'{fitted.serial}: {fitted.model} model of {self.poses} poses, '
                f'{len(fitted.covariance_names)} coefficients',
                '',
            ]
        lines += [*self.result.summary, *self.warnings]
        if gyro := gyro_lines(fitted.gyro):
            lines += ['', *gyro]
        return [*lines, *measured_lines([*self.measured])]

    @property
    def first_screen(self) -> FirstScreen:
        """Return the top of the page."""
        return FirstScreen(**page.badge(self.sensor), tiles=page.tiles(self.result))

    def save(self, path: str | os.PathLike, *, overwrite: bool = False) -> None:
        """
        Write the parameter file; that of another fit becomes NAME.previous.

        overwrite: whether a file is replaced that this package did not write, or that was
        changed since.
        """
        require_own(path, overwrite)
        self.result.save(path)

    def report(
        self,
        folder: str | os.PathLike,
        store: str | os.PathLike = '',
        *,
        overwrite: bool = False,
    ) -> Path:
        """
        Write the page report.html into a folder, and return its path.

        It compares with the earlier calibrations of the unit in `store`; overwrite: as in
        `save`.
        """
        if self.is_over_temperature:
            raise UserError(
                f'{option(report=folder)}: a fit over temperature has no page; leave it out'
            )
        path = own_folder(folder, [page.PAGE], overwrite)
        page.write(path, self.result, store)
        return path / page.PAGE

    def certificate(
        self,
        path: str | os.PathLike,
        data: str | os.PathLike | None = None,
        *,
        overwrite: bool = False,
    ) -> None:
        """
        Write a Digital Calibration Certificate (DCC of PTB) of a calibration on a stage.

        data: path of a YAML file with laboratory, customer, person, device and stage; what it
        lacks is 'not stated'; overwrite: as in `save`.
        """
        require_own(path, overwrite)
        stated = certificate_data.read(data) if data else certificate_data.DEFAULTS
        gum.write(path, self.result, stated)

    def keep(self, store: str | os.PathLike) -> str:
        """Copy the calibration to a store; return one line on it."""
        return self.result.keep(store)

    def to_dict(self) -> dict[str, Any]:
        """Return coefficients, errors and provenance; what is not finite is None."""
        errors = self.held_out[-1] if self.held_out else None
        return as_json(
            {
                'schema': 1,
                'serial': self.sensor.serial,
                'model': self.sensor.model,
                'outcome': self.outcome,
                'poses': self.poses,
                'outliers': self.outliers,
                'coefficients': [row._asdict() for row in self.coefficients],
                'held_out_tilt_deg': errors and errors.tilt_deg.rms,
                'held_out_accel_mg': errors and errors.accel_mg.rms,
                'warnings': self.warnings,
                'measured': self.measured,
                'provenance': self.sensor.provenance,
            }
        )

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each coefficient."""
        from pandas import DataFrame

        return DataFrame(self.coefficients, columns=FittedCoefficient._fields)

    def plot(self, ax: Any = None) -> Any:
        """Draw the errors on held-out poses, mg, into axes of matplotlib."""
        ax = axes_for(ax)
        gravity = self.result.gravity_fit
        if gravity is not None:
            ax.plot(mg(gravity.held_out_mps2), 'o', label='magnitude minus gravity')
        elif self.held_out:
            for axis, errors in zip(self.sensor.axes, self.held_out[-1].pose_errors.accel_mps2.T):
                ax.plot(mg(errors), 'o', label=axis, color=AXIS_COLOURS[axis])
        ax.set(xlabel='held-out pose', ylabel='error of acceleration, mg')
        ax.axhline(0.0, lw=0.8, color=QUIET_COLOUR)
        ax.legend()
        return ax


def fit(
    recordings: RecordingInput | Iterable[RecordingInput],
    sensor: SensorInput | None = None,
    *,
    model: str | None = None,
    effects: Sequence[str] = (),
    prior: str | os.PathLike | None = None,
    journal: str | os.PathLike | None = None,
    poses: str | os.PathLike | None = None,
    urdf: str | os.PathLike | None = None,
    frame: str = 'imu_link',
    joints: str = '',
    means: bool = False,
    data_sha256: str = '',
    progress: Progress = no_progress,
) -> Fit:
    """
    Calibrate one unit: against stage angles where there are any, else against gravity.

    Parameters
    ----------
    recordings
        One or more recordings of rests in several poses, all of one unit, each once: a
        Recording, a DataFrame, or the path of one that is read as it is. With `alpha_rad` and
        `beta_rad` the reference is the stage. Without, it is the length of gravity, which needs
        three axes: seven poses for zero-g and scale factor, ten for misalignment, too.
    sensor
        What is not fitted: a Sensor, a datasheet's name or the path of a parameter file. None
        for the nominal sensor, or any IMU; what a file leaves out is measured.
    model
        'linear', 'physical' or 'full' against the stage; None for the richest that the poses
        determine.
    effects
        Further effects of the full model against the stage: a list of their names. Temperature
        effects alone are fitted to a sensor that rests while its temperature changes.
    prior
        Path of the population.yaml of a fleet: prior of zero-g and scale factor.
    journal, poses
        Path of the journal of the sweep that names the rests, or of a table with `alpha_deg` and
        `beta_deg`, or `roll_deg` and `pitch_deg`, of each rest, which `start_s` and `stop_s` may
        name; for one recording.
    means
        Whether each row of the one recording is the mean of a rest; its stamps are not used.
    urdf, frame, joints
        Path of a robot as the stage, its frame that carries the sensor, topic of its joints.
    data_sha256
        Hash of the recordings for the provenance; '' for that of their files.
    progress
        Called with the share of the work that is done, 0 to 1, and the name of the stage.

    Returns
    -------
    Fit
        The calibrated unit: `save('unit.yaml')`, `report('folder')`, `print(fit)`.

    Raises
    ------
    UserError
        The poses do not determine the model, or recordings contradict each other.

    """
    effects = _checked_names(model, effects)
    rests = _Rests(journal, poses, means)
    population = calibration_store.read_population(prior) if prior else None
    robot = RobotInput(urdf, frame, joints) if urdf else None
    unit = _Unit(sensor, robot, means)
    several: Iterable[Recording] = each_recording(recordings)
    has_thermal_effects_alone = bool(effects) and set(effects) <= set(thermal_fit.EFFECTS)
    has_poses = bool(model or journal or poses or means)
    if has_thermal_effects_alone and not has_poses:
        several = list(several)
        at_rest = _Unit(sensor, robot, means)
        blocks = at_rest.thermal_blocks(several)
        if blocks is not None:
            if prior:
                raise UserError(
                    f'{option(prior=prior)}: a fit over temperature takes none; leave it out'
                )
            progress(_READING, 'fit')
            return _fit_over_temperature(at_rest, blocks, data_sha256)
    recorded = []
    for number, read in enumerate(several):
        read = unit.add(read)
        progress(_READING * (number + 1) / (number + 2), 'reading')
        recorded.append(rests.of(read, unit, number))
    progress(_READING, 'fit')
    try:
        result = calibration.calibrate(
            unit.with_gyro(unit.sensor),
            recorded,
            model,
            effects,
            data_sha256 or unit.sha256,
            population,
        )
    except UserError as error:
        # Rests that were not found are no fault of the poses where the samples are wrong.
        reasons = chain.from_iterable(each.faults for each in recorded)
        raise UserError('; '.join([*reasons, str(error)])) from None
    return _fit(result, unit)


def _fit_over_temperature(unit: _Unit, blocks: Poses, data_sha256: str) -> Fit:
    """Fit temperature effects to blocks of a sensor at rest."""
    result = calibration.calibrate_thermal(
        unit.with_gyro(with_axes(unit.base, unit.sensor.axes)),
        blocks,
        unit.names[0],
        data_sha256 or unit.sha256,
    )
    return _fit(result, unit, is_over_temperature=True)


def _checked_names(model: str | None, effects: Sequence[str]) -> tuple[str, ...]:
    """Refuse a model or an effect that no fit has; return the names of the effects."""
    if model is not None and model not in calibration.STAGE_FITS:
        raise UserError(
            f'model {model}: expected one of {", ".join(calibration.STAGE_FITS)}, or None for '
            'the richest that the poses determine'
        )
    return effect_names(effects)


class _Unit:
    """The unit, while its recordings are read one after the other."""

    def __init__(
        self, sensor: SensorInput | None, robot: RobotInput | None, has_means: bool
    ) -> None:
        self._stated = sensor
        self._robot = robot
        self._has_means = has_means
        self._given: GivenSensor | None = None
        self._paths: list[str] = []
        self.notes: list[str] = []  # Readings beyond the stated range, and what means lack
        self._surroundings: list[Surroundings] = []  # Those of each recording
        self._gyro_rests: list[RestTurns] = []  # The gyroscope in the rests of all recordings

    def add(self, read: Recording) -> Recording:
        """Take the next recording; return it, with the angles of a robot if there is one."""
        if self._given is None:
            self._given = sensor_of(self._stated, read, has_noise=not self._has_means)
            self.sensor = self._given.sensor  # The nominal sensor of the newest recording
            if self.sensor.unstated:
                self.notes.append(_MEANS_LACK)
        self.sensor = (
            nominal_of(self.sensor, read.stream_info, read.axes)
            if self._has_means
            else recorded_nominal(self.sensor, read)
        )
        self._paths.append(read.path)
        self._surroundings.append(Surroundings())
        self._surroundings[-1](read)
        if self._robot is not None:
            path = self._robot.path(read, self.sensor)
            read = path.with_angles(read)
            self.sensor = replace(
                self.sensor,
                stage_resolution_rad=max(self.sensor.stage_resolution_rad, path.step_rad),
            )
        self._gyro_rests += rest_turns(read, self.sensor, self._has_means)
        beyond = BeyondRange()
        beyond.add(read.volts(self.sensor), self.sensor)
        text = beyond.describe(self.sensor)
        if text and 'range_g' not in self.sensor.measured:  # but stated by the parameter file
            self.notes.append(f'{read.path}: {text}')
        return read

    def with_gyro(self, sensor: Sensor) -> Sensor:
        """Return a sensor with the bias of the gyroscope of the recordings, if they have one."""
        gyro = with_bias(sensor.gyro, self._gyro_rests)
        if gyro is sensor.gyro:
            return sensor
        origin = {'gyro_from': ', '.join(self.names)}
        return replace(sensor, gyro=gyro, provenance={**sensor.provenance, **origin})

    def thermal_blocks(self, several: Sequence[Recording]) -> Poses | None:
        """Return the blocks of one recording at rest over temperature; None for others."""
        if len(several) != 1:
            return None
        return thermal_fit.rest_blocks(self.add(several[0]), self.sensor)

    @property
    def base(self) -> Sensor:
        """Return the sensor as it was given, with what was measured."""
        assert self._given is not None
        return self._given.sensor

    def assumed(self, effects: Sequence[str]) -> list[str]:
        """Return what was assumed of temperature and supply, which effects follow."""
        lines = [each.interpolated(effects) for each in self._surroundings]
        return list(chain.from_iterable(lines))

    @property
    def measured(self) -> Sequence[str]:
        """Return what was measured, as no parameter file states it."""
        return self._given.measured if self._given else ()

    @property
    def names(self) -> list[str]:
        """Return the names of the recordings so far."""
        return [Path(path).name for path in self._paths]

    @property
    def sha256(self) -> str:
        """Return the hash of the files of the recordings; '' where there are none."""
        is_stored = all(Path(path).exists() for path in self._paths)
        return calibration_store.sha256(self._paths) if is_stored else ''


class _Rests:
    """Where the rests of a recording are, and what their angles are."""

    def __init__(
        self, journal: str | os.PathLike | None, table: str | os.PathLike | None, are_rows: bool
    ) -> None:
        ways = [bool(way) for way in (journal, table, are_rows)]
        if sum(ways) > 1:
            raise _one_recording_only()
        self._table = read_pose_table(table) if table else None
        self._are_rows = are_rows
        self._is_one = any(ways)
        self._records = (
            sweep_journal.poses_to_fit(sweep_journal.read(journal).entries) if journal else None
        )

    def of(self, read: Recording, unit: _Unit, number: int) -> calibration.RecordedPoses:
        """Return what a recording shows, which is one of several by its number."""
        name = unit.names[-1]
        if number and self._is_one:
            raise _one_recording_only()
        if self._are_rows:
            return calibration.RecordedPoses(name, poses_of_means(read, unit.sensor))
        look = RecordingLook(unit.sensor, read)
        look.feed(read)
        # Rests by the noise of the sensor may not tell the unit; of other faults, the poses tell.
        require_unit(look.gravity(), read.path)
        with look.named_in_refusals():
            poses = extract_poses(read, unit.sensor, self._records, self._table)
        if self._table:
            poses = with_table_angles(poses, self._table)
        filters = estimate_filters(read, unit.sensor, poses)
        return calibration.RecordedPoses(name, poses, filters, look.faults())


def _one_recording_only() -> UserError:
    """Return the error where rests of several recordings are named."""
    return UserError(
        f'{option("journal")}, {option("poses")} and {option("means")}: one of them names the '
        'rests of one recording'
    )


def _fit(result: CalibrationResult, unit: _Unit, is_over_temperature: bool = False) -> Fit:
    """Collect what a user reads of a calibration."""
    measured = measured_lines([*unit.measured])
    fitted = result.fitted
    result = replace(
        result,
        warnings=[*result.warnings, *unit.assumed(fitted.effects)],
        details=[*result.details, *measured],
    )
    names = fitted.covariance_names
    half_widths = Z_90 * stds(fitted.covariance)
    coefficients = tuple(
        FittedCoefficient(
            name=row.name,
            axis=row.axis,
            label=row.label,
            value=float(value),
            half_width=float(half_width),
            unit=parameter_of(name).unit,
            shown=f'{with_half_width(row.fitted, row.half_width)} {row.unit}',
        )
        for name, value, half_width, row in zip(
            names, get(fitted, names), half_widths, compare(fitted, fitted)
        )
    )
    return Fit(
        sensor=fitted,
        outcome=acceptance.acceptance(fitted).outcome,
        coefficients=coefficients,
        held_out=result.held_out,
        poses=int(result.inliers.sum()),
        outliers=result.outliers,
        warnings=tuple(result.warnings),
        measured=tuple(unit.measured),
        notes=tuple(unit.notes),
        is_over_temperature=is_over_temperature,
        result=result,
    )
