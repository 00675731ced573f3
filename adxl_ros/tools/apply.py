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
from pathlib import Path
import sys

from adxl_ros.errors import UserError
from adxl_ros.files import params, recording
from adxl_ros.files.csv_writer import CsvWriter
from adxl_ros.files.recording import Recording
from adxl_ros.files.unit import check_unit
from adxl_ros.model import chain
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Place
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.model.tilt import tilt
from adxl_ros.model.uncertainty import force_covariance
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
    parse.add_argument('-o', dest='output', metavar='OUT.csv', required=True)
    return parse


def apply(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if Path(options.output).resolve() == Path(options.recording).resolve():
        raise UserError(f'{options.output}: is the recording itself; choose another output')
    sensor = params.load(options.params or default_params())
    lost = saturated = rows = 0
    began_s = 0.0
    block = None
    with CsvWriter(options.output, _DIGITS) as out, progress('apply') as show:
        for block in recording.blocks(options.recording, _BLOCK_ROWS):
            if not rows:
                sensor = _of_unit(block, sensor)
            volts = block.volts(sensor)
            at_rail = chain.at_a_rail(volts, sensor)
            if not rows:
                began_s = float(block.time_s[0])
                _say_unknown(block, sensor)
            columns = estimates(sensor, volts, at_rail, _around(block, began_s))
            out.write({'time_s': block.epoch_ns * 1e-9 + block.time_s, **columns})
            rows += len(block)
            lost += int(np.isnan(columns['ax_mps2']).sum())
            saturated += int(at_rail.sum())
            show(block.done)
    _say(lost, rows, 'have no solution: their cells are empty')
    _say(saturated, rows, 'have the ADC at its rail: their standard deviations are inf')
    if block is not None:
        say_notes('apply', block)
    return 0


def _of_unit(block: Recording, sensor: Sensor) -> Sensor:
    if not sensor.effects:
        sensor = with_axes(sensor, block.axes)
    check_unit(block.info, block.axes, sensor, block.path)
    return sensor


def _say(count: int, rows: int, what: str) -> None:
    if count:
        print(f'apply: {count} of {rows} samples {what}', file=sys.stderr)


def _around(block: Recording, began_s: float) -> chain.Environment:
    """Return what is around the samples; nominal where it was not measured."""
    measured = {name: values for name in ('temperature_c', 'supply_v')
                if (values := block.columns.get(name)) is not None}
    return chain.Environment(block.time_s - began_s, **{
        name: np.where(np.isfinite(values), values, getattr(chain.NOMINAL, name))
        for name, values in measured.items()})


def _say_unknown(block: Recording, sensor: Sensor) -> None:
    """Say which effects are not undone, or undone for nominal surroundings."""
    for effect in map(effect_named, sensor.effects):
        if not effect.invertible and effect.acts_on == 'mean' and effect.place < Place.CLOCK \
                and 'stage' not in effect.needs:
            print(f'apply: {effect.name} is not undone: no single sample tells it',
                  file=sys.stderr)
        for name in effect.follows:
            if name != 'time_s' and not np.isfinite(block.columns.get(name, np.nan)).all():
                print(f'apply: {block.path}: {name} is not there or has gaps: {effect.name} is '
                      f'taken at {getattr(chain.NOMINAL, name):g} there', file=sys.stderr)


def estimates(sensor: Sensor, volts: np.ndarray, at_rail: np.ndarray,
              around: chain.Environment = chain.NOMINAL) -> dict[str, np.ndarray]:
    """
    Estimate force and angles with standard deviations, (n,) each, by column of the output.

    NaN with standard deviation inf is what a sample does not show.

    Parameters
    ----------
    sensor
        The unit.
    volts
        ADC volts, (n, m).
    at_rail
        Samples of which nothing is sure, (n,).
    around
        Their surroundings.

    """
    with np.errstate(all='ignore'):  # volts that no force explains
        force = chain.inverse(sensor)(list(volts.T), around)
        covariance = force_covariance(sensor, force, environment=around)
        covariance[:, :, at_rail] = np.inf
        angles = tilt(force, covariance, 'z' in sensor.axes)
    std = np.sqrt([covariance[d, d] for d in range(3)])
    if sensor.axes == 'x':
        force[1:] = np.full((2, len(volts)), np.nan)
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
