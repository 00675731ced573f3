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

"""Correct a recording by its parameter file: acceleration and tilt, from the sensor alone."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import replace
import itertools
from pathlib import Path
import sys

from adxl_ros.compensate import filter_inversion, paper_inverse
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.csv_writer import CsvWriter
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_unit import check_unit
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES
from adxl_ros.model.covariance import force_covariance, leverage
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn, Need, NOMINAL_ENVIRONMENT, Place
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.model.tilt import Tilt, tilt
from adxl_ros.tools.common import default_params, progress, run, say_notes
import numpy as np

_BLOCK_ROWS = 16384
_DIGITS = 12
"""Of an estimate: a millionth of the noise at least."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argparse.ArgumentParser(prog='apply', description=__doc__)
    parse.add_argument('recording', metavar='RECORDING', help='rosbag2 directory, .mcap or CSV')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the calibrated sensor (default: the nominal ADXL203)')
    parse.add_argument('--inverse', choices=('exact', 'paper'), default='exact',
                       help="of the model: exact, or the paper's approximation (14) to (21)")
    parse.add_argument('--undo-filter', action='store_true',
                       help='take the RC filter out, amplitude and phase, for what moves')
    parse.add_argument('-o', dest='output', metavar='OUT.csv', required=True)
    return parse


def apply(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if Path(options.output).resolve() == Path(options.recording).resolve():
        raise UserError(f'{options.output}: is the recording itself; choose another output')
    sensor = parameter_file.load(options.params or default_params())
    lost = saturated = rows = 0
    began_s = 0.0
    block = None
    with CsvWriter(options.output, _DIGITS) as out, progress('apply') as show:
        blocks = recording.blocks(options.recording, _BLOCK_ROWS)
        first = next(blocks, None)
        if first is not None:
            sensor = _of_unit(first, sensor)
            sensor = replace(sensor, rate_hz=first.rate_hz if len(first) > 1 else sensor.rate_hz)
            began_s = float(first.time_s[0])
            _say_unknown(first, sensor, options.undo_filter)
            if 'temperature_c' not in first.columns:
                # What is not known is neither within nor outside.
                sensor = replace(sensor, envelope=replace(sensor.envelope, temperature_c=None))
            blocks = itertools.chain([first], blocks)
        estimate = Estimates(sensor, options.inverse == 'paper', options.undo_filter)
        for block, volts in _with_volts(blocks, sensor, options.undo_filter):
            at_rail = signal_chain.at_a_rail(block.volts(sensor), sensor)
            columns = estimate(volts, at_rail, _around(block, began_s))
            out.write({'time_s': block.epoch_ns * 1e-9 + block.time_s, **columns})
            rows += len(block)
            lost += int(np.isnan(columns['ax_mps2']).sum())
            saturated += int(at_rail.sum())
            show(block.done)
    _say(lost, rows, 'have no solution: their cells are empty')
    _say(estimate.outside, rows, 'lie outside of what was calibrated (temperature or force): '
         'their standard deviations are raised')
    _say(saturated, rows, 'have the ADC at its rail: their standard deviations are inf')
    if block is not None:
        say_notes('apply', block)
    return 0


def _with_volts(blocks: Iterable[Recording], sensor: Sensor, undo_filter: bool
                ) -> Iterator[tuple[Recording, np.ndarray]]:
    if not undo_filter:
        return ((block, block.volts(sensor)) for block in blocks)
    return filter_inversion.undone_blocks(
        ((block, block.time_s, block.volts(sensor)) for block in blocks),
        noise.electronics(sensor)[0], sensor.rate_hz)


def _of_unit(block: Recording, sensor: Sensor) -> Sensor:
    if not sensor.effects:
        sensor = with_axes(sensor, block.axes)
    check_unit(block.stream_info, block.axes, sensor)
    return sensor


def _say(count: int, rows: int, what: str) -> None:
    if count:
        print(f'apply: {count} of {rows} samples {what}', file=sys.stderr)


def _around(block: Recording, began_s: float) -> signal_chain.Environment:
    """Return what is around the samples; nominal where it was not measured."""
    measured = {name: values for name in ('temperature_c', 'supply_v')
                if (values := block.columns.get(name)) is not None}
    return signal_chain.Environment(block.time_s - began_s, **{
        name: np.where(np.isfinite(values), values, getattr(NOMINAL_ENVIRONMENT, name))
        for name, values in measured.items()})


def _say_unknown(block: Recording, sensor: Sensor, undo_filter: bool) -> None:
    """Say which effects are not undone, or undone for nominal surroundings."""
    for effect in map(effect_named, sensor.effects):
        if undo_filter and Need.FILTER in effect.needs:
            continue
        if not effect.invertible and effect.acts_on is ActsOn.MEAN and effect.place < Place.CLOCK \
                and Need.STAGE not in effect.needs:
            print(f'apply: {effect.name} is not undone: no single sample tells it',
                  file=sys.stderr)
        for name in effect.follows:
            if name != 'time_s' and not np.isfinite(block.columns.get(name, np.nan)).all():
                print(f'apply: {block.path}: {name} is not there or has gaps: {effect.name} is '
                      f'taken at {getattr(NOMINAL_ENVIRONMENT, name):g} there', file=sys.stderr)


class Estimates:
    """Estimates of force and angles with standard deviations, by column of the output."""

    def __init__(self, sensor: Sensor, paper: bool = False, undo_filter: bool = False) -> None:
        """
        Prepare for a unit.

        Parameters
        ----------
        sensor
            The unit.
        paper
            By the paper's approximate inverse instead of the exact one.
        undo_filter
            The volts are those before the filter, with the noise that comes with it.

        Raises
        ------
        UserError
            The paper's inverse is not for this sensor.

        """
        if paper and sensor.axes == 'x':
            raise UserError('--inverse paper: needs the axes x and y, the sensor has x; leave it '
                            'out')
        self._sensor = sensor
        self._invert = (paper_inverse if paper else signal_chain).inverse(sensor)
        self._leverage = leverage(sensor)
        self.outside = 0
        self._variance_v2 = filter_inversion.variance_v2(sensor) if undo_filter else None

    def __call__(self, volts: np.ndarray, at_rail: np.ndarray,
                 around: signal_chain.Environment = NOMINAL_ENVIRONMENT) -> dict[str, np.ndarray]:
        """
        Estimate, (n,) each; NaN with standard deviation inf is what a sample does not show.

        Parameters
        ----------
        volts
            ADC volts, (n, m).
        at_rail
            Samples of which nothing is sure, (n,).
        around
            Their surroundings.

        """
        sensor = self._sensor
        with np.errstate(all='ignore'):  # volts that no force explains
            force = self._invert(list(volts.T), around)
            covariance = force_covariance(sensor, force, self._variance_v2, around)
            self.outside += int(np.sum(np.isfinite(force[0]) & sensor.envelope.lies_outside(
                around.temperature_c, force,
                self._leverage(force) if sensor.envelope.leverage else 0.0)))
            covariance[:, :, at_rail] = np.inf
            angles = tilt(force, covariance, 'z' in sensor.axes)
        return _columns(sensor, force, covariance, angles)


def _columns(sensor: Sensor, force: list, covariance: np.ndarray, angles: Tilt
             ) -> dict[str, np.ndarray]:
    std = np.sqrt([covariance[d, d] for d in range(3)])
    if sensor.axes == 'x':
        force[1:] = np.full((2, len(force[0])), np.nan)
    std[np.isnan(force)] = np.inf
    columns = {f'a{axis}_mps2': f for axis, f in zip(AXES, force)}
    columns |= {f'a{axis}_std_mps2': s for axis, s in zip(AXES, std)}
    for names in (('roll', 'pitch', 'inclination'), ('alpha', 'beta')):
        for kind in ('', '_std'):
            columns |= {f'{name}{kind}_rad': getattr(angles, f'{name}{kind}') for name in names}
    return columns


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), apply)
