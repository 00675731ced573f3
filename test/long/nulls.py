# SPDX-License-Identifier: Apache-2.0

"""
Nulls: recordings without any effect, by manoeuvre, rate, axes and encoder, through diagnose.

    make nulls         writes docs/measurements/nulls.md; goes on where it was cut short
    make nulls ARGS='--minutes 5 --seed 3'

The cases run in a random order, so that a part of them is a fair sample.
"""

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import product
import json
from pathlib import Path
import sys
import time

from adxl_ros.diagnose.diagnosis import diagnose
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.sensor import with_axes
from adxl_ros.simulate import simulator
from adxl_ros.simulate.trajectories import TRAJECTORIES
import numpy as np

RATES_HZ = (20, 25, 50, 100, 200, 250, 500, 1000, 2000)
"""Sample rates, Hz."""
AXES = ('x', 'xy', 'xyz')
"""Axes of the sensor."""
STEPS_DEG = (1 / 12, 0.01)
"""Steps of the encoder, degrees: that of the default stage, and that of the blind check."""
LONGEST_S = 200.0
"""Longest recording, s; a longer manoeuvre is cut."""
MOST_SAMPLES = 200_000
"""Largest number of samples of a recording."""
RIGHT = ('no gap', 'insufficient')
"""Right answers: a rest at one pose shows nothing but noise."""


@dataclass(frozen=True, order=True)
class Case:
    """One recording without any effect."""

    manoeuvre: str
    axes: str
    step_deg: float
    rate_hz: int


@dataclass(frozen=True)
class Answer:
    """What diagnose says of a recording, and its processor time, s."""

    text: str
    cpu_s: float


def answer(case, seed):
    """Simulate a recording and diagnose it."""
    sensor = replace(
        with_axes(parameter_file.load(parameter_file.nominal_path()), case.axes),
        rate_hz=float(case.rate_hz), stage_resolution_rad=float(np.radians(case.step_deg)))
    motion = TRAJECTORIES[case.manoeuvre](np.random.default_rng(seed))
    motion = replace(motion, duration_s=min(motion.duration_s, LONGEST_S,
                                            MOST_SAMPLES / case.rate_hz))
    columns = simulator.simulate(sensor, motion, seed)
    recording = Recording(case.manoeuvre, columns.pop('time_s'), columns, sensor_info(sensor))
    began_s = time.process_time()
    try:
        text = in_words(diagnose([recording], sensor))
    except UserError as error:
        text = f'refused: {error}'
    return Answer(text, time.process_time() - began_s)


def in_words(diagnosis):
    """Return the verdict in a few words."""
    if diagnosis.report is None:
        return f'fault: {diagnosis.fault.name}'
    verdict = diagnosis.report.verdict
    if verdict.status == 'unknown':
        return ' '.join(['unknown', *verdict.rest_follows[:1]])
    named = [*verdict.effects, *(' or '.join(group) for group in verdict.groups)]
    return ' and '.join(named) or verdict.status.replace('_', ' ')


def run(cases, seed, minutes, processes, path):
    """Run cases until the time is over; append each answer to a file of lines."""
    end_s = time.monotonic() + 60 * minutes
    with ProcessPoolExecutor(processes) as pool, path.open('a', encoding='utf-8') as file:
        for first in range(0, len(cases), processes):
            if time.monotonic() > end_s:
                return
            some = cases[first:first + processes]
            for case, result in zip(some, pool.map(answer, some, [seed] * len(some))):
                file.write(json.dumps([seed, version('adxl_ros'), asdict(case), asdict(result)])
                           + '\n')
                print(case, result, file=sys.stderr)
            file.flush()


def answers(seed, path):
    """Return the answers of a seed and of this version that a file holds, by case."""
    lines = path.read_text(encoding='utf-8').splitlines() if path.exists() else []
    rows = [json.loads(line) for line in lines]
    return {Case(**case): Answer(**result) for number, release, case, result in rows
            if (number, release) == (seed, version('adxl_ros'))}


def page(by_case, seed, total):
    """Return the page in Markdown."""
    texts = [result.text for result in by_case.values()]
    fault = sum(text.startswith(('fault', 'refused')) for text in texts)
    right = sum(text in RIGHT for text in texts)
    cpu_s = [result.cpu_s for result in by_case.values()]
    wrong = Counter(text for text in texts
                    if text not in RIGHT and not text.startswith(('fault', 'refused')))
    lines = [
        '# Recordings without any effect', '',
        "What `diagnose` says of recordings of the package's own simulator without any effect.",
        f'Each is cut after {LONGEST_S:.0f} s, or after {MOST_SAMPLES} samples.',
        '`make nulls` makes this page.', '',
        '| quantity | value |', '|---|---|',
        f'| date, version, seed | {time.strftime("%Y-%m-%d")}, {version("adxl_ros")}, {seed} |',
        f'| recordings, of all cases | {len(by_case)} of {total} |',
        f'| no gap, or insufficient | {right} |',
        f'| fault of the data | {fault} |',
        f'| a cause, or unknown | {sum(wrong.values())} |',
        f'| processor time: median, longest | {np.median(cpu_s):.1f} s, {max(cpu_s):.1f} s |', '',
        'A dot is no gap, a dash is insufficient, and F is a fault of the data. An empty cell did',
        'not run.', '',
        '| manoeuvre | axes | encoder | ' + ' | '.join(f'{r} Hz' for r in RATES_HZ) + ' |',
        '|---' * (3 + len(RATES_HZ)) + '|']
    for manoeuvre, axes, step_deg in product(TRAJECTORIES, AXES, STEPS_DEG):
        cells = [cell(by_case.get(Case(manoeuvre, axes, step_deg, rate))) for rate in RATES_HZ]
        lines.append(f'| {manoeuvre} | {axes} | {step_deg:.2g}° | ' + ' | '.join(cells) + ' |')
    faults = sorted({text for text in texts if text.startswith(('fault', 'refused'))})
    return '\n'.join([*lines, '', *(['Faults that were named:', '',
                                     *(f'- {text}' for text in faults)] if faults else [])]) + '\n'


def cell(result):
    """Return one cell of the table."""
    if result is None:
        return ''
    if result.text.startswith(('fault', 'refused')):
        return 'F'
    return {'no gap': '·', 'insufficient': '-'}.get(result.text, result.text)


def main():
    """Run what is missing, and write the page."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('page', type=Path)
    parse.add_argument('--minutes', type=float, default=90.0, help='longest run (default 90)')
    parse.add_argument('--processes', type=int, default=2)
    parse.add_argument('--seed', type=int, default=1)
    parse.add_argument('--results', type=Path, default=Path('../nulls_output.jsonl'))
    options = parse.parse_args()
    cases = [Case(*row) for row in product(TRAJECTORIES, AXES, STEPS_DEG, RATES_HZ)]
    done = answers(options.seed, options.results)
    order = np.random.default_rng(options.seed).permutation(len(cases))
    run([cases[i] for i in order if cases[i] not in done], options.seed, options.minutes,
        options.processes, options.results)
    options.page.write_text(page(answers(options.seed, options.results), options.seed,
                                 len(cases)), encoding='utf-8')


if __name__ == '__main__':
    main()
