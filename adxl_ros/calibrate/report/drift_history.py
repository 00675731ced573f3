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

"""How a unit has drifted from one calibration to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from adxl_ros.files import calibration_store
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

_FIGURES = (('zero-g', Coefficient('bias', 'offset_v'), 'mg'),
            ('scale factor', Coefficient('scale_factor', 'offset_v_per_g'), 'permille'))
_TEMPERATURE = Coefficient('temperature_bias', 'per_k')


@dataclass(frozen=True)
class Past:
    """
    Calibrations of one unit, oldest first, the newest last.

    Attributes
    ----------
    sensors
        All of them but for those of the newest's own data; empty where it is the only one.

    """

    sensors: tuple[Sensor, ...]

    @staticmethod
    def of(newest: Sensor, stored: Sequence[Sensor]) -> Past:
        """Put the newest after those of the store that are of other data and of its axes."""
        own = newest.provenance.get('data_sha256')
        seen: dict[str, Sensor] = {}
        for sensor in stored:
            # A fit anew to the same data is no drift: the last one stands for all.
            if sensor.axes == newest.axes and (
                    own is None or sensor.provenance.get('data_sha256') != own):
                seen[sensor.provenance.get('data_sha256')
                     or calibration_store.calibration_id(sensor)] = sensor
        return Past((*seen.values(), newest) if seen else ())

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows: figures of each calibration and their change to the next."""
        axes = self.sensors[-1].axes
        head = ['date', 'id', 'model', 'temperature, °C', *(
            f'{name} {axis}' for name, _, _ in _FIGURES for axis in axes)]
        rows = []
        for before, now in zip((None, *self.sensors), self.sensors):
            cells = []
            for _, key, unit in _FIGURES:
                for d in range(len(axes)):
                    value = _absolute(now, key)[d]
                    change = '' if before is None else \
                        f' ({_change(before, now, key)[0][d]:+.2f} {unit})'
                    cells.append(f'{value:.5f}{change}')
            rows.append([now.provenance.get('date', '')[:16].replace('T', ' '),
                         calibration_store.calibration_id(now), now.model,
                         now.provenance.get('temperature_c', '-'), *cells])
        return head, rows

    def words(self) -> list[str]:
        """Say what has changed since the last calibration beyond both intervals."""
        before, now = self.sensors[-2:]
        found = []
        for name, key, unit in _FIGURES:
            change, std = _change(before, now, key)
            for axis, by, s in zip(now.axes, change, std):
                if abs(by) > Z_90 * s:
                    found.append(f'{name} of {axis} by {by:+.2f} +- {Z_90 * s:.2f} {unit}')
        days = _days(before, now)
        identity = calibration_store.calibration_id(before)
        since = f'In {days:.1f} days since {identity}' if days is not None else \
            f'Since {identity}'
        lines = [f'{since}: {"; ".join(found)}.' if found else
                 f'{since} nothing has changed beyond the 90 % intervals.']
        warmed = _temperature(now) - _temperature(before)
        if abs(warmed) > 1 and found:
            slope, _ = now.datasheet.get(_TEMPERATURE, (1e-4, 0.0))
            lines.append(f"It was {warmed:+.1f} °C warmer: by the datasheet's typical slope "
                         f'{1e3 * slope * abs(warmed):.2f} mg of zero-g come of that.')
        return lines

    def series(self) -> tuple[Any, ...]:
        """Return what `plots.drift` takes."""
        newest = self.sensors[-1]
        dates = [s.provenance.get('date', f'no. {i}')[:16].replace('T', ' ')
                 for i, s in enumerate(self.sensors, 1)]
        columns = [np.array([_change(newest, s, key)[0] for s in self.sensors])
                   for _, key, _ in _FIGURES]
        spreads = [np.array([_std(s, key) for s in self.sensors]) for _, key, _ in _FIGURES]
        return (dates, newest.axes, *columns, *spreads)


def _absolute(sensor: Sensor, key: Coefficient) -> np.ndarray:
    return sensor.zero_g_v if key.effect == 'bias' else sensor.scale_v_per_g


def _change(before: Sensor, now: Sensor, key: Coefficient) -> tuple[np.ndarray, np.ndarray]:
    """Return the change of a figure and its standard deviation, mg or permille, (m,)."""
    by = (_absolute(now, key) - _absolute(before, key)) / now.scale_v_per_g * 1e3
    return by, np.hypot(_std(before, key), _std(now, key))


def _std(sensor: Sensor, key: Coefficient) -> np.ndarray:
    std = dict(zip(sensor.covariance_names, np.sqrt(np.diag(sensor.covariance))))
    return np.array([std.get(replace(key, axis=axis), 0.0) for axis in sensor.axes]) \
        / sensor.scale_v_per_g * 1e3


def _temperature(sensor: Sensor) -> float:
    try:
        return float(sensor.provenance.get('temperature_c', 'nan'))
    except ValueError:
        return float('nan')


def _days(before: Sensor, now: Sensor) -> float | None:
    then, when = calibration_store.date_of(before), calibration_store.date_of(now)
    return None if then is None or when is None else (when - then).total_seconds() / 86400
