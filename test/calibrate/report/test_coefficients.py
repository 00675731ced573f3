# SPDX-License-Identifier: Apache-2.0

"""Fitted coefficients compared with the true ones, and results as tables of a terminal."""

from dataclasses import replace
import re

from adxl_ros.calibrate.fits.full_model import TERMS
from adxl_ros.calibrate.report import acceptance, held_out
from adxl_ros.calibrate.report.acceptance import acceptance_lines, screen_table
from adxl_ros.calibrate.result import compare, truth_table
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import get, names_of, put, with_neutral
import numpy as np
import pytest
from units import drawn, nominal

LINEAR = (Coefficient('cross_axis', 'linear'), Coefficient('cross_axis_z', 'linear'))
STD = 1e-3


def fitted_of(truth, names, error=0.0):
    unit = with_neutral(truth, [name.effect for name in names])
    return replace(
        put(unit, names, get(unit, names) + error),
        model='full',
        covariance_names=names,
        covariance=STD**2 * np.eye(len(names)),
    )


def names_for(axes, terms=TERMS, without=()):
    return tuple(
        name
        for term in terms
        for name in names_of(effect_named(term), axes)
        if name.without_axis not in without
    )


def fitted_and_truth(error=0.0, axes='xy', without=LINEAR):
    truth = drawn(np.random.default_rng(1), nominal(axes))
    return fitted_of(truth, names_for(axes, without=without), error), truth


def coefficient_of(compared, name, axis):
    return next(row for row in compared if (row.name, row.axis) == (name, axis))


def test_each_fitted_coefficient_is_compared() -> None:
    fitted, truth = fitted_and_truth()
    compared = compare(fitted, truth)
    assert [f'{row.name}.{row.axis}' for row in compared] == list(
        map(str, fitted.covariance_names)
    )
    assert all(row.fitted == pytest.approx(row.truth, abs=1e-9) and row.inside for row in compared)
    zero_g = coefficient_of(compared, 'bias.offset_v', 'y')
    assert (zero_g.label, zero_g.unit) == ('zero-g', 'V')
    assert zero_g.truth == pytest.approx(truth.zero_g_v[1])
    assert zero_g.half_width == pytest.approx(1.6449 * STD)
    scale = coefficient_of(compared, 'scale_factor.offset_v_per_g', 'x')
    assert scale.truth == pytest.approx(truth.scale_v_per_g[0])
    alpha = coefficient_of(compared, 'misalignment.alpha_rad', 'x')
    assert (alpha.unit, alpha.half_width) == ('°', pytest.approx(np.degrees(1.6449 * STD)))
    assert alpha.truth == pytest.approx(np.degrees(truth.values['misalignment']['alpha_rad'][0]))
    assert coefficient_of(compared, 'cross_axis.quadratic_per_g', 'x').label == 'zero-g, y²'
    assert coefficient_of(compared, 'cross_axis.quadratic_per_g', 'y').label == 'zero-g, x²'
    assert coefficient_of(compared, 'scale_factor_z.quadratic_per_g2', 'y').label == 'scale, z²'
    # The unit does not have this effect.
    assert coefficient_of(compared, 'nonlinearity.cubic_per_g2', 'x').truth == 0


@pytest.mark.parametrize(
    ('error', 'inside'),
    [(1.6 * STD, True), (-1.6 * STD, True), (1.7 * STD, False), (-1.7 * STD, False)],
)
def test_an_interval_is_90_percent(error: float, inside: bool) -> None:
    assert {row.inside for row in compare(*fitted_and_truth(error))} == {inside}


def test_table_of_the_truth() -> None:
    fitted, truth = fitted_and_truth(without=())
    fitted = put(
        fitted,
        [Coefficient('scale_factor_z', 'quadratic_per_g2', 'x')],
        [truth.values['scale_factor_z']['quadratic_per_g2'][0] + 0.002],
    )
    lines = truth_table(compare(fitted, truth))
    rows = {re.sub(' +', ' ', line[:24]).strip(): line for line in lines}
    assert rows['zero-g x'].split()[2:] == [
        f'{truth.zero_g_v[0]:.4f}',
        '±',
        '0.0016',
        'V',
        f'{truth.zero_g_v[0]:.4f}',
        'ok',
    ]
    assert rows['scale, z² x'].endswith('   MISSED')
    assert rows['cubic y'].split()[-2:] == ['0', 'ok']
    assert rows['misalignment alpha y'].split()[6] == '°'
    assert [line.endswith('MISSED') for line in lines].count(True) == 1
    assert lines[-1] == ' (21 of 22 inside their 90 % intervals; about 20 are expected)'
    assert max(map(len, lines)) <= 79


def test_table_of_errors() -> None:
    errors = held_out.PoseErrors(
        np.full((3, 2), 0.45), np.radians(np.full(3, 7.2)), np.zeros((3, 3))
    )
    fitted = replace(errors, accel_mps2=errors.accel_mps2 / 100, tilt_rad=np.full(3, np.nan))
    models = [held_out.summarise('nominal', errors), held_out.summarise('full', fitted)]
    lines = screen_table(models)
    assert lines[1].split()[2:] == ['7.20', '°', '45.9', 'mg']
    assert lines[2].split() == ['full', 'calibration', '-', '°', '0.459', 'mg', '<-', 'saved']
    assert max(map(len, lines)) <= 79


@pytest.mark.parametrize(
    ('accel', 'tilt', 'begin'),
    [
        ('PASS', 'PASS', [' PASS  calibration error 0.20 mg; the datasheet allows 3.4 mg']),
        ('PASS', '', [' PASS  calibration error 0.20 mg; the datasheet allows 3.4 mg']),
        (
            'FAIL',
            'PASS',
            [' FAIL  calibration error 0.20 mg; the datasheet allows 3.4 mg', 'do not use'],
        ),
        ('PASS', 'FAIL', [' FAIL  tilt error 0.33°, more than 3.4 mg causes', 'do not use']),
        ('PASS', 'NOT SHOWN', [' NOT SHOWN  calibration error 0.20 mg', 'too few']),
    ],
)
def test_acceptance(accel: str, tilt: str, begin: list[str]) -> None:
    provenance = {
        'own_accel_mg': '0.201',
        'own_tilt_deg': '0.3251',
        'verdict': accel,
        'verdict_tilt': tilt,
    }
    lines = acceptance_lines(replace(fitted_and_truth()[0], provenance=provenance))
    assert len(lines) == len(begin) and max(map(len, lines)) <= 79
    assert all(text in line for text, line in zip(begin, lines))
    assert acceptance_lines(fitted_and_truth()[0])[0].startswith(f' {acceptance.NOT_SHOWN}')
