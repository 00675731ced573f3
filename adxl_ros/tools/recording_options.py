# SPDX-License-Identifier: Apache-2.0

"""The options by which all tools read recordings that other software has made."""

from __future__ import annotations

import argparse
import math
import shlex

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import parse_mapping, parse_mounting
from adxl_ros.files.reading_options import ReadingOptions

RECORDING_HELP = 'rosbag2 directory, .mcap, CSV or another table'
"""Help text of the argument that names a recording."""

_HIGHEST_RATE_HZ = 1e5
"""Largest sample rate, Hz: that of a parameter file."""


def add_recording_options(parse: argparse.ArgumentParser) -> None:
    """Add the options that state topic, columns, units, stamps and mounting of a recording."""
    group = parse.add_argument_group(
        'recordings of other software', 'docs/recordings.md has units and examples.')
    group.add_argument('--topic', metavar='NAME', default='',
                       help='topic of type sensor_msgs/Imu (default: imu/data_raw, or the only '
                            'one)')
    group.add_argument('--columns', metavar='MAPPING',
                       help='columns and units of a table, for example '
                            'time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg; or a file that holds '
                            'them')
    group.add_argument('--lsb-per-g', metavar='COUNTS', default='',
                       help='counts of 1 g of columns in LSB: one number, or one for each axis')
    group.add_argument('--lsb-at-0g', metavar='COUNTS', default='',
                       help='counts at 0 g of columns in LSB (default: 0), as 512 of a 10 bit ADC')
    group.add_argument('--rate', metavar='HZ', type=float, default=None,
                       help='stamp the samples by their index at this rate')
    group.add_argument('--drop-bad-stamps', action='store_true',
                       help='leave out samples whose stamp does not increase, and count them')
    group.add_argument('--axes', metavar='x=-y,y=x,z=z',
                       help='axes of the sensor by those of the file, for a documented mounting')


def reading_options(options: argparse.Namespace) -> ReadingOptions:
    """Return how recordings are to be read."""
    if options.rate is not None and not 0 < options.rate <= _HIGHEST_RATE_HZ:
        raise UserError(f'--rate {options.rate:g}: expected samples a second, at most '
                        f'{_HIGHEST_RATE_HZ:g}')
    return ReadingOptions(
        options.topic, parse_mapping(options.columns) if options.columns else None,
        _counts('--lsb-per-g', options.lsb_per_g, True),
        _counts('--lsb-at-0g', options.lsb_at_0g, False), options.rate, options.drop_bad_stamps,
        parse_mounting(options.axes) if options.axes else None)


def reading_text(options: argparse.Namespace) -> str:
    """Return the given options for a command line that reads the same recording."""
    values = {'--topic': options.topic, '--columns': options.columns,
              '--lsb-per-g': options.lsb_per_g, '--lsb-at-0g': options.lsb_at_0g,
              '--rate': '' if options.rate is None else f'{options.rate:g}',
              '--axes': options.axes}
    words = [word for option, value in values.items() if value for word in (option, value)]
    words += ['--drop-bad-stamps'] * options.drop_bad_stamps
    return f' {shlex.join(words)}' if words else ''


def _counts(option: str, text: str, is_positive: bool) -> tuple[float, ...]:
    """Return the numbers of a list."""
    try:
        values = tuple(float(word) for word in text.split(',')) if text else ()
    except ValueError:
        values = (math.nan,)
    if not all(math.isfinite(value) and (value > 0 or not is_positive) for value in values):
        raise UserError(f'{option} {text}: expected counts, for example 16384 or '
                        '16384,16384,16500')
    return values
