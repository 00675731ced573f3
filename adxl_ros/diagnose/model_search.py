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
The search: every effect alone, pairs and triples, by evidence on tangents and then in full.

Tangents serve to look at hundreds of hypotheses within a second; the best are fitted by
re-simulation, shapes included, because a delay of 7 ms under a 40 Hz shaker is no longer linear.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations

from adxl_ros.diagnose.drift_checks import unevenness
from adxl_ros.diagnose.evidence import Fit
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, local, refined
from adxl_ros.diagnose.linear_model import on_tangents, STRAIGHT, Study, study, TOLERANCE
from adxl_ros.diagnose.noise_whitening import DRIFTS, drifts_among
from adxl_ros.diagnose.sensitivities import Variant
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import parameter_of, with_neutral
from adxl_ros.model.effects.base import Coefficient
import numpy as np

MOST_EFFECTS = 3
_REFINED, _PAIRED = 8, 8
WORTH = 5.0
"""Nats that a hypothesis must gain on tangents to be fitted in full, and a drift held out."""
_UNEVEN = 1.4


def search(of: Study, show: Callable[[float], None]) -> list[Hypothesis]:
    """
    Look at every effect, at pairs and at triples; the most probable first.

    Pairs are looked for around the best effect, where what it leaves is straight, and among the
    best of all effects, because two can mask each other.

    Parameters
    ----------
    of
        The recordings and their tangents.
    show
        Takes the fraction that is done.

    """
    found: dict[tuple[str, ...], Hypothesis] = {(): refined(of, (), {}, {})}
    none = on_tangents(of, [])
    singles = _ranked(of, [(i,) for i in _told(of)], none)
    _refine(of, singles[:_REFINED], none, found)
    show(0.3)
    # A file of stated figures lacks both, and what lacks both may not look like either.
    line = [i for i in _told(of) if of.variants[i].effect in STRAIGHT]
    _refine(of, _ranked(of, list(combinations(line, 2)), none), none, found)
    best = _best(found)
    if best.effects:
        _forward(of, best, found)
        show(0.6)
        first = [chosen[0] for _, chosen, _ in singles[:_PAIRED]]
        pairs = _ranked(of, list(combinations(sorted(first), 2)), none)
        worth = _best(found).log_evidence - none.log_evidence + WORTH
        _refine(of, [one for one in pairs if one[0] > worth][:_REFINED // 2], none, found)
        best = _best(found)
        if 1 < len(best.effects) < MOST_EFFECTS:
            _forward(of, best, found)
    _less(of, _best(found), found)
    if _drifts(of, _best(found)):
        _wandering(of, found)
    show(1.0)
    return sorted(found.values(), key=lambda h: -h.log_evidence)


def _told(of: Study) -> list[int]:
    """Return numbers of variants that can be told: no zero-g where the pose is not known."""
    rests = any(one.reference == 'rest' for one in of.series)
    return [i for i, v in enumerate(of.variants) if not rests or v.effect not in STRAIGHT]


def _best(found: dict[tuple[str, ...], Hypothesis]) -> Hypothesis:
    return max(found.values(), key=lambda h: h.log_evidence)


def _drifts(of: Study, best: Hypothesis) -> bool:
    """Tell whether what a hypothesis leaves is likelier with a zero-g that wanders."""
    here = local(of, best.effects, best.sensor)
    return here.fit(wanders=DRIFTS).log_evidence - here.fit().log_evidence > WORTH


def _wandering(of: Study, found: dict[tuple[str, ...], Hypothesis]) -> None:
    """
    Let the zero-g wander, alone, beside the best so far, and beside what is best with it.

    Such noise is the same all the time; what shows in some stretches more than in others is not
    that.
    """
    ranked = sorted(found.values(), key=lambda h: -h.log_evidence)
    several = [h for h in ranked if 0 < len(h.effects) < MOST_EFFECTS][:_REFINED // 2]
    for drift in DRIFTS:
        for h in several:
            start = dict(zip(h.names, h.values))
            one = _resimulated(of, (*h.effects, drift), start, {})
            if one is not None:
                found[one.effects] = one
        drifting = on_tangents(of, [], None, (drift,))
        alone = refined(of, (drift,), {}, {})
        found[alone.effects] = alone
        beside = _ranked(of, [(i,) for i in _told(of)], drifting, (drift,))
        _refine(of, beside[:_REFINED // 2], drifting, found, (drift,))
    for h in list(found.values()):
        if drifts_among(h.effects) and unevenness(of, h) > _UNEVEN:
            del found[h.effects]


def around(of: Study, best: Hypothesis) -> Study:
    """
    Return the study about a hypothesis: residuals and tangents at its fit.

    Filter and latency stay where the file has them, so that they are as free as before.
    """
    at_file = with_neutral(of.series[0].sensor, best.sensor.effects).values
    kept = (*best.effects, *STRAIGHT)
    values = {effect: at_file[effect] if effect in TOLERANCE and effect not in kept
              else of_effect for effect, of_effect in best.sensor.values.items()}
    there = [replace(one, sensor=replace(best.sensor, values=values, rate_hz=one.sensor.rate_hz))
             for one in of.series]
    return study(there, of.used, lambda done: None, best.fit.walks)


def _forward(of: Study, best: Hypothesis, found: dict[tuple[str, ...], Hypothesis]) -> None:
    """Add one effect more to a hypothesis: on tangents about it, then in full."""
    there = around(of, best)
    own = [i for i, v in enumerate(there.variants) if v.effect in best.effects]
    wanders = drifts_among(best.effects)
    alone = on_tangents(there, own, None, wanders)
    gains = []
    for i in _told(there):
        if there.variants[i].effect in best.effects:
            continue
        fit = on_tangents(there, [*own, i], alone, wanders)
        gains.append((fit.log_evidence - alone.log_evidence, i, fit))
    base = {v.effect for v in of.variants}
    for gain, i, fit in sorted(gains, key=lambda one: -one[0])[:_REFINED // 2]:
        if gain < WORTH:
            break
        effects = (*best.effects, there.variants[i].effect)
        if not all(e in base or e in DRIFTS for e in effects):
            continue
        start = dict(zip(best.names, best.values))
        start |= {there.names[k]: v for k, v in zip(fit.ids, fit.values)
                  if k in there.ids[i]} | _begin(there.variants[i])
        shape = {Coefficient(there.variants[i].effect, p): v
                 for p, v in there.variants[i].shape.items()}
        one = _resimulated(of, effects, start, shape)
        if one is not None:
            found[one.effects] = one


def _less(of: Study, best: Hypothesis, found: dict[tuple[str, ...], Hypothesis]) -> None:
    """Leave out each effect of a hypothesis: the first that was found may have been a stand-in."""
    start = dict(zip(best.names, best.values))
    known = {frozenset(effects) for effects in found}
    for effect in best.effects:
        fewer = tuple(e for e in best.effects if e != effect)
        if frozenset(fewer) not in known:
            one = _resimulated(of, fewer, start, {})
            if one is not None:
                found[one.effects] = one


def _ranked(of: Study, sets: Sequence[tuple[int, ...]], none: Fit,
            wanders: Sequence[str] = ()) -> list[tuple[float, tuple[int, ...], Fit]]:
    """Fit sets of variants on tangents; the best of each set of effects, the best first."""
    best: dict[frozenset[str], tuple[float, tuple[int, ...], Fit]] = {}
    for chosen in sets:
        key = frozenset(of.variants[i].effect for i in chosen)
        if len(key) < len(chosen):
            continue
        found = on_tangents(of, chosen, none, wanders)
        gain = found.log_evidence - none.log_evidence
        if key not in best or gain > best[key][0]:
            best[key] = (gain, chosen, found)
    return sorted(best.values(), key=lambda one: -one[0])


def _refine(of: Study, ranked: Iterable[tuple[float, tuple[int, ...], Fit]], none: Fit,
            found: dict[tuple[str, ...], Hypothesis], also: tuple[str, ...] = ()) -> None:
    """Fit the best on tangents in full; those that gain less than is worth it are left."""
    for gain, chosen, fit in ranked:
        if gain < WORTH:
            continue
        start = dict(zip([of.names[i] for i in fit.ids], fit.values))
        for i in chosen:
            start |= _begin(of.variants[i])
        shapes = {Coefficient(of.variants[i].effect, p): value for i in chosen
                  for p, value in of.variants[i].shape.items()}
        effects = (*(of.variants[i].effect for i in chosen), *also)
        if effects in found:
            continue
        one = _resimulated(of, effects, start, shapes)
        if one is not None and one.log_evidence > none.log_evidence:
            found[one.effects] = one


def _begin(variant: Variant) -> dict[Coefficient, float]:
    """Return where a limit begins, as departures from what they are held against."""
    return {name: value - (0.0 if parameter_of(name).is_size else parameter_of(name).scale)
            for name, value in variant.begin.items()}


def _resimulated(of: Study, effects: Sequence[str], start: dict[Coefficient, float],
                 shapes: dict[Coefficient, float]) -> Hypothesis | None:
    try:
        return refined(of, effects, start, shapes)
    except (UserError, np.linalg.LinAlgError):
        return None
