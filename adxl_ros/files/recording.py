# SPDX-License-Identifier: Apache-2.0

"""
Recordings of any format: rosbag2 directories, single bag files, CSV, and tables of other formats.

The content of a file decides its format when it is read, its name when it is written: `.csv` is
CSV, `.mcap` one bag file, everything else a rosbag2 directory.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import mapped_recording, mapping_proposal
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.column_mapping import (
    AS_IT_IS,
    parse_mapping,
    ReadingOptions,
    SignedAxes,
    Table,
)
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.recording_columns import ACCEL, concatenate, GYRO, Recording, TIME, VOLTS
from adxl_ros.files.tables import BLOCK_ROWS, open_table
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor
from adxl_ros.wording import option
import numpy as np

_MAGIC_BYTES = 16  # Bytes at the beginning of a file that show its format

_ENDINGS = {
    b'\x89MCAP': '.mcap',
    b'SQLite format 3': '.db3',
    b'\x28\xb5\x2f\xfd': '.zstd',
    b'#ROSBAG': '.bag',
}
"""Usual ends of file names by the first bytes of the files."""


def read(path: AnyPath, reading: ReadingOptions = AS_IT_IS) -> Recording:
    """
    Read a whole recording.

    Parameters
    ----------
    path
        The recording.
    reading
        Topic, columns and stamps where the recording does not state them.

    Returns
    -------
    Recording
        All samples.

    Raises
    ------
    UserError
        The recording cannot be read, or holds values that no sensor gives.

    """
    return concatenate(blocks(path, BLOCK_ROWS, reading))


def blocks(
    path: AnyPath, rows: int, reading: ReadingOptions = AS_IT_IS
) -> Generator[Recording, None, None]:
    """
    Read a recording in blocks of at most `rows` samples; the memory is bounded by a block.

    All blocks have the same columns, except for a CSV column that turns out to be text further
    down. Alignments, cut and remarks of a block are those up to its end.
    """
    if not is_bag(path):
        return _table_blocks(open_table(path, reading.topic), rows, reading)
    return _mounted(_bag_blocks(path, rows, reading=reading), reading.mounting)


def of_table(table: Table, reading: ReadingOptions = AS_IT_IS) -> Recording:
    """Return the whole recording that a table in memory holds."""
    return concatenate(_table_blocks(table, BLOCK_ROWS, reading))


def _bag_blocks(path: AnyPath, rows: int, **options: Any) -> Generator[Recording, None, None]:
    from adxl_ros.files import bag_reader  # tables need none of it

    return bag_reader.blocks(path, rows, **options)


def _table_blocks(
    table: Table, rows: int, reading: ReadingOptions
) -> Generator[Recording, None, None]:
    """Yield the blocks of a table; propose a mapping where it has none."""
    mapping = reading.mapping or (
        parse_mapping(table.default_mapping) if table.default_mapping else None
    )
    try:
        blocks = mapped_recording.blocks(table, mapping, reading, rows)
        yield from _mounted(blocks, reading.mounting)
    except mapped_recording.NotNativeError as error:
        text, options = mapping_proposal.propose(table)
        raise UserError(f'{error}; {text}', options) from None


def _mounted(
    blocks: Iterator[Recording], mounting: SignedAxes | None
) -> Generator[Recording, None, None]:
    """Turn the blocks of a recording; they stay as they are without a mounting."""
    if mounting is None:
        yield from blocks
        return
    columns, signs = map(list, zip(*mounting))
    for block in blocks:
        names = block.sensor_columns
        if len(names) != len(mounting):
            raise UserError(
                f'{option("axes")}: names the axes {AXES[: len(mounting)]}, but {block.path} has '
                f'{block.axes}'
            )
        zero = np.zeros(1)
        if names[0] in VOLTS and min(signs) < 0:
            zero = block.stream_info.nominal_values(block.axes).get('nominal_zero_g_v', np.ones(0))
            if len(set(zero)) != 1:
                raise UserError(
                    f'{option("axes")}: inverts an axis of {block.path} in volts about an '
                    'unknown zero; write a line "# nominal_zero_g_v: ..." with the '
                    'same value for each axis'
                )
        outputs = np.column_stack([block.columns[name] for name in names]) - zero
        turned = (outputs[:, columns] * signs + zero).T.copy()
        changed = dict(zip(names, turned))
        gyro_radps = block.gyro_radps
        if gyro_radps is not None:
            # A rotation turns an axis of rotation as it turns a force, if it names three axes.
            is_turned = len(mounting) == len(AXES)
            gyro_radps = gyro_radps[:, columns] * signs if is_turned else gyro_radps * np.nan
            changed |= dict(zip(GYRO, gyro_radps.T.copy()))
        yield replace(block, columns={**block.columns, **changed})


def read_ideal(path: AnyPath, epoch_ns: int = 0, unit: str = '') -> Recording:
    """
    Read the ideal specific force of another simulator.

    Parameters
    ----------
    path
        A CSV file with `time_s, ax_mps2, ay_mps2, az_mps2`, or a bag with one topic of type
        sensor_msgs/Imu, or several of which one is `imu/data_raw`.
    epoch_ns
        Origin of the times, ns: `epoch_ns` of the real recording of the manoeuvre.
    unit
        Unit of the samples, one of `GRAVITY`; '' for m/s².

    Returns
    -------
    Recording
        Specific force in the case frame, m/s², with times since `epoch_ns`.

    Raises
    ------
    UserError
        The file cannot be read, or an axis is missing.

    """
    reading = ReadingOptions(unit=unit)
    parts = (
        _bag_blocks(path, BLOCK_ROWS, ideal=True, reading=reading)
        if is_bag(path)
        else mapped_recording.blocks(open_table(path), None, reading, BLOCK_ROWS, ACCEL)
    )
    return at_epoch(concatenate(parts), epoch_ns)


def at_epoch(recording: Recording, epoch_ns: int) -> Recording:
    """Return a recording whose times count from another origin, ns."""
    shift_s = (recording.epoch_ns - epoch_ns) / 1e9
    return replace(recording, time_s=recording.time_s + shift_s, epoch_ns=epoch_ns)


@contextmanager
def writer(path: AnyPath, sensor: Sensor) -> Iterator[Callable[[Recording], None]]:
    """
    Open a new recording, and yield a function that appends a block of samples to it.

    The recording appears under its name when the block ends without an error, or not at all; its
    ending determines the format. A bag holds the nominal conversion of `sensor`.
    """
    if Path(path).suffix != '.csv':
        from adxl_ros.files.bag_writer import recording_bag  # tables need none of it

        with recording_bag(path, sensor) as append:
            yield append
        return
    with csv_writer(path) as append:

        def write_block(block: Recording) -> None:
            epoch = {'epoch_ns': str(block.epoch_ns)} if block.epoch_ns else {}
            append({TIME: block.time_s, **block.columns}, {**block.info, **epoch})

        yield write_block


def write(path: AnyPath, recording: Recording, sensor: Sensor) -> None:
    """
    Write a whole recording.

    Parameters
    ----------
    path
        The file or directory, replaced if it exists; its ending determines the format.
    recording
        The samples and references.
    sensor
        The unit whose nominal conversion a bag holds.

    Raises
    ------
    UserError
        The recording cannot be written.

    """
    with writer(path, sensor) as append:
        append(recording)


def is_bag(path: AnyPath) -> bool:
    """Return whether a recording is a bag; refuse bags that cannot be read under their name."""
    file_path = Path(path)
    if file_path.is_dir():
        return True
    try:
        with open(file_path, 'rb') as file:
            head = file.read(_MAGIC_BYTES)
    except OSError as error:
        raise UserError(f'{file_path}: cannot read: {error.strerror or error}') from None
    ending = next((ending for magic, ending in _ENDINGS.items() if head.startswith(magic)), None)
    if ending == '.bag':
        raise UserError(
            f'{file_path}: is a bag of ROS 1; convert it: rosbags-convert --src '
            f'{file_path} --dst {file_path.with_suffix("")}'
        )
    if ending == '.zstd':
        raise UserError(
            f'{file_path}: is compressed; name the directory with its metadata.yaml, '
            f'or unpack it: zstd -d {file_path}'
        )
    if ending and file_path.suffix != ending:
        raise UserError(f'{file_path}: is a bag; rename it so that it ends in {ending}')
    return file_path.suffix in ('.mcap', '.db3')
