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

"""
Recordings, whatever their format: rosbag2 directories, single bag files, CSV.

What a path holds is told by what is there when it is read, and by its name when it is written:
`.csv` is CSV, `.mcap` one bag file, everything else a rosbag2 directory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import bag_reader, csv_file
from adxl_ros.files.bag_writer import BagWriter
from adxl_ros.files.csv_writer import CsvWriter, recording_columns, recording_info
from adxl_ros.files.recording_columns import ACCEL, concatenate, Recording
from adxl_ros.model.sensor import Sensor
import numpy as np

_BLOCK_ROWS = 65536
_MAGIC = {b'\x89MCAP': '.mcap', b'SQLite format 3': '.db3', b'\x28\xb5\x2f\xfd': '.zstd',
          b'#ROSBAG': '.bag'}


def read(path: str | os.PathLike) -> Recording:
    """
    Read a whole recording.

    Raises
    ------
    UserError
        It cannot be read, or holds something that no sensor gives.

    """
    whole = concatenate(blocks(path, _BLOCK_ROWS))
    if _is_bag(path):
        bag_reader.drop_unsampled(whole)
    return whole


def blocks(path: str | os.PathLike, rows: int) -> Iterator[Recording]:
    """
    Read a recording in blocks of at most `rows` samples, in memory bounded by a block.

    All blocks have the same columns, but for a CSV column that turns out to be text further down.
    The notes of a block tell of the recording up to its end.

    Raises
    ------
    UserError
        It cannot be read, or holds something that no sensor gives.

    """
    return bag_reader.blocks(path, rows) if _is_bag(path) else csv_file.blocks(path, rows)


def read_ideal(path: str | os.PathLike, epoch_ns: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """
    Read the ideal specific force that another simulator gave.

    Parameters
    ----------
    path
        A CSV file with `time_s, ax_mps2, ay_mps2, az_mps2`, or a bag with one topic of type
        sensor_msgs/Imu, or several of which one is `imu/data_raw`.
    epoch_ns
        What the times shall count from: `epoch_ns` of the real recording of the manoeuvre.

    Returns
    -------
    Times, s, (n,), and specific force in the case frame, m/s², (n, 3).

    Raises
    ------
    UserError
        It cannot be read, or an axis is missing.

    """
    parts = (bag_reader.blocks(path, _BLOCK_ROWS, ideal=True) if _is_bag(path)
             else csv_file.blocks(path, _BLOCK_ROWS, needed=ACCEL))
    ideal = concatenate(parts)
    time_s = ideal.time_s + (ideal.epoch_ns - epoch_ns) / 1e9
    return time_s, np.column_stack([ideal.columns[name] for name in ACCEL])


@contextmanager
def writer(path: str | os.PathLike, sensor: Sensor) -> Iterator[Callable[[Recording], None]]:
    """
    Yield a function that appends a block of samples to the recording `path`.

    The recording appears under its name when the block ends without an error, or not at all.

    Parameters
    ----------
    path
        Its ending tells the format.
    sensor
        The unit whose nominal conversion a bag holds.

    Raises
    ------
    UserError
        It cannot be written.

    """
    if Path(path).suffix == '.csv':
        with CsvWriter(path) as file:
            yield lambda part: file.write(recording_columns(part), recording_info(part))
    else:
        with BagWriter(path, sensor) as bag:
            yield bag.write


def write(path: str | os.PathLike, recording: Recording, sensor: Sensor) -> None:
    """
    Write a whole recording, in the format that the ending of `path` tells.

    Raises
    ------
    UserError
        It cannot be written.

    """
    with writer(path, sensor) as append:
        append(recording)


def _is_bag(path: str | os.PathLike) -> bool:
    """Tell bags from CSV files, refusing what is neither or has a misleading name."""
    place = Path(path)
    if place.is_dir():
        return True
    try:
        with open(place, 'rb') as file:
            head = file.read(16)
    except OSError as error:
        raise UserError(f'{place}: cannot read: {error.strerror or error}') from None
    ending = next((ending for magic, ending in _MAGIC.items() if head.startswith(magic)), None)
    if ending == '.bag':
        raise UserError(f'{place}: is a bag of ROS 1; convert it: rosbags-convert --src {place} '
                        f'--dst {place.with_suffix("")}')
    if ending == '.zstd':
        raise UserError(f'{place}: is compressed; name the directory with its metadata.yaml, '
                        f'or unpack it: zstd -d {place}')
    if ending and place.suffix != ending:
        raise UserError(f'{place}: is a bag; rename it so that it ends in {ending}')
    return place.suffix in ('.mcap', '.db3')
