# SPDX-License-Identifier: Apache-2.0

"""Find where a recording differs from its simulation, and which effects cause it."""

from __future__ import annotations

import argparse
from pathlib import Path
from time import monotonic

from adxl_ros.api.gap import diagnose as find_gap, PAGE, PARAMETERS, REPORT
from adxl_ros.diagnose.report_json import as_text
from adxl_ros.diagnose.verdict import MATERIAL_MG
from adxl_ros.model.effects import library
from adxl_ros.report import page as html_page
from adxl_ros.tools import command_line as cli

_EXAMPLES = {
    'a recording against the simulation of its calibration': (
        'recording.mcap --params unit.yaml -o gap'
    ),
    'against another simulator, whose clock differs': 'real.csv --sim gazebo.csv --align -o gap',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('diagnose', __doc__, _EXAMPLES, _details)
    parse.add_argument('recording', nargs='+', help=f'{cli.RECORDING_HELP}; all of one unit')
    parse.add_argument(
        '--params',
        metavar='FILE',
        help='what the simulator models (default: the nominal sensor)',
    )
    parse.add_argument(
        '--prior',
        metavar='FILE',
        help='the population.yaml of a fleet, as prior of zero-g and scale factor',
    )
    parse.add_argument(
        '--sim',
        metavar='RECORDING',
        help='ideal specific force of the same manoeuvre by another simulator',
    )
    parse.add_argument(
        '--sim-unit',
        metavar='UNIT',
        default='',
        help='unit of --sim: g, mg, mmps2 (default: m/s²)',
    )
    parse.add_argument(
        '--in',
        dest='quantity',
        metavar='QUANTITY',
        help='state the gap in your unit, too: tilt (deg), velocity (m/s after '
        '10 s), or MODULE:FUNCTION',
    )
    parse.add_argument(
        '--align',
        action='store_true',
        help='shift --sim in time where its motion is late or early',
    )
    parse.add_argument(
        '--material',
        type=float,
        default=MATERIAL_MG,
        metavar='MG',
        help='amplitude that matters, mg rms (default 0.1, at least a tenth of the '
        'noise); smaller effects are no gap',
    )
    parse.add_argument(
        '--self-check',
        type=int,
        default=0,
        metavar='N',
        help='simulate N recordings from the verdict, and say how often it returns',
    )
    parse.add_argument(
        '--limit',
        action='store_true',
        help='say how sure an ideal observer could be, who knows the effects and the noise',
    )
    parse.add_argument('--seed', type=int, default=0, help='seed of the bootstraps (default 0)')
    parse.add_argument('--json', action='store_true', help='print the report as JSON')
    parse.add_argument(
        '-o',
        dest='output',
        metavar='DIR',
        required=True,
        help='report.json, report.html and params.yaml',
    )
    cli.add_overwrite_option(parse)
    cli.add_robot_options(parse)
    cli.add_recording_options(parse)
    return parse


def _details() -> str:
    """Return exit status and effects for the help text."""
    return (
        'Exit status: 0 with a verdict, 1 where none was possible (the report then\n'
        'names the fault of the recording, or what it lacks), 2 after wrong usage.\n\n'
        + cli.effect_list(library().values())
    )


def diagnose(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    begin_s = monotonic()
    cli.check_outputs(
        options, *(Path(options.output, name) for name in (PAGE, PARAMETERS, REPORT))
    )
    html_page.check_libraries()
    reading = cli.reading_options(options)
    with cli.progress('reading') as show:
        gap = find_gap(
            [cli.read('diagnose', path, reading) for path in options.recording],
            options.params,
            sim=options.sim,
            sim_unit=options.sim_unit,
            urdf=options.urdf,
            frame=options.frame,
            joints=options.joints,
            align=options.align,
            material=options.material,
            prior=options.prior,
            quantity=options.quantity,
            self_check=options.self_check,
            limit=options.limit,
            seed=options.seed,
            progress=show,
        )
        files = gap.save(
            options.output, html_page.command_of_this_process(), overwrite=options.overwrite
        )
    if options.json:
        print(as_text(gap.to_dict()), end='')
    else:
        cli.print_end(
            [*gap.screen, ''], files, gap.next_steps(options.output), monotonic() - begin_s
        )
    if gap.has_verdict:
        return 0
    reason = gap.fault_name or gap.verdict
    cli.note(
        f'diagnose: {", ".join(options.recording)}: no verdict ({reason}); the reason is in '
        f'{Path(options.output, REPORT)}'
    )
    return 1


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), diagnose)
