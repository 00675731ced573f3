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

"""What a calibration shows of itself: plain figures and words, for a terminal or a topic."""

from __future__ import annotations

from typing import Any

from adxl_ros.calibrate.fits import orientations
from adxl_ros.calibrate.guided import running_estimate
from adxl_ros.calibrate.guided.hand_guide import ENOUGH_RESTS, Tumble
from adxl_ros.calibrate.guided.live_window import Newest
from adxl_ros.calibrate.guided.pose_plan import MOVE_S
from adxl_ros.calibrate.guided.session import Session
from adxl_ros.calibrate.guided.stage_guide import Sweep
from adxl_ros.model.coefficients import get
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import Stillness
import numpy as np


class View:
    """Figures of a session, those that cost something only once a pose."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._key: Any = None
        self._slow: dict[str, Any] = {}
        self._first = session.done

    def figures(self) -> dict[str, Any]:
        """Return what there is to show at present; every value is plain."""
        walk = self._session.walk
        state = walk.state()
        return {'phase': state.phase, 'text': state.text, 'late': state.late,
                'where': walk.where(), **self._live(), **self._pose(), **self._learned()}

    def _live(self) -> dict[str, Any]:
        walk, newest = self._session.walk, self._session.newest
        # By hand the noise is learned: what counts as a rest is for the walk to say.
        still = walk.stillness() if isinstance(walk, Tumble) else newest.stillness()
        return live(newest, self._session.unit, still)

    def _pose(self) -> dict[str, Any]:
        walk = self._session.walk
        if isinstance(walk, Tumble):
            up = walk.up()
            now = '' if up is None else \
                f'{orientations.points_up(orientations.name_nearest(up))} now'
            return {'done': len(walk.accepted), 'total': ENOUGH_RESTS, 'skipped': 0,
                    'number': len(walk.accepted) + 1, 'now': now, 'off': '', 'left_s': None,
                    'dwell': None}
        target, there, off = walk.target, walk.angles, ''
        if target is not None and there is not None:
            off = ', '.join(
                f'{name} {np.degrees(now):.2f}° ({np.degrees(now - wanted):+.2f}°)'
                for name, now, wanted in (('alpha', there[0], target.alpha_rad),
                                          ('beta', there[1], target.beta_rad)))
        left = len(walk.targets) - len(walk.accepted) - len(walk.skipped)
        return {'done': len(walk.accepted), 'total': len(walk.targets),
                'skipped': len(walk.skipped), 'number': walk.index + 1, 'now': '', 'off': off,
                'left_s': left * self._pose_s(walk),
                'dwell': [walk.dwelt_s(), walk.settings.dwell_s]}

    def _pose_s(self, walk: Sweep) -> float:
        """Return the time that a pose takes, by those of this session, s."""
        ends = [e.stop_ns for e in list(walk.accepted.values())[self._first:]]
        if len(ends) < 3:
            return walk.settings.dwell_s + MOVE_S
        return float(np.median(np.abs(np.diff(ends)))) * 1e-9

    def _learned(self) -> dict[str, Any]:
        """Return coverage, coefficients and the tilt to expect; made anew with each pose."""
        walk = self._session.walk
        key = len(walk.accepted), max((e.stop_ns for e in walk.accepted.values()), default=0)
        if key != self._key:
            self._key = key
            self._slow = _of_sweep(walk) if isinstance(walk, Sweep) else _of_tumble(walk)
        return self._slow


def live(newest: Newest, unit: Sensor, still: Stillness | None) -> dict[str, Any]:
    """Return the live reading: mean and noise, m/s², the rate, and the rest detector."""
    if not len(newest.volts):
        return {'live': None}
    rest = None
    if still is not None:
        scale = G0_MPS2 / float(unit.nominal_scale_v_per_g[still.axis])
        rest = {'still': still.still, 'axis': unit.axes[still.axis], 'figure': still.statistic,
                'value': still.value * scale, 'limit': still.limit * scale}
    return {'live': [[axis, mean, rms] for axis, mean, rms in zip(
        unit.axes, newest.mean_mps2(), newest.rms_mps2())], 'rate_hz': newest.rate_hz(),
        'rest': rest}


def _of_sweep(walk: Sweep) -> dict[str, Any]:
    told = walk.known
    left = [t for i, t in enumerate(walk.targets)
            if i not in walk.accepted and i not in walk.skipped and not t.check]
    return {'coverage': _planes(walk),
            'coefficients': running_estimate.by_term(told.names, get(told.unit, told.names),
                                                     told.std, told.prior),
            'tilt_deg': _degrees(walk.tilt_error_rad()),
            'tilt_end_deg': _degrees(told.after(left).tilt_error_rad())}


def _degrees(angle_rad: float) -> float | None:
    return float(np.degrees(angle_rad)) if np.isfinite(angle_rad) else None


def _of_tumble(walk: Tumble) -> dict[str, Any]:
    sides = np.count_nonzero(orientations.CANDIDATES, axis=1)
    rows = [[name, int(walk.covered[sides == n].sum()), int((sides == n).sum())]
            for n, name in ((1, 'faces up'), (2, 'edges up'), (3, 'corners up'))]
    faces = ' '.join(orientations.name_up(int(i))
                     for i in np.flatnonzero(walk.covered & (sides == 1)))
    return {'coverage': rows, 'covered': faces,
            'coefficients': running_estimate.by_term(walk.names, walk.values, walk.std,
                                                     walk.prior),
            'tilt_deg': _degrees(walk.tilt_error_rad()), 'tilt_end_deg': None}


def _planes(walk: Sweep) -> list[list[Any]]:
    """Count the poses taken and planned by plane, by direction of travel, and of the checks."""
    rows: dict[str, list[int]] = {}
    before = None
    for i, target in enumerate(walk.targets):
        names = ['check poses'] if target.check else [f'{np.degrees(target.alpha_rad):.0f}°']
        if not target.check and before is not None and target.beta_rad != before.beta_rad:
            names.append('beta forth' if target.beta_rad > before.beta_rad else 'beta back')
        for name in names:
            row = rows.setdefault(name, [0, 0])
            row[0] += i in walk.accepted
            row[1] += 1
        before = target
    order = sorted(rows, key=lambda name: (name.startswith('check'), name.startswith('beta')))
    return [[name, *rows[name]] for name in order]
