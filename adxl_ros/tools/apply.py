# SPDX-License-Identifier: Apache-2.0

"""Correct a recording by a parameter file: acceleration and tilt from the sensor alone."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import itertools
from pathlib import Path

from adxl_ros.compensate.recordings import effects_left, Estimates, ImuFields, RecordingEstimator
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.bag_writer import TiltBag
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.recording_columns import check_unit, Recording
from adxl_ros.model.constants import AXES
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import NOMINAL_ENVIRONMENT
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.signals.recorded_sensor import BeyondRange, listed, load_sensor, measure_unstated
from adxl_ros.tools.command_line import (
    add_recording_options,
    argument_parser,
    command,
    reading_options,
    RECORDING_HELP,
)
from adxl_ros.tools.output import note, print_end, progress, quoted, report_reading, run
import numpy as np

_BLOCK_ROWS = 8192
"""Samples that are corrected at a time (chosen: their arrays stay in the cache)."""

_DIGITS = 12
"""Significant digits of an estimate (chosen: rounding is below a millionth of the noise)."""

_EXAMPLES = {
    'acceleration and tilt by a calibration': 'recording.csv --params unit.yaml -o tilt.csv',
    'a bag with imu/data and tilt': 'recording.mcap --params unit.yaml -o tilt.mcap',
    'a moving sensor, without the lag of its filter':
        'fast.csv --params unit.yaml --undo-filter -o a.csv',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argument_parser('apply', __doc__, _EXAMPLES)
    parse.add_argument('recording', metavar='RECORDING', help=RECORDING_HELP)
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the calibrated sensor (default: the nominal sensor)')
    parse.add_argument('--inverse', choices=('exact', 'paper'), default='exact',
                       help="inverse of the model: exact (default), or the paper's approximation, "
                            'equations 14 to 21')
    parse.add_argument('--undo-filter', action='store_true',
                       help='undo the RC filter, amplitude and phase, for a sensor that moves')
    parse.add_argument('-o', dest='output', metavar='OUT', required=True,
                       help='acceleration and tilt, with standard deviations: OUT.csv is a table; '
                            'OUT.mcap, or a folder OUT, is a bag with imu/data and tilt')
    add_recording_options(parse)
    return parse


def apply(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if Path(options.output).resolve() == Path(options.recording).resolve():
        raise UserError(f'{options.output}: is the recording itself; choose another output')
    rows = unsolved = outside = at_rail = 0
    block, beyond = None, BeyondRange()
    blocks = recording.blocks(options.recording, _BLOCK_ROWS, reading_options(options))
    first = next(blocks, None)
    sensor, measured = _sensor(options.params, first)
    is_table = Path(options.output).suffix == '.csv'
    with (_table if is_table else _bag)(options.output) as write, progress('apply') as show:
        for block, estimates in _estimated(options, sensor, first, blocks):
            write(block, estimates)
            explained = ~(estimates.unsolved | estimates.at_rail)
            beyond.add(estimates.volts[explained], sensor)
            rows += len(block)
            unsolved += int(estimates.unsolved.sum())
            outside += int(estimates.outside.sum())
            at_rail += int(estimates.at_rail.sum())
            show(block.done)
    _report(unsolved, rows, 'have no solution: ' + (
        'their cells are empty' if is_table else 'they are left out'))
    _report(outside, rows, 'lie outside of the validity range (temperature or force): their '
            'standard deviations are raised')
    _report(at_rail, rows, 'have the ADC at its rail: their ' + (
        'standard deviations are inf' if is_table else f'variances are {UNMEASURED_VARIANCE:g}'))
    if beyond.describe(sensor):
        note(f'apply: {beyond.describe(sensor)}')
    if block is not None:
        report_reading('apply', block)
    _print_end(options, sensor, rows, measured)
    return 0


@contextmanager
def _table(path: str) -> Iterator[Callable[[Recording, Estimates], None]]:
    """Open a CSV file, and yield a function that appends a block with its estimates."""
    with csv_writer(path, _DIGITS) as append:
        yield lambda block, estimates: append(
            {'time_s': block.epoch_ns * 1e-9 + block.time_s, **_columns(estimates)})


@contextmanager
def _bag(path: str) -> Iterator[Callable[[Recording, Estimates], None]]:
    """Open a bag, and yield a function that appends a block with its estimates."""
    fields = ImuFields()
    with TiltBag(path) as bag:
        yield lambda block, estimates: bag.write(block.stamp_ns[~estimates.unsolved],
                                                 *fields(estimates))


def _sensor(params: str | None, first: Recording | None) -> tuple[Sensor, list[str]]:
    """Return the sensor of a recording by its first block, and what is measured of it."""
    if first is None:
        return parameter_file.load(params or parameter_file.nominal_path()), []
    sensor, measured = measure_unstated(load_sensor(params, first), first)
    return _of_unit(first, sensor), measured


def _print_end(options: argparse.Namespace, sensor: Sensor, rows: int, measured: list[str]
               ) -> None:
    """Print what was corrected, the file, and how the calibration is used live."""
    by_what = f'the {sensor.model} calibration of {sensor.serial}' if sensor.effects else \
        'the datasheet values: the sensor is not calibrated'
    live = f'compensation --ros-args -p calibration:={quoted(options.params or "")}'
    lines = [f'Corrected {rows} samples by {by_what}.', *listed(measured)]
    print_end(lines, [options.output], command(
        *live.split(' ', 1)) if sensor.effects else command('fit', 'SWEEP -o unit.yaml'))


def _estimated(options: argparse.Namespace, sensor: Sensor, first: Recording | None,
               blocks: Iterator[Recording]) -> Iterator[tuple[Recording, Estimates]]:
    """Yield the blocks of the recording, of which `first` is the first, with their estimates."""
    if first is None:
        return
    _report_effects(first, sensor, options.undo_filter)
    estimator = RecordingEstimator(sensor, first, options.inverse == 'paper', options.undo_filter)
    yield from estimator.blocks(itertools.chain([first], blocks))


def _of_unit(block: Recording, sensor: Sensor) -> Sensor:
    """Return the sensor with the axes of the recording; refuse that of another unit."""
    if not sensor.effects:
        sensor = with_axes(sensor, block.axes)
    check_unit(block.stream_info, block.axes, sensor)
    return sensor


def _report(count: int, rows: int, statement: str) -> None:
    """Print a statement about a number of samples; nothing where there are none."""
    if count:
        note(f'apply: {count} of {rows} samples {statement}')


def _report_effects(block: Recording, sensor: Sensor, undo_filter: bool) -> None:
    """Name the effects that are not undone, or undone for nominal surroundings."""
    not_undone = effects_left(sensor, undo_filter)
    for effect in map(effect_named, sensor.effects):
        if effect in not_undone:
            note(f'apply: {effect.name} is not undone: a single sample does not determine it')
        for name in effect.follows:
            if name != 'time_s' and not np.isfinite(block.columns.get(name, np.nan)).all():
                note(f'apply: {block.path}: {name} is missing or has gaps: {effect.name} is '
                     f'taken at {getattr(NOMINAL_ENVIRONMENT, name):g} there')


def _columns(estimates: Estimates) -> dict[str, np.ndarray]:
    """Return the columns of the output, (n,) each, in its order."""
    columns = {f'a{axis}_mps2': values for axis, values in zip(AXES, estimates.force_mps2)}
    columns |= {f'a{axis}_std_mps2': values
                for axis, values in zip(AXES, estimates.force_std_mps2)}
    for names in (('roll', 'pitch', 'inclination'), ('alpha', 'beta')):
        columns |= {f'{name}_rad': getattr(estimates.tilt, name) for name in names}
        columns |= {f'{name}_std_rad': getattr(estimates.tilt, f'{name}_std') for name in names}
    return columns


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), apply)
