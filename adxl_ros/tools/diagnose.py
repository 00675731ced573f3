# SPDX-License-Identifier: Apache-2.0

"""Find where a recording differs from its simulation, and which effects cause it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from time import monotonic
from typing import Any

from adxl_ros.diagnose import page
from adxl_ros.diagnose.diagnosis import diagnose as diagnose_recordings, Diagnosis, self_check
from adxl_ros.diagnose.report import as_json, screen_lines
from adxl_ros.diagnose.residual_map import gap_in, GapInUnit, quantity
from adxl_ros.diagnose.verdict import MATERIAL_MG
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file, recording
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import NO_UNIT, Recording
from adxl_ros.model.effects import library
from adxl_ros.model.population import posterior
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
_FILES = ('report.html', 'params.yaml', 'report.json')
"""Files of a diagnosis."""


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
    count = len(options.recording)
    for is_wrong, message in (
            (options.seed < 0, f'--seed {options.seed}: must not be negative'),
            (not 0 < options.material < float('inf'),
             f'--material {options.material:g}: must be positive'),
            (options.self_check < 0, f'--self-check {options.self_check}: must not be negative'),
            (options.sim and count > 1,
             f'--sim {options.sim}: goes with one recording, but {count} are given'),
            (options.urdf and (options.sim or count > 1),
             f'--urdf {options.urdf}: goes with one recording, and without --sim'),
            (options.align and not (options.sim or options.urdf),
             '--align: shifts --sim or a robot, and neither is given')):
        if is_wrong:
            raise UserError(message)
    reading = cli.reading_options(options)
    population = calibration_store.read_population(options.prior) if options.prior else None
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
        if population is not None:
            sensor, line, _ = posterior(sensor, population)
            prior_lines = ['', f' prior: {line}']
        diagnosis = diagnose_recordings(recordings, sensor, sim, options.seed,
                                        lambda stage, done: show(done, stage), options.align,
                                        options.material)
        subject = _subject(recordings, sensor, options.sim or options.urdf)
        lines = [*screen_lines(diagnosis, subject), *prior_lines]
        if options.self_check and diagnosis.report is not None:
            lines += ['', ' ' + self_check(diagnosis, recordings, sim, options.self_check,
                                           options.seed,
                                           lambda done: show(done, 'self-check'))]
        gap = gap_in(unit, diagnosis.full_rate, diagnosis.report.baseline,
                     diagnosis.report.sensor, options.seed) \
            if unit is not None and diagnosis.report is not None else None
        lines += ['', f' in      {gap.text}'] if gap else []
        report = _write(options, diagnosis, subject, lines, gap)
    if options.json:
        print(json.dumps(report, indent=1, allow_nan=False))
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
    folder = Path(options.output)
    cli.make_folder(folder)
    report = as_json(diagnosis) | ({'gap_in': gap._asdict()} if gap else {})
    write_text(folder / 'report.json', json.dumps(report, indent=1, allow_nan=False) + '\n')
    parameters = '' if diagnosis.report is None else \
        parameter_file.as_text(diagnosis.report.sensor, lines)
    if parameters:
        write_text(folder / 'params.yaml', parameters)
    steps = _next_steps(options, diagnosis)
    if isinstance(steps, str):
        steps = [NextStep('simulate with these parameters', steps)] if steps else []
    write_text(folder / 'report.html', page.page(diagnosis, page.Run(
        subject, Path(options.params or parameter_file.nominal_path()).name, steps, parameters)))
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


def _next_steps(options: argparse.Namespace, diagnosis: Diagnosis) -> str | list[NextStep]:
    """Return what to record, how to diagnose that, and how to simulate what was found."""
    if diagnosis.report is None:
        return ''
    verdict = diagnosis.report.verdict
    params = cli.quoted(Path(options.output) / 'params.yaml')
    simulate = cli.command('simulate', f'rich --params {params} -o sim.csv')
    if diagnosis.report.next_experiment is None:
        return simulate
    proposal = diagnosis.report.next_experiment
    if proposal.concerns_reference:
        return [NextStep(f'record next.csv: {proposal.manoeuvre}, {proposal.why}',
                         proposal.command),
                NextStep('simulate the sensor without the errors of the reference', simulate)]
    steps, then = [NextStep(f'record next.csv: {proposal.manoeuvre}, {proposal.why}; simulated, '
                            'it is', proposal.command)], ''
    if proposal.beside_simulator:
        both = ', and next_simulated.csv in the simulator' if options.sim else ''
        steps, then = [], (f'record next.csv{both}: '
                           f'{proposal.manoeuvre}, {proposal.why}; then ')
    if verdict.status in ('explained', 'partly'):
        steps += [NextStep(f'{then}diagnose the recording: the effects should close its gap, too',
                           _diagnose_command(options, params, [])),
                  NextStep('simulate with the effects', simulate)]
    else:
        given = options.params and cli.quoted(options.params)
        together = '' if options.sim or options.urdf else ' together with this one'
        steps.append(NextStep(f'{then}diagnose it{together}',
                              _diagnose_command(options, given, options.recording)))
    return steps


def _diagnose_command(options: argparse.Namespace, params: str | None, recordings: list[str]
                      ) -> str:
    """Return the command that diagnoses the next recording, alone or with others."""
    words = [cli.quoted(*([] if options.sim or options.urdf else recordings), 'next.csv')]
    words += [f'--params {params}'] if params else []
    words += ['--sim next_simulated.csv'] if options.sim else []
    words += [f'--urdf {cli.quoted(options.urdf)} --frame {cli.quoted(options.frame)}'] \
        if options.urdf else []
    output = f'{options.output}{"_2" if options.output[-1].isdigit() else "2"}'
    return cli.command('diagnose', ' '.join([*words, f'-o {cli.quoted(output)}']))


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), diagnose)
