# SPDX-License-Identifier: Apache-2.0

"""Find the noise parameters of a sensor in a recording at rest."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.atomic_write import write_bytes
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import command
from adxl_ros.report.figures import new_figure, png
from adxl_ros.report.quantities import duration
from adxl_ros.report.screen import row
from adxl_ros.signals import noise_parameters
from adxl_ros.signals.noise_parameters import AxisNoise, RecordingNoise, settings
from adxl_ros.tools import command_line as cli
import numpy as np
import yaml

MICRO_G = 1e6 / G0_MPS2  # 1 m/s² in µg
_NAMES = ('white noise N', 'bias instability B', 'random walk K')  # Names of the terms
_YAML_COLUMNS = 60  # Columns after which a list is wrapped; its last number may be beyond


def _head(result: RecordingNoise) -> list[str]:
    rest, axes = result.rest, ' '.join(noise.axis for noise in result.axes)
    return [result.path, f'{duration(rest.span_s)} at rest, {rest.rate_hz:.5g} Hz, axes {axes}']


def _tables(result: RecordingNoise) -> list[str]:
    """Return the terms with intervals, then in SI units and by sample, 79 columns at most."""
    wide, narrow = (6, 25, 25, 25), (6, 12, 12, 12, 13, 13, 9)
    rows = [row((' axis', *_NAMES), wide),
            row(('', 'µg/√Hz (90 %)', 'µg (90 %)', 'µg/√s (90 %)'), wide),
            *(row((f' {noise.axis}', *_micro_g_intervals(noise)), wide) for noise in result.axes),
            *_walk_lines(result), '',
            row(('', 'N', 'B', 'K', 'N by sample', 'K by sample', 'datasheet'), narrow),
            row((' axis', 'm/s²/√Hz', 'm/s²', 'm/s²/√s', 'm/s²', 'm/s²', 'µg/√Hz'), narrow)]
    rate = np.sqrt(result.rest.rate_hz)
    for noise in result.axes:
        white, _, walk = noise.estimates
        shown = (*noise.estimates, white.scaled(rate), walk.scaled(1 / rate),
                 white.scaled(1e6 * ONE_SIDED / G0_MPS2))
        rows.append(row((f' {noise.axis}', *(f'{e.value:.3g}' if e.is_seen else f'< {e.high:.3g}'
                                             for e in shown)), narrow))
    return rows


def _walk_lines(result: RecordingNoise) -> list[str]:
    """Return the bounds of the walks."""
    rows = []
    for noise in result.axes:
        time_s, k = noise.fit.bound_s, MICRO_G * noise.fit.walk.value
        if np.isfinite(time_s):
            rows.append(f' {noise.axis}: the walk has bounds, {k * np.sqrt(time_s / 2):.3g} µg '
                        f'rms; correlation time {time_s:.3g} s')
    return rows


def _micro_g_intervals(noise: AxisNoise) -> list[str]:
    """Return the estimates with their intervals, or their upper limits."""
    return [f'{e.value:.3g} ({e.low:.3g} to {e.high:.3g})' if e.is_seen else f'below {e.high:.3g}'
            for e in (estimate.scaled(MICRO_G) for estimate in noise.estimates)]


def _paste_lines(result: RecordingNoise) -> list[str]:
    """Return the settings of other programs in YAML, ready to paste."""
    lines = []
    for program, entries in settings(result.axes, result.rest.rate_hz).items():
        lines.append(f'# {program}')
        for name, values, unit in entries:
            rounded = [float(f'{value:.{6 if value >= 1 else 3}g}') for value in values]
            is_one = len(rounded) == 1
            lines += [f'# {unit}', *yaml.safe_dump(
                {name: rounded[0] if is_one else rounded}, width=_YAML_COLUMNS,
                default_flow_style=False if is_one else None).splitlines()]
    return lines


def _warnings(result: RecordingNoise) -> list[str]:
    rest, texts = result.rest, [*result.doubts]
    if rest.beyond_range:
        texts.append(f'{rest.beyond_range}.')
    if rest.motion_s:
        begin_s, end_s = rest.motion_s[0][:2]
        texts.append(f'not still or interrupted {len(rest.motion_s)} times, first from '
                     f'{begin_s:.5g} s to {end_s:.5g} s. Used is the longest rest, '
                     f'{duration(rest.span_s)} of {duration(rest.recorded_s)}. Record again '
                     'without touching the sensor.')
    for noise in result.axes:
        texts += [f'{noise.axis}: {text}' for text in _axis_warnings(rest.span_s, noise)]
    return texts


def _filter_warning(stated: Sensor, fresh: Sensor) -> list[str]:
    """Say that the noise refutes the stated filter, and what the file states in its place."""
    if 'rc_capacitance_f' in stated.unstated or fresh.rc_s == stated.rc_s:
        return []
    found = f'a filter of {fresh.rc_s * 1e3:.3g} ms' if fresh.rc_s else 'no filter'
    return [f'the noise at {fresh.rate_hz:.5g} Hz shows {found}, not the stated one of '
            f'{stated.rc_s * 1e3:.3g} ms. The new file states what the noise shows.']


def _axis_warnings(span_s: float, noise: AxisNoise) -> list[str]:
    texts = []
    for term, name in enumerate(_NAMES):
        if not (noise.estimates[term].is_seen or noise.is_coarse):
            needed_s = noise.fit.needed_s(term)
            texts.append(f'{duration(span_s)} is too short to see the {name}. ' + (
                'The other terms hide it, in longer recordings, too.' if np.isinf(needed_s) else
                f'To see half of the limit above, record about {duration(needed_s)}.'))
    if noise.is_coarse:
        texts.append(f'samples change in steps of {noise.resolution * MICRO_G:.3g} µg, which hide '
                     'the noise. N, B and K are upper limits. Choose a smaller range.')
    if not noise.fit.white.is_seen:
        texts.append('N is not determined. A parameter file keeps the figure of --params, or '
                     'states no white noise.')
    return texts


_INCHES = (5.0, 4.4)
"""Width and height of the plot of an axis, inches. Chosen: three fit beside each other."""


def _plot(result: RecordingNoise) -> Any:
    figure = new_figure(figsize=(_INCHES[0] * len(result.axes), _INCHES[1]))
    axes = figure.subplots(1, len(result.axes), squeeze=False, sharey=True)
    tau_s, error = result.rest.allan.tau_s, result.rest.allan.relative_error
    for i, (noise, plot) in enumerate(zip(result.axes, axes[0])):
        measured = result.rest.allan.deviation[:, i] * MICRO_G
        plot.errorbar(tau_s, measured, yerr=measured * error.clip(max=0.9), fmt='o', ms=4,
                      color='#36c', label='measured')
        for name, line, estimate in zip(_NAMES, noise.fit.lines(tau_s), noise.estimates):
            if estimate.is_seen:
                plot.plot(tau_s, line * MICRO_G, '--', lw=1, label=name)
        plot.plot(tau_s, noise.fit.allan_deviation(tau_s) * MICRO_G, color='#222',
                  lw=1, label='all three')
        plot.set(xscale='log', yscale='log', title=f'axis {noise.axis}',
                 xlabel='averaging time τ, s', ylim=(measured.min() / 3, measured.max() * 2))
        plot.grid(True, which='both', alpha=0.3)
        plot.legend(fontsize=8)
    axes[0][0].set_ylabel('Allan deviation, µg')
    return figure


_PLOT = 'allan.png'  # Name of the curve in the folder of the report
_BLOCK_ROWS = 65536  # Samples that are read at a time (chosen: some MB)
_EXAMPLES = {
    'noise of each axis, with its Allan deviation': 'still.mcap --report noise',
    'a parameter file for compensation and diagnose':
        'still.csv --params my_sensor.yaml -o my_noise.yaml',
    "a camera's IMU in a bag": 'bag --topic /camera/imu',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('noise', __doc__, _EXAMPLES)
    parse.add_argument('recording', metavar='RECORDING',
                       help=f'{cli.RECORDING_HELP}; of a sensor that nobody touches')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the other values of the sensor (default: the nominal sensor; for a '
                            'recording in m/s² that names no sensor, any IMU)')
    parse.add_argument('-o', dest='output', metavar='FILE.yaml',
                       help='a parameter file with the measured noise')
    parse.add_argument('--report', metavar='DIR', help='write the curve allan.png there')
    cli.add_overwrite_option(parse)
    cli.add_recording_options(parse)
    return parse


def noise(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_outputs(options, options.output,
                      options.report and Path(options.report, _PLOT))
    reading = cli.reading_options(options)
    newest: list[Recording] = []
    with cli.progress('noise') as show:
        def blocks() -> Iterator[Recording]:
            for block in recording.blocks(options.recording, _BLOCK_ROWS, reading):
                newest[:] = [block]
                yield block
                show(block.done, 'read')

        result = noise_parameters.recording_noise(blocks, options.params,
                                                  lambda done: show(done, 'fit'))
    rest, warnings = result.rest, _warnings(result)
    cli.report_reading('noise', *newest)
    files: list[Path] = []
    if options.report:
        files = [Path(options.report, _PLOT)]
        cli.make_folder(files[0].parent)
        write_bytes(files[0], png(_plot(result)))
    if options.output:
        name = Path(options.recording).name
        stated = _sensor(result)
        fresh = noise_parameters.with_noise(stated, result.axes, rest)
        warnings += _filter_warning(stated, fresh)
        parameter_file.save(options.output, replace(fresh, provenance={
            **fresh.provenance, 'noise_from': name, 'rate_from': name}), [
                f'Noise measured in {duration(rest.span_s)} at rest of {result.path}.',
                'Density: over positive frequencies, as datasheets state it.', *_tables(result)])
        files.insert(0, Path(options.output))
    print('\n'.join([*_head(result), '', *_tables(result), '', *_paste_lines(result), '']))
    warnings = [f'WARNING {text}' for text in warnings]
    following = command('diagnose', f'RECORDING --params {cli.quoted(options.output)} '
                            '-o gap') if options.output else command(
        'noise', f'{cli.quoted(options.recording)}{cli.reading_text(options)} -o noise.yaml')
    cli.print_end([*warnings, *[''] * bool(warnings)], files, following)
    return 0


def _sensor(result: RecordingNoise) -> Sensor:
    """Return the sensor of the parameter file, with the axes and rate of the recording."""
    sensor, unit = result.sensor, result.unit
    if sensor.effects and sensor.axes != unit.axes:
        raise UserError(f'{result.path}: has the axes {unit.axes}, but the parameters of '
                        f'{sensor.serial} are for {sensor.axes}; name the parameter file of this '
                        'sensor')
    return replace(sensor if sensor.effects else unit, serial=unit.serial,
                   rate_hz=round(result.rest.rate_hz, 6))


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), noise)
