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
from xml.etree import ElementTree

from adxl_ros.calibrate.report import gum
from adxl_ros.calibrate.report.acceptance import FAIL, PASS
from adxl_ros.calibrate.report.coefficients import compare
from adxl_ros.calibrate.report.gum import Uncertainty
from adxl_ros.calibrate.result import CalibrationResult
from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import write_bytes
from adxl_ros.files.parameter_file import compose
from adxl_ros.model.constants import G0_MPS2, Z_90
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


def _element(name: str, *content: Any, **attributes: str) -> ElementTree.Element:
    """Make an element of DCC, or with `si:` of D-SI, from a text or from its children."""
    prefix, _, local = name.rpartition(':')
    made = ElementTree.Element(f'{{{NAMESPACES[prefix or "dcc"]}}}{local}', attributes)
    for child in content:
        if isinstance(child, ElementTree.Element):
            made.append(child)
        elif child is not None:
            made.text = ' '.join(str(child).split())
    return made


def _text(name: str, text: str) -> ElementTree.Element:
    return _element(name, _element('content', text, lang='en'))


def _numbers(values: Any) -> str:
    return ' '.join(f'{value:.7g}' for value in np.ravel(values))


def _quantity(name: str, values: Any, unit: str, std: Any = None, about: str = '',
              kind: str = '') -> ElementTree.Element:
    """Make a quantity of one value, or of a list, with the expanded uncertainty of each."""
    end = 'XMLList' if np.ndim(values) else ''
    expanded = None if std is None else _element(
        f'si:expandedUnc{end}',
        _element(f'si:uncertainty{end}', _numbers(gum.K * np.asarray(std))),
        _element(f'si:coverageFactor{end}', gum.K),
        _element(f'si:coverageProbability{end}', 0.95),
        _element(f'si:distribution{end}', 'normal'))
    return _element(
        'quantity', _text('name', name), _text('description', about) if about else None,
        _element('si:realListXMLList' if end else 'si:real',
                 _element(f'si:value{end}', _numbers(values)),
                 _element(f'si:unit{end}', unit), expanded), **({'refType': kind} if kind else {}))


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
    """Write the certificate of a calibration against a stage."""
    found = gum.uncertainty(result, laboratory)
    if found is None:
        raise UserError(f'{path}: a certificate states errors at stage angles, and no pose with '
                        'angles was kept out of the fit; leave --dcc out')
    root = _element('digitalCalibrationCertificate',
                    _administrative(result, found, laboratory),
                    _element('measurementResults', _results(result, found, laboratory)),
                    schemaVersion=SCHEMA_VERSION)
    for prefix, uri in NAMESPACES.items():
        ElementTree.register_namespace(prefix, uri)
    ElementTree.indent(root)
    write_bytes(path, ElementTree.tostring(root, 'utf-8', xml_declaration=True))


def _contact(name: str, who: str, laboratory: dict[str, Any]) -> ElementTree.Element:
    return _element(
        name, _text('name', laboratory[f'{who}_name']),
        _element('eMail', laboratory[f'{who}_email']),
        _element('location', _element('city', laboratory[f'{who}_city']),
                 _element('countryCode', laboratory[f'{who}_country'])))


def _identified(issuer: str, value: str, name: str) -> ElementTree.Element:
    return _element('identifications', _element(
        'identification', _element('issuer', issuer), _element('value', value),
        _text('name', name)))


def _administrative(result: CalibrationResult, found: Uncertainty, laboratory: dict[str, Any]
                    ) -> ElementTree.Element:
    fitted = result.fitted
    provenance, date = fitted.provenance, fitted.provenance['date'][:10]
    item = _element(
        'item', _text('name', f'accelerometer, axes {fitted.axes}'),
        _element('manufacturer', _text('name', laboratory['manufacturer'])),
        _element('model', fitted.datasheet_name or NOT_STATED),
        _identified('manufacturer', fitted.serial, 'serial number'))
    return _element(
        'administrativeData',
        _element('dccSoftware', _element('software', _text('name', 'adxl_ros'),
                                         _element('release', provenance['package_version']))),
        _element('coreData', _element('countryCodeISO3166_1', laboratory['laboratory_country']),
                 _element('usedLangCodeISO639_1', 'en'),
                 _element('mandatoryLangCodeISO639_1', 'en'),
                 _element('uniqueIdentifier', laboratory['identifier']
                          or f'adxl_ros-{provenance["id"]}'),
                 _identified('other', provenance['data_sha256'], 'SHA-256 of the recordings'),
                 _element('beginPerformanceDate', date), _element('endPerformanceDate', date),
                 _element('performanceLocation', laboratory['place'])),
        _element('items', item),
        _element('calibrationLaboratory', _contact('contact', 'laboratory', laboratory)),
        _element('respPersons', _element(
            'respPerson', _element('person', _text('name', laboratory['responsible'])),
            _element('mainSigner', 'true'))),
        _contact('customer', 'customer', laboratory),
        _element('statements', *(_conformity(found, row) for row in found.decisions)))


def _conformity(found: Uncertainty, row: gum.Decision) -> ElementTree.Element:
    """State a decision, with the figures that it follows from."""
    word = {PASS: 'pass', FAIL: 'fail'}.get(
        row.outcome, 'conditionalPass' if row.error <= row.limit else 'conditionalFail')
    unit, factor = (_ACCELERATION, 1e-3 * G0_MPS2) if row.unit == 'mg' else (r'\degree', 1.0)
    figures = (('error of the calibration', row.error, 'basic_measuredValue'),
               ('guard band', row.guard_band, ''),
               (f'limit by the {found.limit_name}', row.limit, 'basic_acceptanceLimitUpper'))
    return _element(
        'statement', _element('norm', 'ISO/IEC 17025:2017'), _element('reference', '7.8.6'),
        _text('declaration', f'{row.quantity}: {row.outcome}. Decision rule: {gum.RULE}'),
        _element('conformity', word),
        _element('data', *(_quantity(name, factor * value, unit, kind=kind)
                           for name, value, kind in figures)), refType='basic_conformity')


def _results(result: CalibrationResult, found: Uncertainty, laboratory: dict[str, Any]
             ) -> ElementTree.Element:
    fitted, (worst, axis) = result.fitted, found.worst
    points = [_element('list', *(
        _quantity(*row) for row in (
            ('alpha', np.degrees(found.alpha_rad), r'\degree'),
            ('beta', np.degrees(found.beta_rad), r'\degree'),
            (f'reference acceleration along {name}', found.reference_mps2[:, d], _ACCELERATION,
             None, '', 'basic_referenceValue'),
            (f'measured acceleration along {name}',
             (found.reference_mps2 + found.error_mps2)[:, d], _ACCELERATION, None, '',
             'basic_measuredValue'),
            (f'error along {name}', found.error_mps2[:, d], _ACCELERATION,
             found.combined_mps2[:, d], '', 'basic_measurementError'))))
        for d, name in enumerate(fitted.axes)]
    fit = [_quantity(f'{row.label} {row.axis}', factor * row.fitted, unit,
                     factor * row.half_width / Z_90, row.name)
           for row in compare(fitted, fitted) for unit, factor in [si_unit(row.unit)]]
    budget = [_quantity(cells[0], row.contribution_mps2[worst, axis], _ACCELERATION, None,
                        f'standard uncertainty {cells[1]}, sensitivity {cells[2]}, degrees of '
                        f'freedom {cells[4]}')
              for cells, row in zip(gum.budget_rows(found), found.inputs)]
    conditions = [_quantity('local gravity', fitted.local_gravity_mps2, _ACCELERATION)]
    conditions += [_quantity(f'{name} temperature', value + 273.15, r'\kelvin') for name, value in
                   zip(('lowest', 'highest'), fitted.envelope.temperature_c or ())]
    return _element(
        'measurementResult', _text('name', 'Calibration of an accelerometer in the gravity field'),
        _element('usedMethods', _element(
            'usedMethod', _text('name', 'Expanded uncertainty'),
            _text('description', f'{gum.MEANING} {gum.MODEL}'), _element('norm', 'JCGM 100:2008'),
            refType='basic_uncertainty')),
        _element('measuringEquipments', _element(
            'measuringEquipment', _text('name', 'rotary stage of two axes'),
            _text('description', f'step {np.degrees(fitted.stage_resolution_rad):.4f}°; '
                  f'identification and certificate: {laboratory["stage"]}'),
            refType='basic_normalUsed')),
        _element('influenceConditions', _element(
            'influenceCondition', _text('name', 'Conditions'), _element('data', *conditions))),
        _element('results', *(
            _element('result', _text('name', name), _element('data', *data)) for name, data in (
                ('Errors at poses that the fit has not seen', points),
                ('Coefficients', fit),
                ('Uncertainty budget at the pose of the largest uncertainty', budget)))))
