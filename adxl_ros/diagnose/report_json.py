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

"""The diagnosis as `report.json`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from adxl_ros.diagnose.decision import Verdict, WeightedHypothesis
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.next_experiment import NextExperiment
from adxl_ros.diagnose.report_wording import concern, summary
from adxl_ros.diagnose.residual_map import ResidualCell, SIGNIFICANT_P
from adxl_ros.model.coefficients import fitted_of, get, parameter_of
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Coefficient
import numpy as np

_DIGITS = 6
"""Significant digits of the report. Chosen: more than any of its numbers has."""
_MOST_CELLS = 40
"""Largest number of cells in the report. Chosen: cells of small share say little."""
_WITHOUT_GAP = ('no_gap', 'insufficient')
"""Verdicts in which there is no gap to close."""
PROBABLE = 0.05
"""Smallest probability of what terminal and page show first. Chosen: that of a rival."""


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the report as the objects of JSON; docs/interfaces.md lists its keys."""
    fault = diagnosis.data_fault
    if fault is not None:
        return {'schema': 1, 'verdict': {
            'status': fault.status, 'effects': [], 'groups': [],
            'of': None, 'data_fault': fault.name if fault.status == 'bad_data' else None,
            'probability': 1.0}, 'hypotheses': [], 'gap': None, 'where': [], 'candidates': [],
            'notes': notes(diagnosis), 'next_experiment': None, 'summary': fault.message}
    assert diagnosis.verdict is not None
    verdict = diagnosis.verdict
    return {
        'schema': 1,
        'verdict': {'status': verdict.status, 'effects': list(verdict.effects),
                    'groups': [list(group) for group in verdict.groups],
                    'of': concern(verdict), 'data_fault': None,
                    'probability': _rounded(verdict.probability)},
        'hypotheses': [{'effects': list(h.effects), 'probability': h.probability}
                       for h in _summing_to_one(verdict.hypotheses)],
        'gap': _gap(diagnosis),
        'where': [_cell(c) for c in diagnosis.residual_cells if c.p < SIGNIFICANT_P][:_MOST_CELLS],
        'not_covered': list(diagnosis.not_covered),
        'notes': notes(diagnosis),
        'unknown_where': list(verdict.unknown_where),
        'candidates': _candidates(diagnosis),
        'noise_like': [{'effect': d.effect, 'words': d.message,
                        'nats': _rounded(d.log_bayes_factor)} for d in diagnosis.detections],
        'noise_remainders': _noise_remainders(diagnosis),
        'next_experiment': _next_experiment(diagnosis.next_experiment),
        'summary': summary(diagnosis)}


def notes(diagnosis: Diagnosis) -> list[str]:
    """Return what was corrected or left out, with the file where there are several."""
    several = len(diagnosis.comparisons) > 1
    return [f'{Path(c.name).name}: {note}' if several else note
            for c in diagnosis.comparisons for note in c.notes]


def _gap(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the gap before and after, and the noise recording by recording."""
    assert diagnosis.gap_closure is not None and diagnosis.noise_floor is not None
    assert diagnosis.verdict is not None
    closure, has_gap = diagnosis.gap_closure, diagnosis.verdict.status not in _WITHOUT_GAP
    return {'unit': 'm/s^2', 'before': _rounded(closure.before_mps2),
            'zero_g': _rounded(closure.zero_g_mps2), 'drift': _rounded(closure.drift_mps2),
            'after': _rounded(closure.after_mps2), 'floor': _rounded(closure.floor_mps2),
            'floor_ci': closure.floor_ci and [_rounded(c) for c in closure.floor_ci],
            'floor_source': diagnosis.noise_floor.source,
            'closed': _rounded(closure.closed) if has_gap else None,
            'closed_ci': [_rounded(c) for c in closure.closed_ci],
            'not_in_reference': _rounded(diagnosis.lost_motion_mps2),
            'noise': _noise(diagnosis)}


def _cell(cell: ResidualCell) -> dict[str, Any]:
    """Return one cell of the residual map."""
    return {'axis': cell.axis, 'dimension': cell.dimension, 'statistic': cell.statistic,
            'range': [_rounded(cell.low), _rounded(cell.high)],
            'mean': _rounded(cell.mean_mps2), 'floor_units': _rounded(cell.floor_units),
            'share': _rounded(cell.share), 'p': _rounded(cell.p)}


def _next_experiment(proposal: NextExperiment | None) -> dict[str, Any] | None:
    """Return what to record next."""
    if proposal is None:
        return None
    worth = proposal.nats_per_minute
    return {'manoeuvre': proposal.manoeuvre, 'why': proposal.why, 'command': proposal.command,
            'nats_per_minute': worth and _rounded(worth),
            'menu': [{'manoeuvre': w.text, 'minutes': _rounded(w.minutes),
                      'nats_per_minute': _rounded(w.nats_per_minute)}
                     for w in proposal.menu]}


def _noise_remainders(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return what remains of the noise-like effects, of the axis on which they are largest."""
    return [{'effect': r.effect, 'quantity': r.quantity, 'unit': r.unit,
             'axis': r.axes[r.largest] if r.axes else None,
             'recorded': _rounded(r.recorded[r.largest]),
             'simulated': _rounded(r.simulated[r.largest]),
             'left': _rounded(r.remains[r.largest])} for r in diagnosis.noise_remainders]


def _noise(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Compare recorded with simulated noise, recording by recording."""
    return [{'recording': comparison.name,
             'log_likelihood_gain': _rounded(after.log_likelihood - before.log_likelihood),
             'bands_hz': list(map(_rounded, after.band_edges_hz)),
             'power_ratio_before': list(map(_rounded, before.power_ratio)),
             'power_ratio_after': list(map(_rounded, after.power_ratio)),
             'allan_s': list(after.averaging_times_s),
             'allan_ratio_before': list(map(_rounded, before.allan_ratio)),
             'allan_ratio_after': list(map(_rounded, after.allan_ratio))}
            for comparison, before, after in zip(diagnosis.comparisons, diagnosis.noise_before,
                                                 diagnosis.noise_after)]


def shares_of_gap(diagnosis: Diagnosis) -> dict[str, float]:
    """Split the closed share of the squared gap among the effects by their contributions."""
    assert diagnosis.gap_closure is not None
    closure = diagnosis.gap_closure
    squares = {effect: rms ** 2 for effect, rms in diagnosis.contributions_mps2.items()}
    total = sum(squares.values())
    closed = max(closure.before_mps2 ** 2 - closure.after_mps2 ** 2, 0.0)
    gap = max(closure.before_mps2 ** 2 - closure.floor_mps2 ** 2, 1e-30)
    return {effect: float(min(closed / gap, 1.0) * square / total) if total else 0.0
            for effect, square in squares.items()}


def _rounded(value: float) -> float | None:
    """Round to the digits of the report; None for NaN and infinity."""
    return float(f'{value:.{_DIGITS}g}') if np.isfinite(value) else None


def _summing_to_one(hypotheses: Sequence[WeightedHypothesis]) -> list[WeightedHypothesis]:
    """Round probabilities so that they still sum to 1."""
    first, *others = [WeightedHypothesis(h.effects, round(h.probability, _DIGITS))
                      for h in hypotheses]
    rest = sum(h.probability for h in others)
    return [WeightedHypothesis(first.effects, round(1 - rest, _DIGITS)), *others]


def _candidates(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the effects of all hypotheses and detections, the most probable first."""
    assert diagnosis.verdict is not None
    probability: dict[str, float] = {}
    for weighted in diagnosis.verdict.hypotheses:
        for effect in weighted.effects:
            probability[effect] = probability.get(effect, 0.0) + weighted.probability
    best_with: dict[str, Hypothesis] = {}
    for h in diagnosis.hypotheses:
        for effect in h.effects:
            best_with.setdefault(effect, h)
    shares = shares_of_gap(diagnosis)
    candidates = [_candidate(diagnosis, name, probability.get(name, 0.0), best_with.get(name),
                             shares.get(name))
                  for name in library() if name in probability or name in best_with]
    return sorted(candidates, key=lambda c: (-(c['probability'] or 0.0), c['effect']))


def _candidate(diagnosis: Diagnosis, effect: str, probability: float,
               best_with: Hypothesis | None, share: float | None) -> dict[str, Any]:
    """Return one effect, with its parameters in the best hypothesis that has it."""
    assert diagnosis.verdict is not None and diagnosis.gap_closure is not None
    verdict, closed = diagnosis.verdict, None
    test = diagnosis.single_effect_tests.get(effect)
    detection = next((d for d in diagnosis.detections if d.effect == effect), None)
    p = _rounded(test.p) if test else None
    if detection is None:
        parameters = _parameters(diagnosis, best_with, effect)
        if effect in verdict.best.effects:
            closed = _rounded(diagnosis.gap_closure.closed)
    else:
        parameters = {p.name: {'value': np.asarray(detection.values[p.name]).tolist(),
                               'unit': p.unit}
                      for p in effect_named(effect).parameters if p.name in detection.values}
        if test is None:
            p = float(np.exp(-detection.log_bayes_factor))
    return {'effect': effect, 'of': effect_named(effect).concern.value,
            'probability': _rounded(min(probability, 1.0)), 'closed': closed, 'p': p,
            'parameters': parameters,
            'share': None if share is None else _rounded(share),
            'visibility': _rounded(test.visibility) if test else 1.0,
            'inseparable_from': _rivals(effect, verdict), 'cause': effect_named(effect).cause}


def _rivals(effect: str, verdict: Verdict) -> list[str]:
    """Return the effects that are inseparable from an effect."""
    group = next((g for g in reversed(verdict.groups) if effect in g), ())
    return [other for other in group if other != effect]


def _parameters(diagnosis: Diagnosis, hypothesis: Hypothesis | None, effect: str
                ) -> dict[str, Any]:
    """
    Return the parameters of an effect as the parameter file has them, baseline included.

    A parameter that the recordings do not determine has no value.
    """
    if hypothesis is None:
        return {}
    parameters: dict[str, dict[str, Any]] = {}
    for name in fitted_of(effect_named(effect), hypothesis.sensor.axes):
        key, unit = _key(name), parameter_of(name).unit
        if name in diagnosis.not_determined:
            parameters[key] = {
                'value': None, 'ci': None, 'unit': unit, 'determined': False,
                'not_separated_from': [_key(n) for n in diagnosis.not_determined[name]]}
        elif name in hypothesis.names:
            value = float(get(hypothesis.sensor, [name])[0])
            std = hypothesis.std[hypothesis.names.index(name)]
            parameters[key] = {
                'value': _rounded(value),
                'ci': [_rounded(value - Z_90 * std), _rounded(value + Z_90 * std)],
                'unit': unit, 'determined': True}
        elif effect_named(effect).diagnosis.drift:
            # The density of a drift is chosen with the noise, on a grid.
            parameters[key] = {'value': _rounded(float(get(hypothesis.sensor, [name])[0])),
                               'unit': unit}
    return parameters


def _key(name: Coefficient) -> str:
    """Return the name of a parameter with its axis, as the keys of the report have it."""
    return f'{name.parameter}.{name.axis}' if name.axis else name.parameter
