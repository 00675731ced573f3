# SPDX-License-Identifier: Apache-2.0

"""Correct a recording by a parameter file: acceleration and tilt from the sensor alone."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import itertools
from pathlib import Path

from adxl_ros.compensate.estimators import Estimates, RecordingEstimator
from adxl_ros.compensate.live_stream import ImuFields
from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.bag_writer import tilt_bag
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.recording_columns import check_unit, Recording
from adxl_ros.model.constants import AXES
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.effects import base, effect_named
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.signals.recorded_sensor import BeyondRange, listed, load_sensor, measure_unstated
from adxl_ros.tools import command_line as cli
import numpy as np

_BLOCK_ROWS = 8192  # Samples that are corrected at a time (chosen: their arrays stay in the cache)

_COUNTED = {
    'unsolved': 'have no solution: their cells are empty, and a bag leaves them out',
    'outside': 'lie outside of the validity range (temperature or force): their standard '
               'deviations are raised',
    'at_rail': 'have the ADC at its rail: their standard deviations are inf, in a bag '
               f'their variances {UNMEASURED_VARIANCE:g}'}
"""What is said of counted samples, by the field of `Estimates`."""

_EXAMPLES = {
    'acceleration and tilt by a calibration': 'recording.csv --params unit.yaml -o tilt.csv',
    'a bag with imu/data and tilt': 'recording.mcap --params unit.yaml -o tilt.mcap',
    'a moving sensor, without the lag of its filter':
        'fast.csv --params unit.yaml --undo-filter -o a.csv',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('apply', __doc__, _EXAMPLES)
    parse.add_argument('recording', metavar='RECORDING', help=cli.RECORDING_HELP)
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
    cli.add_overwrite_option(parse)
    cli.add_recording_options(parse)
    return parse


def apply(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.refuse_same_file(options.output, options.recording)
    cli.check_outputs(options, options.output)
    counts: Counter[str] = Counter()
    blocks = recording.blocks(options.recording, _BLOCK_ROWS, cli.reading_options(options))
    first = next(blocks, None)
    if first is None:
        raise UserError(f'{options.recording}: has no samples to correct')
    sensor, measured = measure_unstated(load_sensor(options.params, first), first)
    if not sensor.effects:
        sensor = with_axes(sensor, first.axes)
    check_unit(first.stream_info, first.axes, sensor)
    _report_effects(sensor, options.undo_filter)
    estimator = RecordingEstimator(sensor, first, options.inverse == 'paper', options.undo_filter)
    block, beyond = first, BeyondRange()
    with _output(options.output) as write, cli.progress('apply') as show:
        for block, estimates in estimator.blocks(itertools.chain([first], blocks)):
            write(block, estimates)
            explained = ~(estimates.unsolved | estimates.at_rail)
            beyond.add(estimates.volts[explained], sensor)
            counts['rows'] += len(block)
            for name in _COUNTED:
                counts[name] += int(getattr(estimates, name).sum())
            show(block.done)
    for name, statement in _COUNTED.items():
        if counts[name]:
            cli.note(f'apply: {counts[name]} of {counts["rows"]} samples {statement}')
    if beyond.describe(sensor):
        cli.note(f'apply: {beyond.describe(sensor)}')
    cli.report_reading('apply', block)
    by_what = f'the {sensor.model} calibration of {sensor.serial}' if sensor.effects else \
        'the datasheet values: the sensor is not calibrated'
    following = ('compensation', f'--ros-args -p calibration:={cli.quoted(options.params or "")}')
    cli.print_end([f'Corrected {counts["rows"]} samples by {by_what}.',
                   *estimator.assumed, *listed(measured)], [options.output], cli.command(
        *following if sensor.effects else ('fit', 'SWEEP -o unit.yaml')))
    return 0


@contextmanager
def _output(path: str) -> Iterator[Callable[[Recording, Estimates], None]]:
    """Open a CSV file or a bag, and yield a function that appends a block with its estimates."""
    if Path(path).suffix == '.csv':
        with csv_writer(path) as append_rows:
            yield lambda block, estimates: append_rows(
                {'time_s': block.epoch_ns * 1e-9 + block.time_s, **_columns(estimates)})
    else:
        fields = ImuFields()
        with tilt_bag(path) as append:
            yield lambda block, estimates: append(block.stamp_ns[~estimates.unsolved],
                                                  *fields(estimates))


def _report_effects(sensor: Sensor, undo_filter: bool) -> None:
    """Name the effects that are not undone."""
    for effect in map(effect_named, sensor.effects):
        acts_on_samples = effect.acts_on is base.ActsOn.MEAN and effect.place < base.Place.CLOCK \
            and effect.concern is not base.Concern.STAGE
        is_undone = effect.invertible or (undo_filter and base.Need.FILTER in effect.needs)
        if acts_on_samples and not is_undone:
            cli.note(f'apply: {effect.name} is not undone: a single sample does not determine '
                     'it')


def _columns(estimates: Estimates) -> dict[str, np.ndarray]:
    columns = {f'a{axis}{name}_mps2': values for name, force in (
        ('', estimates.force_mps2), ('_std', estimates.force_std_mps2))
        for axis, values in zip(AXES, force)}
    for names in (('roll', 'pitch', 'inclination'), ('alpha', 'beta')):
        columns |= {f'{name}_rad': getattr(estimates.tilt, name) for name in names}
        columns |= {f'{name}_std_rad': getattr(estimates.tilt, f'{name}_std') for name in names}
    return columns


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), apply)
