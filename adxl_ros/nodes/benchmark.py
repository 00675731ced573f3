# SPDX-License-Identifier: Apache-2.0

"""Measure the live nodes and the reading of recordings, beside a bare baseline."""

from __future__ import annotations

import argparse
import sys

from adxl_ros.closed_output import ended_by_closed_output
from adxl_ros.errors import UserError
from adxl_ros.nodes.support import live_benchmark, rival_driver
from adxl_ros.nodes.support.benchmark_table import print_table
from adxl_ros.nodes.support.node_help import program_parser
from adxl_ros.nodes.support.offline_jobs import offline_jobs
from adxl_ros.nodes.support.processes import use_own_graph

_SECONDS = 10.0
"""Default duration of one live measurement, s."""
_ROUNDS = 3
"""Default number of measurements of each row; chosen: a median needs three."""
_HOURS = 8.0
"""Default duration of the long recordings, h."""
_EXAMPLES = {'all measurements, ten minutes': '',
             'with recordings of 10 minutes, not 8 hours': '--hours 0.17',
             'only the live nodes': '--live',
             'a short look': '--live --seconds 5 --rounds 1'}
"""Examples of arguments, by their purpose."""


@ended_by_closed_output()
def main() -> int:
    """Run the benchmark; return the exit status."""
    parser = program_parser('bench', __doc__, _EXAMPLES)
    parser.add_argument('--seconds', type=float, default=_SECONDS,
                        help=f'duration of each live measurement, s (default {_SECONDS:g})')
    parser.add_argument('--rounds', type=int, default=_ROUNDS,
                        help=f'measurements of each row (default {_ROUNDS})')
    parser.add_argument('--hours', type=float, default=_HOURS,
                        help='duration of the recordings of the rows "apply, … h" (default '
                             f'{_HOURS:g}: 30 GB of disk)')
    parser.add_argument('--live', action='store_true', help='measure only the live nodes')
    parser.add_argument('--iiod', metavar='FILE', help="the tests' IIOD, for the link iio")
    parser.add_argument('--bare', choices=list(live_benchmark.BARE_NODES),
                        help=argparse.SUPPRESS)
    parser.add_argument('--read', metavar='PORT', help=argparse.SUPPRESS)
    parser.add_argument('--rival-board', metavar='PORT', help=argparse.SUPPRESS)
    parser.add_argument('--rival-driver', metavar='PORT', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.bare:
        return live_benchmark.run_bare_node(live_benchmark.BARE_NODES[options.bare])
    if options.read:
        return live_benchmark.run_bare_reader(options.read)
    if options.rival_board:
        return rival_driver.run_board(options.rival_board, live_benchmark.RATE_HZ)
    if options.rival_driver:
        return rival_driver.run_driver(options.rival_driver, live_benchmark.BARE_QUEUE)
    use_own_graph()
    try:
        live_benchmark.measure_live(options.seconds, options.rounds, options.iiod)
        if not options.live:
            print_table(offline_jobs(options.hours), options.rounds)
    except UserError as error:
        print(f'bench: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0
