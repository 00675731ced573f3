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
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
import sys

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording, REFERENCES
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.links.support import emulated_board
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate import simulator
from adxl_ros.simulate.from_recording import motion_from_force, motion_from_references
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.trajectories import TRAJECTORIES
from adxl_ros.tools.common import progress, run, say_notes
from adxl_ros.tools.effect_option import SYNTAX, with_effects
import numpy as np

_BLOCK = 32768
Taker = Callable[[simulator.Columns], None]


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    about = '\n'.join(f'  {name:12}{f.__doc__.splitlines()[0]}'
                      for name, f in TRAJECTORIES.items() if f.__doc__)
    parse = argparse.ArgumentParser(
        prog='simulate', description=__doc__, formatter_class=argparse.RawTextHelpFormatter,
        epilog=f'trajectories:\n{about}\n'
               '  imu         Feel the specific force of --force: ax_mps2, ay_mps2, az_mps2 or\n'
               '              sensor_msgs/Imu, of any simulator.\n'
               '  RECORDING   Follow the stage angles of a recording again, at its stamps.')
    parse.add_argument('trajectory', metavar='TRAJECTORY',
                       help=f'{", ".join(TRAJECTORIES)}, imu, or a recording')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the sensor (default: the nominal sensor)')
    parse.add_argument('--effect', action='append', default=[], metavar='NAME[:key=value,...]',
                       help=f'add an effect: {SYNTAX}')
    parse.add_argument('--force', metavar='RECORDING',
                       help='specific force for the trajectory imu')
    parse.add_argument('--rate', type=float, metavar='HZ', help='sample rate')
    parse.add_argument('--seed', type=int, default=0, help='of noise and manoeuvre (default 0)')
    parse.add_argument('--port', metavar='PATH',
                       help='be a board: send the samples in real time to a terminal device, or\n'
                       'to a new pseudo-terminal of this name')
    parse.add_argument('-o', dest='output', metavar='RECORDING',
                       help='.csv, .mcap or a rosbag2 directory (with --port: not needed)')
    return parse


def simulate(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if options.trajectory not in (*TRAJECTORIES, 'imu') and not Path(options.trajectory).exists():
        near = get_close_matches(options.trajectory, [*TRAJECTORIES, 'imu'], 1)
        parser().error(f'{options.trajectory}: neither a trajectory nor a recording'
                       f'{f"; did you mean {near[0]}?" if near else ""}; the trajectories are '
                       f'{", ".join(TRAJECTORIES)}, imu')
    if not options.output and not options.port:
        parser().error('the following arguments are required: -o, or --port')
    sensor = parameter_file.load(options.params or parameter_file.nominal_path())
    if options.rate is not None:
        if not 0.01 <= options.rate <= 1e5:
            raise UserError(f'--rate {options.rate:g}: outside 0.01 to 100000 Hz')
        sensor = replace(sensor, rate_hz=options.rate)
    if options.seed < 0:
        raise UserError(f'--seed {options.seed}: must be 0 or more')
    for path in filter(None, (options.trajectory, options.force)):
        if options.output and Path(path).resolve() == Path(options.output).resolve():
            raise UserError(f'{options.output}: is the input itself; choose another output')
    sensor = with_effects(sensor, options.effect)
    sensor, duration_s, begin_s, blocks = _run(sensor, options)
    with ExitStack() as stack:
        takers = []
        if options.port:
            takers.append(_sender(stack, sensor, options.port))
        if options.output:
            takers.append(_writer(stack, sensor, str(options.output)))
        show = stack.enter_context(progress('simulate'))
        for columns in blocks:
            for take in takers:
                take(columns)
            show(min((columns['time_s'][-1] - begin_s) / max(duration_s, 1e-9), 1.0))
    return 0


def _writer(stack: ExitStack, sensor: Sensor, path: str) -> Taker:
    write = stack.enter_context(recording.writer(path, sensor))

    def take(columns: simulator.Columns) -> None:
        others = {name: values for name, values in columns.items() if name != 'time_s'}
        write(Recording(path, columns['time_s'], others, sensor_info(sensor)))

    return take


def _sender(stack: ExitStack, sensor: Sensor, port: str) -> Taker:
    emulated_board.check_sensor(sensor)
    fd = stack.enter_context(emulated_board.open_terminal(port))
    sending: list[emulated_board.Board] = []

    def take(columns: simulator.Columns) -> None:
        if not sending:
            roles = emulated_board.roles_of(sensor, columns)
            sending.append(emulated_board.Board(sensor, roles, fd))
            command = emulated_board.driver_command(port, roles)
            print(f'simulate: sending: {command}', file=sys.stderr)
        sending[0].send(columns)

    return take


def _run(sensor: Sensor, options: argparse.Namespace
         ) -> tuple[Sensor, float, float, Iterator[simulator.Columns]]:
    """Return the sensor at its rate, how long it runs from when, and the blocks."""
    name = options.trajectory
    if (name == 'imu') != bool(options.force):
        raise UserError('--force RECORDING goes with the trajectory imu, and imu with it: '
                        'simulate imu --force RECORDING')
    if name == 'imu':
        motion, begin_s = motion_from_force(options.force, options.rate is None)
        if options.rate is None:
            sensor = replace(sensor, rate_hz=motion.internal_rate_hz)
            motion = replace(motion, internal_rate_hz=max(sensor.rate_hz, 1000.0))
        blocks = simulator.simulate_blocks(sensor, motion, options.seed, begin_s)
        return sensor, motion.duration_s, begin_s, blocks
    if name in TRAJECTORIES:
        motion = TRAJECTORIES[name](np.random.default_rng(options.seed))
        blocks = simulator.simulate_blocks(sensor, motion, options.seed)
        return sensor, motion.duration_s, 0.0, blocks
    read = recording.read(name)
    say_notes('simulate', read)
    motion = motion_from_references(read, sensor)
    begin_s, end_s = float(read.time_s[0]), float(read.time_s[-1])
    if options.rate is not None:
        return sensor, end_s - begin_s, begin_s, simulator.simulate_blocks(
            sensor, replace(motion, duration_s=end_s - begin_s), options.seed, begin_s)
    sensor = replace(sensor, rate_hz=read.rate_hz)
    return sensor, end_s - begin_s, begin_s, _again(sensor, motion, read, options.seed)


def _again(sensor: Sensor, motion: Motion, read: Recording, seed: int
           ) -> Iterator[simulator.Columns]:
    """Sample at the stamps of a recording, beside its own references."""
    respond = Response(sensor, motion, seed, float(read.time_s[0]))
    for begin in range(0, len(read), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        volts = respond(read.time_s[part])
        yield {'time_s': read.time_s[part],
               **{f'{axis}_v': volts[:, d] for d, axis in enumerate(sensor.axes)},
               **{name: read.columns[name][part] for name in REFERENCES if name in read.columns}}


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), simulate)
