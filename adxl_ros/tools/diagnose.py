# SPDX-License-Identifier: Apache-2.0

"""Find where a recording differs from its simulation, and which effects cause it."""

from __future__ import annotations

import argparse
from pathlib import Path
from time import monotonic
from typing import Any

from adxl_ros.diagnose.diagnosis import diagnose as diagnose_recordings, Diagnosis, self_check
from adxl_ros.diagnose.report import as_json, as_text, screen_lines
from adxl_ros.diagnose.residual_map import gap_in, GapInUnit, quantity
from adxl_ros.diagnose.verdict import MATERIAL_MG
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import NO_UNIT, Recording
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
from adxl_ros.report import page as html_page
from adxl_ros.report.screen import NextStep
from adxl_ros.signals.recorded_sensor import load_sensor, measure_unstated
from adxl_ros.simulate.trajectories import motion_from_force
from adxl_ros.tools import command_line as cli

_NO_VERDICT = ('bad_data', 'insufficient')
"""Statuses of the report that hold no verdict: the exit status is then 1."""

_EXAMPLES = {
    'a recording against the simulation of its calibration':
        'recording.mcap --params unit.yaml -o gap',
    'against another simulator, whose clock differs':
        'real.csv --sim gazebo.csv --align -o gap',
}
"""Examples of arguments, by their purpose."""
_FILES = ('report.html', 'params.yaml', 'report.json')  # Files of a diagnosis


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('diagnose', __doc__, _EXAMPLES, _details)
    parse.add_argument('recording', nargs='+',
                       help=f'{cli.RECORDING_HELP}; all of one unit')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='what the simulator models (default: the nominal sensor)')
    parse.add_argument('--prior', metavar='FILE',
                       help='the population.yaml of a fleet, as prior of zero-g and scale factor')
    parse.add_argument('--sim', metavar='RECORDING',
                       help='ideal specific force of the same manoeuvre by another simulator')
    parse.add_argument('--in', dest='quantity', metavar='QUANTITY',
                       help='state the gap in your unit, too: tilt (deg), velocity (m/s after '
                            '10 s), or MODULE:FUNCTION')
    parse.add_argument('--align', action='store_true',
                       help='shift --sim in time where its motion is late or early')
    parse.add_argument('--material', type=float, default=MATERIAL_MG, metavar='MG',
                       help='amplitude that matters, mg rms (default 0.1, at least a tenth of the '
                            'noise); smaller effects are no gap')
    parse.add_argument('--self-check', type=int, default=0, metavar='N',
                       help='simulate N recordings from the verdict, and say how often it returns')
    parse.add_argument('--seed', type=int, default=0, help='seed of the bootstraps (default 0)')
    parse.add_argument('--json', action='store_true', help='print the report as JSON')
    parse.add_argument('-o', dest='output', metavar='DIR', required=True,
                       help='report.json, report.html and params.yaml')
    cli.add_robot_options(parse)
    cli.add_recording_options(parse)
    return parse


def _details() -> str:
    """Return exit status and effects for the help text."""
    return ('Exit status: 0 with a verdict, 1 where none was possible (the report then\n'
            'names the fault of the recording, or what it lacks), 2 after wrong usage.\n\n'
            + cli.effect_list(library().values()))


def diagnose(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    begin_s = monotonic()
    cli.check_least(options, seed=0, self_check=0, material=1e-6)
    references = bool(options.sim) + bool(options.urdf)
    if references and references + len(options.recording) > 2:
        raise UserError(f'{options.sim or options.urdf}: --sim or --urdf, one of them, goes with '
                        f'one recording, but {len(options.recording)} are given')
    if options.align and not (options.sim or options.urdf):
        raise UserError('--align: shifts --sim or a robot, and neither is given')
    reading = cli.reading_options(options)
    unit = quantity(options.quantity) if options.quantity else None
    html_page.check_libraries()
    with cli.progress('reading') as show:
        recordings = [cli.read('diagnose', path, reading) for path in options.recording]
        sensor, _ = measure_unstated(load_sensor(options.params, recordings[0]), recordings[0])
        sim = motion_from_force(recording.read_ideal(options.sim, recordings[0].epoch_ns), False
                                )[0] if options.sim else None
        if options.urdf:
            sim = cli.robot_path(options, recordings[0], sensor).as_motion()
        prior_lines: list[str] = []
        if options.prior:
            from adxl_ros.files import calibration_store
            from adxl_ros.model.population import posterior
            sensor, line, _ = posterior(sensor, calibration_store.read_population(options.prior))
            prior_lines = ['', f' prior: {line}']
        diagnosis = diagnose_recordings(recordings, sensor, sim, options.seed,
                                        lambda stage, done: show(done, stage), options.align,
                                        options.material)
        subject = _subject(recordings, sensor, options.sim or options.urdf)
        lines, found, gap = screen_lines(diagnosis, subject), diagnosis.report, None
        lines += prior_lines
        if options.self_check and found:
            lines += ['', ' ' + self_check(diagnosis, recordings, sim, options.self_check,
                                           options.seed,
                                           lambda done: show(done, 'self-check'))]
        if unit and found:
            gap = gap_in(unit, diagnosis.full_rate, found.baseline, found.sensor, options.seed)
            lines += ['', f' in      {gap.text}']
        report = _write(options, diagnosis, subject, lines, gap)
    if options.json:
        print(as_text(report), end='')
    else:
        cli.print_end([*lines, ''], [Path(options.output, name) for name in _FILES],
                      _next_steps(options, diagnosis), monotonic() - begin_s)
    if report['verdict']['status'] not in _NO_VERDICT:
        return 0
    reason = report['verdict']['data_fault'] or report['verdict']['status']
    cli.note(f'diagnose: {", ".join(options.recording)}: no verdict ({reason}); the reason is in '
             f'{Path(options.output, "report.json")}')
    return 1


def _write(options: argparse.Namespace, diagnosis: Diagnosis, subject: str, lines: list[str],
           gap: GapInUnit | None) -> dict[str, Any]:
    """Write the files of a diagnosis; return its report."""
    from adxl_ros.diagnose import page
    folder = Path(options.output)
    cli.make_folder(folder)
    report = as_json(diagnosis) | ({'gap_in': gap._asdict()} if gap else {})
    for name, text in page.documents(diagnosis, report, lines, page.Run(
            subject, Path(options.params or parameter_file.nominal_path()).name,
            _next_steps(options, diagnosis))).items():
        write_text(folder / name, text)
    return report


def _subject(recordings: list[Recording], sensor: Sensor, sim: str | None) -> str:
    """Return what is compared with what."""
    first, count = recordings[0], len(recordings)
    name = Path(first.path).name if count == 1 else f'{count} recordings'
    span_s = sum(float(r.time_s[-1] - r.time_s[0]) for r in recordings if len(r))
    unit = 'the nominal sensor' if sensor.serial == NO_UNIT else f'unit {sensor.serial}'
    simulated = f'{Path(sim).name} through the chain of {unit}' if sim \
        else f'simulation of {unit}'
    return (f'{name} ({span_s:.0f} s, {first.rate_hz:.4g} Hz, {" ".join(first.axes)})  minus  '
            f'{simulated}')


def _next_steps(options: argparse.Namespace, diagnosis: Diagnosis) -> list[NextStep]:
    """Return what to record, how to diagnose that, and how to simulate what was found."""
    if diagnosis.report is None:
        return []
    params = str(Path(options.output) / 'params.yaml')
    proposal, steps = diagnosis.report.next_experiment, []
    if proposal is not None:
        both = ', and next_simulated.csv in the simulator' if options.sim else ''
        steps.append(NextStep(f'record next.csv{both}: {proposal.manoeuvre}, {proposal.why}',
                              '' if proposal.beside_simulator else proposal.command))
    if proposal is not None and not proposal.concerns_reference:
        is_closed = diagnosis.report.verdict.status in ('explained', 'partly')
        is_alone = is_closed or options.sim or options.urdf
        given = {'--params': params if is_closed else options.params,
                 '--sim': options.sim and 'next_simulated.csv', '--urdf': options.urdf,
                 '--frame': options.urdf and options.frame, '-o': f'{options.output}_2'}
        words = [*([] if is_alone else options.recording), 'next.csv']
        words += [word for option in given.items() if option[1] for word in option]
        steps.append(NextStep('diagnose it' if is_alone else 'diagnose it together with this one',
                              cli.command('diagnose', cli.quoted(*words))))
    return [*steps, NextStep('simulate the sensor as it was found', cli.command(
        'simulate', f'rich --params {cli.quoted(params)} -o sim.csv'))]


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), diagnose)
