# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
        """
        Prepare to write to `path`, which is replaced if it exists.

        Raises
        ------
        UserError
            The library rosbags is not installed.

        """
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

        Parameters
        ----------
        stamp_ns
            Stamps, ns, (n,), rising.
        imu_fields
            Fields of sensor_msgs/Imu by name, (n, k) each.
        tilt_rad
            Roll, pitch and inclination, rad, (n, 3).

        Raises
        ------
        UserError
            A time cannot be a stamp.

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
