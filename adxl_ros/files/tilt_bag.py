# SPDX-License-Identifier: Apache-2.0

"""Bags of corrected samples: `imu/data` and `tilt`, as the node `compensation` publishes them."""

from __future__ import annotations

from collections.abc import Mapping
import os

from adxl_ros.files import cdr
from adxl_ros.files.bag_topics import IMU
from adxl_ros.files.bag_writer import FRAME, imu_template, message_header, OpenBag
from adxl_ros.files.mcap_chunks import Batch
import numpy as np

_VECTOR = 'geometry_msgs/msg/Vector3Stamped'
"""Type of the tilt."""


class TiltBag(OpenBag):
    """Writes corrected samples block by block: a message of `imu/data` and `tilt` for each."""

    def __init__(self, path: str | os.PathLike) -> None:
        """Prepare to write to `path`, which is replaced if it exists."""
        super().__init__(path)
        self._imu = imu_template(self.types, np.zeros(9))
        kinds = self.types.types
        zero = kinds['geometry_msgs/msg/Vector3'](x=0.0, y=0.0, z=0.0)
        self._tilt = bytes(self.types.serialize_cdr(
            kinds[_VECTOR](header=message_header(self.types, FRAME), vector=zero), _VECTOR))

    def write(self, stamp_ns: np.ndarray, imu_fields: Mapping[str, np.ndarray],
              tilt_rad: np.ndarray) -> None:
        """
        Append samples.

        stamp_ns: stamps, ns, (n,), rising; imu_fields: fields of sensor_msgs/Imu by name, (n, k)
        each; tilt_rad: roll, pitch and inclination, rad, (n, 3).
        """
        data, tilt = self.connection('/imu/data', IMU), self.connection('/tilt', _VECTOR)
        if not len(stamp_ns):
            return
        self.check_stamps(stamp_ns)
        rows = np.arange(len(stamp_ns))
        self.write_messages(stamp_ns, [
            Batch(data, rows, cdr.fill(self._imu, cdr.imu(self._imu), stamp_ns, imu_fields)),
            Batch(tilt, rows, cdr.fill(self._tilt, cdr.vector3_stamped(self._tilt), stamp_ns,
                                       {'vector': tilt_rad}))])
