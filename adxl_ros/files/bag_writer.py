# SPDX-License-Identifier: Apache-2.0

"""Bags, written block by block, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
import os
from pathlib import Path
import threading
from types import TracebackType
from typing import Any, NamedTuple, TYPE_CHECKING

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.atomic_write import atomic_path, release_written
from adxl_ros.files.bag_messages import (
    BATTERY_STATE,
    DIAGNOSTIC_STATUS,
    import_rosbags,
    IMU,
    JOINT_STATE,
    TEMPERATURE,
    typestore,
)
from adxl_ros.files.mcap_file import Batch, write_messages
from adxl_ros.files.recording_columns import COMMANDS, converted_info, JOINTS, Recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.noise import sample_std_v
from adxl_ros.model.sensor import Sensor
import numpy as np

if TYPE_CHECKING:
    from typing import Self  # since Python 3.11

FRAME = 'imu_link'
"""Frame of the sensor's messages (REP-145)."""

_ROWS_AT_ONCE = 65536
"""Samples that are made into messages at a time (chosen: some 20 MB)."""

_END_OF_TIME_NS = (1 << 31) * 1_000_000_000
"""First stamp that is too late, ns: builtin_interfaces/Time has 32 bits of signed seconds."""

_LONGEST_NS = (1 << 63) - 1
"""Largest duration of ROS, ns: a QoS without a deadline."""

_LATCHED_DEPTH = 1
"""Messages that a latched topic keeps for late subscribers."""

_DEPTH = 10
"""Messages that any other topic keeps, the default depth of ROS."""


class Form(NamedTuple):
    """How the messages of a topic are written."""

    kind: str  # Their type
    find: Callable[[bytes], cdr.Layout]  # Finds the fields of a message
    template: bytes  # A message


class OpenBag:
    """
    A new bag: a rosbag2 directory, or one file for a name.mcap.

    A context manager: the bag appears under its name when the block ends without an error.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        """Prepare to write to `path`, which is replaced if it exists."""
        self._path = Path(path)
        self._rosbag2 = import_rosbags()
        self.types = typestore()
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Open a new bag next to the one to replace."""
        with ExitStack() as stack:
            fresh = stack.enter_context(atomic_path(self._path))
            folder = fresh
            if self._path.suffix == '.mcap':
                # rosbags writes directories; only the file inside is kept.
                folder = fresh.with_suffix('')
                stack.callback(_keep_file, folder / f'{folder.name}.mcap', fresh)
            self._writer = stack.enter_context(self._rosbag2.Writer(
                folder, version=9, storage_plugin=self._rosbag2.StoragePlugin.MCAP))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Close the bag and, if all went well, put it in its place."""
        self._stack.__exit__(kind, error, trace)

    def connection(self, topic: str, kind: str, is_latched: bool = False) -> Any:
        """Return the connection of a topic."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self.types, offered_qos_profiles=[_qos(is_latched)])
        return self._connections[topic]

    def check_stamps(self, stamp_ns: np.ndarray) -> None:
        """Refuse stamps, ns, (n,), rising, that a ROS message cannot have."""
        if stamp_ns[0] < 0 or stamp_ns[-1] >= _END_OF_TIME_NS:
            raise UserError(f'{self._path}: times from {stamp_ns[0] / 1e9:g} to '
                            f'{stamp_ns[-1] / 1e9:g} s cannot be stamps of ROS messages, '
                            'which go from 0 to 2^31 s')

    def batch(self, topic: str, form: Form, stamp_ns: np.ndarray, rows: np.ndarray,
              fields: Mapping[str, np.ndarray]) -> Batch:
        """Return the messages of some samples of all, whose stamps are `stamp_ns`."""
        return Batch(self.connection(topic, form.kind), rows,
                     cdr.fill(form.template, form.find, stamp_ns[rows], fields))

    def write_messages(self, stamp_ns: np.ndarray, batches: Sequence[Batch]) -> None:
        """
        Append the messages of samples.

        stamp_ns: stamps of the samples, ns, (n,), rising.
        """
        write_messages(self._writer, stamp_ns, batches)
        release_written(self._writer.storage.bio)


class BagWriter(OpenBag):
    """
    Writes the samples of a recording, block by block, into a bag.

    Each sample becomes a message of `imu/data_raw`. Sampled references become messages of
    `stage/joint_states`, `temperature` and `supply` with the same stamp; the voltage of
    sensor_msgs/BatteryState is float32. A command becomes a message of `stage/command` where it
    changes, and once every 65536 samples. Columns with other names are left out.
    """

    def __init__(self, path: str | os.PathLike, sensor: Sensor) -> None:
        """Prepare to write to `path`."""
        super().__init__(path)
        self._sensor = sensor
        self._imu = _imu_form(_noise_covariance(sensor))

    def write(self, recording: Recording) -> None:
        """Append samples."""
        stamp_ns = recording.stamp_ns
        self.check_stamps(stamp_ns)
        if '/sensor_info' not in self._connections:
            self._write_info(recording, int(stamp_ns[0]))
        accel = recording.accel_mps2(self._sensor)
        for start in range(0, len(recording), _ROWS_AT_ONCE):
            part = slice(start, start + _ROWS_AT_ONCE)
            references = {name: values[part] for name, values in recording.columns.items()}
            force = np.zeros((len(stamp_ns[part]), 3))
            force[:, :accel.shape[1]] = accel[part]
            batches = [self.batch('/imu/data_raw', self._imu, stamp_ns[part],
                                  np.arange(len(force)), {'linear_acceleration': force}),
                       *self._joint_batches(stamp_ns[part], references, JOINTS,
                                            '/stage/joint_states'),
                       *self._joint_batches(stamp_ns[part], _changes(references), COMMANDS,
                                            '/stage/command')]
            for column, (topic, field, form) in _SCALARS.items():
                values = references.get(column, np.zeros(0))
                rows = np.flatnonzero(~np.isnan(values))
                if len(rows):
                    batches.append(self.batch(topic, form, stamp_ns[part], rows,
                                              {field: values[rows]}))
            self.write_messages(stamp_ns[part], batches)

    def _write_info(self, recording: Recording, stamp_ns: int) -> None:
        kinds = self.types.types
        pair = kinds['diagnostic_msgs/msg/KeyValue']
        info = converted_info(recording.info, self._sensor)
        message = kinds[DIAGNOSTIC_STATUS](
            level=0, name='sensor_info', message='', hardware_id=info['serial'],
            values=[pair(key=key, value=value) for key, value in info.items()])
        raw = self.types.serialize_cdr(message, DIAGNOSTIC_STATUS)
        connection = self.connection('/sensor_info', DIAGNOSTIC_STATUS, is_latched=True)
        self._writer.write(connection, stamp_ns, raw)

    def _joint_batches(self, stamp_ns: np.ndarray, columns: dict[str, np.ndarray],
                       names: Mapping[str, str], topic: str) -> list[Batch]:
        """Return one batch for each set of joints that were sampled together."""
        joints = {joint: columns[column] for joint, column in names.items() if column in columns}
        if not joints:
            return []
        values = np.column_stack(list(joints.values()))
        is_sampled = ~np.isnan(values)
        batches = []
        for pattern in np.unique(is_sampled, axis=0):
            rows = np.flatnonzero((is_sampled == pattern).all(axis=1))
            sampled_joints = [joint for joint, sampled in zip(joints, pattern) if sampled]
            if sampled_joints:
                count = len(sampled_joints)
                template = cdr.message('', count, *sampled_joints, count, np.zeros(count), 0, 0)
                batches.append(self.batch(topic, Form(JOINT_STATE, cdr.joint_state, template),
                                          stamp_ns, rows, {'position': values[rows][:, pattern]}))
        return batches


def _changes(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return commands where they change and in the first row, NaN elsewhere."""
    changed = {}
    for name in COMMANDS.values():
        if name in columns:
            values = columns[name]
            new = np.concatenate([[True], values[1:] != values[:-1]])
            changed[name] = np.where(new & np.isfinite(values), values, np.nan)
    return changed


def _keep_file(file: Path, target: Path) -> None:
    if file.exists():
        os.replace(file, target)


def _qos(is_latched: bool) -> Any:
    """Return the QoS of `ros2 bag play`: reliable, and latched for late subscribers if asked."""
    from rosbags import interfaces as ros
    durability = ros.QosDurability.TRANSIENT_LOCAL if is_latched else ros.QosDurability.VOLATILE
    forever = ros.QosTime(*divmod(_LONGEST_NS, 1_000_000_000))
    return ros.Qos(ros.QosHistory.KEEP_LAST, _LATCHED_DEPTH if is_latched else _DEPTH,
                   ros.QosReliability.RELIABLE, durability, forever, forever,
                   ros.QosLiveliness.AUTOMATIC, forever, False)


def _noise_covariance(sensor: Sensor) -> np.ndarray:
    """Return the covariance of the noise of one sample by rows, (m/s²)², (9,)."""
    variance = np.full(3, UNMEASURED_VARIANCE)
    noise = sample_std_v(sensor) / sensor.nominal_scale_v_per_g * G0_MPS2
    variance[:len(sensor.axes)] = noise ** 2
    return np.diag(variance).ravel()


def _imu_form(covariance: np.ndarray) -> Form:
    """
    Return the form of an Imu without orientation and angular velocity.

    covariance: that of the acceleration by rows, (m/s²)², (9,).
    """
    absent = [-1.0, *[0.0] * 8]
    return Form(IMU, cdr.imu, cdr.message(FRAME, [0.0, 0.0, 0.0, 1.0], absent, np.zeros(3), absent,
                                          np.zeros(3), covariance))


_VOLTAGE = np.array([0.0, *[np.nan] * 6], np.float32)
"""Voltage of a battery; temperature, current, charge, capacities and percentage are unknown."""

_SCALARS = {
    'temperature_c': ('/temperature', 'temperature', Form(
        TEMPERATURE, cdr.temperature, cdr.message(FRAME, np.zeros(2)))),
    'supply_v': ('/supply', 'voltage', Form(
        # Three states, present, no cell voltages and temperatures, location, serial number.
        BATTERY_STATE, cdr.battery_state, cdr.message(
            FRAME, _VOLTAGE, np.array([0, 0, 0, 1], np.uint8), 0, 0, '', ''))),
}
"""Topic, field and form of references that are one number, by column."""


_VECTOR = 'geometry_msgs/msg/Vector3Stamped'
"""Type of the tilt."""


class TiltBag(OpenBag):
    """Writes corrected samples block by block: a message of `imu/data` and `tilt` for each."""

    def __init__(self, path: str | os.PathLike) -> None:
        """Prepare to write to `path`, which is replaced if it exists."""
        super().__init__(path)
        self._imu = _imu_form(np.zeros(9))
        self._tilt = Form(_VECTOR, cdr.vector3_stamped, cdr.message(FRAME, np.zeros(3)))

    def write(self, stamp_ns: np.ndarray, imu_fields: Mapping[str, np.ndarray],
              tilt_rad: np.ndarray) -> None:
        """
        Append samples.

        stamp_ns: stamps, ns, (n,), rising; imu_fields: fields of sensor_msgs/Imu by name, (n, k)
        each; tilt_rad: roll, pitch and inclination, rad, (n, 3).
        """
        self.connection('/imu/data', IMU)
        self.connection('/tilt', _VECTOR)
        if len(stamp_ns):
            self.check_stamps(stamp_ns)
            rows = np.arange(len(stamp_ns))
            self.write_messages(stamp_ns, [
                self.batch('/imu/data', self._imu, stamp_ns, rows, imu_fields),
                self.batch('/tilt', self._tilt, stamp_ns, rows, {'vector': tilt_rad})])


_FLUSH_NS = 500_000_000
"""Time after which messages are written to the file, ns. Chosen: what a kill loses."""


class LiveBag:
    """
    Writes serialized messages of any topics into a rosbag2 directory, as they come.

    A reader, or a kill, finds all messages but those of the last half second. Threads may share
    it. Unlike `BagWriter`, it appears under its name at once.
    """

    def __init__(self, path: Path) -> None:
        """Open a new bag."""
        rosbag2 = import_rosbags()
        self._types = typestore()
        self._writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        self._writer.open()
        self._connections: dict[str, Any] = {}
        self._flushed_ns = 0
        self._lock = threading.Lock()
        self._is_open = True

    def write(self, topic: str, kind: str, data: bytes, time_ns: int) -> None:
        """Append a message; one that comes after the end is left out."""
        with self._lock:
            if not self._is_open:
                return
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, kind,
                                                                       typestore=self._types)
            self._writer.write(self._connections[topic], time_ns, data)
            if time_ns - self._flushed_ns > _FLUSH_NS:
                self._flush()
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
            if self._is_open:
                self._flush()

    def _flush(self) -> None:
        storage = self._writer.storage
        if storage.chunk.bio.tell():
            storage.close_chunk()
        storage.bio.flush()
