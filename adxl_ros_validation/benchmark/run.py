# SPDX-License-Identifier: Apache-2.0
"""Ask every method about every case, and measure what its parameters close on a later part."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
import json
from pathlib import Path
import resource
from typing import Any

import adxl_ros as adxl
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.process import code_version
from adxl_ros.tools import command_line as cli
from adxl_ros.workers import Pool
from adxl_ros_validation.benchmark import methods
from adxl_ros_validation.benchmark.case import Case, Finding, UNKNOWN
from adxl_ros_validation.benchmark.manifest import GIVEN, Loaded
from adxl_ros_validation.blind.grading import Answer
from adxl_ros_validation.blind.real_sensors import Half
from adxl_ros_validation.blind.trials import kept, save, Show
from adxl_ros_validation.kept_results import write
import numpy as np

_BLOCK_S = 2.0
"""Length of the blocks of the bootstrap of what is closed, s; chosen."""


@dataclass(frozen=True)
class Answered:
    """What a method answered to a case, and how its parameters do on the later part."""

    causes: frozenset[str] = frozenset()
    one_of: tuple[frozenset[str], ...] = ()
    status: str = 'failed'
    probability: float = 0.0
    # Mean squares of recording minus simulation by block of the later part, with the stated and
    # with the corrected parameters, (m/s²)²
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()
    cpu_s: float = 0.0
    error: str = ''

    @classmethod
    def of_json(cls, row: Mapping[str, Any]) -> Answered:
        """Read what `as_json` wrote."""
        sets = {
            'causes': frozenset(row['causes']),
            'one_of': tuple(frozenset(group) for group in row['one_of']),
            'before': tuple(row['before']),
            'after': tuple(row['after']),
        }
        return cls(**{**row, **sets})

    def as_json(self) -> dict[str, Any]:
        """Return objects of JSON."""
        sets = {
            'causes': sorted(self.causes),
            'one_of': [sorted(group) for group in self.one_of],
        }
        return {**vars(self), **sets}

    @property
    def answer(self) -> Answer:
        """Return it as the blind check grades it."""
        return Answer(self.status, self.causes, self.one_of, self.probability)


def read_case(stem: Path) -> Case:
    """Read a case: NAME.csv, with NAME.yaml and NAME.sim where they are."""
    recording = adxl.read(stem.with_suffix('.csv'))
    params, force = stem.with_suffix('.yaml'), stem.with_suffix('.sim')
    stated = (
        adxl.load(params) if params.exists() else parameter_file.usual(recording.is_of_nominal)
    )
    return Case(recording, adxl.read(force) if force.exists() else None, stated)


def save_cases(folder: Path, loaded: Sequence[Loaded]) -> dict[str, Loaded]:
    """Write the cases of levels B and C, with the parameters of the datasheet; return by name."""
    chosen = {
        f'{each.source.name}_whole': each for each in loaded if {*each.source.levels} & {'B', 'C'}
    }
    for name, (_, recording, force) in chosen.items():
        folder.mkdir(parents=True, exist_ok=True)
        recording.save(folder / f'{name}.csv', overwrite=True)
        if force is not None:
            force.save(folder / 'force.csv', overwrite=True)
            (folder / 'force.csv').replace(folder / f'{name}.sim')
    return chosen


def later_squares(case: Case) -> float:
    """Return the mean square that the stated parameters leave on the later part, (m/s²)²."""
    return float(np.mean(_blocks(later_part(case), None)))


def later_part(case: Case) -> Case:
    """Return the part of a case that no method gets."""
    return case.rows(_cut(case), len(case.recording))


def _cut(case: Case) -> int:
    """Return the first sample of the later part."""
    return int(GIVEN * len(case.recording))


def _blocks(case: Case, sensor: Any) -> list[float]:
    """Return the mean squares of recording minus simulation by block, (m/s²)²."""
    squares = np.mean(case.residual_mps2(sensor)[case.known] ** 2, axis=1)
    count = max(int(len(squares) / (_BLOCK_S * case.recording.rate_hz)), 1)
    return [float(part.mean()) for part in np.array_split(squares, count) if len(part)]


def ask(place: str, stem: Path) -> tuple[str, dict[str, Any]]:
    """Ask a method about a case; return the name of the case, and `Answered` as JSON."""
    start = resource.getrusage(resource.RUSAGE_SELF)
    answered = Answered()
    try:
        case = read_case(stem)
        finding = methods.method_at(place)(case.rows(0, _cut(case)))
        answered = _answered(case, finding)
    except UserError as error:
        answered = Answered(error=' '.join(str(error).split()))
    except Exception as error:
        answered = Answered(error=f'{type(error).__name__}: {error}')
    end = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = end.ru_utime - start.ru_utime + end.ru_stime - start.ru_stime
    return stem.name, {**answered.as_json(), 'cpu_s': cpu_s}


def _answered(case: Case, finding: Finding) -> Answered:
    """Measure what the parameters of a finding do on the later part."""
    later = later_part(case)
    before: list[float] = []
    after: list[float] = []
    if later.known.any():
        before = after = _blocks(later, None)
        if finding.parameters is not None:
            # Parameters that cannot be simulated here close nothing.
            with suppress(UserError):
                after = _blocks(later, finding.parameters)
    stated = 'explained' if finding.causes or finding.one_of else 'no_gap'
    if UNKNOWN in finding.causes:
        stated = 'unknown'
    return Answered(
        frozenset(finding.causes),
        tuple(frozenset(group) for group in finding.one_of),
        finding.status or stated,
        float(finding.probability),
        tuple(before),
        tuple(after),
    )


def ask_all(
    folder: Path,
    chosen: Mapping[str, str],
    stems: Sequence[Path],
    pool: Pool,
    show: Show,
) -> dict[str, dict[str, Answered]]:
    """Ask all methods about all cases; return answers by method and name of the case."""
    stamp, code = folder / 'answers' / 'version.txt', code_version()
    if stamp.exists() and stamp.read_text() != code:
        raise UserError(
            f'{stamp}: earlier answers are of another version of the package; run the benchmark '
            'into another folder'
        )
    write(stamp, code.encode())
    paths = {stem.name: stem for stem in stems}

    def job(place: str, name: str) -> tuple:
        return place, paths[name]

    try:
        for method, place in chosen.items():
            with show(method) as advance:
                places = folder / 'answers' / method
                kept(places, list(paths), ask, partial(job, place), pool, advance)
    except KeyboardInterrupt:
        cli.note('interrupted: the page has what was answered; the same command continues')
    return {method: _answers_in(folder / 'answers' / method, paths) for method in chosen}


def _answers_in(folder: Path, names: Iterable[str]) -> dict[str, Answered]:
    """Read the answers that a folder has."""
    paths = {name: folder / f'{name}.json' for name in names}
    return {
        name: Answered.of_json(json.loads(path.read_bytes()))
        for name, path in paths.items()
        if path.exists()
    }


def untouched_case(folder: Path, part: Half) -> Case:
    """Return the case of a part of a recording without a defect."""
    save(folder, part.name, part.texts())
    return read_case(folder / part.name)
