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

"""The diagnosis in the words of interfaces: report.json, and a screenful for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.residual_map import SHOWS_P
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects import effect_named, library
import numpy as np

_DIGITS = 6


def as_json(found: Diagnosis) -> dict[str, Any]:
    """Return the report; see interfaces, "`diagnose` writes"."""
    if found.fault is not None:
        return {'schema': 1, 'verdict': {
            'status': found.fault.status, 'effects': [], 'groups': [],
            'data_fault': found.fault.name if found.fault.status == 'bad_data' else None,
            'probability': 1.0}, 'hypotheses': [], 'gap': None, 'where': [], 'candidates': [],
            'next_experiment': None, 'summary': found.fault.words}
    assert found.verdict is not None and found.shrunk is not None and found.floor is not None
    v, far = found.verdict, found.shrunk
    return {
        'schema': 1,
        'verdict': {'status': v.status, 'effects': list(v.effects),
                    'groups': [list(group) for group in v.groups], 'data_fault': None,
                    'probability': _round(v.probability)},
        'hypotheses': [{'effects': list(effects), 'probability': p}
                       for effects, p in _summing_to_one(v.hypotheses)],
        'gap': {'unit': 'm/s^2', 'before': _round(far.before_mps2),
                'after': _round(far.after_mps2), 'floor': _round(far.floor_mps2),
                'floor_source': found.floor.source, 'closed': _round(far.closed),
                'closed_ci': [_round(c) for c in far.closed_ci],
                'noise': _noise(found)},
        'where': [{'axis': c.axis, 'dimension': c.dimension, 'statistic': c.statistic,
                   'range': [_round(c.low), _round(c.high)], 'mean': _round(c.mean_mps2),
                   'floor_units': _round(c.floor_units), 'share': _round(c.share),
                   'p': _round(c.p)} for c in found.cells if c.p < SHOWS_P][:40],
        'not_covered': list(found.missing),
        'unknown_where': list(v.places),
        'candidates': _candidates(found),
        'noise_like': [{'effect': s.effect, 'words': s.words, 'nats': _round(s.nats)}
                       for s in found.signs],
        'next_experiment': None if found.proposal is None else {
            'manoeuvre': found.proposal.manoeuvre, 'why': found.proposal.why,
            'command': found.proposal.command,
            'nats_per_minute': found.proposal.nats_per_minute and _round(
                found.proposal.nats_per_minute),
            'menu': [{'manoeuvre': words, 'minutes': _round(minutes),
                      'nats_per_minute': _round(worth)}
                     for words, minutes, worth in found.proposal.menu]},
        'summary': sentence(found)}


def _noise(found: Diagnosis) -> list[dict[str, Any]]:
    """Compare recorded with simulated noise, recording by recording."""
    return [{'recording': one.name, 'log_likelihood_gain': _round(
                after.log_likelihood - before.log_likelihood),
             'bands_hz': [_round(f) for f in after.bands_hz],
             'power_ratio_before': [_round(r) for r in before.power],
             'power_ratio_after': [_round(r) for r in after.power],
             'allan_s': list(after.times_s),
             'allan_ratio_before': [_round(r) for r in before.allan],
             'allan_ratio_after': [_round(r) for r in after.allan]}
            for one, before, after in zip(found.series, *found.alike)]


def shares(found: Diagnosis) -> dict[str, float]:
    """Split the squares that close, before less after, among the effects by what each makes."""
    assert found.shrunk is not None
    parts = {effect: rms ** 2 for effect, rms in found.contributions.items()}
    whole = sum(parts.values())
    closes = max(found.shrunk.before_mps2 ** 2 - found.shrunk.after_mps2 ** 2, 0.0)
    gap = max(found.shrunk.before_mps2 ** 2 - found.shrunk.floor_mps2 ** 2, 1e-30)
    return {effect: float(min(closes / gap, 1.0) * part / whole) if whole else 0.0
            for effect, part in parts.items()}


def _round(value: float) -> float | None:
    return float(f'{value:.{_DIGITS}g}') if np.isfinite(value) else None


def _summing_to_one(hypotheses: Sequence[tuple[tuple[str, ...], float]]
                    ) -> list[tuple[tuple[str, ...], float]]:
    rounded = [(effects, round(p, _DIGITS)) for effects, p in hypotheses]
    (effects, _), rest = rounded[0], rounded[1:]
    return [(effects, round(1 - sum(p for _, p in rest), _DIGITS)), *rest]


def _candidates(found: Diagnosis) -> list[dict[str, Any]]:
    """Lay out what was weighed, effect by effect, the most probable first."""
    assert found.verdict is not None and found.shrunk is not None
    v = found.verdict
    chance: dict[str, float] = {}
    for effects, p in v.hypotheses:
        for effect in effects:
            chance[effect] = chance.get(effect, 0.0) + p
    seen: dict[str, Hypothesis] = {}
    for h in found.hypotheses:
        for effect in h.effects:
            seen.setdefault(effect, h)
    rivals = {effect: [e for e in group if e != effect] for group in v.groups for effect in group}
    share = shares(found)
    out = []
    for name in library():
        if name not in chance and name not in seen:
            continue
        score = found.scores.get(name)
        signs = [s for s in found.signs if s.effect == name]
        best = name in v.best.effects or bool(signs)
        out.append({
            'effect': name, 'probability': _round(min(chance.get(name, 0.0), 1.0)),
            'closed': _round(found.shrunk.closed) if best and not signs else None,
            'p': _round(score.p) if score else float(np.exp(-signs[0].nats)) if signs else None,
            'parameters': _parameters(seen.get(name), name),
            'share': _round(share[name]) if name in share else None,
            'visibility': _round(score.visibility) if score else 1.0,
            'inseparable_from': rivals.get(name, []), 'cause': effect_named(name).cause})
        if signs:
            out[-1]['parameters'] = {p: {'value': np.asarray(value).tolist()}
                                     for p, value in signs[0].values.items()}
    return sorted(out, key=lambda one: (-(one['probability'] or 0.0), one['effect']))


def _parameters(h: Hypothesis | None, effect: str) -> dict[str, Any]:
    if h is None:
        return {}
    out = {}
    for name, std in zip(h.names, h.std):
        if name.effect != effect:
            continue
        p = parameter_of(name)
        # As in the parameter file, what the baseline has of it included.
        middle = float(get(h.sensor, [name])[0])
        key = f'{name.parameter}.{name.axis}' if name.axis else name.parameter
        out[key] = {
            'value': _round(middle), 'ci': [_round(middle - Z_90 * std),
                                            _round(middle + Z_90 * std)], 'unit': p.unit}
    return out


def sentence(found: Diagnosis) -> str:
    """Say the verdict in one sentence."""
    if found.fault is not None:
        return found.fault.words
    assert found.verdict is not None and found.shrunk is not None
    v, far = found.verdict, found.shrunk
    mg = [1e3 * x / 9.80665 for x in (far.before_mps2, far.after_mps2, far.floor_mps2)]
    if v.status == 'no_gap':
        return (f'No gap: the recording differs from the simulator by {mg[0]:.2f} mg rms, the '
                f'floor is {mg[2]:.2f} mg (probability {v.probability:.2f}).')
    if v.status == 'insufficient':
        return 'Insufficient: nothing moves or warms, so that no effect could show.'
    if v.status == 'unknown':
        where = f' over {", ".join(v.places[:3])}' if v.places else ''
        return (f'Unknown: a gap of {mg[0]:.2f} mg rms above a floor of {mg[2]:.2f} mg that no '
                f'effect of the library explains shows{where} (probability {v.probability:.2f}).')
    parts = [*v.effects, *(f'one of {", ".join(group)}' for group in v.groups)]
    closed = '' if not np.isfinite(far.closed) else \
        f': {mg[0]:.2f} mg rms shrink to {mg[1]:.2f} above a floor of {mg[2]:.2f}, ' \
        f'{100 * far.closed:.0f} % of the gap'
    return f'{" and ".join(parts)} (probability {v.probability:.2f}){closed}.'


def screenful(found: Diagnosis) -> list[str]:
    """Lay the diagnosis out for a terminal."""
    lines = [sentence(found)]
    if found.fault is not None or found.verdict is None:
        return lines
    report = as_json(found)
    lines += ['', f'floor from {report["gap"]["floor_source"]} samples; closed share on stretches '
              f'held out: {report["gap"]["closed"]} (90 %: {report["gap"]["closed_ci"]})', '',
              f'{"hypothesis":44} {"probability":>11}']
    lines += [f'{", ".join(h["effects"]) or "no gap":44} {h["probability"]:11.3f}'
              for h in report['hypotheses'][:6]]
    if report['where']:
        lines += ['', 'where the gap shows most:']
        lines += [f'  {c["axis"]}  {c["dimension"]:16} {c["range"][0]:9.4g} to '
                  f'{c["range"][1]:9.4g}  {1e3 * c["mean"] / 9.80665:+8.2f} mg  '
                  f'{100 * c["share"]:5.1f} %  p {c["p"]:.3f}' for c in report['where'][:6]]
    for one in report['candidates'][:3]:
        if (one['probability'] or 0) < 0.05:
            continue
        lines += ['', f'{one["effect"]}: {one["cause"]}']
        lines += [f'  {name:32} {p["value"]:.5g} ({p["ci"][0]:.4g} to {p["ci"][1]:.4g}) '
                  f'{p["unit"]}' for name, p in one['parameters'].items() if 'ci' in p]
    if found.proposal is not None:
        lines += ['', f'next: {found.proposal.manoeuvre}, {found.proposal.why}',
                  f'  {found.proposal.command}']
    return lines
