# SPDX-License-Identifier: Apache-2.0

"""Poses: mean output at rest with the angles of the encoder, by setting of each joint."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import COMMANDS, JOINTS, Recording
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.files.tables import PoseTable
from adxl_ros.model import signal_chain
from adxl_ros.model.effects import base, effect_named
from adxl_ros.model.effects.base import Coefficient, Components, Environment, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import specific_force, UPRIGHT
from adxl_ros.model.noise import sample_std_v
from adxl_ros.model.sensor import get, parameter_of, put, Sensor
from adxl_ros.process import option
from adxl_ros.signals import block_statistics, recorded_sensor, rest_detection
from adxl_ros.signals.rest_detection import Rest, SAME_ANGLE_RAD
import numpy as np

_SAME_PLANE_RAD = np.radians(1.0)  # Largest difference of neighbouring angles alpha in one plane


@dataclass(frozen=True)
class Poses:
    """k poses of one unit with m measured axes."""

    volts: np.ndarray  # Mean output of each measured axis, V, (k, m)
    std_v: np.ndarray  # Standard deviation of that mean, V, (k, m)
    alpha_rad: np.ndarray  # Of the stage's encoder, unwrapped, (k,); NaN without a stage
    beta_rad: np.ndarray
    time_s: np.ndarray  # Beginning and end of each rest, s, (k, 2)
    # True for a pose that the fit does not use, so that it can show the error, (k,)
    check: np.ndarray
    # temperature_c, supply_v: Means over each rest, (k,); NaN where they were not measured
    temperature_c: np.ndarray = None  # type: ignore[assignment]
    supply_v: np.ndarray = None  # type: ignore[assignment]
    # Number of the setting of each joint, (k,) int. Poses of one setting share the error of the
    # joint. By default each change of the angle from one pose to the next begins a setting.
    alpha_setting: np.ndarray = None  # type: ignore[assignment]
    beta_setting: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Fill in the fields that are not given."""
        for name in ('temperature_c', 'supply_v'):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(len(self.volts), np.nan))
        for joint in ('alpha', 'beta'):
            if getattr(self, f'{joint}_setting') is None:
                object.__setattr__(
                    self,
                    f'{joint}_setting',
                    _settings_by_angle(getattr(self, f'{joint}_rad'), self.time_s[:, 0]),
                )

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.volts)

    @classmethod
    def without_volts(
        cls, alpha_rad: np.ndarray, beta_rad: np.ndarray, std_v: np.ndarray
    ) -> Poses:
        """Make poses that have not been measured, with a noise, (m,) or (k, m), of their means."""
        count = len(alpha_rad)
        noise_v = np.broadcast_to(std_v, (count, np.shape(std_v)[-1])).copy()
        return cls(
            np.zeros_like(noise_v),
            noise_v,
            alpha_rad,
            beta_rad,
            np.zeros((count, 2)),
            np.zeros(count, bool),
        )

    @staticmethod
    def from_records(records: Sequence[PoseRecord]) -> Poses:
        """Return the poses of a journal."""

        def column(name: str) -> np.ndarray:
            return np.array([getattr(record, name) for record in records])

        stamps_ns = np.column_stack([column('start_ns'), column('stop_ns')])
        poses = Poses(
            column('mean_v'),
            column('std_v'),
            column('alpha_rad'),
            column('beta_rad'),
            stamps_ns * 1e-9,
            column('check').astype(bool),
            column('temperature_c'),
            column('supply_v'),
        )
        # Poses without numbers of settings get those by the angles.
        return replace(
            poses,
            **{
                name: column(name).astype(int)
                for name in ('alpha_setting', 'beta_setting')
                if None not in column(name)
            },
        )

    @staticmethod
    def joined(parts: Sequence[Poses]) -> Poses:
        """Join the poses of several recordings of one unit, each with settings of its own."""
        joined = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Poses)
        }
        for name in ('alpha_setting', 'beta_setting'):
            settings = [getattr(part, name) for part in parts]
            first = np.cumsum([0, *(int(n.max(initial=-1)) + 1 for n in settings[:-1])])
            joined[name] = np.concatenate([numbers + f for numbers, f in zip(settings, first)])
        return Poses(**joined)

    def subset(self, chosen: np.ndarray) -> Poses:
        """Select poses by mask or by index."""
        return Poses(*(getattr(self, field.name)[chosen] for field in fields(self)))

    @property
    def environment(self) -> Environment:
        """Return temperature and supply of each rest; nominal ones where not measured."""
        measured = {name: getattr(self, name) for name in ('temperature_c', 'supply_v')}
        return NOMINAL_ENVIRONMENT._replace(
            **{
                name: np.where(np.isfinite(values), values, getattr(NOMINAL_ENVIRONMENT, name))
                for name, values in measured.items()
            }
        )

    def with_temperature(self) -> Poses:
        """Return the poses with a temperature, in the order of time."""
        order = np.argsort(self.time_s[:, 0], kind='stable')
        return self.subset(order[np.isfinite(self.temperature_c[order])])

    @property
    def has_angles(self) -> np.ndarray:
        """Return which poses have both angles, (k,) bool."""
        return np.isfinite(self.alpha_rad) & np.isfinite(self.beta_rad)


def _settings_by_angle(angle_rad: np.ndarray, start_s: np.ndarray) -> np.ndarray:
    """Return numbers of settings by changes of the angle in the order of time, (k,) int."""
    order = np.argsort(start_s, kind='stable')
    settings = np.zeros(len(order), int)
    settings[order[1:]] = np.cumsum(np.abs(np.diff(angle_rad[order])) > SAME_ANGLE_RAD)
    return settings


def planes(alpha_rad: np.ndarray) -> list[np.ndarray]:
    """Group poses by plane: indices of those whose alpha agree within 1°."""
    order = np.argsort(alpha_rad, kind='stable')
    cuts = np.flatnonzero(np.diff(alpha_rad[order]) > _SAME_PLANE_RAD) + 1
    return np.split(order, cuts) if len(order) else []


def reference_force(poses: Poses, gravity_mps2: float) -> Components:
    """Return the specific force at the angles of the encoder, on a stage without errors."""
    return specific_force(poses.alpha_rad, poses.beta_rad, gravity_mps2)


_RAIL_STDS = 3.0
"""Distance of a mean from a rail of the ADC, in standard deviations of a sample, up to which its
samples were cut off there. Chosen: beyond it one sample of 700 is."""


def at_a_rail(sensor: Sensor, poses: Poses) -> np.ndarray:
    """Return the poses, (k,) bool, whose mean is false as samples are at a rail of the ADC."""
    rails_v = np.array([0.0, sensor.adc_vref_v - sensor.lsb_v])
    reach_v = (_RAIL_STDS * sample_std_v(sensor) + sensor.lsb_v) * bool(sensor.adc_bits)
    return (np.abs(poses.volts[:, :, None] - rails_v).min(axis=2) < reach_v).any(axis=1)


def with_table_angles(poses: Poses, table: PoseTable) -> Poses:
    """Give rests the angles of a table of poses, in their order."""
    angles, path = table.angles_rad, table.path
    if len(angles) != len(poses):
        starts = ', '.join(f'{start_s:.1f}' for start_s in poses.time_s[:, 0]) + ' s'
        raise UserError(
            f'{path}: has {len(angles)} poses, but the recording has {len(poses)} rests, which '
            f'begin at {starts}; write a row for each rest (with empty angles where they are not '
            'known)'
        )
    return Poses(
        poses.volts,
        poses.std_v,
        angles[:, 0],
        angles[:, 1],
        poses.time_s,
        poses.check,
        poses.temperature_c,
        poses.supply_v,
    )


_ANGLE_STEP_RAD = 1e-4
"""Step of the central differences by an angle, rad. Chosen: the chain is smooth, so that the error
of the slope, of order step², is far below the noise."""
_COEFFICIENT_STEP = 1e-3
"""Step of the central differences by a coefficient, in typical sizes. Chosen: the chain is nearly
linear over a thousandth of a typical size."""


def predicted_volts(
    unit: Sensor,
    poses: Poses,
    shift_rad: tuple[float, float] = (0.0, 0.0),
    force: Components | None = None,
) -> np.ndarray:
    """Predict the mean output of a unit in poses, V, (k, m); `force` is that of `stage_force`."""
    force = force or stage_force(
        unit, poses.alpha_rad + shift_rad[0], poses.beta_rad + shift_rad[1]
    )
    return np.column_stack(signal_chain.static_response(unit)(force, poses.environment))


def residual_g(unit: Sensor, poses: Poses) -> np.ndarray:
    """Return measured minus predicted output in poses, g, (k, m)."""
    return (poses.volts - predicted_volts(unit, poses)) / unit.scale_v_per_g


def stage_force(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> Components:
    """Return the specific force at rest on a stage with the stage effects of a unit."""
    signals = base.Signals(
        NOMINAL_ENVIRONMENT,
        alpha=base.Joint(alpha_rad),
        beta=base.Joint(beta_rad),
        up=list(UPRIGHT),
        gravity_mps2=unit.local_gravity_mps2,
    )
    signal_chain.Chain(unit, filter(_is_of_stage, unit.effects))(base.Place.STAGE, signals)
    return specific_force(
        signals.alpha.position, signals.beta.position, signals.gravity_mps2, 0.0, signals.up
    )


def _is_of_stage(effect: str) -> bool:
    return effect_named(effect).place is base.Place.STAGE


def angle_jacobian(unit: Sensor, poses: Poses) -> np.ndarray:
    """Differentiate the predicted volts by alpha and beta, V/rad, (k, m, 2)."""

    def slope(alpha_rad: float, beta_rad: float) -> np.ndarray:
        above = predicted_volts(unit, poses, (alpha_rad, beta_rad))
        below = predicted_volts(unit, poses, (-alpha_rad, -beta_rad))
        return (above - below) / (2 * _ANGLE_STEP_RAD)

    return np.stack([slope(_ANGLE_STEP_RAD, 0.0), slope(0.0, _ANGLE_STEP_RAD)], axis=2)


def coefficient_jacobian(unit: Sensor, poses: Poses, names: Sequence[Coefficient]) -> np.ndarray:
    """Differentiate the predicted volts by coefficients, V per their unit, (k, m, p)."""
    force = stage_force(unit, poses.alpha_rad, poses.beta_rad)

    def slope(name: Coefficient) -> np.ndarray:
        value, step = get(unit, [name]), _COEFFICIENT_STEP * parameter_of(name).scale
        shared = None if _is_of_stage(name.effect) else force
        above, below = (
            predicted_volts(put(unit, [name], value + change), poses, force=shared)
            for change in (step, -step)
        )
        return (above - below) / (2 * step)

    return np.stack([slope(name) for name in names], axis=2)


ENCODER_STEPS = 1.5
"""Largest change of an encoder at rest, in its steps. Chosen: it may flicker by one step."""
COMMAND_RAD = 1e-9
"""Commands that differ by less are equal, rad. Chosen: above the rounding of a message."""
_MAX_READINGS = 100_000
"""Largest number of readings in memory; older ones are forgotten. Chosen: 1000 s at 100 Hz."""


def angle_tolerance_rad(sensor: Sensor) -> float:
    """Return the largest change of an encoder's reading that is no move, rad."""
    return max(ENCODER_STEPS * sensor.stage_resolution_rad, SAME_ANGLE_RAD)


def _moved(
    readings_rad: np.ndarray,
    before_rad: Any,
    commands_rad: np.ndarray,
    held_rad: Any,
    tolerance_rad: float,
) -> Any:
    """
    Return whether joints have moved from one pose to the next, by their encoder or their command.

    readings_rad, before_rad: readings between the poses with the mean of the second one, (n,) or
    (n, joints), and the mean of the first one; commands_rad, held_rad: commands between the poses,
    and the one before. NaN where there is none.
    """
    low, high = (extreme(readings_rad, axis=0) for extreme in (np.fmin.reduce, np.fmax.reduce))
    first, last = (
        extreme(commands_rad, axis=0, initial=np.nan)
        for extreme in (np.fmin.reduce, np.fmax.reduce)
    )
    return (
        (np.fmax(high - before_rad, before_rad - low) > tolerance_rad)
        | (np.fmax(last - held_rad, held_rad - first) > COMMAND_RAD)
        | (np.isnan(held_rad) & np.isfinite(last))
    )


def recorded_settings(
    rests: np.ndarray,
    readings_rad: np.ndarray | None,
    commands_rad: np.ndarray | None,
    tolerance_rad: float,
) -> np.ndarray:
    """
    Return the number of the setting of one joint in each rest of a recording, (k,) int.

    rests: first row and row after the last of each rest, (k, 2), in any order; readings_rad,
    commands_rad: encoder and command at each sample, (n,); NaN or None where there is none.
    """
    missing = np.full(int(rests.max(initial=0)), np.nan)
    readings, commands = (missing if v is None else v for v in (readings_rad, commands_rad))
    order = np.argsort(rests[:, 0], kind='stable')
    start, stop = rests[order].T
    middle, settings = (start + stop) // 2, np.zeros(len(rests), int)
    means_rad = np.array([_mean_of_finite(readings[a:b]) for a, b in zip(start, stop)])
    before_rad, held_rad = (
        block_statistics.held_values(v, np.isfinite(v)) for v in (means_rad, commands)
    )
    settings[order[1:]] = np.cumsum(
        [
            _moved(
                np.append(readings[middle[i] : middle[i + 1]], means_rad[i + 1]),
                before_rad[i],
                commands[start[i] + 1 : start[i + 1] + 1],
                held_rad[start[i]],
                tolerance_rad,
            )
            for i in range(len(rests) - 1)
        ]
    )
    return settings


def poses_of_means(recording: Recording, sensor: Sensor) -> Poses:
    """
    Return the poses of a table of which each row is the mean of a rest.

    The noise of the means is not known. Against gravity, 0 stands for it, and the residuals show
    it; against a stage, it is at most that of a sample.
    """
    volts, columns = recording.volts(sensor), recording.columns
    missing, std_v = np.full(len(recording), np.nan), np.zeros_like(volts)
    angles = recording.stage_angles
    alpha_rad, beta_rad = (missing, missing) if angles is None else angles.T
    if angles is not None:
        std_v += sample_std_v(sensor)
    if angles is not None and not std_v.any():
        raise UserError(
            f'{recording.path}: nothing states the noise of means with stage angles; '
            f'state sensor.noise_density_g_per_rthz in the file of {option("sensor")}, or leave '
            'alpha and beta out'
        )
    return Poses(
        volts,
        std_v,
        alpha_rad,
        beta_rad,
        np.zeros((len(recording), 2)),
        np.zeros(len(recording), bool),
        columns.get('temperature_c', missing),
        columns.get('supply_v', missing),
    )


def _surroundings(
    recording: Recording,
    name: str,
    rests: Sequence[Rest],
    means: Callable[[np.ndarray | None], np.ndarray],
) -> np.ndarray:
    """Return the mean of a column at each rest, (k,); between others where a rest has none."""
    values = recording.columns.get(name)
    at_rest = means(values)
    is_missing = np.isnan(at_rest)
    if values is not None and np.isfinite(values).any():
        known = np.isfinite(values)
        middle_s = np.array([(rest.time_start_s + rest.time_stop_s) / 2 for rest in rests])
        at_rest[is_missing] = np.interp(
            middle_s[is_missing], recording.time_s[known], values[known]
        )
    return at_rest


def _mean_of_finite(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float('nan')


class SettingTracker:
    """Numbers the settings of alpha and beta while a sweep runs, after those of its poses."""

    def __init__(self, tolerance_rad: float, taken: Sequence[PoseRecord] = ()) -> None:
        self._tolerance_rad = tolerance_rad
        numbers = [
            [
                -1 if number is None else number
                for number in (record.alpha_setting, record.beta_setting)
            ]
            for record in taken
        ]
        self._settings = np.max([[-1, -1], *numbers], axis=0)
        self._mean_rad = np.full(2, np.nan)
        self._readings, self._commands = (deque[_Stamped](maxlen=_MAX_READINGS) for _ in range(2))
        # First and last stamp of the newest pose, ns; None if the stage may have moved unseen
        self._newest_ns: tuple[int, int] | None = None

    def read(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add an encoder reading."""
        self._readings.append((stamp_ns, (alpha_rad, beta_rad)))

    def between(self, first_ns: int, last_ns: int) -> np.ndarray:
        """Return the encoder's angles alpha and beta between two stamps, rad, (n, 2)."""
        return _between(self._readings, first_ns - 1, last_ns)

    def command(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add a command, which is in force from its stamp on."""
        before = self._commands[-1][1] if self._commands else (np.nan, np.nan)
        new = tuple(a if np.isfinite(a) else b for a, b in zip((alpha_rad, beta_rad), before))
        if new != before:
            self._commands.append((stamp_ns, new))

    def lose_track(self) -> None:
        """Count both joints as moved before the next pose; stamps may begin again."""
        self._newest_ns = None
        self._readings.clear()
        held = [(-np.inf, angles) for _, angles in self._commands][-1:]
        self._commands.clear()
        self._commands.extend(held)

    def settings(
        self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float
    ) -> tuple[int, int]:
        """Return the numbers of the settings of alpha and beta in the next pose."""
        moved = np.ones(2, bool)
        if self._newest_ns is not None:
            first_ns = self._newest_ns[0]
            seen = _between(self._readings, sum(self._newest_ns) // 2, (start_ns + stop_ns) // 2)
            seen = np.vstack([seen, (alpha_rad, beta_rad)])
            held = np.vstack([(np.nan, np.nan), _between(self._commands, -np.inf, first_ns)])[-1]
            moved = _moved(
                seen,
                self._mean_rad,
                _between(self._commands, first_ns, start_ns),
                held,
                self._tolerance_rad,
            )
        alpha, beta = self._settings + moved
        return int(alpha), int(beta)

    def take(self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Make a pose the newest one."""
        self._settings = np.array(self.settings(start_ns, stop_ns, alpha_rad, beta_rad))
        mean = np.array([alpha_rad, beta_rad])
        self._mean_rad = np.where(np.isfinite(mean), mean, self._mean_rad)
        self._newest_ns = start_ns, stop_ns


_Stamped = tuple[float, tuple[float, ...]]
"""A stamp, ns, and the angles of both joints from then on, rad."""


def _between(kept: Iterable[_Stamped], after_ns: float, last_ns: float) -> np.ndarray:
    """Return the angles after a stamp, up to another one, rad, (n, 2)."""
    return np.array(
        [angles for stamp_ns, angles in kept if after_ns < stamp_ns <= last_ns]
    ).reshape(-1, 2)


_MAX_PERIODS = 1.5
"""Largest distance of neighbouring samples in a rest without gaps, sample periods."""
_MIN_SAMPLES = 0.9
"""Smallest share of the samples of a pose in the journal that its recording must have."""


_SHORTEST_SPAN_S = 0.5  # Shortest rest of a table, s. Chosen: ten blocks show the error of a mean


def _named_rests(recording: Recording, records: Sequence[PoseRecord]) -> list[Rest]:
    """Find the rows of the rests that a journal names by their first and last stamp."""
    rests, stamps_ns = [], recording.stamp_ns
    for number, record in enumerate(records, 1):
        start = int(np.searchsorted(stamps_ns, record.start_ns, 'left'))
        stop = int(np.searchsorted(stamps_ns, record.stop_ns, 'right'))
        if stop - start < _MIN_SAMPLES * record.samples:
            raise UserError(
                f'{recording.path}: has {stop - start} samples between the stamps of '
                f'pose {number} of the journal, which has {record.samples}; give '
                'the recording of the same run'
            )
        rests.append(
            Rest(start, stop, float(recording.time_s[start]), float(recording.time_s[stop - 1]))
        )
    return rests


def _rests_of_table(recording: Recording, path: str, spans_s: np.ndarray) -> list[Rest]:
    """Return the rests between stamps of a recording, s, (k, 2), that a table names."""
    rests, fewest = [], _SHORTEST_SPAN_S * recording.rate_hz
    # The stamps as the recording states them
    time_s = recording.time_s + recording.epoch_ns * 1e-9
    for number, (start_s, stop_s) in enumerate(spans_s.tolist(), 1):
        start, stop = np.searchsorted(time_s, start_s), np.searchsorted(time_s, stop_s, 'right')
        if not stop - start >= fewest:
            raise UserError(
                f'{path}: pose {number} is from {start_s:.6g} to {stop_s:.6g} s, in which '
                f'{recording.path} has {max(stop - start, 0)} samples, expected {fewest:.0f} at '
                f'least; its stamps are {time_s[0]:.6g} to {time_s[-1]:.6g} s'
            )
        first_s, last_s = recording.time_s[[start, stop - 1]].tolist()
        rests.append(Rest(int(start), int(stop), first_s, last_s))
    return rests


def extract_poses(
    recording: Recording,
    sensor: Sensor,
    records: Sequence[PoseRecord] | None = None,
    table: PoseTable | None = None,
) -> Poses:
    """Find the rests of a recording, or take those of a journal or a table, and average each."""
    volts, angles = recording.volts(sensor), recording.stage_angles
    if table is not None and table.spans_s is not None:
        rests = _rests_of_table(recording, table.path, table.spans_s)
    elif records is None:
        finder = rest_detection.recording_finder(sensor, angles is not None)
        finder.feed(recording.time_s, volts, angles)
        rests = finder.rests()
    else:
        rests = _named_rests(recording, records)
    if not rests:
        raise UserError(
            f'{recording.path}: the sensor is nowhere at rest; hold it still for at '
            'least 1 s in each pose'
        )

    def means(values: np.ndarray | None) -> np.ndarray:
        return np.array(
            [
                np.nan if values is None else _mean_of_finite(values[rest.start : rest.stop])
                for rest in rests
            ]
        )

    mean, std = rest_detection.rest_means(
        recording.time_s, volts, rests, sensor.rate_hz, rest_detection.datasheet_noise(sensor)
    )
    measured = {
        'volts': mean,
        'std_v': std,
        'time_s': np.array([[rest.time_start_s, rest.time_stop_s] for rest in rests]),
        **{
            name: _surroundings(recording, name, rests, means)
            for name in ('temperature_c', 'supply_v')
        },
    }
    if records is not None:
        return replace(Poses.from_records(records), **measured)
    alpha_rad, beta_rad = (
        means(None if angles is None else angles[:, joint]) for joint in range(2)
    )
    for joint in ('alpha', 'beta'):
        readings, commands = (
            recording.columns.get(name) for name in (JOINTS[joint], COMMANDS[joint])
        )
        if readings is not None or commands is not None:
            measured[f'{joint}_setting'] = recorded_settings(
                np.array([[rest.start, rest.stop] for rest in rests]),
                readings,
                commands,
                angle_tolerance_rad(sensor),
            )
    return Poses(
        alpha_rad=alpha_rad, beta_rad=beta_rad, check=np.zeros(len(rests), bool), **measured
    )


def estimate_filters(
    recording: Recording, sensor: Sensor, poses: Poses
) -> list[recorded_sensor.FilterNoise | None]:
    """Estimate the output filter of each axis from the noise of the poses."""
    volts, gapless = recording.volts(sensor), []
    for begin, end in zip(*np.searchsorted(recording.time_s, poses.time_s.T)):
        steps_s = np.diff(recording.time_s[begin : end + 1])
        if steps_s.size and steps_s.max() * sensor.rate_hz < _MAX_PERIODS:
            gapless.append(volts[begin : end + 1])
    return [
        recorded_sensor.estimate_filter(
            [rest[:, d] for rest in gapless], sensor.rate_hz, sensor.rc_s, sensor.lsb_v
        )
        for d in range(len(sensor.axes))
    ]
