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
From hypotheses to a verdict: probabilities, sets that cannot be told apart, unknown.

Evidence decides between hypotheses that the library holds. Three rules stand before it, because
the library is never quite the truth: an effect must make a visible part of the gap, an effect more
must be worth it, and what a flexible term finds beside the best hypothesis is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.drift_checks import crowding
from adxl_ros.diagnose.gap_closure import Shrunk
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.linear_model import FOLLOWED, STRAIGHT, Study
from adxl_ros.diagnose.model_discrepancy import Discrepancy, UNKNOWN_NATS
from adxl_ros.diagnose.noise_detectors import Sign
from adxl_ros.diagnose.noise_whitening import DRIFTS, drifts_among
from adxl_ros.model.coefficients import neutral
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Effect
import numpy as np

PRIOR = {0: 0.35, 1: 0.40, 2: 0.15, 3: 0.03}
"""Of as many effects; what is left is unknown."""
VISIBLE = 0.03
"""An effect that makes less of the noise than this, rms, is not the gap."""
SHARE = 0.02
"""Nor is one that makes less of the squares of the gap than this."""
DRIFTING = 0.1
"""Nor is a drift beside other effects that makes less of them than this: what is left of a form
that is not quite the sensor's comes and goes like a drift."""
BESIDE_NATS = 25.0
"""Nor is an effect beside a drift that gains less: at its slowest no drift is the model's."""
TAKEN = 0.006
"""Nor is an effect more that takes less off the squares of the gap than this."""
RIVAL = 0.05
"""A rival more probable than this cannot be told apart."""
CERTAIN = 0.5
UNKNOWN_OF_GAP, UNKNOWN_OF_NOISE = 0.3, 0.05
"""What a flexible term must find, by the rms of the gap and of the noise, to be unknown."""
UNKNOWN_LEFT = 0.2
"""What must be left above the floor, by what is explained: less is another form of the same."""
CROWDED_NATS = 30.0
"""Gain of octaves with more or less than their share that shows a walk to be none: no sensor walks
quite as the model."""
LEFT_OF_GAP, LEFT_OF_NOISE = 0.7, 0.5
"""What is left above the floor, by what is explained and by the noise, to be unknown."""
_WANDERS = 2.0
"""In nine of ten recordings a random walk has less than this times its expected mean square."""
UNSEEN = {False: 0.22, True: 0.3}
"""How often an effect more is there that does not show, without and beside one that does. Rounded
down from 17 of 72 and 20 of 62 in working seeds of the blind check, whose mix this presumes: a
quarter without a gap, a fifth pairs, strengths alike by their logarithm from 0.02 of the noise."""
SURE = 0.75
"""How often what is called unknown is outside the library: 13 of 18 there."""
_TEMPER = 0.5
"""Nats count half: samples of a model that is nearly right are not quite independent."""


@dataclass(frozen=True)
class Verdict:
    """
    The answer.

    Attributes
    ----------
    status
        Of interfaces: 'no_gap', 'explained', 'inseparable', 'unknown', 'insufficient'.
    effects, groups
        Named for certain; sets of which one is.
    probability
        Of that answer.
    hypotheses
        Effects and probability, the most probable first; they sum to 1.
    best
        The hypothesis that is taken.
    places
        Where an unknown shows, the strongest first.

    """

    status: str
    effects: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    probability: float
    hypotheses: tuple[tuple[tuple[str, ...], float], ...]
    best: Hypothesis
    places: tuple[str, ...] = ()


def contribution_mps2(of: Study, found: Hypothesis, effect: str) -> float:
    """Return what one effect of a hypothesis makes, rms about its mean, m/s²."""
    if effect in DRIFTS:
        return _wandered_mps2(of, found, effect)
    library = effect_named(effect)
    squares, count = 0.0, 0
    for one, mask in zip(of.series, of.used):
        sensor = replace(found.sensor, rate_hz=one.sensor.rate_hz)
        without = replace(sensor, values={**sensor.values, effect: _baseline(of, effect, library)})
        whole = (one.simulated(sensor) - one.simulated(without))[mask]
        if effect not in STRAIGHT:
            whole = whole - whole.mean(axis=0)
        squares += float(np.sum((whole / one.scale_v_per_mps2) ** 2))
        count += whole.size
    return float(np.sqrt(squares / max(count, 1)))


def _wandered_mps2(of: Study, found: Hypothesis, drift: str) -> float:
    """Return the rms about its mean of a drift over the recordings, m/s²."""
    density = np.sqrt(np.mean(next(iter(found.sensor.values[drift].values())) ** 2))
    return float(np.sqrt(np.mean([_wander_mps2(one, drift, density) ** 2 for one in of.series])))


def _wander_mps2(series: Series, drift: str, density: float) -> float:
    """
    Return the expected rms about its mean of a drift over a recording, m/s².

    Of a random walk w·√(T/6); of 1/f noise its density by the root of ln of T by its highest
    frequency.
    """
    span_s = series.time_s[-1] - series.time_s[0]
    return float(G0_MPS2 * density * (np.sqrt(span_s / 6) if drift == 'bias_walk' else np.sqrt(
        np.log(series.sensor.rate_hz / 2 * span_s))))


def _baseline(of: Study, effect: str, library: Effect) -> dict[str, np.ndarray]:
    sensor = of.series[0].sensor
    return sensor.values[effect] if effect in sensor.effects else neutral(library, sensor.axes)


def worthy(of: Study, found: Sequence[Hypothesis], noise_mps2: float) -> list[Hypothesis]:
    """
    Keep the hypotheses of which each effect makes a visible part of the gap, the likeliest first.

    What an effect more takes off the squares is compared with the same hypothesis without it: no
    form of an effect is quite the sensor's, and what is left of a large one always looks a little
    like some other.
    """
    squares = {frozenset(h.effects): _squares_mps2(of, h) for h in found}
    evidence = {frozenset(h.effects): h.log_evidence for h in found}
    kept = [one for one in found if _each_counts(of, one, squares, evidence, noise_mps2)]
    weight = _weights(of, kept)
    return [kept[i] for i in np.argsort(-weight, kind='stable')]


def _each_counts(of: Study, one: Hypothesis, squares: dict[frozenset[str], float],
                 evidence: dict[frozenset[str], float], noise_mps2: float) -> bool:
    """Tell whether each effect of a hypothesis is worth it, beside those without it."""
    parts = {effect: contribution_mps2(of, one, effect) for effect in one.effects}
    whole = sum(p * p for effect, p in parts.items() if not effect_named(effect).exact)
    here = squares[frozenset(one.effects)]
    closes = min(squares[frozenset()] - here, whole)
    for effect, part in parts.items():
        least = _least_mps2(of, effect, noise_mps2)
        fewer = frozenset(one.effects) - {effect}
        taken = part * part
        if fewer in squares and effect not in (*DRIFTS, *FOLLOWED):
            taken = squares[fewer] - here
        share = DRIFTING if effect in DRIFTS else SHARE
        # Beside nothing there is no form that could be wrong: what it makes need not be left.
        if part < least or part * part < share * whole or (fewer and taken < least ** 2) \
                or taken < TAKEN * closes:
            return False
        if fewer in evidence and effect not in DRIFTS and drifts_among(fewer) \
                and one.log_evidence - evidence[fewer] < BESIDE_NATS:
            return False
    return True


def _least_mps2(of: Study, effect: str, noise_mps2: float) -> float:
    """Return what an effect must make to be seen: no angle is known better than the stage's."""
    if not any(p.unit == 'rad' for p in effect_named(effect).parameters if p.is_size):
        return VISIBLE * noise_mps2
    return max(VISIBLE * noise_mps2, of.least_angle_rad() * G0_MPS2)


def _weights(of: Study, found: Sequence[Hypothesis]) -> np.ndarray:
    """Return log-probabilities of hypotheses but for a constant: evidence, and how many alike."""
    count = len({v.effect for v in of.variants})
    ways = {0: 1, 1: count, 2: count * (count - 1) / 2, 3: count * (count - 1) * (count - 2) / 6}
    return np.array([_TEMPER * h.log_evidence + np.log(PRIOR[len(h.effects)]
                                                       / ways[len(h.effects)]) for h in found])


def _squares_mps2(of: Study, found: Hypothesis) -> float:
    """Return the mean square of what a hypothesis leaves about its mean, (m/s²)²."""
    squares, count = 0.0, 0
    for one, mask in zip(of.series, of.used):
        off = (one.residual(found.sensor) / one.scale_v_per_mps2)[mask]
        squares += float(np.sum((off - off.mean(axis=0)) ** 2))
        count += off.size
    return squares / max(count, 1)


def left(of: Study, best: Hypothesis, far: Shrunk, noise_mps2: float) -> float:
    """
    Return the rms of what is left above the floor and the wandering of a healthy zero-g, m/s².

    Parameters
    ----------
    of
        The recordings.
    best
        The most probable hypothesis, whose noise may wander.
    far
        About its fit.
    noise_mps2
        Rms of the noise that was found, lines, spikes and steps included.

    """
    filters = [tried[walk] for tried, walk in zip(of.filters, best.fit.walks)]
    series = [one for one in of.series for _ in one.sensor.axes]
    wandered = float(np.mean([_wander_mps2(one, f.drift, f.density) ** 2
                              for one, f in zip(series, filters)]))
    floor = max(far.floor_mps2, noise_mps2) ** 2 + _WANDERS * wandered
    return float(np.sqrt(max(far.within_mps2 ** 2 - floor, 0.0)))


def judge(of: Study, found: Sequence[Hypothesis], discrepancy: Discrepancy,
          instead: Discrepancy | None, signs: Sequence[Sign], noise_mps2: float,
          gap_mps2: float, left_mps2: float) -> Verdict:
    """
    Weigh the hypotheses.

    Parameters
    ----------
    of
        The recordings.
    found
        Worthy hypotheses, the likeliest first, none among them.
    discrepancy, instead
        Beside the most probable of them; in place of its drift, None where that is likelier.
    signs
        Noise-like effects that show.
    noise_mps2, gap_mps2
        Rms of the noise, and of what the most probable hypothesis explains, m/s².
    left_mps2
        Rms of what neither it nor noise explains on stretches held out, m/s²; see `left`.

    """
    weight = _weights(of, found)
    share = np.exp(weight - weight[0])
    best = found[0]
    unknown = 0.02
    places: tuple[str, ...] = ()
    drifts = bool(drifts_among(best.effects))
    # Where codes are coarser than the noise, their rounding follows the signal.
    rounded_mps2 = max(float(one.sensor.lsb_v / np.min(one.scale_v_per_mps2)) / 12 ** 0.5
                       for one in of.series)
    if discrepancy.gain > UNKNOWN_NATS \
            and discrepancy.rms_mps2 > max(UNKNOWN_OF_NOISE * noise_mps2,
                                           UNKNOWN_OF_GAP * gap_mps2, rounded_mps2) \
            and (drifts or not best.effects or left_mps2 > UNKNOWN_LEFT * gap_mps2):
        unknown = SURE
        places = _places(discrepancy)
    if instead is not None and instead.gain > UNKNOWN_NATS:
        unknown = SURE
        places = _places(instead)
    if drifts and crowding(of, best) > CROWDED_NATS:
        unknown = SURE
        places = tuple(dict.fromkeys((*places, 'time_s')))
    # Nothing is left of a drift but what it is known by.
    if not drifts and left_mps2 > max(LEFT_OF_NOISE * noise_mps2, LEFT_OF_GAP * gap_mps2,
                                      rounded_mps2):
        unknown = SURE
        places = places or ('frequency',)
    known = share / share.sum() * (1 - unknown)
    loud = tuple(sign.effect for sign in signs if sign.effect != 'unknown')
    if any(sign.effect == 'unknown' for sign in signs):
        unknown = max(unknown, SURE)
        known = known / known.sum() * (1 - unknown)
        places = (*places, 'frequency')
    more = UNSEEN[bool(best.effects or loud)]
    listed = [(tuple(sorted((*h.effects, *loud))), float(p * (1 - more)))
              for h, p in zip(found, known)]
    unseen = float(known.sum()) * more
    if best.effects or loud:
        listed.append((tuple(sorted((*best.effects, *loud, 'unknown'))), unseen))
    else:
        unknown += unseen
    listed.append((('unknown',), float(unknown)))
    listed.sort(key=lambda one: -one[1])
    if unknown > CERTAIN:
        return Verdict('unknown', (), (), float(unknown), tuple(listed), best, places)
    rivals = _rivals(found, known)
    certain = tuple(sorted((*(e for e in best.effects if len(rivals[e]) == 1), *loud)))
    groups = tuple(sorted({tuple(sorted(rivals[e])) for e in best.effects
                           if len(rivals[e]) > 1}))
    inside = {frozenset((*certain, *loud)) | set(choice) for choice in _choices(groups)}
    probability = float(sum(p for effects, p in listed if frozenset(effects) in inside))
    if not best.effects and not loud:
        return Verdict('no_gap', (), (), probability, tuple(listed), best)
    status = 'inseparable' if groups else 'explained'
    return Verdict(status, certain, groups, probability, tuple(listed), best)


def _places(discrepancy: Discrepancy) -> tuple[str, ...]:
    where = discrepancy.where
    return tuple(sorted((k for k, g in where.items() if g > UNKNOWN_NATS),
                        key=lambda k: -where[k]))


def _rivals(found: Sequence[Hypothesis], known: np.ndarray) -> dict[str, set[str]]:
    """Return by effect of the best hypothesis those that could stand in its place."""
    best = found[0]
    out = {effect: {effect} for effect in best.effects}
    for h, p in zip(found[1:], known[1:]):
        if p < RIVAL * known[0] or len(h.effects) != len(best.effects):
            continue
        gone, new = set(best.effects) - set(h.effects), set(h.effects) - set(best.effects)
        for effect in gone:
            out[effect] |= new
    return out


def _choices(groups: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    out: list[tuple[str, ...]] = [()]
    for group in groups:
        out = [(*one, effect) for one in out for effect in group]
    return out
