# SPDX-License-Identifier: Apache-2.0

"""The full model: coverage of intervals, gauge, outliers, stage errors, contradictions."""

from dataclasses import replace

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.fits import full_model, term_selection
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import get, put, with_neutral
import numpy as np
from pace import within
import pytest
from units import drawn, NOMINAL, nominal, PLANES_RAD, swept

pytestmark = pytest.mark.long

TERMS = full_model.TERMS


def swept_unit(seed, axes='xy', stage_deg=5 / 60, **options):
    """Draw a unit with all terms and sweep it; return nominal sensor, unit and poses."""
    rng = np.random.default_rng(seed)
    sensor = nominal(axes)
    truth = drawn(rng, sensor, full_model.default_terms(axes))
    poses = swept(rng, replace(truth, stage_resolution_rad=np.radians(stage_deg)), **options)
    return sensor, truth, poses


def errors(fit, truth):
    """Return errors of the coefficients and their standard deviations, (p,) each."""
    names = fit.fitted.covariance_names
    truth = with_neutral(truth, {name.effect for name in names})
    return (get(fit.fitted, names) - get(truth, names), np.sqrt(np.diag(fit.fitted.covariance)))


@pytest.mark.parametrize('axes, units, per_setting', [('xy', 40, True), ('xyz', 24, False)])
def test_ninety_percent_intervals_cover_ninety_percent(axes, units, per_setting):
    """The coverage is right over hundreds of intervals, for all kinds of stage errors."""
    z = np.concatenate(
        [
            np.divide(*errors(full_model.fit_full(sensor, poses), truth))
            for sensor, truth, poses in (
                swept_unit(k, axes, per_setting=per_setting) for k in range(units)
            )
        ]
    )
    assert len(z) > 550
    assert 0.875 < np.mean(np.abs(z) < Z_90) < 0.93


@pytest.mark.parametrize('eccentric', [False, True])
def test_an_eccentric_stage_is_identified_and_a_sound_one_has_no_such_term(eccentric):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = drawn(rng, nominal(), (*TERMS, 'stage_eccentricity'))
        names = full_model.fitted_coefficients('xy', ('stage_eccentricity',))[2:]
        truth = put(truth, names, eccentric * 1e-3 * rng.choice([-1, 1], len(names)))
        fit, _ = term_selection.fit_selected(nominal(), swept(rng, truth, per_setting=True))
        assert any('eccentricity' in name.effect for name in fit.names) == eccentric
        error, std = errors(fit, truth)
        assert np.sqrt(np.mean((error / std) ** 2)) < 2


def test_a_term_that_is_not_convex_is_fitted_from_several_starts():
    """The periods of an ADC's nonlinearity are right, far from the typical value."""
    sensor, truth, _ = swept_unit(3)
    truth = with_neutral(truth, ['adc_inl'])
    values = {**truth.values['adc_inl'], 'amplitude_v': np.array(1e-3), 'cycles': np.array(17.3)}
    truth = replace(truth, values={**truth.values, 'adc_inl': values})
    poses = swept(np.random.default_rng(1), truth, check_poses=0)
    fit = full_model.fit_full(sensor, poses, (*TERMS, 'adc_inl')).with_stage.values['adc_inl']
    assert fit['cycles'] == pytest.approx(17.3, rel=0.01)
    assert fit['amplitude_v'] == pytest.approx(1e-3, rel=0.15)


def test_the_gauge_is_fixed_where_only_the_sum_is_identifiable():
    """Linear cross-axis terms only are a misalignment, and cross_axis.linear stays 0."""
    rng = np.random.default_rng(3)
    truth = drawn(rng, nominal(), ('bias', 'scale_factor', 'misalignment'))
    truth = with_neutral(truth, ['cross_axis', 'cross_axis_z'])
    truth = put(
        truth,
        [Coefficient('cross_axis', 'linear', 'x'), Coefficient('cross_axis_z', 'linear', 'y')],
        [0.012, -0.02],
    )
    poses = swept(rng, truth)
    fit, _ = term_selection.fit_selected(nominal(), poses)
    assert not set(full_model.GAUGE) & {
        full_model.term_of(name) for name in fit.fitted.covariance_names
    }
    assert fit.fitted.values['cross_axis']['linear'].tolist() == [0, 0]
    turned = fit.fitted.values['misalignment']['beta_rad'][0]
    assert turned == pytest.approx(truth.values['misalignment']['beta_rad'][0] + 0.012, abs=4e-4)


def test_outliers_are_named_and_excluded():
    sensor, truth, poses = swept_unit(5, check_poses=0)
    bad = [7, 40, 90]
    volts = poses.volts.copy()
    volts[bad] += [[0.01, 0.0], [0.0, -0.02], [0.03, 0.01]]
    fit, _ = term_selection.fit_selected(sensor, replace(poses, volts=volts))
    assert fit.outliers == tuple(bad)
    error, std = errors(fit, truth)
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.6
    assert any(
        'outliers, left out: pose 8 (alpha' in line for line in term_selection.warnings(fit, poses)
    )


def test_a_change_of_temperature_is_reported_and_fitted():
    sensor, truth, poses = swept_unit(10, check_poses=0)
    warm = replace(poses, temperature_c=np.linspace(20, 35, len(poses)))
    fit, _ = term_selection.fit_selected(sensor, warm)
    assert any(
        'temperature moved by 15.0 degC' in line for line in term_selection.warnings(fit, warm)
    )
    drift = 1e-3 * truth.scale_v_per_g * (warm.temperature_c[:, None] - 25)
    fit, _ = term_selection.fit_selected(sensor, replace(warm, volts=warm.volts + drift))
    assert fit.fitted.values['temperature_bias']['per_k'] == pytest.approx([1e-3] * 2, rel=0.1)
    assert not any('temperature moved' in line for line in term_selection.warnings(fit, warm))


@pytest.mark.parametrize(
    'planes_deg, lost', [([90], 'cross_axis_z.quadratic_per_g'), ([90, 60], 'scale_factor_z')]
)
def test_poses_of_too_few_planes_are_refused(planes_deg, lost):
    sensor, _, poses = swept_unit(1, planes_rad=np.radians(planes_deg), check_poses=0)
    with pytest.raises(
        UserError, match=rf'do not determine .*{lost}.*add poses \(alpha, beta\) = '
    ):
        full_model.fit_full(sensor, poses)


def test_a_simpler_model_is_fitted_if_the_full_one_is_not_determined():
    sensor, _, poses = swept_unit(1, planes_rad=PLANES_RAD[2:3], check_poses=0)
    fit = calibration.calibrate(sensor, [calibration.RecordedPoses('made', poses)])
    assert fit.fitted.model == 'linear'
    assert fit.warnings[-2].startswith('not full: the full model is not determined')
    assert fit.warnings[-1].startswith('not physical: ')


@pytest.mark.parametrize(
    'change',
    [
        lambda truth: put(
            truth,
            [Coefficient('misalignment', 'alpha_rad', axis) for axis in 'xy'],
            truth.values['misalignment']['alpha_rad'] + [0.02, 0.02],
        ),
        lambda truth: put(
            truth,
            [Coefficient('bias', 'offset_v', 'x')],
            truth.values['bias']['offset_v'][:1] + 0.08,
        ),
    ],
)
def test_recordings_that_contradict_each_other_are_refused(change):
    rng = np.random.default_rng(12)
    truth = drawn(rng, nominal(), TERMS)
    parts = [swept(rng, unit, check_poses=0) for unit in (truth, truth, change(truth))]
    with pytest.raises(UserError, match=r'(turned|shifted) by .* standard dev.*: another unit'):
        calibration.calibrate(
            nominal(),
            [calibration.RecordedPoses(f'{name}.csv', part) for name, part in zip('abc', parts)],
            'full',
        )


@pytest.mark.perf
def test_six_hundred_poses_of_three_axes_take_two_seconds():
    """The time includes stage errors and the selection of terms."""
    sensor, _, poses = swept_unit(2, 'xyz', planes_rad=np.radians(np.linspace(0, 180, 23)))
    assert len(poses) > 600
    with within(2.0):
        fit, _ = term_selection.fit_selected(sensor, poses)
    assert len(fit.names) >= 20


def test_the_noise_determines_the_filter_time_constant(run_tool, tmp_path):
    run_tool(
        'simulate',
        'sweep',
        '--params',
        NOMINAL,
        '--effect',
        'bandwidth:resistance_ratio.x=0.2,resistance_ratio.y=-0.15',
        '--effect',
        'misalignment',
        '-o',
        tmp_path / 'sweep.csv',
    )
    done = run_tool('fit', tmp_path / 'sweep.csv', '-o', tmp_path / 'unit.yaml')
    assert done.returncode == 0, done.stderr
    assert '#   bandwidth.resistance_ratio ' in (tmp_path / 'unit.yaml').read_text()
    fitted = parameter_file.load(tmp_path / 'unit.yaml')
    assert fitted.model == 'full'
    ratio = fitted.values['bandwidth']['resistance_ratio']
    assert ratio == pytest.approx([0.2, -0.15], abs=0.04)
    std = np.sqrt(np.diag(fitted.covariance))[-2:]
    assert np.abs((ratio - [0.2, -0.15]) / std).max() < 4
