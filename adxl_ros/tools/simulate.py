# SPDX-License-Identifier: Apache-2.0

"""Simulate a recording of a manoeuvre by a sensor with effects."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
import sys

from adxl_ros.api.simulation import IMU, prepare
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import TIME
from adxl_ros.links.support import emulated_board
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import command
from adxl_ros.report.screen import entry_list
from adxl_ros.simulate.response import Columns
from adxl_ros.simulate.trajectories import TRAJECTORIES
from adxl_ros.tools import command_line as cli

_NAMES = (*TRAJECTORIES, IMU)
"""What is no recording."""
_EXAMPLES = {
    'a calibration sweep of the nominal sensor': 'sweep -o sweep.csv',
    'two effects, one of typical size and one with a value': (
        'rich --effect lever_arm --effect temperature_bias:per_k.x=4e-4 -o rich.mcap'
    ),
    'the motion of a recording, by a calibrated sensor': (
        'real.csv --params unit.yaml -o simulated.csv'
    ),
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('simulate', __doc__, _EXAMPLES, _details)
    parse.add_argument(
        'trajectory', metavar='TRAJECTORY', help=f'{", ".join(TRAJECTORIES)}, imu, or a recording'
    )
    parse.add_argument('--params', metavar='FILE', help='the sensor (default: the nominal sensor)')
    parse.add_argument(
        '--effect',
        action='append',
        default=[],
        metavar='NAME[:key=value,...]',
        help=f'add an effect: {cli.SYNTAX}',
    )
    parse.add_argument(
        '--force', metavar='RECORDING', help='specific force for the trajectory imu'
    )
    parse.add_argument('--rate', type=float, metavar='HZ', help='sample rate')
    parse.add_argument(
        '--seed', type=int, default=0, help='seed of noise and manoeuvre (default 0)'
    )
    parse.add_argument(
        '--port',
        metavar='PATH',
        help='act as a board: send the samples in real time to a terminal device, '
        'or to a new pseudo-terminal of this name',
    )
    parse.add_argument(
        '-o',
        dest='output',
        metavar='RECORDING',
        help='.csv, .mcap or a rosbag2 directory (optional with --port)',
    )
    cli.add_overwrite_option(parse, '--overwrite')  # --force is the specific force
    return parse


def _details() -> str:
    """Return the trajectories and the effects for the help text."""
    about = {name: f.__doc__.splitlines()[0] for name, f in TRAJECTORIES.items() if f.__doc__}
    about[IMU] = (
        'Apply the specific force of --force, from any simulator: ax_mps2, ay_mps2, '
        'az_mps2 or sensor_msgs/Imu.'
    )
    about['RECORDING'] = 'Follow the stage angles of a recording, at its stamps.'
    return '\n\n'.join(
        [
            entry_list('trajectories', about),
            cli.effect_list(library().values()),
            'docs/reference/effects.md has the parameters of each effect.',
        ]
    )


def simulate(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    _check(options)
    is_named = options.trajectory in _NAMES
    made = prepare(
        options.trajectory if is_named else cli.read('simulate', options.trajectory),
        options.params,
        effects=cli.effect_inputs(options.effect),
        force=options.force,
        rate=options.rate,
        seed=options.seed,
    )
    cli.report_notes('simulate', made.left_out)
    with ExitStack() as stack:
        send = _board_output(stack, made.sensor, options.port) if options.port else None
        write = (
            stack.enter_context(recording.writer(options.output, made.sensor))
            if options.output
            else None
        )
        show = stack.enter_context(cli.progress('simulate'))
        for block in made.blocks(options.seed):
            if send:
                send({TIME: block.time_s, **block.columns})
            if write:
                write(block)
            show(block.done)
    cli.print_end(
        made.screen, filter(None, [options.output]), _next_step(options) if options.output else ''
    )
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
    """Refuse wrong usage, and an output that must not be replaced."""
    if options.trajectory not in _NAMES and not Path(options.trajectory).exists():
        parser().error(
            f'{options.trajectory}: neither a recording nor one of the trajectories '
            f'{", ".join(_NAMES)}'
        )
    if not options.output and not options.port:
        parser().error('the following arguments are required: -o, or --port')
    # The name of a trajectory is no file, though a file of that name may be written.
    source = options.force if options.trajectory in _NAMES else options.trajectory
    if options.output and source:
        cli.refuse_same_file(options.output, source)
    cli.check_outputs(options, options.output)


def _board_output(stack: ExitStack, sensor: Sensor, port: str) -> Callable[[Columns], None]:
    emulated_board.check_sensor(sensor)
    descriptor = stack.enter_context(emulated_board.open_terminal(port))
    boards: list[emulated_board.Board] = []

    def send(columns: Columns) -> None:
        if not boards:
            roles = emulated_board.roles_of(sensor, columns)
            boards.append(emulated_board.Board(sensor, roles, descriptor))
            print(
                f'simulate: sending: {emulated_board.driver_command(port, roles)}', file=sys.stderr
            )
        boards[0].send(columns)

    return send


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), simulate)
