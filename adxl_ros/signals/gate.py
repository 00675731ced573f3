# SPDX-License-Identifier: Apache-2.0

"""
A gate for logs: what became worse from one recording to another, and which limits are missed.

Something counts as worse if the interval of its change excludes no change. Intervals have such a
level that all of them together call chance worse in one of a hundred comparisons.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import recorded_nominal, Recording
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import mg
from adxl_ros.signals.recorded_sensor import load_sensor
from adxl_ros.signals.rest_detection import rests_of
from adxl_ros.wording import option
import numpy as np
import scipy

if TYPE_CHECKING:
    from adxl_ros.signals.findings import Findings
    from adxl_ros.signals.recording_contents import RecordingContents

KINDS = ('sound', 'gaps', 'rate', 'noise', 'zero-g', 'rests')
"""What may fail: whether a recording is sound, and what is compared with an earlier one."""
_CHANCE = 0.01  # Probability that chance alone is called worse in a comparison of two recordings
_INTERVALS = 7  # Intervals that share it: gaps, noise of three axes, zero-g, rests, and rate
_FEWEST_PARTS = 10  # Parts of the rests whose scatter is known within a quarter
_FEWEST_POSES = 3  # Orientations that show a change of the zero-g. Chosen: one for each axis
_SAME_RATE = 0.99  # Ratio of two rates of one setting: oscillators of sensors differ by 1 %
MINIMA = ('samples', 'span_s', 'rate_hz', 'rest_share', 'longest_rest_s', 'rests', 'poses')
"""Numbers of a recording that may have a minimum, as the JSON of a check names them."""
_MINIMUM = 'min '  # Begin of the name of an outcome that is a limit


@dataclass(frozen=True)
class Outcome:
    """One comparison, or one limit."""

    name: str  # sound, gaps, rate, noise, zero-g, rests, or 'min' with what has a minimum
    is_worse: bool  # Whether it became worse, or the limit is missed
    text: str  # Figures, for people
    # Low and high end of the interval of the ratio to the other recording, or of the change, in
    # `unit`; None where nothing was compared
    interval: tuple[float, float] | None = None
    unit: str = ''  # Unit of the interval: m/s^2 for the zero-g; '' for a ratio

    def fails(self, fail_on: Collection[str]) -> bool:
        """Return whether it is one of the kinds that fail, or a limit, and worse."""
        return self.is_worse and (self.name in fail_on or self.name.startswith(_MINIMUM))


def require_kinds(fail_on: Collection[str]) -> None:
    """Refuse names that are no kinds of outcomes."""
    for name in fail_on:
        if name not in KINDS:
            raise UserError(f'{option(fail_on=name)}: expected some of {", ".join(KINDS)}')


def outcomes_of(
    found: Findings,
    minima: Mapping[str, float],
    earlier: Earlier | None,
    read: Callable[[], Recording],
) -> tuple[Outcome, ...]:
    """
    Return whether a recording is sound, what became worse, and its limits.

    read: reads the recording, which is only needed for an earlier one.
    """
    sound = Outcome('sound', not found.is_sound, 'sound' if found.is_sound else found.faults[0])
    if found.contents is None:
        return (sound,)
    compared = earlier.compare(found.contents, read()) if earlier is not None else []
    return (sound, *compared, *limits(found.contents, minima))


@dataclass(frozen=True)
class _AtRest:
    """A recording at rest."""

    log_std: np.ndarray  # Logarithm of the deviation of a sample by part and axis, (k, m)
    departure_mps2: np.ndarray  # Length of each rest less gravity, m/s², (k,); none without z


def limits(contents: RecordingContents, minima: Mapping[str, float]) -> list[Outcome]:
    """Compare numbers of a recording with their minima."""
    outcomes = []
    for name, smallest in minima.items():
        value = float(getattr(contents, name))
        text = f'{value:.4g}, expected {smallest:.4g} at least'
        outcomes.append(Outcome(f'{_MINIMUM}{name}', value < smallest, text))
    return outcomes


class Earlier:
    """
    An earlier recording of the same task, with which others are compared.

    Parameters
    ----------
    found
        What a check found of it.
    read
        Its samples.
    sensor
        The sensor, or the path of its parameter file; None for the nominal one.

    Raises
    ------
    UserError
        It cannot be read.

    """

    def __init__(
        self,
        found: Findings,
        read: Recording,
        sensor: Sensor | str | None = None,
    ) -> None:
        if found.contents is None:
            raise UserError(f'{found.path}: {found.faults[0]}')
        self._contents = found.contents
        self._sensor = sensor
        self._at_rest = _at_rest(read, sensor)

    def compare(self, contents: RecordingContents, read: Recording) -> list[Outcome]:
        """Return one outcome of another recording for each of `KINDS` but the first."""
        now = _at_rest(read, self._sensor)
        return [
            _events('gaps', contents, self._contents),
            _rate(contents, self._contents),
            _noise(now, self._at_rest),
            _zero_g(now, self._at_rest),
            _events('rests', contents, self._contents),
        ]


def _events(name: str, new: RecordingContents, old: RecordingContents) -> Outcome:
    """Compare how often something happens, as events of chance; fewer rests are worse."""
    counts = [int(getattr(each, name)) for each in (new, old)]
    text = ', before '.join(
        f'{count} in {each.span_s:.4g} s' for count, each in zip(counts, (new, old))
    )
    if not sum(counts):
        return Outcome(name, False, text)
    # Of all events, the share of the new recording is binomial (Clopper and Pearson 1934).
    share = scipy.stats.binomtest(counts[0], sum(counts)).proportion_ci(1 - _CHANCE / _INTERVALS)

    def rates(value: float) -> float:
        """Return the ratio of the rates for a share."""
        return old.span_s / new.span_s * value / (1 - value) if value < 1 else np.inf

    low = rates(share.low)
    high = rates(share.high)
    is_worse = high < 1 if name == 'rests' else low > 1
    return Outcome(name, is_worse, f'{text}: {_ratio(low, high)}', (low, high))


def _rate(new: RecordingContents, old: RecordingContents) -> Outcome:
    """Compare the sample rates, which the jitter of the stamps makes uncertain."""
    ratio = new.rate_hz / old.rate_hz
    # The first and the last stamp of each recording scatter by its jitter.
    std = float(np.hypot(*(np.sqrt(2) * each.jitter_s / each.span_s for each in (new, old))))
    width = -float(scipy.stats.norm.ppf(_CHANCE / _INTERVALS / 2)) * std
    text = f'{new.rate_hz:.5g} Hz, before {old.rate_hz:.5g} Hz'
    interval = ratio * (1 - width), ratio * (1 + width)
    return Outcome('rate', interval[1] < _SAME_RATE, text, interval)


def _noise(new: _AtRest, old: _AtRest) -> Outcome:
    """Compare the deviation of a sample; the axis that became worst counts."""
    axes = min(new.log_std.shape[1], old.log_std.shape[1])
    if min(len(new.log_std), len(old.log_std)) < _FEWEST_PARTS or not axes:
        return Outcome('noise', False, 'not compared: too little rests in one of both')
    found = []
    for axis in range(axes):
        low, high = np.exp(_change(new.log_std[:, axis], old.log_std[:, axis]))
        found.append((float(low), float(high), AXES[axis]))
    low, high, axis_name = max(found)
    return Outcome('noise', low > 1, f'{axis_name}: {_ratio(low, high)}', (low, high))


def _zero_g(new: _AtRest, old: _AtRest) -> Outcome:
    """Compare by how much the length of rests departs from gravity."""
    if min(len(new.departure_mps2), len(old.departure_mps2)) < _FEWEST_POSES:
        return Outcome(
            'zero-g', False, f'not compared: needs three axes and {_FEWEST_POSES} rests in both'
        )
    now_mps2 = np.abs(new.departure_mps2)
    before_mps2 = np.abs(old.departure_mps2)
    low, high = _change(now_mps2, before_mps2)
    text = (
        f'length of gravity off by {mg(now_mps2.mean()):.3g} mg, before '
        f'{mg(before_mps2.mean()):.3g} mg: change '
        f'{mg(low):.3g} to {mg(high):.3g} mg'
    )
    return Outcome('zero-g', low > 0, text, (low, high), 'm/s^2')


def _change(new: np.ndarray, old: np.ndarray) -> tuple[float, float]:
    """Return the interval of the difference of two means (Welch 1947)."""
    interval = scipy.stats.ttest_ind(new, old, equal_var=False).confidence_interval(
        1 - _CHANCE / _INTERVALS
    )
    return float(interval.low), float(interval.high)


def _ratio(low: float, high: float) -> str:
    return f'{low:.3g} to {high:.3g} times'


def _at_rest(read: Recording, sensor: Sensor | str | None) -> _AtRest:
    """Return noise and lengths over the rests of a recording."""
    unit = recorded_nominal(load_sensor(sensor, read), read)
    accel_mps2 = read.accel_mps2(unit)
    rests = rests_of(unit, read)
    samples = [accel_mps2[each.rest.includes(read.time_s)] for each in rests]
    count = -(-_FEWEST_PARTS // max(len(samples), 1))
    parts = []
    for each in samples:
        parts += [part for part in np.array_split(each, count) if len(part) > 1]
    std = np.reshape([part.std(axis=0) for part in parts], (len(parts), len(read.axes)))
    lengths = [float(np.linalg.norm(each.mean(axis=0))) for each in samples]
    has_length = len(read.axes) == len(AXES)
    return _AtRest(
        np.log(np.maximum(std, np.finfo(float).tiny)),
        np.array(lengths if has_length else []) - unit.local_gravity_mps2,
    )


def write_junit(
    path: str | os.PathLike,
    results: Sequence[tuple[Findings, Sequence[Outcome]]],
    fail_on: Collection[str],
) -> None:
    """
    Write the outcomes as a report of JUnit: a suite for each recording, a case for each outcome.

    fail_on: kinds that fail; a case of another one is skipped where it is worse.
    """
    root = ElementTree.Element('testsuites', name='adxl_ros check')
    for findings, outcomes in results:
        suite = ElementTree.SubElement(root, 'testsuite', name=Path(findings.path).name)
        failures = 0
        for outcome in outcomes:
            case = ElementTree.SubElement(
                suite, 'testcase', name=outcome.name, classname=findings.path
            )
            if outcome.is_worse:
                is_failure = outcome.fails(fail_on)
                failures += is_failure
                kind = 'failure' if is_failure else 'skipped'
                ElementTree.SubElement(case, kind, message=outcome.text)
        suite.set('tests', str(len(outcomes)))
        suite.set('failures', str(failures))
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding='unicode', xml_declaration=True)
    write_text(path, text + '\n')
