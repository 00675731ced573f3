# SPDX-License-Identifier: Apache-2.0

"""From a session to the contents of the calibration screen."""

from __future__ import annotations

import math

from adxl_ros.calibrate.guided.live_window import NewestSamples
from adxl_ros.calibrate.guided.screen_contents import (
    AxisReading,
    Estimate,
    LiveReading,
    Progress,
    RestReading,
)
from adxl_ros.calibrate.guided.session import Session
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import Stillness


class SessionDisplay:
    """The displayed values of one session; the slow estimate is computed once for each pose."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._estimate: Estimate | None = None
        self._estimate_key = (0, 0)

    def live(self) -> LiveReading | None:
        """Return what the sensor reads at present; None without samples."""
        newest = self._session.newest
        return live_reading(newest, self._session.unit, self._session.guide.stillness(newest))

    def progress(self) -> Progress:
        """Return the progress of the calibration."""
        return self._session.guide.progress()

    def estimate(self) -> Estimate:
        """Return what the poses determine so far."""
        guide = self._session.guide
        newest_ns = max((record.stop_ns for record in guide.accepted.values()), default=0)
        # A pose that is taken again changes the stamp only.
        key = len(guide.accepted), newest_ns
        if self._estimate is None or key != self._estimate_key:
            self._estimate, self._estimate_key = guide.estimate_contents(), key
        return self._estimate


def live_reading(newest: NewestSamples, unit: Sensor, stillness: Stillness | None
                 ) -> LiveReading | None:
    """Return what the sensor reads at present."""
    if not len(newest.volts):
        return None
    axes = tuple(AxisReading(axis, mean_mps2, rms_mps2) for axis, mean_mps2, rms_mps2 in zip(
        unit.axes, newest.mean_mps2(), newest.rms_mps2()))
    rest = None if stillness is None else _rest(stillness, unit)
    rate_hz = newest.rate_hz()
    return LiveReading(axes, rate_hz if math.isfinite(rate_hz) else None, rest)


def _rest(stillness: Stillness, unit: Sensor) -> RestReading:
    mps2_per_v = G0_MPS2 / float(unit.nominal_scale_v_per_g[stillness.axis])
    return RestReading(bool(stillness.at_rest), unit.axes[stillness.axis], stillness.statistic,
                       float(stillness.value) * mps2_per_v, float(stillness.limit) * mps2_per_v)
