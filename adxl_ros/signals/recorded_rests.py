# SPDX-License-Identifier: Apache-2.0

"""The rests of a recording, as all tools find them."""

from __future__ import annotations

from dataclasses import replace

from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model.constants import SAME_ANGLE_RAD
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import RestFinder, RestMean
from adxl_ros.signals.rest_limits import datasheet_noise
from adxl_ros.signals.rest_search import Rest, RestRule
import numpy as np

_PART_S = 3600.0  # Time after which old blocks are forgotten, s; it bounds the memory
_ANGLES = (JOINTS['alpha'], JOINTS['beta'])  # Columns of the encoder angles


def recording_finder(sensor: Sensor, has_angles: bool) -> RestFinder:
    """Return the finder of rests in a recording that all tools use."""
    is_unknown = 'noise_density_g_per_rthz' in sensor.unstated
    rule = RestRule(
        noise=None if is_unknown else datasheet_noise(sensor),
        angle_tolerance_rad=(
            max(sensor.stage_resolution_rad, SAME_ANGLE_RAD) if has_angles else None
        ),
        gravity=sensor.nominal_scale_v_per_g,
    )
    return RestFinder(sensor.rate_hz, len(sensor.axes), rule)


class RecordedRests:
    """Finds the rests of a recording of any length; the memory is that of an hour."""

    def __init__(self, sensor: Sensor, first: Recording) -> None:
        self._sensor = replace(sensor, rate_hz=first.rate_hz)
        self._has_angles = set(_ANGLES) <= set(first.columns)
        self._finder = recording_finder(self._sensor, self._has_angles)
        self._taken_s = float(first.time_s[0])
        self.detected: list[RestMean] = []  # Rests of all blocks up to the last `take`

    def feed(self, block: Recording) -> None:
        """Add a block of the recording."""
        angles_rad = (
            np.column_stack([block.columns[name] for name in _ANGLES])
            if self._has_angles
            else None
        )
        self._finder.feed(block.time_s, block.volts(self._sensor), angles_rad)
        if block.time_s[-1] - self._taken_s > _PART_S:
            self.take()
            self._finder.forget()
            self._taken_s = float(block.time_s[-1])

    def by_own_noise(self) -> list[RestMean]:
        """Return the rests of the newest hour by the noise that the samples show alone."""
        finder = self._finder.by_own_noise()
        return finder.means(finder.rests())

    def take(self) -> None:
        """Add the newest rests to `detected`; what was found twice is one rest."""
        for found in self._finder.means(self._finder.rests()):
            newest = self.detected[-1] if self.detected else None
            if newest is None or found.rest.time_start_s > newest.rest.time_stop_s:
                self.detected.append(found)
            else:
                self.detected[-1] = newest._replace(rest=_joined(newest.rest, found.rest))


def _joined(earlier: Rest, later: Rest) -> Rest:
    """Return one rest of two that overlap."""
    disturbed_s = [span for span in later.disturbed_s if span[0] >= earlier.time_stop_s]
    return replace(
        earlier,
        stop=later.stop,
        time_stop_s=later.time_stop_s,
        disturbed_s=(*earlier.disturbed_s, *disturbed_s),
    )


def rests_of(sensor: Sensor, read: Recording) -> list[RestMean]:
    """Return the rests of a whole recording."""
    rests = RecordedRests(sensor, read)
    rests.feed(read)
    rests.take()
    return rests.detected
