# SPDX-License-Identifier: Apache-2.0

"""Find the noise parameters of a sensor in a recording at rest."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
import json
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import html_page, parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_unit import unit_of
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.axis_noise import recording_noise, RecordingNoise, with_noise
from adxl_ros.signals.recorded_sensor import load_sensor
from adxl_ros.signals.still_stretch import longest_rest
from adxl_ros.tools import noise_page, noise_text
from adxl_ros.tools.closing_lines import print_end, quoted
from adxl_ros.tools.command_line import argument_parser, command
from adxl_ros.tools.common import make_folder, progress, report_reading, run, ShowDone
from adxl_ros.tools.recording_options import (
    add_recording_options,
    reading_options,
    reading_text,
    RECORDING_HELP,
)

_BLOCK_ROWS = 65536
"""Samples that are read at a time (chosen: some MB)."""
_EXAMPLES = {
    'noise of each axis, with the Allan deviation as a page': 'still.mcap --report noise',
    'a parameter file for compensation and diagnose':
        'still.csv --params my_sensor.yaml -o my_noise.yaml',
    "a camera's IMU in a bag": 'bag --topic /camera/imu',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argument_parser('noise', __doc__, _EXAMPLES)
    parse.add_argument('recording', metavar='RECORDING',
                       help=f'{RECORDING_HELP}; of a sensor that nobody touches')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the other values of the sensor (default: the nominal sensor; for a '
                            'recording in m/s² that names no sensor, any IMU)')
    parse.add_argument('-o', dest='output', metavar='FILE.yaml',
                       help='a parameter file with the measured noise')
    parse.add_argument('--report', metavar='DIR',
                       help='write the page report.html, the curve allan.png and allan.csv there')
    parse.add_argument('--json', action='store_true', help='print the result as JSON')
    add_recording_options(parse)
    return parse


def noise(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if options.report:
        html_page.check_libraries()
    source = _Source(options)
    with progress('noise') as show:
        rest = longest_rest(lambda: source.blocks(show), source.unit)
        result = recording_noise(options.recording, rest, source.axes,
                                 lambda done: show(done, 'fit'))
    report_reading('noise', source.last)
    files: list[Path] = []
    if options.report:
        make_folder(Path(options.report))
        files += noise_page.write(Path(options.report), result)
    if options.output:
        fresh = with_noise(source.sensor(rest.rate_hz), result.axes)
        name = Path(options.recording).name
        provenance = {**fresh.provenance, 'noise_from': name, 'rate_from': name}
        parameter_file.save(options.output, replace(fresh, provenance=provenance),
                            noise_text.comments(result))
        files.insert(0, Path(options.output))
    if options.json:
        print(json.dumps(noise_text.as_json(result), indent=1))
        return 0
    _print(options, result, files)
    return 0


class _Source:
    """
    The recording and its unit.

    last: the newest block.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self._path = options.recording
        self._params = options.params
        self._reading = reading_options(options)
        self._sensor: Sensor | None = None
        self._unit: Sensor | None = None
        self.axes = ''  # Measured axes, known after the first block

    def blocks(self, show: ShowDone) -> Iterator[Recording]:
        """Yield the blocks of the recording, and show how much has been read."""
        for block in recording.blocks(self._path, _BLOCK_ROWS, self._reading):
            self.last = block
            yield block
            show(block.done, 'read')

    def unit(self, block: Recording) -> Sensor:
        """Return the nominal sensor of the recording by its first block."""
        if self._unit is None:
            self.axes = block.axes
            self._sensor = load_sensor(self._params, block)
            self._unit = unit_of(self._sensor, block.stream_info, block.axes)
        return self._unit

    def sensor(self, rate_hz: float) -> Sensor:
        """Return the sensor of the parameter file, with the axes and rate of the recording."""
        assert self._unit is not None and self._sensor is not None
        if self._sensor.effects and self._sensor.axes != self.axes:
            raise UserError(f'{self._path}: has the axes {self.axes}, but the parameters of '
                            f'{self._sensor.serial} are for {self._sensor.axes}; name the '
                            'parameter file of this sensor')
        base = self._sensor if self._sensor.effects else self._unit
        return replace(base, serial=self._unit.serial, rate_hz=round(rate_hz, 6))


def _print(options: argparse.Namespace, result: RecordingNoise, files: list[Path]) -> None:
    """Print the result, the files and the next command."""
    for line in [*noise_text.head(result), '', *noise_text.tables(result), '',
                 *noise_text.paste_lines(result), '']:
        print(line)
    warnings = noise_text.warnings(result)
    following = command('diagnose', f'RECORDING --params {quoted(options.output)} -o gap') \
        if options.output else command(
            'noise', f'{quoted(options.recording)}{reading_text(options)} -o noise.yaml')
    print_end([*(f'WARNING {text}' for text in warnings), *([''] if warnings else [])], files,
              following)


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), noise)
