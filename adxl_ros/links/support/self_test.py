# SPDX-License-Identifier: Apache-2.0

"""
The self-test of a sensor: how the driver runs and judges it, and a line that emulates it.

The line moves the mass of the sensor electrostatically, so that the output changes by a step. The
samples that it changes are no acceleration: they are withheld.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from math import ceil
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.links.support.base import Samples
from adxl_ros.model.sensor import Sensor
import numpy as np

HOLD_S = 0.5
"""Time after which a board ends the self-test by itself, s. Chosen: four commands in a row may be
lost, and a driver that was killed leaves the sensor so for no longer."""
SETTLING_S = 0.2
"""Time after the end for which a board marks its samples, s. Chosen: 20 time constants of a filter
of 10 ms, for a driver that starts just then and has not seen the end."""
_SETTLED_S = 0.1
"""Time for which the sensor itself settles, s: ST's drivers wait so long."""
_TIME_CONSTANTS = 10.0  # Of the output filter until e^-10 of the step is left
_WINDOW_S = 0.2  # Samples that are averaged, s; chosen: ten periods of 50 Hz
_FEWEST = 8  # Fewest samples that are averaged
_BLOCKS = 4  # Blocks of them whose means show whether the sensor moves
_LONGEST_S = 3.0  # Longest wait, in addition to the time that the samples need, s; chosen
_SHORTEST_RC_S = 1e-9  # Time constant of an output without filter, s
_LONG_AGO_NS = -(2**61)  # Stamp before all others, ns


class SelfTestAnswer(NamedTuple):
    """How a self-test has ended."""

    is_passed: bool
    text: str


class _Batch(NamedTuple):
    """What one read of a link has given."""

    samples: Samples
    sensor: Sensor
    is_on: np.ndarray  # During which samples the self-test is on, as the link marks them, (n,)
    is_settled: np.ndarray  # Whether the output has settled since it began or ended, (n,)
    settling_ns: float  # Time that this takes, ns


Steps = Generator[None, Any, SelfTestAnswer]  # Each step takes a `_Batch`


class SelfTest:
    """Withholds the samples that a self-test changes, and runs one where it is asked for."""

    def __init__(self, hold: Callable[[float], None]) -> None:
        self._hold = hold  # As `Link.hold_self_test`
        self._was_on = False  # Whether the newest sample is marked
        self._changed_ns = _LONG_AGO_NS  # Stamp of the sample at which that changed
        self._steps: Steps | None = None

    def begin(self) -> SelfTestAnswer | None:
        """Begin a test, unless one is running; return why it cannot be, or None."""
        if self._steps is None:
            self._steps = self._run()
            return self._step(None)
        return None

    def take(self, samples: Samples, sensor: Sensor) -> tuple[Samples, SelfTestAnswer | None]:
        """Take the next samples; return those to publish, and how a test has ended, or None."""
        stamps_ns = samples.stamp_ns
        is_on = samples.in_self_test
        if is_on is None:
            if self._steps is None and self._changed_ns == _LONG_AGO_NS:
                return samples, None
            is_on = np.zeros(len(stamps_ns), bool)
        settling_ns = 1e9 * (_SETTLED_S + _TIME_CONSTANTS * sensor.rc_s)
        changes = np.diff(is_on, prepend=self._was_on)
        changed_ns = np.maximum.accumulate(np.where(changes, stamps_ns, self._changed_ns))
        since_ns = stamps_ns - changed_ns
        # The stamps of a clock that was set back say nothing about the line.
        is_settled = (since_ns < 0) | (since_ns >= settling_ns)
        if len(stamps_ns):
            self._was_on = bool(is_on[-1])
            self._changed_ns = int(changed_ns[-1])
        answer = self._step(_Batch(samples, sensor, is_on, is_settled, settling_ns))
        return samples.where(is_settled & ~is_on), answer

    def _step(self, batch: _Batch | None) -> SelfTestAnswer | None:
        if self._steps is None:
            return None
        try:
            self._steps.send(batch)
        except StopIteration as end:
            self._steps = None
            return end.value
        return None

    def _run(self) -> Steps:
        """Average before, during and after the step, so that a steady drift cancels out."""
        try:
            self._hold(0.0)
            before_v, _ = yield from self._means(0.0, 'no sample came')
            on_v, _ = yield from self._means(HOLD_S, 'the self-test did not begin')
            after_v, sensor = yield from self._means(0.0, 'the self-test did not end')
        except UserError as error:
            return SelfTestAnswer(False, str(error))
        return judge(sensor, np.concatenate([before_v, after_v]), on_v)

    def _means(
        self, hold_s: float, obstacle: str
    ) -> Generator[None, Any, tuple[np.ndarray, Sensor]]:
        """Hold the self-test again and again; return the means of blocks that are settled, V."""
        taken: list[np.ndarray] = []
        until_ns = None
        while True:
            batch: _Batch = yield
            self._hold(hold_s)
            rows = batch.is_settled & (batch.is_on == (hold_s > 0))
            taken.append(batch.samples.volts[rows])
            needed = max(ceil(_WINDOW_S * batch.sensor.rate_hz), _FEWEST)
            if sum(map(len, taken)) >= needed:
                blocks = np.array_split(np.concatenate(taken), _BLOCKS)
                return np.array([block.mean(axis=0) for block in blocks]), batch.sensor
            longest_ns = 1e9 * (_LONGEST_S + needed / batch.sensor.rate_hz)
            until_ns = until_ns or batch.samples.until_ns + longest_ns + 3 * batch.settling_ns
            if batch.samples.until_ns > until_ns:
                self._hold(0.0)
                raise UserError(f'no result: {obstacle}')


def judge(sensor: Sensor, off_v: np.ndarray, on_v: np.ndarray) -> SelfTestAnswer:
    """Compare the step between means of blocks, V, (n, m), with the range of the datasheet."""
    scale_v_per_g = sensor.nominal_scale_v_per_g
    steps_g = (on_v.mean(axis=0) - off_v.mean(axis=0)) / scale_v_per_g
    # A sensor that moves or shakes moves the means of blocks, too.
    errors_g = (np.ptp(off_v, axis=0) + np.ptp(on_v, axis=0)) / scale_v_per_g
    is_at_end = np.any(sensor.saturated(np.concatenate([off_v, on_v])), axis=0)
    limits_g = list(zip(sensor.self_test_lower_g, sensor.self_test_upper_g))
    wrong = ''
    unsure = ''
    texts = []
    for i, axis in enumerate(sensor.axes):
        step_g, error_g = steps_g[i], errors_g[i]
        lower_g, upper_g = limits_g[i] if limits_g else (-np.inf, np.inf)
        text = f'{axis} {step_g:+.2f} g'
        if limits_g:
            text += f' ({lower_g:.2f} to {upper_g:.2f})'
        if is_at_end[i]:
            unsure += axis
            text += ' at the end of its range'
        elif step_g + error_g < lower_g or step_g - error_g > upper_g:
            wrong += axis
        elif step_g - error_g < lower_g or step_g + error_g > upper_g:
            unsure += axis
            text += f' uncertain by {error_g:.2f} g'
        texts.append(text)
    measured = ', '.join(texts)
    if (np.abs(steps_g) <= errors_g).all():
        measured += '; no step: is the self-test pin of the sensor connected?'
    if wrong:
        return SelfTestAnswer(False, f'FAIL {", ".join(wrong)}: {measured}')
    if unsure:
        return SelfTestAnswer(
            False, f'NOT SURE {measured}; keep {", ".join(unsure)} level and at rest'
        )
    if not limits_g:
        return SelfTestAnswer(
            False,
            f'NOT COMPARED {measured}; write sensor.self_test_lower_g and '
            'sensor.self_test_upper_g of the datasheet into the parameter file',
        )
    return SelfTestAnswer(True, f'PASS {measured}')


class EmulatedLine:
    """The self-test of a simulated sensor, which ends by itself."""

    def __init__(self, sensor: Sensor) -> None:
        step_g = np.array(sensor.self_test_g)
        if not len(step_g):
            step_g = np.mean([sensor.self_test_lower_g, sensor.self_test_upper_g], axis=0)
        self.has_step = len(step_g) > 0  # Whether the parameters state what it does
        self._step_v = step_g * sensor.scale_v_per_g if self.has_step else np.zeros(1)
        self._rc_s = max(sensor.rc_s, _SHORTEST_RC_S)
        self._on_s = self._off_s = _LONG_AGO_NS * 1e-9

    def hold(self, now_s: float, hold_s: float) -> None:
        """Keep the self-test on from now for a time, s; 0 ends it."""
        if now_s >= self._off_s and hold_s:
            self._on_s = now_s
        self._off_s = now_s + hold_s if hold_s else min(self._off_s, now_s)

    def add(self, time_s: np.ndarray, volts: np.ndarray) -> np.ndarray:
        """Add the step to samples at times, s, in place, (n, m); return which are marked, (n,)."""
        settling_s = max(SETTLING_S, 2 * _TIME_CONSTANTS * self._rc_s)
        if not len(time_s) or time_s[0] >= self._off_s + settling_s:
            return np.zeros(len(time_s), bool)
        on_s = np.clip(time_s, self._on_s, self._off_s) - self._on_s
        off_s = np.maximum(time_s - self._off_s, 0.0)
        level = (1 - np.exp(-on_s / self._rc_s)) * np.exp(-off_s / self._rc_s)
        volts += np.outer(level, self._step_v)
        return (time_s >= self._on_s) & (off_s < settling_s)
