# SPDX-License-Identifier: Apache-2.0

"""Simulate a recording of a manoeuvre by a sensor with effects."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
import sys
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording, sensor_info
from adxl_ros.files.surroundings import assumed
from adxl_ros.links.support import emulated_board
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Concern
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import command
from adxl_ros.report.screen import entry_list
from adxl_ros.simulate.motion import INTERNAL_RATE_HZ, Motion
from adxl_ros.simulate.response import Columns, simulate_blocks
from adxl_ros.simulate.trajectories import (
    motion_from_force,
    motion_from_references,
    TRAJECTORIES,
)
from adxl_ros.tools import command_line as cli
import numpy as np

_EXAMPLES = {
    'a calibration sweep of the nominal sensor': 'sweep -o sweep.csv',
    'two effects, one of typical size and one with a value':
        'rich --effect lever_arm --effect temperature_bias:per_k.x=4e-4 -o rich.mcap',
    'the motion of a recording, by a calibrated sensor':
        'real.csv --params unit.yaml -o simulated.csv',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('simulate', __doc__, _EXAMPLES, _details)
    parse.add_argument('trajectory', metavar='TRAJECTORY',
                       help=f'{", ".join(TRAJECTORIES)}, imu, or a recording')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the sensor (default: the nominal sensor)')
    parse.add_argument('--effect', action='append', default=[], metavar='NAME[:key=value,...]',
                       help=f'add an effect: {cli.SYNTAX}')
    parse.add_argument('--force', metavar='RECORDING',
                       help='specific force for the trajectory imu')
    parse.add_argument('--rate', type=float, metavar='HZ', help='sample rate')
    parse.add_argument('--seed', type=int, default=0,
                       help='seed of noise and manoeuvre (default 0)')
    parse.add_argument('--port', metavar='PATH',
                       help='act as a board: send the samples in real time to a terminal device, '
                       'or to a new pseudo-terminal of this name')
    parse.add_argument('-o', dest='output', metavar='RECORDING',
                       help='.csv, .mcap or a rosbag2 directory (optional with --port)')
    cli.add_overwrite_option(parse, '--overwrite')  # --force is the specific force
    return parse


def _details() -> str:
    """Return the trajectories and the effects for the help text."""
    about = {name: f.__doc__.splitlines()[0] for name, f in TRAJECTORIES.items() if f.__doc__}
    about['imu'] = ('Apply the specific force of --force, from any simulator: ax_mps2, ay_mps2, '
                    'az_mps2 or sensor_msgs/Imu.')
    about['RECORDING'] = 'Follow the stage angles of a recording, at its stamps.'
    return '\n\n'.join([entry_list('trajectories', about), cli.effect_list(library().values()),
                        'docs/reference/effects.md has the parameters of each effect.'])


def simulate(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    _check(options)
    sensor = parameter_file.load(options.params or parameter_file.nominal_path())
    if options.rate is not None:
        sensor = replace(sensor, rate_hz=options.rate)
    sensor = cli.with_effects(sensor, options.effect)
    for name in sensor.effects:
        if effect_named(name).concern is Concern.REFERENCE and not options.force:
            if any(text.partition(':')[0] == name for text in options.effect):
                raise UserError(f'--effect {name}: acts on the specific force of a recording; say '
                                'simulate imu --force RECORDING, or leave the effect out')
            cli.note(f'simulate: {name} is an error of the reference, and is left out')
    source = _source(sensor, options)
    sensor = source.sensor
    with ExitStack() as stack:
        send = _board_output(stack, sensor, options.port) if options.port else None
        write = stack.enter_context(recording.writer(options.output, sensor)) \
            if options.output else None
        show = stack.enter_context(cli.progress('simulate'))
        for columns in source.blocks(options.seed):
            if send:
                send(columns)
            time_s = columns.pop('time_s')
            if write:
                write(Recording(options.output, time_s, columns, sensor_info(sensor)))
            if source.motion.duration_s:
                show(min((time_s[-1] - source.begin_s) / source.motion.duration_s, 1.0))
    result = (f'Simulated {options.trajectory}: {source.motion.duration_s:.4g} s at '
              f'{sensor.rate_hz:.4g} Hz, axes {sensor.axes}. Sensor {sensor.serial}, effects: '
              f'{", ".join(sensor.effects) or "none"}.')
    cli.print_end([result, *source.assumed], filter(None, [options.output]),
                  _next_step(options) if options.output else '')
    return 0


def _next_step(options: argparse.Namespace) -> str:
    """Return the command that evaluates the simulated recording."""
    words = [options.output]
    words += ['--params', options.params] if options.params else []
    # Without a stage, the force that the sensor felt is the reference.
    words += ['--sim', options.force] if options.force else []
    tool, output = ('fit', 'unit.yaml') if options.trajectory == 'sweep' else ('diagnose', 'gap')
    return command(tool, cli.quoted(*words, '-o', output))


def _check(options: argparse.Namespace) -> None:
    names = (*TRAJECTORIES, 'imu')
    if options.trajectory not in names and not Path(options.trajectory).exists():
        parser().error(f'{options.trajectory}: neither a recording nor one of the trajectories '
                       f'{", ".join(names)}')
    if not options.output and not options.port:
        parser().error('the following arguments are required: -o, or --port')
    bounds = parameter_file.SENSOR_FIELDS['sensor.rate_hz'].metadata
    if options.rate is not None and not bounds['lower'] <= options.rate <= bounds['upper']:
        raise UserError(f'--rate {options.rate:g}: outside {bounds["lower"]:g} to '
                        f'{bounds["upper"]:g} Hz')
    cli.check_least(options, seed=0)
    # The name of a trajectory is no file, though a file of that name may be written.
    source = options.force if options.trajectory in names else options.trajectory
    if options.output and source:
        cli.refuse_same_file(options.output, source)
    cli.check_outputs(options, options.output)
    if (options.trajectory == 'imu') != bool(options.force):
        raise UserError('--force RECORDING and the trajectory imu need each other: '
                        'simulate imu --force RECORDING')


class _Source(NamedTuple):
    """What is simulated."""

    sensor: Sensor  # The sensor, at its rate
    motion: Motion
    begin_s: float = 0.0  # Begin of the motion, s
    like: Recording | None = None  # A recording that has the stamps of the samples
    assumed: Sequence[str] = ()  # What was assumed of the surroundings, one line each

    def blocks(self, seed: int) -> Iterator[Columns]:
        """Yield the samples."""
        return simulate_blocks(self.sensor, self.motion, seed, self.begin_s, self.like)


def _source(sensor: Sensor, options: argparse.Namespace) -> _Source:
    """Return what the options name."""
    if options.trajectory in TRAJECTORIES:
        return _Source(sensor, TRAJECTORIES[options.trajectory](
            np.random.default_rng(options.seed)))
    if options.trajectory == 'imu':
        # The specific force of another simulator, at its rate or another.
        ideal = recording.read_ideal(options.force)
        motion, begin_s = motion_from_force(ideal, options.rate is None)
        if options.rate is None:
            sensor = replace(sensor, rate_hz=motion.internal_rate_hz)
            motion = replace(motion, internal_rate_hz=max(sensor.rate_hz, INTERNAL_RATE_HZ))
        return _Source(sensor, motion, begin_s, assumed=assumed(ideal, sensor.effects))
    # The references of a recording, at its stamps or at another rate.
    read = cli.read('simulate', options.trajectory)
    motion, like = motion_from_references(read, sensor), None
    if options.rate is None:
        sensor, like = replace(sensor, rate_hz=read.rate_hz), read
    return _Source(sensor, motion, float(read.time_s[0]), like, assumed(read, sensor.effects))


def _board_output(stack: ExitStack, sensor: Sensor, port: str) -> Callable[[Columns], None]:
    emulated_board.check_sensor(sensor)
    descriptor = stack.enter_context(emulated_board.open_terminal(port))
    boards: list[emulated_board.Board] = []

    def send(columns: Columns) -> None:
        if not boards:
            roles = emulated_board.roles_of(sensor, columns)
            boards.append(emulated_board.Board(sensor, roles, descriptor))
            print(f'simulate: sending: {emulated_board.driver_command(port, roles)}',
                  file=sys.stderr)
        boards[0].send(columns)

    return send


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), simulate)
