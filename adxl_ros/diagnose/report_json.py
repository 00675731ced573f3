# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as `report.json`."""

from __future__ import annotations

import json
from typing import Any, TYPE_CHECKING

from adxl_ros.diagnose import report as words
from adxl_ros.diagnose.next_experiment import MENU
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient, Effect, Manoeuvre
from adxl_ros.model.sensor import fitted_of, get, parameter_of
from adxl_ros.report.quantities import Interval
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.diagnosis import Diagnosis, Report
    from adxl_ros.diagnose.next_experiment import NextExperiment
    from adxl_ros.diagnose.search import Hypothesis

_DIGITS = 6  # Significant digits of the report. Chosen: more than any of its numbers has


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the report as the objects of JSON; docs/reference/report_json.md lists its keys."""
    report = diagnosis.report
    if report is None:
        return _of_fault(diagnosis)
    verdict = report.verdict
    return _rounded(
        {
            'schema': 1,
            'verdict': {
                'status': verdict.status,
                'effects': verdict.effects,
                'groups': verdict.groups,
                'of': words.concern(verdict),
                'data_fault': None,
                'probability': verdict.probability,
                'repeated': verdict.repeated,
                'surest': report.surest,
            },
            'hypotheses': [h._asdict() for h in verdict.hypotheses],
            'gap': _gap(report),
            'explained': _power(verdict.explained),
            'rest': _power(verdict.remainder),
            'rest_follows': verdict.remainder_follows,
            'material': verdict.material_mps2,
            'lost_without': {e: _power(p) for e, p in verdict.lost_without.items()},
            'where': [
                {
                    'axis': c.axis,
                    'dimension': c.dimension,
                    'range': (c.low, c.high),
                    'mean': c.mean_mps2,
                    'share': c.share,
                    'p': c.p,
                }
                for c in report.residual_cells
            ],
            'not_covered': report.not_covered,
            'notes': words.notes(diagnosis),
            'could_show': [
                {
                    'effect': r.name.effect,
                    'parameter': r.name.parameter,
                    'axis': r.name.axis or None,
                    'unit': r.unit,
                    'smallest': r.smallest,
                    'could_show': r.shows,
                }
                for r in report.could_show
            ],
            'candidates': candidates(report),
            'noise_remainders': [
                {
                    'effect': r.effect,
                    'quantity': r.quantity,
                    'unit': r.unit,
                    'axis': r.axis or None,
                    'recorded': r.recorded,
                    'simulated': r.simulated,
                    'left': r.left,
                }
                for r in report.noise_remainders
            ],
            'next_experiment': report.next_experiment and _proposal(report.next_experiment),
            'summary': words.summary(diagnosis),
        }
    )


def _of_fault(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the report on recordings that have no verdict."""
    fault = diagnosis.fault
    assert fault is not None
    return {
        'schema': 1,
        'verdict': {
            'status': fault.status,
            'effects': [],
            'groups': [],
            'of': None,
            'data_fault': fault.name if fault.status == 'bad_data' else None,
            'probability': 1.0,
            'surest': None,
        },
        'hypotheses': [],
        'gap': None,
        'where': [],
        'candidates': [],
        'notes': words.notes(diagnosis),
        'next_experiment': None,
        'summary': fault.message,
    }


def _proposal(proposal: NextExperiment) -> dict[str, Any]:
    """Return what to record next, with the worth of all manoeuvres."""
    menu = [
        {
            'manoeuvre': MENU[Manoeuvre[w.name]].text,
            'minutes': w.minutes,
            'nats_per_minute': w.per_minute,
        }
        for w in proposal.menu
    ]
    return {
        'manoeuvre': proposal.manoeuvre,
        'why': proposal.why,
        'command': proposal.command,
        'menu': menu,
    }


def as_text(values: dict[str, Any]) -> str:
    """Return values as JSON."""
    return json.dumps(values, indent=1, allow_nan=False) + '\n'


def _rounded(value: Any) -> Any:
    """Round all numbers to the digits of the report; None for NaN and infinity."""
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(v) for v in value]
    if not isinstance(value, float):
        return value
    return float(f'{value:.{_DIGITS}g}') if np.isfinite(value) else None


def _power(power: Interval) -> dict[str, Any]:
    """Return a power, (m/s²)², with its interval."""
    return {'value': power.value, 'ci': (power.low, power.high), 'unit': '(m/s^2)^2'}


def _gap(report: Report) -> dict[str, Any]:
    """Return the gap before and after, and the noise recording by recording."""
    closure = report.closure
    verdict = report.verdict
    figures: dict[str, Any] = {'unit': 'm/s^2'}
    for name, figure in closure._asdict().items():
        figures |= {name: figure.value, f'{name}_ci': (figure.low, figure.high)}
    if verdict.status in words.WITHOUT_GAP:
        figures['closed'] = None
    if not np.isfinite(closure.floor.low):
        figures['floor_ci'] = None
    return {
        **figures,
        'floor_source': report.noise_floor.source,
        'upper_limit': verdict.upper_limit_mps2,
        'tolerated': verdict.tolerated_mps2,
        'reference': verdict.reference_mps2,
        'not_in_reference': report.linear_model.lost_motion_mps2,
        'noise': report.noise,
    }


def candidates(report: Report) -> list[dict[str, Any]]:
    """Return the effects of all hypotheses and detections, the most probable first, unrounded."""
    verdict = report.verdict
    visible = {row.name.effect: row.share for row in report.could_show}
    shares = words.shares_of_gap(report)
    out = []
    for name, effect in library().items():
        probabilities = [h.probability for h in verdict.hypotheses if name in h.effects]
        hypothesis = next((h for h in report.hypotheses if name in h.effects), None)
        if not probabilities and hypothesis is None:
            continue
        # The last one, where an effect is in two groups.
        group = next((g for g in reversed(verdict.groups) if name in g), ())
        out.append(
            {
                'effect': name,
                'of': effect.concern.value,
                'probability': min(sum(probabilities), 1.0),
                'closed': report.closure.closed.value if name in verdict.best else None,
                # The rule weighs held-out figures, and no effect has a p of its own.
                'p': None,
                'parameters': _parameters(report, hypothesis, effect),
                'share': shares.get(name),
                'visibility': visible.get(name, 1.0),
                'inseparable_from': [other for other in group if other != name],
                'cause': effect.cause,
            }
        )
    return sorted(out, key=lambda c: (-c['probability'], c['effect']))


def _parameters(
    report: Report, hypothesis: Hypothesis | None, effect: Effect
) -> dict[str, dict[str, Any]]:
    """
    Return the parameters of an effect as the parameter file has them, baseline included.

    A parameter that the recordings do not determine has no value.
    """
    detected = next((d.values for d in report.detections if d.effect == effect.name), None)
    if detected is not None:
        return {
            p.name: {'value': np.asarray(detected[p.name]).tolist(), 'unit': p.unit}
            for p in effect.parameters
            if p.name in detected
        }
    sensor = report.sensor
    names = fitted_of(effect, sensor.axes)
    if effect.diagnosis.drift and effect.name in sensor.effects:
        # The density of a drift is chosen with the noise, on a grid.
        values = get(sensor, names).tolist()
        return {
            _key(name): {'value': value, 'unit': parameter_of(name).unit}
            for name, value in zip(names, values)
        }
    if hypothesis is None:
        return {}
    parameters = {}
    fitted = get(hypothesis.sensor, hypothesis.names).tolist()
    for name, value, std, is_open in zip(
        hypothesis.names, fitted, hypothesis.std, hypothesis.undetermined
    ):
        if name in names:
            interval = value - Z_90 * std, value + Z_90 * std
            parameters[_key(name)] = {
                'value': None if is_open else value,
                'ci': None if is_open else interval,
                'unit': parameter_of(name).unit,
                'determined': not is_open,
            }
    return parameters


def _key(name: Coefficient) -> str:
    """Return the name of a parameter with its axis, as the keys of the report have it."""
    return f'{name.parameter}.{name.axis}' if name.axis else name.parameter


def named_effects(report: Report) -> list[str]:
    """Return the effects of the verdict by their share of the gap."""
    shares = words.shares_of_gap(report)
    return sorted(report.verdict.named, key=lambda name: -shares.get(name, 0.0))
