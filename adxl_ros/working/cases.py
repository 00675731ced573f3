# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Working cases: their mix, their strengths, their labels and their files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
import json
import math
from pathlib import Path
from typing import Any

from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.csv_writer import CsvWriter
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Place
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Held
from adxl_ros.working import chain_faults, sample_faults, scene as scenes, unlisted_faults
from adxl_ros.working.fault import Fault, Kind, LIBRARY_SHARE
from adxl_ros.working.scene import Scene
import numpy as np

SEED = 7_000_000
"""First number of every seed; chosen: no other program of the package draws with it."""
LISTED = {kind.name: kind for kind in (*chain_faults.KINDS, *sample_faults.KINDS)}
"""Kinds of effects that the library has."""
UNLISTED = {kind.name: kind for kind in unlisted_faults.KINDS}
"""Kinds that it does not have."""
_GROUPS = ('none', 'single', 'pair', 'aged', 'outside')
"""Groups of cases: 'aged' is an effect of the library beside a zero-g or scale factor that really
changed."""
_SHARES = (0.2, 0.38, 0.17, 0.1, 0.15)
"""Shares of the groups; chosen."""
_STRENGTHS_MG = (0.15, 1.5, 8.0)
"""Lowest strength of a weak and of any other effect, and the highest, mg. Strengths are
log-uniform."""
_WEAK_SHARE = 0.15
"""Share of the weak effects; chosen."""
_AT_REST_SHARE = 0.5
"""Share of the faults that were there when the unit was calibrated, of those that show at rest;
chosen."""
_MAX_SIZE_STEPS = 9
"""Largest number of simulations to find the size for a strength; chosen."""
_SIZE_TOLERANCE = 0.08
"""Largest error of the logarithm of the strength; chosen."""
_STRAIGHT = ('bias', 'scale_factor', 'gravity')
"""Effects that show only beyond the tolerance of a calibration."""
HIDDEN_BELOW = 30.0
"""Signal-to-noise ratio, as a sum of squares, below which a fault cannot be seen; chosen: the
likelihood ratio of an effect with three coefficients, with a prior of 1 in 30, needs some 25."""
_DIGITS = 9
"""Significant digits of a recording's columns; chosen: far below a step of the ADC."""


@dataclass(frozen=True)
class Label:
    """
    What is true of a case. Its fields are the keys of the label file.

    Attributes
    ----------
    name
        Name of its files.
    group
        One of the groups.
    effects
        Right answer: effects of the library.
    outside
        Whether it has a fault outside the library.
    rate_hz, seconds, axes, manoeuvre, resolution_rad
        Of recording and stage.
    noise_mps2
        Rms of the noise, m/s².
    gap_mg
        Rms of the recording without noise minus the stated simulation, mg.
    faults
        For each fault: kind, size, shape, strength in mg, squared signal-to-noise ratio beyond
        zero-g and scale factor (`visibility`), and whether the calibration contains it.

    """

    name: str
    group: str
    effects: tuple[str, ...]
    outside: bool
    rate_hz: float
    seconds: float
    axes: str
    manoeuvre: str
    resolution_rad: float
    noise_mps2: float
    gap_mg: float
    faults: list[dict[str, Any]] = field(default_factory=list)

    @property
    def hidden(self) -> frozenset[str]:
        """Return the effects that may be missing in a right answer."""
        return frozenset(row['kind'] for row in self.faults if row['visibility'] < HIDDEN_BELOW)


def write(folder: Path, seed: int, number: int,
          seconds: tuple[float, float] = scenes.SECONDS) -> Label:
    """
    Draw a case, and write its recording, its parameter file and its label.

    Parameters
    ----------
    folder
        Gets a folder for the case.
    seed
        Seed of the cases.
    number
        Number of the case.
    seconds
        Shortest and longest recording, s.

    Returns
    -------
    Label
        Its label.

    """
    name = name_of(seed, number)
    rng = np.random.default_rng([SEED, seed, number])
    group, kinds = planned(rng, seed, number)
    scene = scenes.draw(rng, [kind.needs for kind in kinds if kind.needs], seconds)
    clean = scenes.samples(scene, [])
    faults, rows = [], []
    at_rest: list[Fault] = []
    for kind in kinds:
        fault, row = _sized(rng, scene, kind, clean)
        faults.append(fault)
        rows.append(row)
        if row['calibrated']:
            at_rest.append(fault)
    volts = scenes.samples(scene, faults)
    gap_g = (volts - clean) / scene.true.scale_v_per_g
    if at_rest:
        stated = scenes.calibrated(scene, at_rest)
        gap_g = gap_g - _taken_up(scene, stated)
        scene = scene._replace(stated=stated)
    label = Label(name, group, tuple(kind.name for kind in kinds if kind.listed),
                  any(not kind.listed for kind in kinds), scene.true.rate_hz,
                  len(volts) / scene.true.rate_hz, scene.true.axes, scene.manoeuvre,
                  scene.true.stage_resolution_rad, _noise_mps2(scene),
                  1e3 * _rms(gap_g), rows)
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    with CsvWriter(place / f'{name}.csv', _DIGITS) as writer:
        writer.write(scenes.columns(scene, volts))
    parameter_file.save(place / f'{name}.yaml', scene.stated)
    write_text(place / f'{name}.json', json.dumps(asdict(label), indent=1) + '\n')
    return label


def name_of(seed: int, number: int) -> str:
    """
    Return the name of a case.

    Parameters
    ----------
    seed
        Seed of the cases.
    number
        Number of the case.

    Returns
    -------
    str
        Name of its folder and files.

    """
    return f'w{seed:03d}_{number:04d}'


def read(path: Path) -> Label:
    """Read a label."""
    row: dict[str, Any] = json.loads(path.read_text(encoding='utf-8'))
    return Label(**{**row, 'effects': tuple(row['effects'])})


def planned(rng: np.random.Generator, seed: int, number: int) -> tuple[str, list[Kind]]:
    """
    Plan a case; singles take the kinds in turn.

    Parameters
    ----------
    rng
        The random generator.
    seed, number
        Seed of the cases, and number of the case.

    Returns
    -------
    tuple
        Group and kinds.

    """
    group = str(rng.choice(_GROUPS, p=_SHARES))
    turn = np.random.default_rng([SEED, seed, number // len(LISTED)]).permutation(list(LISTED))
    first = LISTED[str(turn[number % len(LISTED)])]
    if group == 'none':
        return group, []
    if group == 'single':
        return group, [first]
    if group == 'outside':
        return group, [UNLISTED[str(rng.choice(list(UNLISTED)))]]
    aging = ('bias', 'scale_factor')
    if group == 'aged':
        other = first if first.name not in aging else LISTED[str(rng.choice(
            [name for name in LISTED if name not in aging]))]
        return group, [other, LISTED[str(rng.choice(aging, p=(0.7, 0.3)))]]
    second = LISTED[str(rng.choice([name for name in LISTED if name != first.name]))]
    return group, [first, second]


def _sized(rng: np.random.Generator, scene: Scene, kind: Kind, clean: np.ndarray
           ) -> tuple[Fault, dict[str, Any]]:
    """Draw a fault and find the size of its drawn strength; return it with its row."""
    weak, lowest, highest = _STRENGTHS_MG
    low, high = (weak, lowest) if rng.random() < _WEAK_SHARE else (lowest, highest)
    strength_mg = math.exp(rng.uniform(math.log(low), math.log(high)))
    shape = kind.draw(rng, len(scene.true.axes))
    if kind.act is None or (kind.parameters is not None and rng.random() < LIBRARY_SHARE):
        shape['form'] = 'library'
    calibrated = kind.at_rest and bool(rng.random() < _AT_REST_SHARE)
    sizes: list[float] = []
    strengths: list[float] = []
    fault = Fault(kind, kind.start, shape)
    while True:
        stated = scenes.calibrated(scene, [fault]) if calibrated else scene.stated
        change = (scenes.samples(scene, [fault]) - clean) / scene.true.scale_v_per_g
        beyond = change - _taken_up(scene, stated)
        sizes.append(math.log(fault.size))
        strengths.append(math.log(max(1e3 * _rms(beyond), 1e-9)))
        wrong = math.log(strength_mg) - strengths[-1]
        if abs(wrong) < _SIZE_TOLERANCE or len(sizes) == _MAX_SIZE_STEPS \
                or (fault.size == kind.largest and wrong > 0):
            break
        fault = replace(fault, size=min(math.exp(
            _next(sizes, strengths, math.log(strength_mg))), kind.largest))
    return fault, {'kind': kind.name, 'size': fault.size, 'shape': shape,
                   'strength_mg': 1e3 * _rms(beyond), 'calibrated': calibrated,
                   'visibility': _visibility(scene, kind, change)}


def _next(sizes: Sequence[float], strengths: Sequence[float], target: float) -> float:
    """Return the next size to try by the secant, or the middle of the bracket; all logarithms."""
    slope = 1.0
    if len(sizes) > 1 and sizes[-1] != sizes[-2]:
        slope = (strengths[-1] - strengths[-2]) / (sizes[-1] - sizes[-2])
    step = (target - strengths[-1]) / min(max(slope, 0.5), 20.0)
    size = sizes[-1] + min(max(step, -2.5), 2.5)
    below = [s for s, strength in zip(sizes, strengths) if strength < target]
    above = [s for s, strength in zip(sizes, strengths) if strength >= target]
    if below and above and not max(below) < size < min(above):
        return (max(below) + min(above)) / 2
    return size


def _taken_up(scene: Scene, stated: Sensor) -> np.ndarray:
    """Return what a calibration with a fault changes in the simulation, g, (n, m)."""
    before = scene.stated
    if stated is before:
        return np.zeros((1, len(before.axes)))
    zero = (stated.zero_g_v - before.zero_g_v) / before.scale_v_per_g
    slope = (stated.scale_v_per_g - before.scale_v_per_g) / before.scale_v_per_g
    return zero + slope * _force_g(scene)


def _force_g(scene: Scene) -> np.ndarray:
    """Return the specific force along the measured axes, g, (n, m)."""
    motion = scene.motion
    count = max(int(round(motion.duration_s * scene.true.rate_hz, 6)), 1)
    time_s = np.arange(count) / scene.true.rate_hz
    shaken = 0.0 if isinstance(motion.shift, Held) else motion.shift(time_s, 2)
    force = specific_force(motion.alpha(time_s), motion.beta(time_s), G0_MPS2, shaken)
    return np.column_stack([force[d] / G0_MPS2 for d in range(len(scene.true.axes))])


def _visibility(scene: Scene, kind: Kind, change: np.ndarray) -> float:
    """Return the squared signal-to-noise ratio of a change beyond zero-g and scale factor."""
    noise_g = scene.true.noise_density_g_per_rthz * math.sqrt(scene.true.rate_hz / 2)
    if kind.name in _STRAIGHT:
        tolerance_g = math.hypot(scenes.ZERO_G_STD_G, scenes.ZERO_G_STD_G)
        return float(np.sum((np.mean(np.abs(change), axis=0) / tolerance_g) ** 2))
    force, total = _force_g(scene), 0.0
    for d, column in enumerate(change.T):
        line = np.column_stack([np.ones(len(column)), force[:, d]])
        rest = column - line @ np.linalg.lstsq(line, column, rcond=None)[0]
        total += float(np.sum(rest ** 2)) / noise_g[d] ** 2
    return total if kind.place not in (Place.ADC, Place.CODE) else total / 10


def _noise_mps2(scene: Scene) -> float:
    """Return the rms of the white noise of a recording behind the filter, m/s²."""
    sensor = scene.true
    band_hz = min(sensor.rate_hz / 2, 1 / (4 * sensor.rc_s)) if sensor.rc_s else \
        sensor.rate_hz / 2
    return float(np.sqrt(np.mean(sensor.noise_density_g_per_rthz ** 2) * band_hz) * G0_MPS2)


def _rms(values: Sequence[float] | np.ndarray) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))
