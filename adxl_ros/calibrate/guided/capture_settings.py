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

"""How poses are taken, and what a calibration waits for."""

from __future__ import annotations

from dataclasses import dataclass

STAGE_MODES = ('commanded', 'encoder', 'manual')


@dataclass(frozen=True)
class Settings:
    """
    How poses are taken; times are sensor time.

    Attributes
    ----------
    dwell_s, timeout_s
        Time at rest a pose, and after which a pose is said to be late.
    tolerance_rad, near_rad
        Arrived within: a stage that moves itself, one that is turned by hand.
    stage_mode
        One of `STAGE_MODES`.
    temperature_span_c
        How far the temperature may be from that of the first pose.

    """

    dwell_s: float
    tolerance_rad: float
    timeout_s: float
    stage_mode: str
    near_rad: float = 0.035
    temperature_span_c: float = 3.0


@dataclass(frozen=True)
class State:
    """
    What a calibration waits for.

    Attributes
    ----------
    phase
        'operator', 'stage', 'rest', 'dwell', 'refused' or 'done'.
    text
        The same for people, with figures.
    late
        Whether it has waited longer than the time-out, or refuses what it gets.

    """

    phase: str
    text: str
    late: bool
