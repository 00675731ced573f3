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
"""The diagnosis as one HTML page that opens offline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from adxl_ros.diagnose import page_figures
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.effect_proof import EffectProof, prove
from adxl_ros.diagnose.report_json import as_json, notes, PROBABLE
from adxl_ros.diagnose.report_text import badge, named_effects, parameter_label
from adxl_ros.diagnose.report_wording import (
    concern_text,
    gap_rows,
    headline,
    is_only_noise,
    listed,
    mg,
    mg_text,
    NOISE_STAYS,
    p_text,
    parameter_text,
    percent,
    probability_text,
    range_text,
    remainder_rows,
    tiles,
)
from adxl_ros.files import html_page, plotly_figures
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Parameter
from adxl_ros.model.sensor import Sensor

_COLOURS = {'explained': 'green', 'no_gap': 'grey', 'inseparable': 'amber',
            'insufficient': 'amber', 'unknown': 'red', 'bad_data': 'red'}
"""Colour of the badge for each status."""
_CELL_ROWS = 12
"""Rows of the table of cells. Chosen: the map above it shows all."""
_MARGIN = 0.06
"""Margin beside the whiskers of sizes, as a share of their range. Chosen: no dot is cut."""


@dataclass(frozen=True)
class Run:
    """
    What the page says about the run that made it.

    Attributes
    ----------
    subject
        What is compared with what.
    parameter_file
        The parameter file of the simulation.
    steps : list of tuple
        What to do next: purpose and command.
    parameters_text
        Text of the new parameter file; empty for none.
    command
        Command that makes the page; empty for that of this process.

    """

    subject: str
    parameter_file: str
    steps: Sequence[tuple[str, str]]
    parameters_text: str
    command: str = ''


def page(diagnosis: Diagnosis, run: Run) -> str:
    """
    Lay out the page.

    Parameters
    ----------
    diagnosis
        The diagnosis.
    run
        The run that made it.

    Returns
    -------
    str
        The page, HTML.

    Raises
    ------
    UserError
        Plotly or jinja2 is not installed.

    """
    html_page.check_libraries()
    report = as_json(diagnosis)
    status = report['verdict']['status']
    values: dict[str, Any] = {
        'title': run.subject,
        'about': [f'parameter file {run.parameter_file}'],
        'badge': {'colour': _COLOURS[status], 'word': badge(diagnosis),
                  'sentence': _sentence(diagnosis, report)},
        'notes': notes(diagnosis), 'figures': {}, 'has_verdict': False,
        'download': run.parameters_text and html_page.download_url(run.parameters_text)}
    if run.command:
        values['command'] = run.command
    if diagnosis.data_fault is None and diagnosis.verdict is not None:
        values |= _contents(diagnosis, report) | {'steps': run.steps}
    return html_page.render('adxl_ros.diagnose', 'diagnosis.html', values)


def _sentence(diagnosis: Diagnosis, report: dict[str, Any]) -> str:
    """Return the verdict in one sentence beside its badge."""
    status = report['verdict']['status']
    if status == 'no_gap':
        return 'The recording agrees with its simulation within the noise.'
    if status != 'explained':
        return headline(diagnosis)
    assert diagnosis.gap_closure is not None and diagnosis.verdict is not None
    closure, effects = diagnosis.gap_closure, listed(report['verdict']['effects'], 'and')
    if is_only_noise(diagnosis):
        return f'{effects}. {NOISE_STAYS}'
    return (f'{effects}: the difference falls from {mg_text(closure.before_mps2)} '
            f'to {mg_text(closure.after_mps2)} rms.{concern_text(diagnosis.verdict)}')


def _contents(diagnosis: Diagnosis, report: dict[str, Any]) -> dict[str, Any]:
    """Return what the template shows of a diagnosis with a verdict."""
    assert diagnosis.verdict is not None
    named = named_effects(diagnosis, report)
    candidates = report['candidates']
    probable = [c for c in candidates if (c['probability'] or 0.0) >= PROBABLE]
    probable.sort(key=lambda c: named.index(c['effect']) if c['effect'] in named else len(named))
    refuted = [c for c in candidates if (c['probability'] or 0.0) < PROBABLE]
    after = diagnosis.verdict.best.sensor
    proofs = _proofs(diagnosis, probable)
    figures = {'waterfall': page_figures.waterfall(diagnosis),
               'signals': page_figures.signals(diagnosis.comparisons[0], after),
               'spectrum': page_figures.gap_spectrum(diagnosis.full_rate[0], after),
               'map': page_figures.residual_map(diagnosis.residual_cells)}
    figures |= {f'proof-{p.effect}': page_figures.proof(p) for p in proofs}
    noisy = bool(report['noise_remainders'])
    return {
        'has_verdict': True,
        'figures': figures,
        'tiles': tiles(diagnosis),
        'effects': [_effect(c, noisy) for c in probable],
        'refuted': [[c['effect'], p_text(c['probability'] or 0.0), c['cause']] for c in refuted],
        'proofs': [{'effect': p.effect, 'text': _proof_text(p)} for p in proofs],
        'gap_rows': gap_rows(diagnosis),
        'remainders': remainder_rows(diagnosis),
        'converged': diagnosis.verdict.best.converged,
        'groups': [' or '.join(group) for group in report['verdict']['groups']],
        'hypotheses': [[', '.join(h['effects']) or 'no gap', p_text(h['probability'])]
                       for h in report['hypotheses'] if h['probability'] >= PROBABLE],
        'refuted_hypotheses': [
            [', '.join(h['effects']) or 'no gap', p_text(h['probability'])]
            for h in report['hypotheses'] if h['probability'] < PROBABLE],
        'cells': _cell_rows(report),
        'not_covered': report['not_covered'],
        'noise': _noise_rows(report),
        'menu': _menu_rows(report),
    }


def _proofs(diagnosis: Diagnosis, candidates: Sequence[dict[str, Any]]) -> list[EffectProof]:
    """Prove the effects that the page shows, as far as the fitted sensor has them."""
    assert diagnosis.verdict is not None
    detected = {d.effect for d in diagnosis.detections}
    proofs = []
    for candidate in candidates:
        effect = candidate['effect']
        sensor = _sensor_with(diagnosis, effect, effect in detected)
        if sensor is not None:
            proofs.append(prove(effect, diagnosis.comparisons[0], diagnosis.full_rate[0], sensor))
    return proofs


def _sensor_with(diagnosis: Diagnosis, effect: str, detected: bool) -> Sensor | None:
    """Return the most probable fitted sensor that has an effect; None without one."""
    if detected and diagnosis.sensor is not None and effect in diagnosis.sensor.effects:
        return diagnosis.sensor
    return next((h.sensor for h in diagnosis.hypotheses if effect in h.effects), None)


def _proof_text(evidence: EffectProof) -> str:
    """Explain the proof of an effect in one sentence."""
    if evidence.binned:
        return ('Points: recording minus a simulation with all other effects, with 90 % bars. '
                'Line: the model of this effect.')
    kind = 'spectrum' if evidence.is_spectrum else 'histogram'
    return f'The effect is there if the recorded {kind} follows the green line, not the red one.' \
        if any(c.label == 'recorded' for c in evidence.curves) else \
        'The effect is there if the spectrum of the difference falls from red to green.'


def _effect(candidate: dict[str, Any], noisy: bool) -> dict[str, Any]:
    """Return the row of an effect."""
    effect = effect_named(candidate['effect'])
    stated = {p.name: p for p in effect.parameters}
    parameters = candidate['parameters']
    is_single = len({name.partition('.')[0] for name in parameters}) == 1
    return {
        'name': effect.name,
        'sure': probability_text(candidate['probability'] or 0.0),
        'share': '' if candidate['share'] is None else
                 f'{percent(candidate["share"], noisy)} % of the gap',
        'cause': effect.cause,
        'rivals': candidate['inseparable_from'],
        'does': (effect.apply.__doc__ or '').strip().split('\n')[0],
        'meaning': [[p.name, p.unit, p.doc] for p in effect.parameters],
        'sizes': [_size(parameter_label(name, is_single), parameter,
                        stated[name.partition('.')[0]], parameters)
                  for name, parameter in parameters.items()]}


def _size(label: str, parameter: dict[str, Any], stated: Parameter,
          parameters: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return one size of an effect, with its whisker where it has an interval."""
    text = parameter_text(parameter)
    size: dict[str, Any] = {'label': label or 'size', 'doc': stated.doc, 'text': text,
                            'mark': None}
    if parameter.get('ci'):
        comparable = [p for p in parameters.values() if p.get('ci') and p['unit'] == stated.unit]
        low = min(0.0, *(p['ci'][0] for p in comparable))
        high = max(0.0, *(p['ci'][1] for p in comparable))
        margin = _MARGIN * (high - low)
        size['mark'] = plotly_figures.whisker(
            parameter['value'], parameter['ci'][0], parameter['ci'][1],
            (low - margin, high + margin), text)
    return size


def _cell_rows(report: dict[str, Any]) -> list[list[str]]:
    """Return the significant cells with the largest shares."""
    rows = []
    for c in report['where'][:_CELL_ROWS]:
        low, high = c['range']
        rows.append([c['axis'], c['dimension'], c['statistic'], range_text(low, high),
                     f'{mg(c["mean"]):+.2f}', f'{c["floor_units"]:+.1f}',
                     f'{100 * c["share"]:.1f} %', p_text(c['p'])])
    return rows


def _noise_rows(report: dict[str, Any]) -> list[list[str]]:
    """Return ratios of recorded and simulated noise, before and after."""
    rows = []
    for noise in report['gap']['noise']:
        names = [f'{low:.3g} to {high:.3g} Hz' for low, high in pairwise(noise['bands_hz'])]
        names += [f'Allan deviation at {t:g} s' for t in noise['allan_s']]
        before, after = ([*noise[f'power_ratio_{when}'], *noise[f'allan_ratio_{when}']]
                         for when in ('before', 'after'))
        rows += [[name, f'{b:.2f}', f'{a:.2f}'] for name, b, a in zip(names, before, after)]
        rows.append(['gain of log likelihood', '', f'{noise["log_likelihood_gain"]:.0f}'])
    return rows


def _menu_rows(report: dict[str, Any]) -> list[list[str]]:
    """Return the manoeuvres that would separate hypotheses, the best first."""
    proposal = report['next_experiment']
    return [] if proposal is None else [
        [m['manoeuvre'], f'{m["minutes"]:.1f}', f'{m["nats_per_minute"]:.2g}']
        for m in proposal['menu']]
