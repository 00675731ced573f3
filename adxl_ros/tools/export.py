# SPDX-License-Identifier: Apache-2.0

"""Write a calibrated sensor in a format of other simulators and tools."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from adxl_ros.files import exports, parameter_file
from adxl_ros.files.atomic_write import write_text
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import command
from adxl_ros.report.quantities import mg
from adxl_ros.report.screen import entry_list
from adxl_ros.simulate.response import ChainMemo, change_mg
from adxl_ros.simulate.trajectories import TRAJECTORIES
from adxl_ros.tools import command_line as cli
import numpy as np

_EXAMPLES = {
    'noise and zero-g of a sensor for Gazebo': 'my_sensor.yaml --to sdf -o imu.sdf',
    'the result of a diagnosis for MuJoCo': 'gap/params.yaml --to mujoco -o imu.xml',
    'covariances of imu_sensor_broadcaster': 'my_sensor.yaml --to broadcaster -o imu.yaml',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    formats = exports.formats()
    meanings = {name: form.meaning for name, form in formats.items()}
    parse = cli.argument_parser(
        'export', __doc__, _EXAMPLES, lambda: entry_list('formats', meanings)
    )
    parse.add_argument('params', metavar='PARAMS', help='parameter file of the sensor')
    parse.add_argument(
        '--to',
        dest='format',
        required=True,
        choices=list(formats),
        metavar='FORMAT',
        help=', '.join(formats),
    )
    parse.add_argument('-o', dest='output', required=True, metavar='FILE', help='the new file')
    cli.add_overwrite_option(parse)
    return parse


def export(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.refuse_same_file(options.output, options.params)
    cli.check_outputs(options, options.output)
    sensor = parameter_file.load(options.params)
    holds = exports.places(exports.formats()[options.format], sensor)
    with cli.progress('sizes of the effects') as show:
        exported = _sized(sensor, options, holds, show)
    write_text(options.output, exports.text(options.format, exported))
    held = [name for name in exported.sizes_mg if name in exported.holds]
    lost = [name for name in exported.sizes_mg if name not in exported.holds]
    lines = [f'Sensor {sensor.serial} for {options.format}. The file holds: {", ".join(held)}.']
    if lost:
        lines.append(f'It lacks: {", ".join(lost)}; its head has their sizes.')
    cli.print_end(
        lines,
        [options.output],
        command('simulate', f'rich --params {cli.quoted(options.params)} -o rich.csv'),
    )
    return 0


def _sized(
    sensor: Sensor,
    options: argparse.Namespace,
    holds: Mapping[str, str],
    show: Callable[[float], None],
) -> exports.Export:
    """Simulate the sizes of all parts of a sensor."""
    motion = TRAJECTORIES['rich'](np.random.default_rng(0))
    change = partial(change_mg, sensor, motion, ChainMemo())
    stage = exports.stage_effects(sensor)
    own = [name for name in sensor.effects if name not in stage]
    sizes_mg = {}
    for number, name in enumerate(own):
        show(number / len(own))
        sizes_mg[name] = change([name])
    axes = exports.axes(sensor)
    sizes_mg[exports.WHITE_NOISE] = _rms_mg([axis.noise_std_mps2 for axis in axes])
    if sensor.adc_bits:
        sizes_mg[exports.STEPS] = _rms_mg([axis.step_mps2 / np.sqrt(12) for axis in axes])
    if sensor.rc_s:
        sizes_mg[exports.FILTER] = change([], False)
    lost = [name for name in own if name not in holds]
    return exports.Export(
        sensor=sensor,
        source=Path(options.params).name,
        holds=holds,
        sizes_mg=sizes_mg,
        remaining_mg=change(lost, exports.FILTER in holds),
    )


def _rms_mg(values_mps2: list[float]) -> float:
    """Return the rms of values in m/s², mg."""
    return float(mg(np.sqrt(np.mean(np.square(values_mps2)))))


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), export)
