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

"""
The next manoeuvre: which of a menu would tell what this recording could not.

Each manoeuvre is simulated with the best hypothesis, noise included, and its rivals are fitted to
it: by how much more likely the truth is than its nearest rival, per minute, is what it is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose.baseline_comparison import Series, thinned
from adxl_ros.diagnose.decision import Verdict
from adxl_ros.diagnose.linear_model import on_tangents, study
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.response import Response
import numpy as np

_RATE_HZ = 62.5
_TURNED = 'stage_offset:beta_rad=3.141593'
_LEAST_NATS = 3.0
MENU = {
    'shaker': ('shake along x from 2 to 40 Hz', 'shaker', False,
               ('time_offset', 'bandwidth', 'mount_resonance', 'vibration_rectification')),
    'speeds': ('turn two planes at two speeds, forth and back, with reversals', 'rich', False,
               ('backlash', 'hysteresis', 'lever_arm', 'clock_skew')),
    'plane': ('sweep a second plane', 'tilt_both', False,
              ('misalignment', 'cross_axis', 'cross_axis_z', 'scale_factor_z', 'nonlinearity',
               'quadratic', 'stage_eccentricity', 'base_tilt')),
    'remount': ('remount the sensor turned by 180 deg about z, and sweep again', 'tilt_both', True,
                ('stage_offset', 'gravity', 'scale_factor', 'bias', 'adc_inl')),
    'heat': ('dwell, heat and cool', 'soak', False,
             ('temperature_bias', 'temperature_scale', 'warm_up', 'bias_walk', 'flicker')),
    'supply': ('step the supply at rest', 'soak', False, ('supply',)),
}
"""In words, the trajectory of `simulate`, whether remounted, and what it shows best."""


@dataclass(frozen=True)
class Next:
    """
    What to record next.

    Attributes
    ----------
    manoeuvre, why, command
        In words, and for `simulate`.
    nats_per_minute
        What it is expected to tell; None where there is nothing to tell apart.
    menu
        The same of all manoeuvres: words, minutes, nats a minute; the best first.

    """

    manoeuvre: str
    why: str
    command: str
    nats_per_minute: float | None = None
    menu: tuple[tuple[str, float, float], ...] = ()


def proposed(verdict: Verdict, missing: Sequence[str], seed: int) -> Next | None:
    """
    Propose the manoeuvre that tells most of what is not told apart; None if all is told.

    Parameters
    ----------
    verdict
        With its groups.
    missing
        What the recordings do not cover.
    seed
        Of the simulated noise.

    """
    if verdict.groups:
        group = verdict.groups[0]
        worth = {name: _nats_per_minute(name, verdict.best.sensor, group, seed) for name in MENU}
        order = sorted(MENU, key=lambda name: -worth[name][1])
        return _next(order[0], f'to tell {" from ".join(group)}', worth[order[0]][1], tuple(
            (MENU[name][0], *worth[name]) for name in order))
    if verdict.status == 'no_gap' and not missing:
        return None
    best = max(MENU, key=lambda name: len(set(MENU[name][3]) & set(verdict.effects)))
    if not set(MENU[best][3]) & set(verdict.effects):
        best = 'speeds' if verdict.status == 'unknown' or not missing else 'plane'
    return _next(best, 'what is unknown shows elsewhere, too' if verdict.status == 'unknown' else
                 f'this recording has no {", no ".join(missing)}' if missing else
                 'to confirm it on another recording')


def _next(name: str, why: str, nats_per_minute: float | None = None,
          menu: tuple[tuple[str, float, float], ...] = ()) -> Next:
    words, path, turned, _ = MENU[name]
    effect = f' --effect {_TURNED}' if turned else ''
    return Next(words, why, f'ros2 run adxl_ros simulate {path}{effect} -o next.csv',
                nats_per_minute, menu)


def _nats_per_minute(name: str, sensor: Sensor, group: Sequence[str], seed: int
                     ) -> tuple[float, float]:
    """Return the minutes of a manoeuvre and what it tells a minute, nats."""
    _, path, turned, _ = MENU[name]
    motion = trajectories.TRAJECTORIES[path](np.random.default_rng(seed))
    minutes = motion.duration_s / 60
    truth = replace(sensor, rate_hz=_RATE_HZ)
    baseline = replace(truth, effects=tuple(e for e in truth.effects if e not in group))
    if turned:
        truth, baseline = (_remounted(one) for one in (truth, baseline))
    time_s = np.arange(round(motion.duration_s * _RATE_HZ)) / _RATE_HZ
    try:
        volts = Response(truth, motion, seed)(time_s)
    except UserError:
        return minutes, 0.0
    still = np.zeros(len(time_s), bool)
    one = thinned(Series(name, time_s, volts, motion, baseline, 'stage', {}, still))
    there = study([one], [np.ones(len(one), bool)], lambda done: None, only=group)
    none = on_tangents(there, [])
    gains = {effect: max((on_tangents(there, [i], none).log_evidence - none.log_evidence
                          for i, v in enumerate(there.variants) if v.effect == effect),
                         default=0.0) for effect in group}
    ranked = sorted(gains.values())
    apart = ranked[-1] - max(ranked[-2], 0.0) if ranked[-1] > _LEAST_NATS else 0.0
    return minutes, apart / minutes


def _remounted(sensor: Sensor) -> Sensor:
    """Turn the sensor on its stage: the encoder's zero is half a turn away."""
    turned = with_neutral(sensor, ['stage_offset'])
    values = turned.values['stage_offset']
    return replace(turned, values={**turned.values, 'stage_offset': {
        **values, 'beta_rad': np.asarray(values['beta_rad']) + np.pi}})
