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
The words and figures of a diagnosis, which terminal, page and JSON share.

All of them show the same rows, so that their figures agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from adxl_ros.diagnose.baseline_comparison import Reference
from adxl_ros.diagnose.decision import Verdict
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.noise_remainder import NoiseRemainder
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn, Concern
import numpy as np

_NEARLY_ALL = 0.995
"""Closed share from which a percentage would be rounded to 100. Chosen: half a percent."""
_ALL = 0.9995
"""Closed share that is shown as 100 %. Chosen: it rounds to 100.0 %."""
_PREFIXED = ('V', 'g', 's', 'm')
"""Units that take a prefix."""
_PREFIX_BELOW = 0.1
"""Magnitude below which a unit takes a prefix. Chosen: 0.1 V is shown as it is."""
_SMALLEST_MG = 0.005
"""Acceleration, mg, that rounds to 0.00 below this."""
_FLOOR_SOURCES = {'still': 'from rests', 'repeats': 'from repeats of a trajectory',
                  'assumed': 'assumed from the parameter file'}
"""Sources of the noise floor, for people."""
_UNKNOWN_DIMENSIONS = 3
"""Dimensions of the unknown that the summary names. Chosen: the strongest ones."""


class Row(NamedTuple):
    """
    One row of figures.

    Attributes
    ----------
    label
        What it is.
    text
        Its figures with their units.

    """

    label: str
    text: str


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict in one sentence."""
    if diagnosis.data_fault is not None:
        return diagnosis.data_fault.message
    assert diagnosis.verdict is not None
    verdict = diagnosis.verdict
    probability = f'(probability {verdict.probability:.2f})'
    if verdict.status == 'no_gap':
        return f'No gap {probability}.'
    if verdict.status == 'insufficient':
        return ('No verdict: neither motion nor temperature nor supply changes, so that no effect '
                'can show.')
    if verdict.status == 'unknown':
        where = verdict.unknown_where[:_UNKNOWN_DIMENSIONS]
        follows = f' It shows over {", ".join(where)}.' if where else ''
        return f'Unknown: no effect of the library explains the gap {probability}.{follows}'
    named = listed([*verdict.effects, *(listed(group, 'or') for group in verdict.groups)], 'and')
    several = len(diagnosis.comparisons) > 1
    recordings = 'these recordings do' if several else 'this recording does'
    inseparable = f': {recordings} not separate them' if verdict.groups else ''
    return f'Gap explained by {named}{inseparable} {probability}.{concern_text(verdict)}'


def concern(verdict: Verdict) -> str | None:
    """
    Return what a verdict is about: reference, stage or sensor.

    Parameters
    ----------
    verdict
        The verdict.

    Returns
    -------
    str or None
        Concerns of the effects, joined by 'and', and by 'or' where a group holds several; None
        where no effect is named.

    """
    concerns = [_concerns([effect]) for effect in verdict.effects]
    concerns += [_concerns(group) for group in verdict.groups]
    return ' and '.join(sorted(dict.fromkeys(concerns))) or None


def _concerns(effects: Sequence[str]) -> str:
    """Return what one of some effects is an error of."""
    return ' or '.join(sorted({effect_named(e).concern.value for e in effects}))


def concern_text(verdict: Verdict) -> str:
    """Return a sentence on what is the reference's in a verdict; empty where nothing is."""
    concerns = concern(verdict)
    reference = Concern.REFERENCE.value
    if concerns == reference:
        return f' This is an error of the {reference}, not of the sensor.'
    certain = [e for e in verdict.effects if effect_named(e).concern is Concern.REFERENCE]
    undecided = [group for group in verdict.groups
                 if Concern.REFERENCE.value in _concerns(group)]
    sentences = [f' {listed(certain, "and")} is of the {reference}.'] if certain else []
    sentences += [f' The error is of the {_concerns(group).replace(" or ", " or of the ")}; both '
                  'give the same samples.' for group in undecided]
    return ''.join(sentences)


def listed(names: Sequence[str], word: str) -> str:
    """
    Return names separated by commas, with a word before the last one.

    Parameters
    ----------
    names
        At least one name.
    word
        The word, such as 'and'.

    Returns
    -------
    str
        The list as text.

    """
    *first, last = names
    return f'{", ".join(first)} {word} {last}' if first else last


def summary(diagnosis: Diagnosis) -> str:
    """Return verdict and gap in a few sentences."""
    if diagnosis.gap_closure is None:
        return headline(diagnosis)
    closure = diagnosis.gap_closure
    sentences = [headline(diagnosis),
                 f'Recording minus simulation is {mg_text(closure.before_mps2)} rms.']
    if pose_is_compared(diagnosis):
        sentences.append(f'Of this, {_parts_text(diagnosis)}.')
    if closes(diagnosis):
        effects = _effects_of_closure(diagnosis)
        sentences.append(f'{effects[0].upper()}{effects[1:]} reduce it to '
                         f'{mg_text(closure.after_mps2)} on held-out blocks: '
                         f'{closed_text(diagnosis)} closed.')
    elif is_only_noise(diagnosis):
        sentences.append(NOISE_STAYS)
    if diagnosis.lost_motion_mps2:
        sentences.append(f'The reference lacks {lost_text(diagnosis)}.')
    sentences.append(f'The noise floor is {mg_text(closure.floor_mps2)}.')
    sentences += [f'{row.label}: {row.text}.' for row in remainder_rows(diagnosis)]
    return ' '.join(sentences)


def lost_text(diagnosis: Diagnosis) -> str:
    """Return how much motion a smooth reference lacks."""
    lacking_hz = min(c.lacking_hz for c in diagnosis.comparisons)
    return f'{mg_text(diagnosis.lost_motion_mps2)} rms of motion above {lacking_hz:.2g} Hz'


NOISE_STAYS = 'The effects are noise, which no simulation repeats sample by sample.'
"""Why effects on the noise close nothing."""


def gap_rows(diagnosis: Diagnosis) -> list[Row]:
    """Return the gap and its parts, row by row."""
    assert diagnosis.gap_closure is not None and diagnosis.noise_floor is not None
    closure = diagnosis.gap_closure
    rows = [Row('gap', f'{mg_text(closure.before_mps2)} rms, recording minus simulation'),
            Row('of which', _parts_text(diagnosis) if pose_is_compared(diagnosis)
                else 'the mean is not compared, because the pose is unknown')]
    if closes(diagnosis):
        rows += [Row('closed to', f'{mg_text(closure.after_mps2)} rms on held-out blocks, by '
                     f'{_effects_of_closure(diagnosis)}'),
                 Row('closed', closed_text(diagnosis))]
    elif is_only_noise(diagnosis):
        rows.append(Row('closed', NOISE_STAYS))
    if diagnosis.lost_motion_mps2:
        rows.append(Row('not in the reference', lost_text(diagnosis)))
    rows.append(Row('noise floor', f'{mg_text(closure.floor_mps2)} rms, '
                    f'{_FLOOR_SOURCES[diagnosis.noise_floor.source]}'))
    return rows


def tiles(diagnosis: Diagnosis) -> list[Row]:
    """Return the figures of the gap that the page shows first."""
    assert diagnosis.gap_closure is not None
    closure = diagnosis.gap_closure
    before = Row('gap, recording minus simulation', mg_text(closure.before_mps2))
    floor = Row('noise floor', mg_text(closure.floor_mps2))
    if not closes(diagnosis):
        return [before, floor]
    return [before, Row('with the effects, held out', mg_text(closure.after_mps2)), floor,
            Row('closed', percent(closure.closed, bool(diagnosis.noise_remainders)) + ' %')]


def remainder_rows(diagnosis: Diagnosis) -> list[Row]:
    """Return what remains of each noise-like effect, row by row."""
    return [Row(f'{r.effect}, {r.quantity}{_axis_text(r)}',
                f'{_quantity_text(r.recorded[r.largest], r.unit)} recorded, '
                f'{_quantity_text(r.simulated[r.largest], r.unit)} simulated, '
                f'{_quantity_text(r.remains[r.largest], r.unit)} left')
            for r in diagnosis.noise_remainders]


def _axis_text(remainder: NoiseRemainder) -> str:
    """Return the axis of the largest value as text, empty where all are equal."""
    return f' on {remainder.axes[remainder.largest]}' if remainder.axes else ''


def _quantity_text(value: float, unit: str) -> str:
    """Return a statistic of the noise with its unit."""
    if unit == 'm/s^2':
        return mg_text(value)
    if unit == '1':
        return f'{100 * value:.2g} %'
    return f'{value:.2g}'


def _parts_text(diagnosis: Diagnosis) -> str:
    """Return what zero-g and drift take up of the gap."""
    assert diagnosis.gap_closure is not None
    closure = diagnosis.gap_closure
    return (f'{mg_text(closure.zero_g_mps2)} is zero-g and {mg_text(closure.drift_mps2)} is '
            'drift')


def pose_is_compared(diagnosis: Diagnosis) -> bool:
    """Determine whether the mean of a recording is compared."""
    return any(c.reference is not Reference.NONE for c in diagnosis.comparisons)


def _effects_of_closure(diagnosis: Diagnosis) -> str:
    """Return the effects that the gap is closed with as text."""
    assert diagnosis.verdict is not None
    verdict = diagnosis.verdict
    named = ', '.join(verdict.best.effects)
    return f'the nearest effects of the library ({named})' if verdict.status == 'unknown' \
        else 'the effects'


def is_only_noise(diagnosis: Diagnosis) -> bool:
    """Determine whether a verdict has effects, but none that acts on the mean."""
    verdict = diagnosis.verdict
    assert verdict is not None
    return verdict.status in ('explained', 'inseparable') and not any(
        effect_named(e).acts_on is ActsOn.MEAN for e in verdict.best.effects)


def closes(diagnosis: Diagnosis) -> bool:
    """Determine whether there is a gap, and effects that change the mean."""
    assert diagnosis.verdict is not None and diagnosis.gap_closure is not None
    return diagnosis.verdict.status in ('explained', 'inseparable', 'unknown') \
        and bool(np.isfinite(diagnosis.gap_closure.closed)) and any(
            effect_named(e).acts_on is ActsOn.MEAN for e in diagnosis.verdict.best.effects)


def closed_text(diagnosis: Diagnosis) -> str:
    """Return the closed share with its 90 % interval."""
    assert diagnosis.gap_closure is not None
    closure, noisy = diagnosis.gap_closure, bool(diagnosis.noise_remainders)
    low, high = (percent(share, noisy) for share in closure.closed_ci)
    closed = percent(closure.closed, noisy)
    if low == high == closed:
        return f'{closed} %'
    return f'{closed} % ({low if low == high else f"{low} to {high}"} %)'


def percent(share: float, noisy: bool) -> str:
    """
    Return a share in per cent. Where noise-like effects stay, it is never 100.

    Parameters
    ----------
    share
        The share, at most 1.
    noisy
        Whether noise-like effects stay.

    Returns
    -------
    str
        The percentage without its sign.

    """
    if share >= _NEARLY_ALL and (noisy or share < _ALL):
        return '> 99'
    return f'{100 * share:.0f}'


def mg(value_mps2: Any) -> Any:
    """Convert m/s² to mg."""
    return 1e3 * value_mps2 / G0_MPS2


def mg_text(value_mps2: float) -> str:
    """Return an acceleration, m/s², in mg with three digits at most."""
    value = float(mg(value_mps2))
    if 0 < abs(value) < _SMALLEST_MG:
        return f'< {2 * _SMALLEST_MG:g} mg'
    digits = 2 if abs(value) < 10 else 1 if abs(value) < 100 else 0
    return f'{value:.{digits}f} mg'


def floor_source(diagnosis: Diagnosis) -> str:
    """Return in words what determines the noise floor."""
    assert diagnosis.noise_floor is not None
    return _FLOOR_SOURCES[diagnosis.noise_floor.source]


def probability_text(probability: float) -> str:
    """Return a probability in per cent; only certainty by definition would be 0 or 100 %."""
    if probability >= _NEARLY_ALL:
        return '> 99 %'
    return '< 1 %' if probability < 1 - _NEARLY_ALL else f'{100 * probability:.0f} %'


def p_text(p: float) -> str:
    """Return a probability as text."""
    return '< 0.001' if p < 1e-3 else f'{p:.3f}'


def range_text(low: float, high: float) -> str:
    """
    Return a range with as many digits as its width needs.

    Parameters
    ----------
    low, high
        Range of a dimension, in its unit.

    Returns
    -------
    str
        Both ends, or one figure where they are equal.

    """
    digits = int(np.clip(np.ceil(1.0 - np.log10(max(high - low, 1e-6))), 0, 4))
    low_text, high_text = (f'{round(v, digits) + 0.0:.{digits}f}' for v in (low, high))
    return low_text if low_text == high_text else f'{low_text} to {high_text}'


def parameter_text(parameter: dict[str, Any]) -> str:
    """Return a parameter of the report with interval and unit, or that it is not determined."""
    if not parameter.get('determined', True):
        others = parameter['not_separated_from']
        return f'not determined separately from {", ".join(others)}' if others \
            else 'not determined'
    if 'ci' not in parameter:
        values, unit = _with_prefix(np.atleast_1d(parameter['value']).tolist(),
                                    parameter['unit'])
        return f'{", ".join(f"{v:.4g}" for v in values)} {unit}'.rstrip()
    values, unit = _with_prefix([parameter['value'], *parameter['ci']], parameter['unit'])
    width = max(values[2] - values[1], 1e-12)
    digits = int(np.clip(np.ceil(1.0 - np.log10(width)), 0, 6))
    value, low, high = (f'{v:.{digits}f}' for v in values)
    return f'{value} ({low} to {high}) {unit}'.rstrip()


def _with_prefix(values: Sequence[float], unit: str) -> tuple[list[float], str]:
    """Return values and unit, with a prefix where they are small, and angles in degrees."""
    if unit == 'rad':
        return [float(np.degrees(v)) for v in values], '°'
    if unit == '1':
        return list(values), ''
    base, largest = unit.split('/')[0].split('^')[0], max(map(abs, values))
    if base not in _PREFIXED or largest >= _PREFIX_BELOW or '^' in unit.split('/')[0]:
        return list(values), unit.replace('^2', '²')
    factor, prefix = (1e3, 'm') if largest >= _PREFIX_BELOW * 1e-3 else (1e6, 'µ')
    return [factor * v for v in values], prefix + unit.replace('^2', '²')
