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

"""Simulate a recording: a manoeuvre and effects in, what sensor and encoder say out."""

from __future__ import annotations

import argparse
from dataclasses import replace
from difflib import get_close_matches

from adxl_ros.errors import UserError
from adxl_ros.files import params, recording
from adxl_ros.files.columns import Recording, sensor_info
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.simulate import simulate as run_chain
from adxl_ros.model.trajectory import TRAJECTORIES
from adxl_ros.tools.common import default_params, run
import numpy as np


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    about = '; '.join(f'{name}: {f.__doc__.splitlines()[0]}' for name, f in TRAJECTORIES.items())
    parse = argparse.ArgumentParser(prog='simulate', description=__doc__, epilog=about)
    parse.add_argument('trajectory', choices=list(TRAJECTORIES), metavar='TRAJECTORY',
                       help=', '.join(TRAJECTORIES))
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the sensor (default: the nominal ADXL203)')
    parse.add_argument('--effect', action='append', default=[], metavar='NAME[:key=value,...]',
                       help='add an effect; KEY=VALUE for all its axes, KEY.AXIS=VALUE for one; '
                            'a name alone takes typical values')
    parse.add_argument('--rate', type=float, metavar='HZ', help='sample rate')
    parse.add_argument('--seed', type=int, default=0, help='of noise and manoeuvre (default 0)')
    parse.add_argument('-o', dest='output', metavar='RECORDING', required=True,
                       help='.csv, .mcap or a rosbag2 directory')
    return parse


def simulate(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    sensor = params.load(options.params or default_params())
    if options.rate is not None:
        if not 0.01 <= options.rate <= 1e5:
            raise UserError(f'--rate {options.rate:g}: outside 0.01 to 100000 Hz')
        sensor = replace(sensor, rate_hz=options.rate)
    for text in options.effect:
        sensor = with_effect(sensor, text)
    rng = np.random.default_rng(options.seed)
    columns = run_chain(sensor, TRAJECTORIES[options.trajectory](sensor.rate_hz, rng), rng)
    time_s = columns.pop('time_s')
    recording.write(options.output, Recording(str(options.output), time_s, columns,
                                              sensor_info(sensor)), sensor)
    return 0


def with_effect(sensor: Sensor, text: str) -> Sensor:
    """
    Add an effect, or change its parameters, as the command line states it.

    Raises
    ------
    UserError
        Unknown effect, parameter or axis (the nearest is suggested), or out of bounds.

    """
    name, _, rest = text.partition(':')
    effect = effect_named(name)
    count = len(sensor.axes)
    values = dict(sensor.values.get(name) or {p.name: np.zeros(count)
                                              for p in effect.parameters})
    if not rest:
        values = {p.name: np.array([p.scale * (a in p.axes) for a in sensor.axes])
                  for p in effect.parameters}
    for part in filter(None, rest.split(',')):
        key, _, figure = part.partition('=')
        parameter_name, _, axis = key.partition('.')
        parameter = next((p for p in effect.parameters if p.name == parameter_name), None)
        if parameter is None:
            names = [p.name for p in effect.parameters]
            near = get_close_matches(parameter_name, names, 1) or names
            raise UserError(f'--effect {text}: {name} has no parameter {parameter_name!r}; did '
                            f'you mean {near[0]}?')
        try:
            value = float(figure)
        except ValueError:
            raise UserError(f'--effect {text}: {figure!r} is not a number') from None
        if not parameter.lower <= value <= parameter.upper:
            raise UserError(f'--effect {text}: {value:g} {parameter.unit} is outside '
                            f'{parameter.lower:g} to {parameter.upper:g}')
        chosen = [i for i, a in enumerate(sensor.axes)
                  if a in parameter.axes and axis in ('', a)]
        if not chosen:
            raise UserError(f'--effect {text}: no axis {axis!r} to act on; the sensor has '
                            f'{sensor.axes}, {parameter_name} acts on {parameter.axes}')
        values[parameter_name] = values[parameter_name].copy()
        values[parameter_name][chosen] = value
    effects = sensor.effects if name in sensor.effects else (*sensor.effects, name)
    return replace(sensor, effects=effects, values={**sensor.values, name: values})


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), simulate)
