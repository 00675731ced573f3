# SPDX-License-Identifier: Apache-2.0

"""
1 kHz of three channels for half an hour, with a random fault every 20 s; a sweep killed 200 times.

    make soak                       prints tables for docs/links.md and docs/guided.md
    make soak ARGS='--minutes 5 --kills 20 --seed 3'
"""

import argparse
from collections import defaultdict
from importlib.metadata import version
import os
import sys
import tempfile
import time

from domain import BY_UDP
from faults import driver, Fault, Outcome, run_fault, SERIAL_FAULTS, table_cells, table_row
from kills import kill
import numpy as np
from rig import memory_mib, private_graph, SampleReport, SerialRig

PERIOD_S = 20.0
"""Time from one fault to the next, s."""
FAULT_S = 2.0
"""Duration of a fault of the bytes, s."""
MARGIN_S = 3.0
"""Time that is kept free before the next fault, s."""
TABLE_HEAD = ('| fault | times | published | wrong | missing | counted | recovered within | '
              'worst stamp, ms |\n|---|---|---|---|---|---|---|---|')
"""Head of the table in docs/links.md."""
NO_FAULT = Fault('no fault', lambda rig, pid, duration_s: rig.graph.spin(duration_s) or 0)
"""The time between two faults."""


def soak(minutes, seed):
    """Return the outcomes by fault, and the driver's memory after a minute and at the end, MiB."""
    rng = np.random.default_rng(seed)
    outcomes = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder, private_graph() as graph:
        rig = SerialRig(graph, folder, {'seed': seed, 'ppm': 60.0})
        with driver(*rig.driver_parameters()) as process:
            rig.wait_for_samples(1000, 30)
            began_s = due_s = time.monotonic()
            memory = []
            while time.monotonic() < began_s + 60 * minutes:
                fault = SERIAL_FAULTS[rng.integers(len(SERIAL_FAULTS))]
                outcomes[fault].append(run_fault(fault, rig, process.pid, FAULT_S))
                due_s += PERIOD_S
                pause_s = due_s - time.monotonic() - MARGIN_S
                if pause_s > 0:
                    outcomes[NO_FAULT].append(run_fault(NO_FAULT, rig, process.pid, pause_s))
                if not memory and time.monotonic() > began_s + 60:
                    memory.append(memory_mib(process.pid))
            memory.append(memory_mib(process.pid))
        rig.end()
    return outcomes, memory


def combined(outcomes):
    """Add the counts of outcomes; keep the largest error and the slowest recovery."""
    reports = [outcome.report for outcome in outcomes]
    recoveries = [outcome.recovery_ms for outcome in outcomes if outcome.recovery_ms is not None]
    report = SampleReport(
        published=sum(report.published for report in reports),
        wrong=sum(report.wrong for report in reports),
        missing=sum(report.missing for report in reports),
        counted=sum(report.counted for report in reports),
        estimated=sum(report.estimated for report in reports),
        max_error_ms=max(report.max_error_ms for report in reports))
    return Outcome(report, max(recoveries, default=None))


def print_origin(options, length):
    """Print where the table below comes from."""
    print(f'{time.strftime("%Y-%m-%d")}, adxl_ros {version("adxl_ros")}, seed {options.seed}, '
          f'{length}.\n')


def check_link(options):
    """Run the link for a time and print its table; return the names of faults that failed."""
    outcomes, memory = soak(options.minutes, options.seed)
    print_origin(options, f'{options.minutes:g} minutes')
    print(TABLE_HEAD)
    for fault, runs in sorted(outcomes.items(), key=lambda item: item[0].name):
        print(table_row(fault.name, len(runs), *table_cells(combined(runs))))
    every_run = [outcome for runs in outcomes.values() for outcome in runs]
    print(table_row('all', len(every_run), *table_cells(combined(every_run))))
    print(f'\nMemory of the driver: {memory[0]:.1f} MiB after a minute, {memory[-1]:.1f} MiB at '
          'the end.')
    return [fault.name for fault, runs in outcomes.items()
            if any(failed(fault, outcome.report) for outcome in runs)]


def failed(fault, report):
    """Return whether a sample is wrong, or a missing one is not counted."""
    return report.wrong or (fault.exact and report.missing != report.counted)


def check_sweep(options):
    """Kill a sweep repeatedly and print a table; return the failures."""
    with tempfile.TemporaryDirectory() as folder, private_graph():
        sweeps = kill(folder, os.environ | BY_UDP, options.kills, options.seed)
    print_origin(options, f'{sweeps.kills} kills')
    print('| killed while | times |\n|---|---|')
    for moment, times in sorted(sweeps.moments.items()):
        print(table_row(moment, times))
    print(f'\n{sweeps.poses} poses were acknowledged, {sweeps.sweeps} sweeps came to their end; '
          f'lost or changed: {len(sweeps.lost)}, broken files: {len(sweeps.broken)}.')
    too_few = [f'only {sweeps.sweeps} sweeps ended'] if sweeps.sweeps < sweeps.kills // 10 else []
    return [*sweeps.lost, *sweeps.broken, *too_few]


def main():
    """Run both checks and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--minutes', type=float, default=30.0)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--kills', type=int, default=200)
    options = parser.parse_args()
    failures = check_link(options) if options.minutes else []
    failures += check_sweep(options) if options.kills else []
    result = f'wrong: {", ".join(failures)}' if failures else 'nothing wrong'
    print(f'soak: {result}', file=sys.stderr)
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
