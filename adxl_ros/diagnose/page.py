# SPDX-License-Identifier: Apache-2.0
"""
The diagnosis as one HTML page that opens offline, with its figures and proofs.

The proof of an effect is the recording minus a simulation with all other effects, over the
effect's own variable, or spectra and histograms with and without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

from adxl_ros.diagnose.comparison import (
    BaselineComparison,
    Reference,
)
from adxl_ros.diagnose.diagnosis import Diagnosis, Report
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.diagnose.report import (
    as_json,
    axis_scale,
    badge,
    figure_rows,
    headline,
    mg,
    mg_text,
    named_effects,
    notes,
    parameter_label,
    parameter_text,
    percent,
    PROBABLE,
    remainder_rows,
    shares_of_gap,
    shown_row,
)
from adxl_ros.diagnose.residual_map import BLOCK_S, RANGES, ResidualCell, SIGNIFICANT_P
from adxl_ros.diagnose.visibility import by_effect
from adxl_ros.model import noise
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.diagnosis_hints import ProofVariable
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.filters import low_pass
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.report import figures as plots, page as html_page
from adxl_ros.report.figures import Figure, figure, line, rounded
import numpy as np
import scipy

_BINS = 10
"""Ranges of equal width, and of equal counts, of a proof. Chosen: a curve is visible."""
_RATE_S = 20.0
"""Time over which a temperature changes, s. Chosen: beyond the noise of a thermometer."""
_FEWEST_SAMPLES = 20
"""Fewest samples of a range. Chosen: their mean is worth a point."""
_SMALLEST_SHARE = 0.5
"""Share of the effect's variance that the variable must show. Chosen: half of it."""
_CONTRIBUTION = 'what the model of the effect predicts, mg'
"""Variable of an effect that none of its own variables shows."""
_SEGMENT = 4096
"""Samples in a segment of a spectrum. Chosen: 0.06 Hz at 250 Hz."""
_POINTS_PER_OCTAVE = 12
"""Points of a plotted spectrum in an octave. Chosen: lines stay visible."""
_HISTOGRAM_BINS, _HISTOGRAM_QUANTILE = 81, 0.9999
"""Bins, and share of the samples within. Chosen: a bin at 0, and spikes of 0.1 %."""


class BinnedAxis(NamedTuple):
    """One axis of a proof over a variable: means of the ranges, with half of 90 % intervals."""

    axis: str
    variable: np.ndarray
    residual_mg: np.ndarray
    half_width_mg: np.ndarray
    model_mg: np.ndarray


class Curve(NamedTuple):
    """A spectrum or a histogram of one axis."""

    axis: str
    label: str
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class EffectProof:
    """What shows an effect: means over a variable, or spectra, mg/√Hz, or histograms."""

    effect: str
    variable: str
    is_spectrum: bool = False
    binned: tuple[BinnedAxis, ...] = ()
    curves: tuple[Curve, ...] = ()


def prove(effect: str, comparison: BaselineComparison, full_rate: BaselineComparison,
          sensor: Sensor) -> EffectProof:
    """Show an effect of a sensor, which has all effects of the verdict, in a recording."""
    library_effect = effect_named(effect)
    variables = library_effect.diagnosis.proof
    without = replace(sensor, values={**sensor.values, effect: with_neutral(
        comparison.sensor, [effect]).values[effect]})
    if ProofVariable.STEP in variables:
        return EffectProof(effect, ProofVariable.STEP.value,
                           curves=_histograms(full_rate, sensor, without))
    if library_effect.acts_on is ActsOn.NOISE or ProofVariable.FREQUENCY in variables:
        if library_effect.acts_on is ActsOn.NOISE:
            signals_v = {'recorded': full_rate.residual_v(sensor),
                         'without the effect': full_rate.simulated_noise_v(without, 0),
                         'with the effect': full_rate.simulated_noise_v(sensor, 0)}
        else:
            signals_v = {'without the effect': full_rate.residual_v(without),
                         'with the effect': full_rate.residual_v(sensor)}
        return EffectProof(effect, ProofVariable.FREQUENCY.value, True, curves=tuple(
            curve for label, v in signals_v.items() for curve in spectra(full_rate, v, label)))
    return _binned(effect, variables, comparison, sensor, without)


def _binned(effect: str, variables: Sequence[ProofVariable], comparison: BaselineComparison,
            sensor: Sensor, without: Sensor) -> EffectProof:
    """Average the residual without the effect over the variable that shows the effect best."""
    to_mg = 1e3 / (G0_MPS2 * comparison.scale_v_per_mps2)
    used = comparison.used
    residual_mg = (comparison.residual_v(without) * to_mg)[used]
    model_mg = residual_mg - (comparison.residual_v(sensor) * to_mg)[used]
    best, values, largest = _CONTRIBUTION, model_mg, _SMALLEST_SHARE
    for variable in variables:
        candidate = _values(comparison, variable)
        if candidate is None:
            continue
        share = _share(candidate[used], model_mg)
        if share > largest:
            best, values, largest = variable.value, candidate[used], share
    block = np.flatnonzero(used) // max(round(BLOCK_S * comparison.sensor.rate_hz), 1)
    axes = tuple(_bin(axis, values[:, d], residual_mg[:, d], model_mg[:, d], block)
                 for d, axis in enumerate(comparison.sensor.axes))
    return EffectProof(effect, best, binned=axes)


def _places(values: np.ndarray) -> np.ndarray:
    """Return the range of each value, (n,); quantiles and equal widths divide the ranges."""
    shares = np.linspace(0, 1, _BINS + 1)
    low, high = float(values.min()), float(values.max())
    edges = np.unique([*np.quantile(values, shares), *(low + (high - low) * shares)])
    return np.clip(np.searchsorted(edges, values, 'right') - 1, 0, max(len(edges) - 2, 0))


def _share(values: np.ndarray, model_mg: np.ndarray) -> float:
    """Return the share of the variance of the model that lies between the ranges of a variable."""
    between = total = 0.0
    for d in range(model_mg.shape[1]):
        place = _places(values[:, d])
        count = np.maximum(np.bincount(place), 1)
        mean = np.bincount(place, model_mg[:, d]) / count
        between += float(np.sum(count * mean ** 2))
        total += float(np.sum(model_mg[:, d] ** 2))
    return between / total if total else 0.0


def _bin(axis: str, values: np.ndarray, residual_mg: np.ndarray, model_mg: np.ndarray,
         block: np.ndarray) -> BinnedAxis:
    """Average one axis over the ranges of the variable."""
    place = _places(values)
    count = np.bincount(place)
    filled = count >= min(_FEWEST_SAMPLES, int(count.max()))
    count = np.maximum(count, 1)
    means = [np.bincount(place, v) / count for v in (values, residual_mg, model_mg)]
    # The noise is correlated, so that the sums of whole blocks give the error of a mean.
    noise_mg = residual_mg - model_mg - (means[1] - means[2])[place]
    cell = place * (int(block.max()) + 1) + block
    sums = np.bincount(cell, noise_mg)
    owner = np.arange(len(sums)) // (int(block.max()) + 1)
    std = np.sqrt(np.bincount(owner, sums ** 2, minlength=len(count))) / count
    return BinnedAxis(axis, *(v[filled] for v in (means[0], means[1], Z_90 * std, means[2])))


def _values(comparison: BaselineComparison, variable: ProofVariable) -> np.ndarray | None:
    """Return a variable at the samples of each axis, (n, m); None where it is not known."""
    time_s, motion, axes = comparison.time_s, comparison.motion, comparison.sensor.axes
    if variable is ProofVariable.OUTPUT:
        return comparison.volts
    by_time = {ProofVariable.TIME: time_s - time_s[0]}
    if motion.temperature_c is not None:
        temperature_c = motion.temperature_c(time_s)
        late_k = temperature_c - low_pass(temperature_c, _RATE_S, comparison.dt_s, {})
        by_time |= {ProofVariable.TEMPERATURE: temperature_c,
                    ProofVariable.TEMPERATURE_RATE: late_k * 60 / _RATE_S}
    if motion.supply_v is not None:
        by_time[ProofVariable.SUPPLY] = motion.supply_v(time_s)
    if comparison.reference is Reference.STAGE:
        by_time |= {
            ProofVariable.ALPHA: np.degrees(motion.alpha(time_s)),
            ProofVariable.BETA: np.degrees(motion.beta(time_s)) % 360,
            ProofVariable.ALPHA_RATE: np.degrees(motion.alpha(time_s, 1)),
            ProofVariable.BETA_RATE: np.degrees(motion.beta(time_s, 1)),
            ProofVariable.ALPHA_ACCELERATION: np.degrees(motion.alpha(time_s, 2)),
            ProofVariable.BETA_ACCELERATION: np.degrees(motion.beta(time_s, 2))}
    if variable in by_time:
        return np.repeat(by_time[variable][:, None], len(axes), axis=1)
    force_g = _force_g(comparison)
    if force_g is None:
        return None
    places = [AXES.index(axis) for axis in axes]
    if variable is ProofVariable.OWN_FORCE:
        return force_g[:, places]
    if variable is ProofVariable.CROSS_FORCE:
        return force_g[:, [1 if d == 0 else 0 for d in places]]
    if variable is ProofVariable.FORCE_Z:
        return force_g[:, [2] * len(axes)]
    if variable is ProofVariable.FORCE_RATE:
        return np.gradient(force_g, time_s, axis=0)[:, places]
    return None


def _force_g(comparison: BaselineComparison) -> np.ndarray | None:
    """Return the specific force of the reference, g, (n, 3); None without a reference."""
    time_s, motion = comparison.time_s, comparison.motion
    if comparison.reference is Reference.STAGE:
        return np.column_stack(specific_force(motion.alpha(time_s), motion.beta(time_s), 1.0))
    if comparison.reference is Reference.SIMULATOR and motion.force is not None:
        return np.column_stack(motion.force(time_s)) / G0_MPS2
    return None


def spectra(comparison: BaselineComparison, signal_v: np.ndarray, label: str) -> list[Curve]:
    """Estimate spectra, mg/√Hz, by axis, with equally dense points per octave."""
    signal_mg = bridged(signal_v, comparison.used) * 1e3 / (G0_MPS2 * comparison.scale_v_per_mps2)
    frequency_hz, power = scipy.signal.welch(
        np.nan_to_num(signal_mg), comparison.sensor.rate_hz, axis=0,
        nperseg=min(_SEGMENT, len(signal_mg)))
    frequency_hz, power = frequency_hz[1:], power[1:]
    place = np.floor(np.log2(frequency_hz / frequency_hz[0]) * _POINTS_PER_OCTAVE).astype(int)
    _, place = np.unique(place, return_inverse=True)
    count = np.bincount(place)
    mean_hz = np.bincount(place, frequency_hz) / count
    return [Curve(axis, label, mean_hz, np.sqrt(np.bincount(place, power[:, d]) / count))
            for d, axis in enumerate(comparison.sensor.axes)]


def _histograms(comparison: BaselineComparison, sensor: Sensor, without: Sensor
                ) -> tuple[Curve, ...]:
    """Return histograms of the changes from one sample to the next, recorded and simulated."""
    to_mg = 1e3 / (G0_MPS2 * comparison.scale_v_per_mps2)
    at_rate = replace(without, rate_hz=comparison.sensor.rate_hz)
    mean_v = comparison.simulated_v(at_rate)
    signals_v = {'recorded': comparison.volts,
                 'without the effect': mean_v + comparison.simulated_noise_v(without, 0),
                 'with the effect': mean_v + comparison.simulated_noise_v(sensor, 0)}
    steps = {label: np.diff(v * to_mg, axis=0) for label, v in signals_v.items()}
    curves = []
    for d, axis in enumerate(comparison.sensor.axes):
        finite = steps['recorded'][:, d][np.isfinite(steps['recorded'][:, d])]
        reach = float(np.quantile(np.abs(finite), _HISTOGRAM_QUANTILE))
        edges = np.linspace(-reach, reach, _HISTOGRAM_BINS + 1)
        for label, values in steps.items():
            count, _ = np.histogram(values[:, d], edges)
            curves.append(Curve(axis, label, (edges[1:] + edges[:-1]) / 2, count))
    return tuple(curves)


_COLOURS = {'explained': 'green', 'partly': 'amber', 'no_gap': 'grey', 'inseparable': 'amber',
            'insufficient': 'amber', 'unknown': 'red', 'bad_data': 'red'}
"""Colour of the badge for each status."""
_MARGIN = 0.06
"""Margin beside the whiskers of sizes, as a share of their range. Chosen: no dot is cut."""
_PLOTTED_POINTS = 3000
"""Largest number of plots.points of a line. Chosen: more than a wide screen has columns."""
_INK, _EFFECT_COLOUR = '#1f2933', '#5b8fd6'
_CURVE_COLOURS = {'recorded': _INK, 'stated noise': plots.QUIET_COLOUR} | dict.fromkeys(
    ('before', 'without the effect'), plots.BEFORE_COLOUR) | dict.fromkeys(
        ('after', 'with the effect'), plots.AFTER_COLOUR)


@dataclass(frozen=True)
class Run:
    """
    What the page says about the run that made it.

    `steps` are what to do next, purpose and command; `command` makes the page, and is empty for
    that of this process.
    """

    subject: str
    parameter_file: str
    steps: Sequence[tuple[str, str]]
    parameters_text: str
    command: str = ''


def page(diagnosis: Diagnosis, run: Run) -> str:
    """Lay out the page; raise UserError where Plotly or jinja2 is not installed."""
    html_page.check_libraries()
    objects = as_json(diagnosis)
    values: dict[str, Any] = {
        'title': run.subject, 'about': [f'parameter file {run.parameter_file}'],
        'badge': {'colour': _COLOURS[objects['verdict']['status']],
                  'word': badge(diagnosis), 'sentence': headline(diagnosis)},
        'notes': notes(diagnosis), 'figures': {}, 'has_verdict': False,
        'download': run.parameters_text and html_page.download_url(run.parameters_text)}
    if run.command:
        values['command'] = run.command
    if diagnosis.report is not None:
        values |= _contents(diagnosis, diagnosis.report, objects) | {'steps': run.steps}
    return html_page.render('adxl_ros.diagnose', 'diagnosis.html', values)


def _contents(diagnosis: Diagnosis, report: Report, objects: dict[str, Any]) -> dict[str, Any]:
    """Return what the template shows of a diagnosis with a verdict."""
    named, proposal = named_effects(report, objects), objects['next_experiment']
    shown = [c for c in objects['candidates']
             if c['effect'] in named or c['probability'] >= PROBABLE]
    shown.sort(key=lambda c: named.index(c['effect']) if c['effect'] in named else len(named))
    after, full_rate = report.verdict.best.sensor, diagnosis.full_rate[0]
    proofs = [prove(c['effect'], diagnosis.comparisons[0], full_rate, sensor)
              for c in shown if (sensor := _sensor_with(report, c['effect'])) is not None]
    rows, scale = figure_rows(diagnosis), float(report.baseline.scale_v_per_g.mean())
    return {
        'has_verdict': True,
        'figures': {'waterfall': waterfall(report), 'map': map_figure(report.residual_cells),
                    'signals': signals(diagnosis.comparisons[0], after),
                    'spectrum': gap_spectrum(full_rate, after),
                    **{f'proof-{p.effect}': proof(p) for p in proofs}},
        'tiles': rows[:3] + [r for r in rows[3:] if r.label in (
            'upper limit', 'explained', 'repeats, not explained')][:4 - len(rows[:3])],
        'effects': [_effect(c, report) for c in shown],
        'proofs': [{'effect': p.effect, 'text': _proof_text(p)} for p in proofs],
        'figure_rows': rows, 'remainders': [row[:2] for row in remainder_rows(report)],
        'converged': report.verdict.best.converged,
        'hypotheses': [[', '.join(h['effects']) or 'no gap', percent(h['probability'])]
                       for h in objects['hypotheses']],
        'not_covered': objects['not_covered'], 'noise': _noise_rows(objects),
        'menu': [[m['manoeuvre'], f'{m["minutes"]:.1f}', f'{m["nats_per_minute"]:.2g}']
                 for m in proposal['menu']] if proposal else [],
        'could_show': [(row.shows, *shown_row(row, scale))
                       for row in by_effect(report.could_show).values()]}


def _sensor_with(report: Report, effect: str) -> Sensor | None:
    """Return the most probable fitted sensor that has an effect; None without one."""
    if any(d.effect == effect for d in report.detections) and effect in report.sensor.effects:
        return report.sensor
    return next((h.sensor for h in report.hypotheses if effect in h.effects), None)


def _proof_text(evidence: EffectProof) -> str:
    """Explain the proof of an effect in one sentence."""
    if evidence.binned:
        return ('Points: recording minus a simulation with all other effects, with 90 % bars. '
                'Line: the model of this effect.')
    kind = 'spectrum' if evidence.is_spectrum else 'histogram'
    return f'The effect is there if the recorded {kind} follows the green line, not the red one.' \
        if any(c.label == 'recorded' for c in evidence.curves) else \
        'The effect is there if the spectrum of the difference falls from red to green.'


def _effect(candidate: dict[str, Any], report: Report) -> dict[str, Any]:
    """Return one effect with its sizes, as dot and plots.whisker where they have an interval."""
    effect, parameters = effect_named(candidate['effect']), candidate['parameters']
    stated, sizes = {p.name: p for p in effect.parameters}, []
    is_single = len({key.partition('.')[0] for key in parameters}) == 1
    for key, parameter in parameters.items():
        text = parameter_text(parameter, axis_scale(report, key))
        mark = None
        if parameter.get('ci'):
            ends = [v for p in parameters.values() if p.get('ci')
                    and p['unit'] == parameter['unit'] for v in p['ci']]
            low, high = min(0.0, *ends), max(0.0, *ends)
            margin = _MARGIN * (high - low)
            mark = plots.whisker(parameter['value'], parameter['ci'][0], parameter['ci'][1],
                                 (low - margin, high + margin), text)
        sizes.append({'label': parameter_label(key, is_single) or 'size', 'text': text,
                      'doc': stated[key.partition('.')[0]].doc, 'mark': mark})
    return {'name': effect.name, 'sure': percent(candidate['probability']),
            'share': '' if candidate['share'] is None else
            f'{percent(candidate["share"])} of the gap', 'cause': effect.cause,
            'rivals': candidate['inseparable_from'], 'sizes': sizes}


def _noise_rows(objects: dict[str, Any]) -> list[list[str]]:
    """Return ratios of recorded and simulated noise, before and after."""
    rows = []
    for ratios in objects['gap']['noise']:
        names = [f'{low:.3g} to {high:.3g} Hz' for low, high in pairwise(ratios['bands_hz'])]
        names += [f'Allan deviation at {t:g} s' for t in ratios['allan_s']]
        before, after = ([*ratios[f'power_ratio_{when}'], *ratios[f'allan_ratio_{when}']]
                         for when in ('before', 'after'))
        rows += [[name, f'{b:.2f}', f'{a:.2f}'] for name, b, a in zip(names, before, after)]
    return rows


def waterfall(report: Report) -> Figure:
    """Draw the gap, what each effect takes off it, what stays, and the noise floor."""
    closure = report.closure
    before, after, floor = (float(mg(v)) for v in (
        closure.before_mps2, closure.after_mps2, closure.floor_mps2))
    bars = [('gap', 0.0, before, mg_text(closure.before_mps2), plots.BEFORE_COLOUR)]
    level = before
    for name, share in sorted(shares_of_gap(report).items(), key=lambda item: -item[1]):
        if share > 0:
            lower = max(level ** 2 - share * (before ** 2 - floor ** 2), 0.0) ** 0.5
            bars.append((name, lower, level - lower, percent(share), _EFFECT_COLOUR))
            level = lower
    if len(bars) > 1:
        bars.append(('what is left', 0.0, after, mg_text(closure.after_mps2), plots.AFTER_COLOUR))
    bars.append(('noise floor', 0.0, floor, mg_text(closure.floor_mps2), plots.QUIET_COLOUR))
    labels, base, width, text, colours = zip(*bars)
    trace = {'type': 'bar', 'width': 0.62, 'orientation': 'h', 'y': labels, 'x': rounded(width),
             'base': rounded(base), 'text': text, 'textposition': 'outside', 'cliponaxis': False,
             'marker': {'color': colours}, 'hovertemplate': '%{y}: %{text}<extra></extra>',
             'showlegend': False}
    return figure([trace], 60 + 38 * len(labels), xaxis={
        'title': {'text': 'rms, mg'}, 'range': [0, 1.2 * max(before, after, floor)]},
        yaxis={'autorange': 'reversed', 'ticks': '', 'type': 'category'})


def proof(evidence: EffectProof) -> Figure:
    """Draw means over the variable with the line of the model, or curves."""
    if not evidence.binned:
        unit = 'mg/√Hz' if evidence.is_spectrum else 'samples'
        return _panels(evidence.curves, evidence.variable, unit, evidence.is_spectrum)
    traces = []
    for binned in evidence.binned:
        colour, order = plots.AXIS_COLOURS[binned.axis], np.argsort(binned.variable)
        traces += [plots.points(binned.variable, binned.residual_mg, binned.half_width_mg,
                                f'{binned.axis} recorded', colour),
                   line(binned.variable[order], binned.model_mg[order], f'{binned.axis} model',
                        colour)]
    return figure(traces, 300, xaxis={'title': {'text': evidence.variable}},
                  yaxis={'title': {'text': 'recording minus simulation, mg'}},
                  margin={'l': 8, 'r': 12, 't': 36, 'b': 8})


def _panels(curves: Sequence[Curve], title: str, unit: str, is_log: bool) -> Figure:
    """Draw curves in one panel for each axis, below each other."""
    axes = list(dict.fromkeys(curve.axis for curve in curves))
    traces, layout = [], {}
    for number, axis in enumerate(axes, 1):
        for curve in (c for c in curves if c.axis == axis):
            positive = curve.y > 0
            traces.append(line(curve.x[positive], curve.y[positive], curve.label,
                               _CURVE_COLOURS[curve.label], xaxis='x',
                               yaxis=plots.axis_number('y', number), legendgroup=curve.label,
                               showlegend=number == 1))
        layout[plots.axis_number('yaxis', number)] = {
            'title': {'text': f'{axis}, {unit}'}, 'domain': _domain(number, len(axes)),
            **plots.log_axis(np.concatenate([c.y for c in curves if c.axis == axis]))}
    return figure(traces, 60 + 190 * len(axes), margin={'l': 8, 'r': 12, 't': 36, 'b': 8},
                  xaxis={'title': {'text': title}, 'anchor': plots.axis_number('y', len(axes)),
                         **(plots.log_axis(curves[0].x) if is_log else {})}, **layout)


def _domain(number: int, count: int) -> list[float]:
    """Return the vertical range of a panel, from the top; there is a gap between panels."""
    height = (1 + 0.08) / count - 0.08
    top = 1 - (number - 1) * (height + 0.08)
    return [max(top - height, 0.0), top]


def signals(comparison: BaselineComparison, after: Sensor) -> Figure:
    """Draw recording, simulation and difference, before and after, with linked zoom."""
    time_s, scale = comparison.time_s - comparison.time_s[0], comparison.scale_v_per_mps2
    before_mg, after_mg = (mg(comparison.residual_v(s) / scale)
                           for s in (comparison.sensor, after))
    recorded_g = mg((comparison.volts - comparison.sensor.zero_g_v) / scale) / 1e3
    axes, traces, layout = comparison.sensor.axes, [], {}
    panels: Mapping[str, Sequence[tuple[str, np.ndarray, str]]] = {
        '{}, g': [('recording', recorded_g, _INK),
                  ('simulation before', recorded_g - before_mg / 1e3, plots.BEFORE_COLOUR),
                  ('simulation after', recorded_g - after_mg / 1e3, plots.AFTER_COLOUR)],
        'difference {}, mg': [('difference before', before_mg, plots.BEFORE_COLOUR),
                              ('difference after', after_mg, plots.AFTER_COLOUR)]}
    count = len(panels) * len(axes)
    for i, (d, label) in enumerate(((d, label) for d in range(len(axes)) for label in panels), 1):
        for name, values, colour in panels[label]:
            chosen = plots.extremes(values[:, d], _PLOTTED_POINTS)
            traces.append(line(time_s[chosen], values[chosen, d], name, colour, xaxis='x',
                               yaxis=plots.axis_number('y', i), legendgroup=name,
                               showlegend=d == 0, opacity=0.8))
        layout[plots.axis_number('yaxis', i)] = {'title': {'text': label.format(axes[d])},
                                                 'domain': _domain(i, count), 'nticks': 5}
    return figure(traces, 80 + 150 * count, margin={'l': 8, 'r': 12, 't': 60, 'b': 8}, xaxis={
        'title': {'text': 'time, s'}, 'anchor': plots.axis_number('y', count)}, **layout)


def gap_spectrum(comparison: BaselineComparison, after: Sensor) -> Figure:
    """Draw the spectrum of the gap before and after, and the stated noise."""
    curves = [*spectra(comparison, comparison.residual_v(comparison.sensor), 'before'),
              *spectra(comparison, comparison.residual_v(after), 'after')]
    frequency_hz = curves[0].x
    stated = mg(np.sqrt(noise.density_v2_per_hz(comparison.sensor, frequency_hz))
                / comparison.scale_v_per_mps2)
    curves += [Curve(axis, 'stated noise', frequency_hz, stated[:, d])
               for d, axis in enumerate(comparison.sensor.axes)]
    return _panels(curves, 'frequency, Hz', 'mg/√Hz', True)


def map_figure(cells: Sequence[ResidualCell]) -> Figure:
    """Draw the mean residual over ranges of all dimensions; significant cells have a dot."""
    means = [c for c in cells if c.dimension != 'frequency_hz']
    labels, values, texts, marks = [], [], [], []
    for name, axis in sorted({(c.dimension, c.axis) for c in means}):
        row = sorted((c for c in means if (c.dimension, c.axis) == (name, axis)),
                     key=lambda c: c.low)
        in_degrees = 'rad' in name
        unit = name.rpartition('_')[2] if not in_degrees else '°/s' if 'rate' in name else '°'
        factor = float(np.degrees(1.0)) if in_degrees else 1.0
        labels.append(f'{name.split("_rad")[0].replace("_", " ")}: {axis}')
        pad = [None] * (RANGES - len(row))
        values.append([*rounded([mg(c.mean_mps2) for c in row]), *pad])
        texts.append([f'{factor * c.low:.4g} to {factor * c.high:.4g} {unit}' for c in row] + pad)
        marks += [(i, labels[-1]) for i, c in enumerate(row) if c.p < SIGNIFICANT_P]
    largest = float(max((abs(mg(c.mean_mps2)) for c in means), default=1.0))
    heat = {'type': 'heatmap', 'y': labels, 'x': list(range(RANGES)), 'z': values,
            'text': texts, 'hovertemplate': '%{y}, %{text}<br>mean %{z:.3~g} mg<extra></extra>',
            'colorscale': 'RdBu', 'zmin': -largest, 'zmax': largest, 'xgap': 2, 'ygap': 2,
            'colorbar': {'title': {'text': 'mg'}, 'thickness': 12}}
    dots = {'type': 'scatter', 'mode': 'markers', 'x': [i for i, _ in marks],
            'y': [label for _, label in marks], 'hoverinfo': 'skip', 'showlegend': False,
            'marker': {'color': _INK, 'size': 5}}
    return figure([heat, dots], 80 + 22 * len(labels), xaxis={
        'showticklabels': False, 'showgrid': False, 'zeroline': False,
        'title': {'text': 'parts of the range, ascending'}},
        yaxis={'type': 'category', 'showgrid': False, 'dtick': 1})
