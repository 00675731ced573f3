# SPDX-License-Identifier: Apache-2.0

"""Uncertainty by the GUM, checked on simulated units, and the certificate that states it."""

from dataclasses import replace
import os
from pathlib import Path
from xml.etree import ElementTree

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.fits.full_model import TERMS
from adxl_ros.calibrate.report import certificate_data, error_causes, gum
from adxl_ros.errors import UserError
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.kinematics import specific_force
import numpy as np
import pytest
from units import drawn, nominal, swept

pytestmark = pytest.mark.long

GRAVITY_MPS2, GRAVITY_STD_MPS2 = 9.80131, 5e-4
NAMESPACES = {'dcc': 'https://ptb.de/dcc', 'si': 'https://ptb.de/si'}
SCHEMA = Path(os.environ.get('DCC_SCHEMA', ''))
"""Folder with dcc.xsd, and with the schemas of its imports as SI_Format.xsd and xmldsig.xsd."""
IMPORTS = {
    'https://ptb.de/si/v2.1.0/SI_Format.xsd': 'SI_Format.xsd',
    'https://www.w3.org/TR/xmldsig-core/xmldsig-core-schema.xsd': 'xmldsig.xsd',
}


def calibrated(seed, axes='xy', model=None, gravity_mps2=GRAVITY_MPS2):
    rng = np.random.default_rng([seed, 17])
    sensor = nominal(axes, serial='<7 & 8>', local_gravity_mps2=gravity_mps2)
    truth = replace(
        drawn(rng, sensor, TERMS),
        local_gravity_mps2=gravity_mps2 + GRAVITY_STD_MPS2 * rng.normal(),
    )
    poses = swept(rng, truth)
    return truth, calibration.calibrate(sensor, [calibration.RecordedPoses('made', poses)], model)


@pytest.fixture(scope='module')
def found():
    _, result = calibrated(1)
    return result, gum.uncertainty(result)


@pytest.mark.parametrize(('axes', 'units'), [('xy', 5), ('xyz', 3)])
def test_the_expanded_interval_holds_for_drawn_units(axes, units):
    """
    At stated poses, all inputs are drawn anew: stage, noise, temperature, gravity by unit.

    The largest part is uniform, so that k = 2 holds in more than 95 %: the standard uncertainty is
    checked, too.
    """
    ratios, columns = [], [AXES.index(axis) for axis in axes]
    for seed in range(units):
        truth, result = calibrated(seed, axes)
        table = gum.uncertainty(result)
        rng, alpha, beta = np.random.default_rng([seed, 18]), table.alpha_rad, table.beta_rad
        std_v = noise.sample_std_v(truth) / np.sqrt(
            noise.effective_samples(5000, 1e-3, truth.rc_s)
        )
        z_sign = np.where(np.cos(alpha) < 0, -1, 1)
        stated = np.column_stack(specific_force(alpha, beta, truth.local_gravity_mps2))
        for _ in range(20):
            slip = truth.stage_resolution_rad * rng.uniform(-0.5, 0.5, (2, len(alpha)))
            force = specific_force(alpha + slip[0], beta + slip[1], truth.local_gravity_mps2)
            volts = np.column_stack(signal_chain.static_response(truth)(list(force)))
            drift_g = rng.uniform(-2, 2, (len(alpha), 1)) * 1e-4 * rng.normal(size=len(axes))
            volts += drift_g * truth.scale_v_per_g + std_v * rng.normal(size=volts.shape)
            got = np.column_stack(signal_chain.inverse(result.fitted, z_sign)(list(volts.T)))
            ratios.append(((got - stated)[:, columns] / table.combined_mps2).ravel())
    ratios = np.concatenate(ratios)
    assert 0.9 < np.sqrt(np.mean(ratios**2)) < 1.1
    assert 0.94 < np.mean(np.abs(ratios) < gum.K) < 0.99


def test_the_table_adds_up_and_has_the_numbers_of_the_error_budget(found):
    """Each contribution is uncertainty times sensitivity; PASS follows from the figures."""
    result, table = found
    assessment, at = result.assessments[-1], table.worst
    for row, part in zip(table.inputs, ('noise', 'coefficients', None, 'model')):
        if part:
            assert np.mean(row.contribution_mps2**2) == pytest.approx(
                getattr(assessment.accel, part), rel=1e-9
            )
    parts_mg = [1e3 * row.contribution_mps2[at] / G0_MPS2 for row in table.inputs]
    section = gum.section(table)
    assert section['combined'] == f'{np.sqrt(np.sum(np.square(parts_mg))):.3f} mg'
    assert [row[3] for row in section['budget']] == [f'{part:.3f}' for part in parts_mg]
    accel, tilt = table.decisions
    assert accel.error == pytest.approx(assessment.error_mg)
    assert (
        (accel.outcome, tilt.outcome)
        == (assessment.accel_outcome, assessment.tilt_outcome)
        == ('PASS', 'PASS')
    )
    assert accel.error + accel.guard_band <= accel.limit


def test_degrees_of_freedom(found):
    """They are at least those of the part with the fewest, and infinite without type A."""
    _, table = found
    assert [np.isfinite(row.freedom) for row in table.inputs[:2]] == [True, True]
    assert (table.freedom >= min(row.freedom for row in table.inputs) - 1e-9).all()
    certain = replace(table, inputs=tuple(replace(row, freedom=np.inf) for row in table.inputs))
    assert (certain.freedom > 1e9).all()
    section = gum.section(table)
    assert 1.95 < float(section['factor']) < 2.2


def test_a_certificate_states_what_the_laboratory_says(found, tmp_path):
    path = tmp_path / 'lab.yaml'
    path.write_text('laboratory_name: Lab & Sons\nlaboratory_country: DE\nstage: no. 7\n')
    gum.write(tmp_path / 'cert.xml', found[0], certificate_data.read(path))
    validate(tmp_path / 'cert.xml')
    texts = [element.text for element in ElementTree.parse(tmp_path / 'cert.xml').iter()]
    assert texts.count('Lab & Sons') == 1
    assert texts.count('DE') == 2
    assert any((text or '').endswith('certificate: no. 7') for text in texts)
    for text, message in (
        ('labratory_name: x\n', 'lab.yaml:1:1: labratory_name: unknown key'),
        ('person: x\ncustomer_country: Germany\n', "lab.yaml:2:1: customer_country: 'Germany'"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            certificate_data.read(path)


def test_the_stage_knows_on_which_side_of_90_degrees_a_pose_is(found):
    errors = next(row for row in found[0].held_out if row.model == 'full')
    held = found[0].poses.subset(errors.pose_index)
    force = np.column_stack(
        specific_force(0 * held.beta_rad + np.radians(87), held.beta_rad, GRAVITY_MPS2)
    )
    by_coefficients = error_causes.covariances(errors, held, force).by_coefficients
    assert np.sqrt(by_coefficients[0, 0].max()) < 2e-3


def test_standard_gravity_is_no_local_gravity():
    _, result = calibrated(2, model='linear', gravity_mps2=G0_MPS2)
    table = gum.uncertainty(result)
    assert 'B, not local: anywhere' in [row.kind for row in table.inputs]
    assert 'FAIL' in {row.outcome for row in table.decisions}


def children(element):
    return [child.tag.partition('}')[2] for child in element]


def test_a_certificate_has_the_elements_of_the_schema(found, tmp_path):
    """The elements and their order are compared by name; with DCC_SCHEMA, by the schema itself."""
    result, _ = found
    gum.write(tmp_path / 'cert.xml', result)
    validate(tmp_path / 'cert.xml')
    root = ElementTree.parse(tmp_path / 'cert.xml').getroot()
    assert root.tag == '{https://ptb.de/dcc}digitalCalibrationCertificate'
    assert root.get('schemaVersion') == gum.SCHEMA_VERSION
    administrative, measured = root
    assert children(administrative) == [
        'dccSoftware',
        'coreData',
        'items',
        'calibrationLaboratory',
        'respPersons',
        'customer',
        'statements',
    ]
    assert children(administrative[1]) == [
        'countryCodeISO3166_1',
        'usedLangCodeISO639_1',
        'mandatoryLangCodeISO639_1',
        'uniqueIdentifier',
        'identifications',
        'beginPerformanceDate',
        'endPerformanceDate',
        'performanceLocation',
    ]
    assert children(measured[0]) == [
        'name',
        'usedMethods',
        'measuringEquipments',
        'influenceConditions',
        'results',
    ]
    text = {element.text for element in root.iter()}
    assert {'<7 & 8>', 'pass', 'not stated'} <= text
    named, table = NAMESPACES, gum.uncertainty(result)
    errors = [
        part
        for part in root.iterfind('.//dcc:quantity', named)
        if part.get('refType') == 'basic_measurementError'
    ]
    for d, part in enumerate(errors):
        values, expanded = (
            np.array(part.find(f'.//si:{tag}', named).text.split(), float)
            for tag in ('valueXMLList', 'uncertaintyXMLList')
        )
        np.testing.assert_allclose(values, table.error_mps2[:, d], rtol=1e-6)
        np.testing.assert_allclose(expanded, 2 * table.combined_mps2[:, d], rtol=1e-6)
    assert len(errors) == 2
    (scale,) = (
        part
        for part in root.iterfind('.//dcc:quantity', named)
        if part.findtext('.//dcc:name/dcc:content', namespaces=named) == 'scale factor x'
    )
    assert (
        scale.findtext('.//si:unit', namespaces=named) == r'\volt\metre\tothe{-1}\second\tothe{2}'
    )
    assert float(scale.findtext('.//si:value', namespaces=named)) == pytest.approx(
        result.fitted.scale_v_per_g[0] / G0_MPS2
    )


def validate(path):
    """Validate against the schema of PTB, if the environment names a copy of it."""
    if not (SCHEMA / 'dcc.xsd').is_file():
        return
    etree = pytest.importorskip('lxml.etree')
    text = (SCHEMA / 'dcc.xsd').read_text()
    for address, name in IMPORTS.items():
        text = text.replace(address, str(SCHEMA / name))
    etree.XMLSchema(etree.fromstring(text.encode())).assertValid(etree.parse(str(path)))


def test_what_a_polynomial_over_temperature_lacks_is_a_part_of_the_uncertainty(found):
    """The stated deviation of the corrected acceleration holds the same."""
    result, table = found
    envelope = replace(
        result.fitted.envelope,
        temperature_c=(20.0, 60.0),
        zero_g_nodes_c=(22.0, 40.0, 58.0),
        zero_g_next=(1e-7, 2e-7),
        zero_g_at_c=25.0,
    )
    poses = replace(result.poses, temperature_c=np.full(len(result.poses), 75.0))
    fitted = replace(result.fitted, envelope=envelope)
    wider = gum.uncertainty(replace(result, fitted=fitted, poses=poses))
    added = G0_MPS2 * np.array(envelope.zero_g_std_g(75.0))
    assert wider.inputs[-1].contribution_mps2 == pytest.approx(
        np.tile(np.abs(added), (len(wider.alpha_rad), 1))
    )
    assert (wider.combined_mps2 > table.combined_mps2).all()
