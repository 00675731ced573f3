# SPDX-License-Identifier: Apache-2.0

"""Bags, written block by block, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import threading
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.atomic_write import AnyPath, atomic_path, release_written
from adxl_ros.files.bag_messages import (
    Batch,
    BATTERY_STATE,
    DIAGNOSTIC_STATUS,
    import_rosbags,
    IMU,
    JOINT_STATE,
    TEMPERATURE,
    typestore,
    write_messages,
)
from adxl_ros.files.column_mapping import Columns
from adxl_ros.files.recording_columns import COMMANDS, JOINTS, Recording
from adxl_ros.files.stream_info import converted_info
from adxl_ros.files.tables import TABLE_ENDINGS
from adxl_ros.model.covariance import imu_covariance, NOT_MEASURED
from adxl_ros.model.sensor import Sensor
import numpy as np

FRAME = 'imu_link'  # Frame of the sensor's messages (REP-145)

_ROWS_AT_ONCE = 65536  # Samples that are made into messages at a time (chosen: some 20 MB)
_END_OF_TIME_NS = (1 << 31) * 1_000_000_000
"""First stamp that is too late, ns: builtin_interfaces/Time has 32 bits of signed seconds."""
_LONGEST_NS = (1 << 63) - 1  # Largest duration of ROS, ns: a QoS without a deadline
_OTHER_FORMATS = {
    *TABLE_ENDINGS,
    *('.csv', '.tsv', '.txt', '.json', '.yaml', '.xlsx', '.h5', '.feather', '.npy', '.pkl'),
    *('.mcap', '.db3', '.bag'),
}
"""
Ends of the names of files, in lower case, that are no bags or only read.

Of them '.mcap' is written where it is in lower case.
"""
_VOLTAGE = np.array([0.0, *[np.nan] * 6], np.float32)
"""Voltage of a battery; temperature, current, charge, capacities and percentage are unknown."""
_FLUSH_NS = 500_000_000
"""Time after which messages are written to the file, ns. Chosen: what a kill loses."""


class TopicForm(NamedTuple):
    """How the messages of a topic are written."""

    kind: str  # Their type
    find: Callable[[bytes], cdr.Layout]  # Finds the fields of a message
    template: bytes  # A message


class _NewBag:
    """Writes the messages of a new bag by topic."""

    def __init__(self, path: Path, writer: Any) -> None:
        self.path = path
        self.writer = writer
        self.types = typestore()
        self.connections: dict[str, Any] = {}

    def connection(self, topic: str, kind: str, qos: Sequence[Any] = ()) -> Any:
        """Return the connection of a topic; without a QoS, `ros2 bag play` takes its default."""
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(
                topic, kind, typestore=self.types, offered_qos_profiles=qos
            )
        return self.connections[topic]

    def batch(self, topic: str, form: TopicForm, stamp_ns: np.ndarray, fields: Columns) -> Batch:
        """Return the messages of a topic at stamps, ns, (n,), rising."""
        return Batch(
            self.connection(topic, form.kind),
            stamp_ns,
            cdr.fill(form.template, form.find, stamp_ns, fields),
        )

    def append(self, batches: Sequence[Batch]) -> None:
        """Append messages, those of the sensor first."""
        stamp_ns = batches[0].stamp_ns
        if stamp_ns[0] < 0 or stamp_ns[-1] >= _END_OF_TIME_NS:
            raise UserError(
                f'{self.path}: times from {stamp_ns[0] / 1e9:g} to '
                f'{stamp_ns[-1] / 1e9:g} s cannot be stamps of ROS messages, '
                'which go from 0 to 2^31 s'
            )
        write_messages(self.writer, batches)
        release_written(self.writer.storage.bio)


def _check_ending(path: Path) -> None:
    """Refuse a directory with the name of a file of another format."""
    if path.suffix != '.mcap' and path.suffix.lower() in _OTHER_FORMATS:
        raise UserError(
            f'{path}: files that end in {path.suffix} are not written; write NAME.csv, '
            'NAME.mcap, or NAME for a rosbag2 directory'
        )


@contextmanager
def _new_bag(path: AnyPath) -> Iterator[_NewBag]:
    """Open a rosbag2 directory, or one file for a name.mcap; it appears with the block's end."""
    _check_ending(Path(path))
    rosbag2 = import_rosbags()
    with atomic_path(path) as fresh:
        # rosbags writes directories; of a name.mcap, only the file inside is kept.
        folder = fresh.with_suffix('') if fresh.suffix == '.mcap' else fresh
        with rosbag2.Writer(
            folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
        ) as writer:
            yield _NewBag(Path(path), writer)
        if folder != fresh:
            os.replace(folder / f'{folder.name}.mcap', fresh)


@contextmanager
def recording_bag(path: AnyPath, sensor: Sensor) -> Iterator[Callable[[Recording], None]]:
    """
    Open a new bag, and yield a function that appends samples of a recording.

    References get the stamps of their samples. A command becomes a message where it changes, and
    once every 65536 samples. The gyroscope is the angular velocity. Columns with other names
    are left out.
    """
    imu = _imu_form(imu_covariance(sensor))
    with _new_bag(path) as bag:

        def append(recording: Recording) -> None:
            if not bag.connections:
                _write_info(bag, recording, sensor)
            for start in range(0, len(recording), _ROWS_AT_ONCE):
                part = recording.rows(start, start + _ROWS_AT_ONCE)
                accel = part.accel_mps2(sensor)
                force = np.zeros((len(part), 3))
                force[:, : accel.shape[1]] = accel
                batches = [
                    bag.batch(
                        '/imu/data_raw',
                        imu,
                        part.stamp_ns,
                        {'linear_acceleration': force, **angular_velocity(part.gyro_radps)},
                    ),
                    *_joint_batches(
                        bag, part.stamp_ns, part.columns, JOINTS, '/stage/joint_states'
                    ),
                    *_joint_batches(
                        bag, part.stamp_ns, _changes(part.columns), COMMANDS, '/stage/command'
                    ),
                ]
                for column, scalar in _SCALARS.items():
                    values = part.columns.get(column, np.full(len(part), np.nan))
                    is_known = ~np.isnan(values)
                    if is_known.any():
                        fields = {scalar.field: values[is_known]}
                        stamp_ns = part.stamp_ns[is_known]
                        batches.append(bag.batch(scalar.topic, scalar.form, stamp_ns, fields))
                bag.append(batches)

        yield append


def _write_info(bag: _NewBag, recording: Recording, sensor: Sensor) -> None:
    """Write what the sensor states, latched for late subscribers of `ros2 bag play`."""
    from rosbags import interfaces as ros

    kinds = bag.types.types
    info = converted_info(recording.info, sensor)
    message = kinds[DIAGNOSTIC_STATUS](
        level=0,
        name='sensor_info',
        message='',
        hardware_id=info['serial'],
        values=[
            kinds['diagnostic_msgs/msg/KeyValue'](key=key, value=value)
            for key, value in info.items()
        ],
    )
    forever = ros.QosTime(*divmod(_LONGEST_NS, 1_000_000_000))
    latched = ros.Qos(
        history=ros.QosHistory.KEEP_LAST,
        depth=1,
        reliability=ros.QosReliability.RELIABLE,
        durability=ros.QosDurability.TRANSIENT_LOCAL,
        deadline=forever,
        lifespan=forever,
        liveliness=ros.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )
    bag.writer.write(
        bag.connection('/sensor_info', DIAGNOSTIC_STATUS, [latched]),
        int(recording.stamp_ns[0]),
        bag.types.serialize_cdr(message, DIAGNOSTIC_STATUS),
    )


def _joint_batches(
    bag: _NewBag,
    stamp_ns: np.ndarray,
    columns: Columns,
    names: Mapping[str, str],
    topic: str,
) -> Iterator[Batch]:
    """Yield one batch for each set of joints that were sampled together."""
    none = np.full(len(stamp_ns), np.nan)
    values = np.column_stack([columns.get(column, none) for column in names.values()])
    is_sampled = ~np.isnan(values)
    for pattern in np.unique(is_sampled, axis=0):
        rows = (is_sampled == pattern).all(axis=1)
        sampled = [joint for joint, is_there in zip(names, pattern) if is_there]
        count = len(sampled)
        # Frame, names, positions, no velocities, no efforts; each array begins with its length.
        template = cdr.message('', count, *sampled, count, np.zeros(count), 0, 0)
        if sampled:
            yield bag.batch(
                topic,
                TopicForm(JOINT_STATE, cdr.joint_state, template),
                stamp_ns[rows],
                {'position': values[rows][:, pattern]},
            )


def _changes(columns: Columns) -> dict[str, np.ndarray]:
    """Return commands where they change and in the first row, NaN elsewhere."""
    return {
        name: np.where(
            np.append(True, columns[name][1:] != columns[name][:-1]), columns[name], np.nan
        )
        for name in COMMANDS.values()
        if name in columns
    }


def angular_velocity(
    gyro_radps: np.ndarray | None, variance: np.ndarray | float = 0.0
) -> dict[str, np.ndarray]:
    """
    Return the fields of sensor_msgs/Imu by name for a gyroscope, rad/s, (n, 3); none for None.

    variance: that of each axis, (rad/s)², 0 where it is not known (REP-145). A sample that was
    not taken has no angular velocity.
    """
    if gyro_radps is None:
        return {}
    is_taken = np.isfinite(gyro_radps).all(axis=1)[:, None]
    covariance = np.zeros((len(gyro_radps), 9))
    covariance[:, [0, 4, 8]] = variance
    return {
        'angular_velocity': np.where(is_taken, gyro_radps, 0.0),
        'angular_velocity_covariance': np.where(is_taken, covariance, NOT_MEASURED),
    }


def _imu_form(covariance: np.ndarray) -> TopicForm:
    """Return the form of an Imu without orientation and rate, by its covariance, (9,)."""
    return TopicForm(
        IMU,
        cdr.imu,
        cdr.message(
            FRAME,
            [0.0, 0.0, 0.0, 1.0],
            NOT_MEASURED,
            np.zeros(3),
            NOT_MEASURED,
            np.zeros(3),
            covariance,
        ),
    )


class _Scalar(NamedTuple):
    """The topic of a reference that is one number."""

    topic: str
    field: str  # Field of its messages
    form: TopicForm


_SCALARS = {
    'temperature_c': _Scalar(
        '/temperature',
        'temperature',
        TopicForm(TEMPERATURE, cdr.temperature, cdr.message(FRAME, np.zeros(2))),
    ),
    'supply_v': _Scalar(
        '/supply',
        'voltage',
        TopicForm(
            # Three states, present, no cell voltages and temperatures, location, serial number.
            BATTERY_STATE,
            cdr.battery_state,
            cdr.message(FRAME, _VOLTAGE, np.array([0, 0, 0, 1], np.uint8), 0, 0, '', ''),
        ),
    ),
}
"""References that are one number, by column."""


@contextmanager
def tilt_bag(path: AnyPath) -> Iterator[Callable[..., None]]:
    """
    Open a new bag, and yield a function that appends messages of `imu/data` and `tilt`.

    Its arguments are stamps, ns, (n,), rising; fields of sensor_msgs/Imu by name, (n, k) each;
    and roll, pitch and inclination, rad, (n, 3).
    """
    forms = {
        '/imu/data': _imu_form(np.zeros(9)),
        '/tilt': TopicForm(
            'geometry_msgs/msg/Vector3Stamped',
            cdr.vector3_stamped,
            cdr.message(FRAME, np.zeros(3)),
        ),
    }
    with _new_bag(path) as bag:
        for topic, form in forms.items():
            bag.connection(topic, form.kind)

        def append(stamp_ns: np.ndarray, imu_fields: Columns, tilt_rad: np.ndarray) -> None:
            if len(stamp_ns):
                fields = {'/imu/data': imu_fields, '/tilt': {'vector': tilt_rad}}
                bag.append(
                    [
                        bag.batch(topic, form, stamp_ns, fields[topic])
                        for topic, form in forms.items()
                    ]
                )

        yield append


class LiveBag:
    """
    Writes serialized messages into a rosbag2 directory as they come, from any thread.

    A reader, or a kill, finds all messages but those of the last half second.
    """

    def __init__(self, path: Path) -> None:
        """Open a new bag."""
        rosbag2 = import_rosbags()
        self._writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        self._writer.open()
        self._bag = _NewBag(path, self._writer)
        self._flushed_ns = 0
        self._lock = threading.RLock()
        self._is_open = True

    def write(self, topic: str, kind: str, data: bytes, time_ns: int) -> None:
        """Append a message; one that comes after the end is left out."""
        with self._lock:
            if not self._is_open:
                return
            self._writer.write(self._bag.connection(topic, kind), time_ns, data)
            if time_ns - self._flushed_ns > _FLUSH_NS:
                self.flush()
                self._flushed_ns = time_ns

    def close(self) -> None:
        """Write the end of the bag."""
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._writer.close()

    def flush(self) -> None:
        """Write the messages so far to the file."""
        with self._lock:
            storage = self._writer.storage
            if self._is_open and storage.chunk.bio.tell():
                storage.close_chunk()
                storage.bio.flush()
