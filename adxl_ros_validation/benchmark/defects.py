# SPDX-License-Identifier: Apache-2.0
"""
Level A: the world of the blind check puts one defect, two or none into real recordings.

The first part of a recording makes the parameters, the trials are parts of the rest. Labels are
sealed by a hash before the first diagnosis.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.workers import Pool
from adxl_ros_validation.benchmark.manifest import Loaded
from adxl_ros_validation.blind import real_sensors, trials
from adxl_ros_validation.blind.ideal_observer import (
    Bracket,
    bracket,
    IdealObserver,
    KNOWN_KINDS,
    line,
    noise_visibility,
    told_apart,
)
from adxl_ros_validation.blind.real_sensors import Half
from adxl_ros_validation.blind.simulator import Fault, G0, Unit
from adxl_ros_validation.blind.trials import Label, Show
import numpy as np

GROUPS = {
    'none': 'no defect',
    'single': 'one defect',
    'pair': 'two defects',
    'outside': 'one outside the library',
}
"""Groups of trials in words."""
_TRIALS = real_sensors.PlanRule(
    {'none': 0.25, 'single': 0.4, 'pair': 0.2, 'outside': 0.15}, 5, 't'
)
"""How trials are planned; the shares are chosen as those of the blind check are."""
_SHORTEST_S = 75.0
"""Shortest recording of level A, s: 30 s of its later part, less a tenth and a quarter."""
_BANDS = 60
"""Bands of the spectrum of what an untouched part leaves; as many as the blind check has."""


def halves(loaded: Sequence[Loaded], folder: Path) -> tuple[list[Half], list[str]]:
    """Return the later parts of recordings with parameters, and why others are left out."""
    made, left_out = [], []
    folder.mkdir(parents=True, exist_ok=True)
    for source, recording, force in loaded:
        if 'A' not in source.levels:
            continue
        path = folder / f'{source.name}.csv'
        recording.save(path, overwrite=True)
        if force is not None:
            force.save(path.with_name(f'{source.name}_sim.csv'), overwrite=True)
        try:
            if recording.span_s < _SHORTEST_S:
                raise UserError(
                    f'has {recording.span_s:.0f} s; level A needs {_SHORTEST_S:.0f} s, so that a '
                    'method gets half a minute of a trial'
                )
            made.append(real_sensors.later_part(path))
        except UserError as error:
            left_out.append(f'{source.name}, level A: {" ".join(str(error).split())}')
    return made, left_out


def save_untouched(folder: Path, parts: Sequence[Half]) -> list[Path]:
    """Write the later parts without a defect; return their names without an ending."""
    for part in parts:
        trials.save(folder, part.name, part.texts())
    return [folder / part.name for part in parts]


def seal(
    folder: Path, parts: Sequence[Half], seed: int | None, count: int, pool: Pool, show: Show
) -> str:
    """Draw the trials of level A into a folder; return the published hash of their labels."""
    return trials.seal(
        folder,
        partial(real_sensors.plans, parts, rule=_TRIALS),
        partial(real_sensors.draw, parts),
        seed,
        count,
        pool,
        show,
    )


class _RecordedScene(NamedTuple):
    """What the ideal observer asks of a scene, by a recording."""

    part: Half
    seed: tuple[int, ...]
    unit: Unit

    def response(self, faults: Sequence[Fault], coarse: bool = True) -> np.ndarray:
        """Return what a fault changes where the reference is known, m/s², (m, n)."""
        before = self.part.g()
        changed = real_sensors.acted_on(self.part, self.seed, faults[0])
        return G0 * (changed - before) * self.part.known


class RecordedObserver(IdealObserver):
    """
    The ideal observer of a real recording.

    It knows the forms of the defects, and the spectrum of what the untouched part leaves, which it
    takes for noise; `untouched` is that rest, m/s², (m, n), 0 where the reference is unknown.
    """

    def __init__(self, part: Half, seed: tuple[int, ...], untouched: np.ndarray) -> None:
        self.scene = _RecordedScene(part, seed, part.unit())  # type: ignore[assignment]
        kinds = part.kinds()
        self.known = {name: kind for name, kind in KNOWN_KINDS.items() if name in kinds}
        self.force = part.g() * G0 * part.known
        self.axes, self.count = self.force.shape
        self.weight = 1 / np.sqrt(_smooth_spectrum(untouched, part))
        # Zero-g and scale factor are known as those of the blind check are.
        self.state([], part.known.astype(float))


def _smooth_spectrum(untouched: np.ndarray, part: Half) -> np.ndarray:
    """Return the power of what an untouched part leaves, smooth over frequency, (m, f)."""
    known = part.known
    share = max(float(known.mean()), 1e-3)
    rows = np.zeros_like(untouched)
    for row, force, out in zip(untouched, part.g(), rows):
        zero, scale = line(force[known], row[known])
        out[known] = row[known] - zero - scale * force[known]
    power = np.abs(np.fft.rfft(rows)) ** 2 / (rows.shape[1] * share)
    edges = np.unique(np.geomspace(1, power.shape[1], _BANDS).astype(int))
    bands = [power[:, a:b].mean(axis=1) for a, b in pairwise(edges)]
    smooth = np.repeat(np.array(bands).T, np.diff(edges), axis=1)
    floor = (0.1 * part.noise_mps2) ** 2
    return np.maximum(np.concatenate([smooth[:, :1], smooth], axis=1), floor)


def limit(part: Half, label: Label, untouched: np.ndarray) -> Bracket:
    """Return how probably the ideal observer names all defects of a trial."""
    observer = RecordedObserver(part, label.seed, untouched)
    faults = label.acting()
    changes = [observer.scene.response([fault]) for fault in faults]
    if label.group == 'outside':
        # No kind is in its place: it need only be seen.
        seen = [
            noise_visibility(observer, fault.kind, change)
            if fault.kind.random
            else float(np.sum(observer.project(change) ** 2))
            for fault, change in zip(faults, changes)
        ]
        return bracket(np.sqrt(seen))
    return told_apart(observer, faults, changes).exactly
