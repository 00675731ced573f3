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
import os
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import bag_reader, csv_file, mapped_recording
from adxl_ros.files.bag_writer import BagWriter
from adxl_ros.files.column_guess import describe, is_sensor_step, shell_quoted, time_unit_of_step
from adxl_ros.files.column_mapping import (
    AS_IT_IS,
    ColumnMapping,
    mounted,
    parse_mapping,
    Quantity,
    ReadingOptions,
    Source,
    unit_in_name,
    UNITS,
)
from adxl_ros.files.csv_file import csv_writer, HeaderError
from adxl_ros.files.recording_columns import ACCEL, concatenate, Recording, TIME
from adxl_ros.files.tables import is_text, open_table, Table
from adxl_ros.model.sensor import Sensor
import numpy as np

_BLOCK_ROWS = 65536
"""Samples that are read at a time (chosen: some MB)."""

_FEWEST_STAMPS = 8
"""Stamps whose steps show their unit. Chosen: a lost sample hides no median."""

_WHOLE = 1e-3
"""Largest distance of a stamp from a whole number by rounding, in its unit."""

_SAME_RATE = 0.1
"""Largest relative difference of a stated sample rate from that of the stamps. Chosen."""

_MAGIC_BYTES = 16
"""Bytes at the beginning of a file that show its format."""

_ENDINGS = {b'\x89MCAP': '.mcap', b'SQLite format 3': '.db3', b'\x28\xb5\x2f\xfd': '.zstd',
            b'#ROSBAG': '.bag'}
"""Usual ends of file names by the first bytes of the files."""


def read(path: str | os.PathLike, reading: ReadingOptions = AS_IT_IS) -> Recording:
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
    recording = concatenate(blocks(path, _BLOCK_ROWS, reading))
    if _is_bag(path):
        bag_reader.drop_unsampled(recording)
    return recording


def blocks(path: str | os.PathLike, rows: int, reading: ReadingOptions = AS_IT_IS
           ) -> Generator[Recording, None, None]:
    """
    Read a recording in blocks; the memory is bounded by a block.

    All blocks have the same columns, except for a CSV column that turns out to be text further
    down. Alignments, cut and remarks of a block are those up to its end.

    Parameters
    ----------
    path
        The recording.
    rows
        Largest number of samples of a block.
    reading
        Topic, columns and stamps where the recording does not state them.

    Returns
    -------
    iterator
        The blocks in the order of time.

    Raises
    ------
    UserError
        The recording cannot be read, or holds values that no sensor gives.

    """
    read_blocks = _blocks(path, rows, reading)
    if reading.mounting is None:
        return read_blocks
    return mounted(read_blocks, reading.mounting)


def _blocks(path: str | os.PathLike, rows: int, reading: ReadingOptions
            ) -> Generator[Recording, None, None]:
    """Return the blocks along the axes of the file; see `blocks`."""
    if _is_bag(path):
        return bag_reader.blocks(path, rows, reading=reading)
    if is_text(path) and not reading.changes_columns and not reading.topic:
        return _with_sound_rate(_native_blocks(path, rows), None)
    table = open_table(path, reading.topic)
    mapping = reading.mapping or _mapping_of(table)
    if mapping is None:
        text, options = describe(table)
        raise UserError(f'{path}: {text}', options)
    read_blocks = mapped_recording.blocks(table, mapping, reading, rows)
    return read_blocks if reading.rate_hz else _with_sound_rate(read_blocks, mapping)


def _with_sound_rate(read_blocks: Iterator[Recording], mapping: ColumnMapping | None
                     ) -> Generator[Recording, None, None]:
    """Yield the blocks of a table; refuse stamps that are in another unit, by their steps."""
    is_first = True
    for block in read_blocks:
        if is_first and len(block) > _FEWEST_STAMPS:
            _check_step(block, mapping or mapped_recording.native_mapping(
                (TIME, *block.columns), block.path))
            is_first = False
        yield block


def _check_step(block: Recording, mapping: ColumnMapping | None) -> None:
    """Refuse stamps whose steps no sensor has, unless the file states their rate."""
    step_s, stated_hz = 1 / block.rate_hz, block.stream_info.rate_hz
    if mapping is None or (stated_hz and abs(step_s * stated_hz - 1) < _SAME_RATE):
        return
    source = mapping.sources['time']
    read_as = source.unit or unit_in_name(source.column, Quantity.TIME) or 's'
    divisor = UNITS[Quantity.TIME][read_as].divisor
    raw = block.time_s * divisor
    is_whole = bool((np.abs(raw - np.rint(raw)) < _WHOLE).all())
    if is_sensor_step(step_s, is_whole):
        return
    unit = time_unit_of_step(step_s * divisor, is_whole)
    fitting = {**mapping.sources, 'time': Source(source.column, unit)}
    raise UserError(
        f'{block.path}: {source.column} has steps of {step_s * divisor:.4g}, which as {read_as} '
        f'are {block.rate_hz:.3g} Hz; if that is right, give --rate {block.rate_hz:.3g}, and if '
        f'they are {unit}:', f'--columns {shell_quoted(str(ColumnMapping(fitting)))}')


def _mapping_of(table: Table) -> ColumnMapping | None:
    """Return the mapping by the definition of a format, or by the package's own columns."""
    if table.default_mapping:
        return parse_mapping(table.default_mapping)
    return mapped_recording.native_mapping(table.names, table.path)


def _native_blocks(path: str | os.PathLike, rows: int) -> Generator[Recording, None, None]:
    """Yield the blocks of a CSV file in the package's columns; propose a mapping for others."""
    try:
        yield from csv_file.blocks(path, rows)
    except HeaderError as error:
        raise _with_proposal(path, error) from None


def _with_proposal(path: str | os.PathLike, error: HeaderError) -> UserError:
    """Add the best mapping to an error about the columns of a text table."""
    try:
        table = open_table(path)
    except UserError:
        return error
    text, options = describe(table, is_listed=', '.join(table.names[:2]) in str(error))
    return UserError(f'{error}; {text}', options)


def read_ideal(path: str | os.PathLike, epoch_ns: int = 0) -> Recording:
    """
    Read the ideal specific force of another simulator.

    Parameters
    ----------
    path
        A CSV file with `time_s, ax_mps2, ay_mps2, az_mps2`, or a bag with one topic of type
        sensor_msgs/Imu, or several of which one is `imu/data_raw`.
    epoch_ns
        Origin of the times, ns: `epoch_ns` of the real recording of the manoeuvre.

    Returns
    -------
    Recording
        Specific force in the case frame, m/s², with times since `epoch_ns`.

    Raises
    ------
    UserError
        The file cannot be read, or an axis is missing.

    """
    parts = (bag_reader.blocks(path, _BLOCK_ROWS, ideal=True) if _is_bag(path)
             else _with_sound_rate(csv_file.blocks(path, _BLOCK_ROWS, needed=ACCEL), None))
    ideal = concatenate(parts)
    return replace(ideal, time_s=ideal.time_s + (ideal.epoch_ns - epoch_ns) / 1e9,
                   epoch_ns=epoch_ns)


@contextmanager
def writer(path: str | os.PathLike, sensor: Sensor) -> Iterator[Callable[[Recording], None]]:
    """
    Open a new recording, and yield a function that appends a block of samples to it.

    The recording appears under its name when the block ends without an error, or not at all.

    Parameters
    ----------
    path
        The recording; its ending determines the format.
    sensor
        The unit whose nominal conversion a bag holds. A CSV file does not need it.

    Yields
    ------
    callable
        Takes the samples to append.

    Raises
    ------
    UserError
        The recording cannot be written.

    """
    if Path(path).suffix == '.csv':
        with csv_writer(path) as append:
            yield lambda block: append({TIME: block.time_s, **block.columns}, _csv_info(block))
    else:
        with BagWriter(path, sensor) as bag:
            yield bag.write


def _csv_info(recording: Recording) -> dict[str, str]:
    """Return the `# key: value` lines of a recording's CSV file."""
    info = {key: value for key, value in recording.info.items() if key != 'epoch_ns'}
    return {**info, 'epoch_ns': str(recording.epoch_ns)} if recording.epoch_ns else info


def write(path: str | os.PathLike, recording: Recording, sensor: Sensor) -> None:
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


def _is_bag(path: str | os.PathLike) -> bool:
    """Return whether a file is a bag or CSV; refuse other formats and misleading names."""
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
        raise UserError(f'{file_path}: is a bag of ROS 1; convert it: rosbags-convert --src '
                        f'{file_path} --dst {file_path.with_suffix("")}')
    if ending == '.zstd':
        raise UserError(f'{file_path}: is compressed; name the directory with its metadata.yaml, '
                        f'or unpack it: zstd -d {file_path}')
    if ending and file_path.suffix != ending:
        raise UserError(f'{file_path}: is a bag; rename it so that it ends in {ending}')
    return file_path.suffix in ('.mcap', '.db3')
