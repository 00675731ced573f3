# SPDX-License-Identifier: Apache-2.0

"""
A calibration as Digital Calibration Certificate: XML by the schema DCC 3.2.0 of PTB, D-SI 2.1.0.

What the tool cannot know comes from a file of the laboratory, or is marked as not stated.
"""

from __future__ import annotations

from collections import Counter
import math
import os
import re
from typing import Any

from adxl_ros.calibrate.report import gum
from adxl_ros.calibrate.report.acceptance import FAIL, PASS
from adxl_ros.calibrate.report.coefficients import compare
from adxl_ros.calibrate.report.gum import Uncertainty
from adxl_ros.calibrate.result import CalibrationResult
from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.parameter_file import compose
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
import numpy as np
import yaml

SCHEMA_VERSION = '3.2.0'
"""Version of the schema."""
NAMESPACES = {'dcc': 'https://ptb.de/dcc', 'si': 'https://ptb.de/si'}
"""Name spaces of the elements."""
NOT_STATED = 'not stated'
"""What stands where the laboratory states nothing."""
PLACES = ('laboratory', 'customer', 'laboratoryBranch', 'customerBranch', 'other')
"""Places of a calibration that the schema knows."""
_LABORATORY = {
    **{f'{who}_{what}': NOT_STATED for who in ('laboratory', 'customer')
       for what in ('name', 'email', 'city')},
    'laboratory_country': 'ZZ', 'customer_country': 'ZZ', 'place': 'other',
    'responsible': NOT_STATED, 'manufacturer': NOT_STATED, 'stage': NOT_STATED, 'identifier': ''}
"""Texts of a laboratory's file, and what stands for those that are missing; ZZ is no country."""
_UNITS = {'V': 'volt', 'rad': 'radian', '°': 'degree', 'K': 'kelvin', 's': 'second', 'm': 'metre'}
"""Units of D-SI; all others count as 1."""
_ACCELERATION = r'\metre\second\tothe{-2}'


def read_laboratory(path: str | os.PathLike | None) -> dict[str, Any]:
    """Read the texts and the standard uncertainties of a laboratory's YAML file; None has none."""
    node = compose(path) if path is not None else None
    given = yaml.constructor.SafeConstructor().construct_document(node) if node else {}
    known = (*_LABORATORY, *gum.STATED)
    unknown = [str(name) for name in given if name not in known] if isinstance(given, dict) else \
        ['no mapping']
    if unknown:
        raise UserError(f'{path}: found {", ".join(unknown)}; expected a mapping with some of '
                        f'{", ".join(known)}')
    for name, value in given.items():
        if name in gum.STATED:
            if not isinstance(value, (int, float)) or not 0 <= value < math.inf:
                raise UserError(f'{path}: {name}: {value!r} is no number such as 1.0e-5')
        elif not isinstance(value, str) or not value.strip():
            raise UserError(f'{path}: {name}: {value!r} is no text')
        elif name.endswith('country') and not re.fullmatch('[A-Z]{2}', value):
            raise UserError(f'{path}: {name}: {value!r} is no code of two capitals such as DE')
        elif name == 'place' and value not in PLACES:
            raise UserError(f'{path}: place: {value!r} is none of {", ".join(PLACES)}')
    return {**_LABORATORY, **given}


def _quantity(name: str, values: Any, unit: str, std: Any = None, about: str = '',
              kind: str = '') -> dict[str, Any]:
    """Describe a quantity of one value, or of a list, with the expanded uncertainty of each."""
    return {'name': name, 'about': about, 'kind': kind, 'unit': unit,
            'numbers': _numbers(values), 'is_list': np.ndim(values) > 0,
            'expanded': '' if std is None else _numbers(gum.K * np.asarray(std))}


def _numbers(values: Any) -> str:
    return ' '.join(f'{value:.7g}' for value in np.ravel(values))


def si_unit(unit: str) -> tuple[str, float]:
    """Return a unit such as V/g in D-SI, and the factor of its values: g is no unit there."""
    powers: Counter[str] = Counter()
    for sign, part in zip((1, -1), unit.replace('²', '^2').split('/')):
        base, _, power = part.partition('^')
        powers[base] += sign * int(power or 1)
    g = powers.pop('g', 0)
    powers['m'] += g
    powers['s'] -= 2 * g
    parts = [f'\\{_UNITS[base]}' + (f'\\tothe{{{power}}}' if power != 1 else '')
             for base, power in powers.items() if base in _UNITS and power]
    return ''.join(parts) or r'\one', G0_MPS2 ** g


def write(path: str | os.PathLike, result: CalibrationResult, laboratory: dict[str, Any]) -> None:
    """Write the certificate of a calibration against a stage, by the template of its elements."""
    found = gum.uncertainty(result, laboratory)
    if found is None:
        raise UserError(f'{path}: a certificate states errors at stage angles, and no pose with '
                        'angles was kept out of the fit; leave --dcc out')
    from jinja2 import Environment, PackageLoader, StrictUndefined
    environment = Environment(
        loader=PackageLoader('adxl_ros.calibrate.report', ''), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    fitted = result.fitted
    write_text(path, environment.get_template('certificate.xml').render(
        namespaces=NAMESPACES, schema_version=SCHEMA_VERSION, not_stated=NOT_STATED, k=gum.K,
        rule=gum.RULE, method=f'{gum.MEANING} {gum.MODEL}', fitted=fitted,
        provenance=fitted.provenance, step_deg=np.degrees(fitted.stage_resolution_rad),
        laboratory={name: ' '.join(str(words).split()) for name, words in laboratory.items()},
        decisions=[_decision(found, row) for row in found.decisions], **_results(fitted, found)))


def _decision(found: Uncertainty, row: gum.Decision) -> dict[str, Any]:
    """State a decision, with the figures that it follows from."""
    word = {PASS: 'pass', FAIL: 'fail'}.get(
        row.outcome, 'conditionalPass' if row.error <= row.limit else 'conditionalFail')
    unit, factor = (_ACCELERATION, 1e-3 * G0_MPS2) if row.unit == 'mg' else (r'\degree', 1.0)
    figures = (('error of the calibration', row.error, 'basic_measuredValue'),
               ('guard band', row.guard_band, ''),
               (f'limit by the {found.limit_name}', row.limit, 'basic_acceptanceLimitUpper'))
    return {'quantity': row.quantity, 'outcome': row.outcome, 'conformity': word,
            'figures': [_quantity(name, factor * value, unit, kind=kind)
                        for name, value, kind in figures]}


def _results(fitted: Sensor, found: Uncertainty) -> dict[str, list[Any]]:
    """Return errors, coefficients, budget and conditions as quantities."""
    worst, axis = found.worst
    errors = [
        [_quantity('alpha', np.degrees(found.alpha_rad), r'\degree'),
         _quantity('beta', np.degrees(found.beta_rad), r'\degree'),
         _quantity(f'reference acceleration along {name}', found.reference_mps2[:, d],
                   _ACCELERATION, kind='basic_referenceValue'),
         _quantity(f'measured acceleration along {name}',
                   (found.reference_mps2 + found.error_mps2)[:, d], _ACCELERATION,
                   kind='basic_measuredValue'),
         _quantity(f'error along {name}', found.error_mps2[:, d], _ACCELERATION,
                   found.combined_mps2[:, d], kind='basic_measurementError')]
        for d, name in enumerate(fitted.axes)]
    coefficients = [_quantity(f'{row.label} {row.axis}', factor * row.fitted, unit,
                              factor * row.half_width / Z_90, row.name)
                    for row in compare(fitted, fitted) for unit, factor in [si_unit(row.unit)]]
    budget = [_quantity(cells[0], row.contribution_mps2[worst, axis], _ACCELERATION, None,
                        f'standard uncertainty {cells[1]}, sensitivity {cells[2]}, degrees of '
                        f'freedom {cells[4]}')
              for cells, row in zip(gum.budget_rows(found), found.inputs)]
    conditions = [_quantity('local gravity', fitted.local_gravity_mps2, _ACCELERATION)]
    conditions += [_quantity(f'{name} temperature', value + 273.15, r'\kelvin') for name, value in
                   zip(('lowest', 'highest'), fitted.envelope.temperature_c or ())]
    return {'errors': errors, 'coefficients': coefficients, 'budget': budget,
            'conditions': conditions}
