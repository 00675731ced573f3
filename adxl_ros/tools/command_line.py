# SPDX-License-Identifier: Apache-2.0

"""The command lines of the tools: parser, options, effects, messages, progress and end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
import shlex
import signal
import sys
from typing import Any, TYPE_CHECKING

from adxl_ros.api import recordings
from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.atomic_write import AnyPath, require_own
from adxl_ros.files.column_mapping import AS_IT_IS, ReadingOptions
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.effects.base import Effect
from adxl_ros.process import ended_by_closed_output
from adxl_ros.report.arguments import require_least
from adxl_ros.report.screen import bar, end_lines, entry_list, NextStep, program_parser, wrapped
from adxl_ros.wording import option, options_named, READING

if TYPE_CHECKING:
    from adxl_ros.api.sensors import EffectInput

_BAR_COLUMNS = 24
"""Columns of a progress bar: names of stages and times stand beside it in 80 columns."""
RECORDING_HELP = 'rosbag2 directory, .mcap, CSV or another table'
"""Help text of the argument that names a recording."""
SYNTAX = (
    'NAME alone has typical values, KEY=VALUE sets a parameter for all its axes, '
    'KEY.AXIS=VALUE for one; parameters without a value are neutral'
)
"""What an option may be, for help texts."""


class _Parser(argparse.ArgumentParser):
    """A parser whose epilog is made for the help text only; effects may fail to load."""

    details: Callable[[], str] | None = None

    def format_help(self) -> str:
        if self.details is not None:
            self.epilog = f'{self.epilog}\n\n{self.details()}'
            self.details = None
        return super().format_help()


def argument_parser(
    tool: str,
    description: str | None,
    examples: Mapping[str, str],
    details: Callable[[], str] | None = None,
) -> argparse.ArgumentParser:
    """Make the parser of a tool; `details` makes the end of its help text."""
    parse = program_parser(_Parser, tool, description, examples)
    parse.details = details
    return parse


def effect_list(effects: Iterable[Effect]) -> str:
    """Return a list of effects with their causes for a help text, by name."""
    causes = {effect.name: effect.cause.partition(';')[0].rstrip('.') for effect in effects}
    return entry_list('effects', dict(sorted(causes.items())))


def add_recording_options(parse: argparse.ArgumentParser) -> None:
    """Add the options that state topic, columns, units, stamps and mounting of a recording."""
    group = parse.add_argument_group(
        'recordings of other software', 'docs/howto/logs.md has units and examples.'
    )
    group.add_argument(
        '--topic',
        metavar='NAME',
        default='',
        help='topic of type sensor_msgs/Imu (default: imu/data_raw, or the only one)',
    )
    group.add_argument(
        '--columns',
        metavar='MAPPING',
        help='columns and units of a table, for example '
        'time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg; or a file that holds '
        'them',
    )
    group.add_argument(
        '--unit',
        metavar='UNIT',
        default='',
        help='unit of the samples of a topic or of all axes of a table: g, mg, '
        'mps2, mmps2, lsb ... (default: what the file states; topics are in '
        'm/s²)',
    )
    group.add_argument(
        '--lsb-per-g',
        metavar='COUNTS',
        default='',
        help='counts of 1 g of columns in LSB: one number, or one for each axis',
    )
    group.add_argument(
        '--lsb-at-0g',
        metavar='COUNTS',
        default='',
        help='counts at 0 g of columns in LSB (default: 0), as 512 of a 10 bit ADC',
    )
    group.add_argument(
        '--rate',
        metavar='HZ',
        type=float,
        help='stamp the samples by their index at this rate',
    )
    group.add_argument(
        '--drop-bad-stamps',
        action='store_true',
        help='leave out samples whose stamp does not increase, and count them',
    )
    group.add_argument(
        '--drop-bad-samples',
        action='store_true',
        help='leave out samples that have no number as their stamp or on an axis, and count them',
    )
    group.add_argument(
        '--axes',
        metavar='x=-y,y=x,z=z',
        help='axes of the sensor by those of the file, for a documented mounting',
    )


def add_robot_options(parse: argparse.ArgumentParser) -> None:
    """Add the options of a robot that carries the sensor, in place of a stage."""
    group = parse.add_argument_group(
        'a robot as the stage',
        'joints from the recording (sensor_msgs/JointState), a moving base from odom',
    )
    group.add_argument('--urdf', metavar='FILE', help='the robot; needs pinocchio')
    group.add_argument(
        '--frame',
        metavar='NAME',
        default='imu_link',
        help='its frame that carries the sensor (default: imu_link)',
    )
    group.add_argument(
        '--joints',
        metavar='TOPIC',
        default='',
        help='topic of its joints (default: joint_states, or the only one)',
    )


def reading_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `read` that are given."""
    return {name: getattr(options, name) for name in READING}


def reading_options(options: argparse.Namespace) -> ReadingOptions:
    """Return how recordings are to be read."""
    return recordings.reading_options(**reading_arguments(options))


def reading_text(options: argparse.Namespace) -> str:
    """Return the given options for a command line that reads the same recording."""
    text = ''
    for name, value in reading_arguments(options).items():
        if value:
            text += f' {option(**{name: value if value is True else shlex.quote(str(value))})}'
    return text


def effect_inputs(texts: Iterable[str]) -> list[EffectInput]:
    """Return effects and their values as they are written: NAME, or NAME:KEY=VALUE,..."""
    inputs: list[EffectInput] = []
    for text in texts:
        name, _, rest = text.partition(':')
        values = {}
        for part in filter(None, rest.split(',')):
            key, _, number = part.partition('=')
            values[key.strip()] = number.strip()
        inputs.append((name, values))
    return inputs


def print_end(
    result: Sequence[str],
    files: Iterable[AnyPath],
    following: str | Sequence[NextStep] = '',
    took_s: float | None = None,
) -> None:
    """Print the end of a tool within 79 columns; outcomes are coloured in a terminal."""
    print(
        '\n'.join(
            end_lines(
                result, [str(path) for path in files if Path(path).exists()], following, took_s
            )
        )
    )


def quoted(*words: AnyPath) -> str:
    """Return words of a command line as a shell reads them."""
    return shlex.join(str(word) for word in words)


@options_named()
@ended_by_closed_output()
def run(parser: argparse.ArgumentParser, command: Callable[[argparse.Namespace], int]) -> int:
    """Parse the command line and run a tool."""
    # It ends by an exception, so that unfinished files are removed.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        return command(parser.parse_args())
    except UserError as error:
        note(f'{parser.prog}: {" ".join(str(error).split())}', error.paste)
        return 1
    except KeyboardInterrupt:
        note(f'{parser.prog}: interrupted')
        return 130


def note(text: str, paste: str = '') -> None:
    """Print a message on stderr: one line, which a terminal gets wrapped between words."""
    if sys.stderr.isatty():
        lines = wrapped(text.removesuffix(paste), 2)
        text = '\n'.join([*lines, paste] if paste else lines)
    print(text, file=sys.stderr)


def check_least(options: argparse.Namespace, **least: float) -> None:
    """Refuse numbers of options that are too small; an option that is not given has none."""
    for name, lowest in least.items():
        require_least(name, getattr(options, name), lowest)


def add_overwrite_option(parse: argparse.ArgumentParser, name: str = '--force') -> None:
    """Add the option that replaces files of others; `name` is its other name."""
    parse.add_argument(
        *dict.fromkeys(('--overwrite', name)),
        dest='overwrite',
        action='store_true',
        help='replace files that this package did not write, or that were changed since',
    )


def check_outputs(options: argparse.Namespace, *paths: AnyPath | None) -> None:
    """Refuse to replace a file or folder of others; a path that is not given is None or ''."""
    for path in paths:
        if path:
            require_own(path, options.overwrite)


def refuse_same_file(output: str, source: str) -> None:
    """Refuse an output that is the input, which a tool reads while it writes."""
    if Path(output).resolve() == Path(source).resolve():
        raise UserError(f'{output}: is the input itself; choose another output')


def report_notes(tool: str, notes: Iterable[str]) -> None:
    """Report on stderr what was assumed or left out of an input."""
    for line in notes:
        note(f'{tool}: {line}')


def read(tool: str, path: str, reading: ReadingOptions = AS_IT_IS) -> Recording:
    """Read a recording, and report on stderr how."""
    read = recording.read(path, reading)
    report_notes(tool, read.notes)
    return read


@contextmanager
def progress(title: str) -> Iterator[Callable[..., None]]:
    """Show a bar on a terminal with rich; yield what takes the share done, and a stage's name."""
    drawn = bar(
        sys.stderr,
        _BAR_COLUMNS,
        '{task.percentage:3.0f} %',
        'TimeElapsedColumn',
        'TimeRemainingColumn',
    )
    if drawn is None:
        yield lambda done, stage='': None
        return
    with drawn:
        task = drawn.add_task(title, total=1.0)

        def show(done: float, stage: str = '') -> None:
            # A plan that grows does not take the bar back.
            drawn.update(
                task, completed=max(done, drawn.tasks[task].completed), description=stage or title
            )

        yield show
