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

"""The next manoeuvre: which of a menu would separate what this recording could not."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.gap.verdict import Verdict

MENU = {
    'shaker': ('shake along x, 2 to 40 Hz', 'simulate shaker', ('time_offset', 'bandwidth',
               'mount_resonance', 'vibration_rectification')),
    'speeds': ('turn the same plane at two speeds, forth and back', 'simulate rich',
               ('backlash', 'hysteresis', 'lever_arm', 'clock_skew')),
    'planes': ('sweep a second plane alpha', 'simulate sweep',
               ('misalignment', 'cross_axis', 'cross_axis_z', 'scale_factor_z', 'nonlinearity',
                'quadratic', 'stage_eccentricity', 'base_tilt')),
    'remount': ('remount the sensor turned by 180° about z and sweep again', 'simulate sweep',
                ('stage_offset', 'gravity', 'scale_factor', 'bias', 'adc_inl')),
    'heat': ('dwell, heat by 15 °C and cool', 'simulate soak',
             ('temperature_bias', 'temperature_scale', 'warm_up', 'bias_walk', 'flicker')),
    'supply': ('step the supply by 0.2 V at rest', 'simulate soak', ('supply',)),
}
"""What to do, the command for it, and the effects that it shows best."""


@dataclass(frozen=True)
class Next:
    """What to record next, why, and by which command."""

    manoeuvre: str
    why: str
    command: str


def proposed(verdict: Verdict, missing: list[str]) -> Next | None:
    """Propose the manoeuvre that shows most of what is not told apart; None if all is told."""
    if verdict.status == 'no_gap' and not missing:
        return None
    asked = [effect for group in verdict.groups for effect in group] or list(verdict.effects)
    best = max(MENU, key=lambda name: len(set(MENU[name][2]) & set(asked)))
    if verdict.status in ('no_gap', 'insufficient') or not set(MENU[best][2]) & set(asked):
        best = 'speeds' if verdict.status == 'unknown' or not missing else 'planes'
    words, command, _ = MENU[best]
    why = f'to tell {" from ".join(verdict.groups[0])}' if verdict.groups else \
        'what is unknown shows elsewhere, too' if verdict.status == 'unknown' else \
        f'this recording has no {", no ".join(missing)}' if missing else \
        'to confirm it on another recording'
    return Next(words, why, f'ros2 run adxl_ros {command} -o next.csv')
