# SPDX-License-Identifier: Apache-2.0

"""
The rests of a sensor at work: the stream is searched in windows, and neighbours are one stay.

Only rests by the stated noise of the sensor count, so that none is taken while something vibrates.
A long stay gives a rest every five minutes, or when its temperature has changed.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace

from adxl_ros.files.sweep_journal import NaturalRest
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import RestFinder
from adxl_ros.signals.rest_limits import datasheet_noise
from adxl_ros.signals.rest_search import Rest, RestRule
import numpy as np

_WINDOW_NS = 30 * 10**9
"""Length of a window, ns; chosen: it bounds what a kill loses, and temperature hardly changes."""
_SHORTEST_S = 5.0
"""Shortest rest that counts, s; chosen: the noise of its mean is far below its scatter."""
_EDGE_S = 1.0
"""Distance from the edge of a window within which a rest goes on in the next one, s; chosen: the
search cuts what settles, some time constants of the filter, from each end."""
_SAME_G = 1e-3
"""Largest change of a mean from one window to the next within a stay, g; chosen: creep and
temperature change it by less in half a minute."""
_THINNED_NS = 300 * 10**9
"""Time between two rests of one stay, ns; chosen: their errors are independent by then."""
_THINNED_K = 1.0  # Change of the temperature that gives a rest earlier, K
_STALE_NS = 60 * 10**9  # Age from which a temperature is unknown, ns; as in the compensation


class RestStream:
    """Finds the rests of a stream."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._stamps_ns: list[np.ndarray] = []
        self._volts: list[np.ndarray] = []
        self._begin_ns = 0
        self._temperatures: deque[tuple[int, float]] = deque()
        self._last: NaturalRest | None = None  # The last rest that was found
        self._goes_on = False  # Whether it reached the end of its window
        self._given: NaturalRest | None = None  # The last rest that was given
        self._stay = 0
        self.counts: Counter[str] = Counter(rests=0, without_temperature=0)

    def go_on_after(self, stay: int) -> None:
        """Give the stays that follow numbers after those of a journal."""
        self._stay = stay

    def add_temperature(self, stamps_ns: np.ndarray, celsius: np.ndarray) -> None:
        """Add readings of the temperature, °C, before samples of their time."""
        finite = np.isfinite(celsius)
        self._temperatures.extend(zip(stamps_ns[finite].tolist(), celsius[finite].tolist()))

    def add(self, stamps_ns: np.ndarray, volts: np.ndarray) -> Iterator[NaturalRest]:
        """Add samples, (n,) and (n, m), in order; yield the rests of windows that are full."""
        while len(stamps_ns):
            is_gap = bool(self._stamps_ns) and not (
                0 <= stamps_ns[0] - self._stamps_ns[-1][-1] < _WINDOW_NS
            )
            if is_gap:
                yield from self.finish()
            self._begin_ns = self._begin_ns if self._stamps_ns else int(stamps_ns[0])
            count = int(np.searchsorted(stamps_ns, self._begin_ns + _WINDOW_NS))
            if count:
                self._stamps_ns.append(stamps_ns[:count])
                self._volts.append(volts[:count])
            stamps_ns, volts = stamps_ns[count:], volts[count:]
            if len(stamps_ns):
                yield from self._cut()

    def finish(self) -> Iterator[NaturalRest]:
        """Yield the rests of the last window, and end the stay."""
        if self._stamps_ns:
            yield from self._cut()
        self._goes_on = False

    def _cut(self) -> Iterator[NaturalRest]:
        """Search a window."""
        stamps_ns, volts = np.concatenate(self._stamps_ns), np.concatenate(self._volts)
        self._stamps_ns = []
        self._volts = []
        time_s = (stamps_ns - stamps_ns[0]) * 1e-9
        finite = np.isfinite(volts).all(axis=1)
        increases = np.diff(time_s, prepend=-1.0) > 0
        used = finite & increases
        if used.sum() < 2:
            self._goes_on = False
            return
        rule = RestRule(datasheet_noise(self._sensor), learns=False)
        finder = RestFinder(self._sensor.rate_hz, volts.shape[1], rule)
        finder.feed(time_s[used], volts[used])
        goes_on = False
        for rest, mean_v, std_v in finder.means(finder.rests()):
            found = self._natural(rest, mean_v, std_v, int(stamps_ns[0]))
            is_first = rest.time_start_s < _EDGE_S
            if not (is_first and self._goes_on and self._is_same(found)):
                self._stay += 1
            found = replace(found, stay=self._stay)
            self._last = found
            self._goes_on = False
            goes_on = rest.time_stop_s > time_s[-1] - _EDGE_S
            if rest.span_s >= _SHORTEST_S:
                yield from self._thinned(found)
        self._goes_on = goes_on

    def _natural(
        self, rest: Rest, mean_v: np.ndarray, std_v: np.ndarray, begin_ns: int
    ) -> NaturalRest:
        start_ns = begin_ns + round(rest.time_start_s * 1e9)
        stop_ns = begin_ns + round(rest.time_stop_s * 1e9)
        return NaturalRest(
            stay=0,
            start_ns=start_ns,
            stop_ns=stop_ns,
            mean_v=tuple(mean_v.tolist()),
            std_v=tuple(std_v.tolist()),
            temperature_c=self._temperature_c(start_ns, stop_ns),
        )

    def _temperature_c(self, start_ns: int, stop_ns: int) -> float:
        """Return the mean temperature of a rest, or the newest before; NaN where it is unknown."""
        while len(self._temperatures) > 1 and self._temperatures[1][0] <= start_ns:
            self._temperatures.popleft()
        known = [
            celsius
            for stamp_ns, celsius in self._temperatures
            if start_ns - _STALE_NS <= stamp_ns <= stop_ns
        ]
        return float(np.mean(known)) if known else np.nan

    def _is_same(self, found: NaturalRest) -> bool:
        """Return whether a rest goes on from the window before."""
        assert self._last is not None
        change_v = np.abs(np.subtract(found.mean_v, self._last.mean_v))
        return bool((change_v < _SAME_G * self._sensor.scale_v_per_g).all())

    def _thinned(self, found: NaturalRest) -> Iterator[NaturalRest]:
        """Yield a rest if it is the first of its stay, or tells something new."""
        if np.isnan(found.temperature_c):
            self.counts['without_temperature'] += 1
            return
        given = self._given
        if (
            given is not None
            and given.stay == found.stay
            and found.start_ns - given.start_ns < _THINNED_NS
            and abs(found.temperature_c - given.temperature_c) < _THINNED_K
        ):
            return
        self._given = found
        self.counts['rests'] += 1
        yield found
