# SPDX-License-Identifier: Apache-2.0

"""The full model: coverage of intervals, gauge, outliers, stage errors, contradictions."""

from dataclasses import replace

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.fits import full_fit_text, full_model, term_selection
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get, put, with_neutral
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import specific_force
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
    return (get(fit.fitted, names) - get(truth, names),
            np.sqrt(np.diag(fit.fitted.covariance)))


@pytest.mark.parametrize('axes, units, per_setting', [
    ('xy', 70, False), ('xy', 70, True), ('xyz', 40, True)])
def test_ninety_percent_intervals_cover_ninety_percent(axes, units, per_setting):
    """The coverage is right over more than a thousand intervals, for all kinds of stage errors."""
    z = np.concatenate([np.divide(*errors(full_model.fit_full(sensor, poses), truth))
                        for sensor, truth, poses in (
                            swept_unit(k, axes, per_setting=per_setting) for k in range(units))])
    assert len(z) > 1000
    assert 0.875 < np.mean(np.abs(z) < Z_90) < 0.93


@pytest.mark.parametrize('per_setting', [True, False])
def test_the_kind_of_the_stage_error_is_identifiable(per_setting):
    """Errors by setting and by pose are separated, and their level is right."""
    levels = []
    for k in range(8):
        sensor, _, poses = swept_unit(k, per_setting=per_setting)
        stage = full_model.fit_full(sensor, poses).stage
        levels.append((stage.setting_rad, stage.pose_rad))
    setting, pose = np.degrees(np.median(levels, axis=0))
    wanted, other = (setting, pose) if per_setting else (pose, setting)
    assert wanted == pytest.approx(5 / 60 / np.sqrt(12), rel=0.1)
    assert other < 0.4 * wanted


@pytest.mark.parametrize('eccentric', [False, True])
def test_an_eccentric_stage_is_identified_and_a_sound_one_has_no_such_term(eccentric):
    """An eccentricity of 20 µm is identified, and no other."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = drawn(rng, nominal(), (*TERMS, 'stage_eccentricity'))
        names = full_model.fitted_coefficients('xy', ('stage_eccentricity',))[2:]
        truth = put(truth, names, eccentric * 1e-3 * rng.choice([-1, 1], len(names)))
        fit, _ = term_selection.fit_selected(nominal(), swept(rng, truth, per_setting=True))
        assert any('eccentricity' in name.effect for name in fit.names) == eccentric
        error, std = errors(fit, truth)
        assert np.sqrt(np.mean((error / std) ** 2)) < 2


def test_each_axis_of_a_three_axis_unit_has_its_cross_axis_terms():
    """A quadratic term of z is fitted to the noise, and does not appear as stage error."""
    sensor, truth, poses = swept_unit(4, 'xyz', 0.0, check_poses=0,
                                      planes_rad=np.radians(np.arange(0, 181, 30)))
    fit, _ = term_selection.fit_selected(sensor, poses)
    bent = truth.values['cross_axis']['quadratic_per_g'][2]
    assert abs(bent) > 1e-3
    assert fit.fitted.values['cross_axis']['quadratic_per_g'][2] == pytest.approx(bent, abs=2e-4)
    assert np.degrees(fit.stage_std_rad) < 2e-3
    error, std = errors(fit, truth)
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.4


def test_a_fit_that_does_not_converge_is_reported(monkeypatch):
    """The text of the fit contains the warning only if the fit does not converge."""
    sensor, _, poses = swept_unit(2)
    fit, terms = term_selection.fit_selected(sensor, poses)
    assert fit.converged
    assert full_fit_text.NOT_CONVERGED not in full_fit_text.report_lines(fit, poses, terms)
    monkeypatch.setattr(full_model, '_MAX_ROUNDS', 1)
    fit, terms = term_selection.fit_selected(sensor, poses)
    assert not fit.converged
    assert full_fit_text.NOT_CONVERGED in full_fit_text.report_lines(fit, poses, terms)


def test_a_term_that_is_not_convex_is_fitted_from_several_starts():
    """The periods of an ADC's nonlinearity are right, far from the typical value."""
    sensor, truth, _ = swept_unit(3)
    truth = with_neutral(truth, ['adc_inl'])
    values = {**truth.values['adc_inl'], 'amplitude_v': np.array(1e-3), 'cycles': np.array(17.3)}
    truth = replace(truth, values={**truth.values, 'adc_inl': values})
    poses = swept(np.random.default_rng(1), truth, check_poses=0)
    fit = full_model.fit_full(sensor, poses, (*TERMS, 'adc_inl')).unit.values['adc_inl']
    assert fit['cycles'] == pytest.approx(17.3, rel=0.01)
    assert fit['amplitude_v'] == pytest.approx(1e-3, rel=0.15)


def test_one_axis():
    """A sensor of one axis is fitted as well."""
    sensor, truth, poses = swept_unit(1, 'x')
    error, std = errors(full_model.fit_full(sensor, poses), truth)
    assert np.abs(error / std).max() < 4


def test_the_gauge_is_fixed_where_only_the_sum_is_identifiable():
    """Linear cross-axis terms only are a misalignment, and cross_axis.linear stays 0."""
    rng = np.random.default_rng(3)
    truth = drawn(rng, nominal(), ('bias', 'scale_factor', 'misalignment'))
    truth = with_neutral(truth, ['cross_axis', 'cross_axis_z'])
    truth = put(truth, [Coefficient('cross_axis', 'linear', 'x'),
                        Coefficient('cross_axis_z', 'linear', 'y')], [0.012, -0.02])
    poses = swept(rng, truth)
    fit, _ = term_selection.fit_selected(nominal(), poses)
    assert not set(full_model.GAUGE) & {full_model.term_of(name)
                                        for name in fit.fitted.covariance_names}
    assert fit.fitted.values['cross_axis']['linear'].tolist() == [0, 0]
    turned = fit.fitted.values['misalignment']['beta_rad'][0]
    assert turned == pytest.approx(
        truth.values['misalignment']['beta_rad'][0] + 0.012, abs=4e-4)


def test_the_gauge_is_free_where_products_make_the_parts_identifiable():
    """If the scale factor depends on z, the same terms are fitted to the noise."""
    rng = np.random.default_rng(3)
    truth = drawn(rng, nominal(), TERMS)
    truth = put(truth, [Coefficient('cross_axis', 'linear', 'x'),
                        Coefficient('cross_axis_z', 'linear', 'y'),
                        Coefficient('scale_factor_z', 'linear_per_g', 'x'),
                        Coefficient('scale_factor_z', 'quadratic_per_g2', 'y')],
                [0.015, -0.02, 0.01, 0.01])
    poses = swept(rng, replace(truth, stage_resolution_rad=0.0))
    held = np.radians([[40, 10], [75, 200], [130, 300], [20, 100]])
    force = specific_force(*held.T, truth.local_gravity_mps2)
    volts = signal_chain.static_response(truth)(force)
    worst = {}
    for name, fit in (('fixed', full_model.fit_full(nominal(), poses)),
                      ('judged', term_selection.fit_selected(nominal(), poses)[0])):
        up = np.where(np.cos(held[:, 0]) < 0, -1, 1)
        error = np.subtract(signal_chain.inverse(fit.fitted, up)(volts), force)[:2]
        worst[name] = np.abs(error).max()
    assert worst['judged'] < 3e-4 and worst['fixed'] > 2 * worst['judged']


def test_outliers_are_named_and_excluded():
    """Three poses with a knock do not change the coefficients."""
    sensor, truth, poses = swept_unit(5, check_poses=0)
    bad = [7, 40, 90]
    volts = poses.volts.copy()
    volts[bad] += [[0.01, 0.0], [0.0, -0.02], [0.03, 0.01]]
    fit, terms = term_selection.fit_selected(sensor, replace(poses, volts=volts))
    assert fit.outliers == tuple(bad)
    error, std = errors(fit, truth)
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.6
    assert any('outliers, left out: pose 8 (alpha' in line
               for line in full_fit_text.report_lines(fit, poses, terms))


@pytest.mark.parametrize('stage_deg', [1.0, 3.0])
def test_a_large_stage_error_is_not_attributed_to_the_sensor(stage_deg):
    """The stage error is estimated, and the magnitude of gravity determines zero-g."""
    sensor, truth, poses = swept_unit(6, 'xyz', stage_deg * np.sqrt(12))
    fit, terms = term_selection.fit_selected(sensor, poses)
    assert np.degrees(fit.stage_std_rad) == pytest.approx(stage_deg, rel=0.15)
    error, std = errors(fit, truth)
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.6
    zero_g = [name.effect == 'bias' for name in fit.fitted.covariance_names]
    assert np.abs(error[zero_g]).max() < 1e-4
    assert any('the reference is worse than stated' in line
               for line in full_fit_text.report_lines(fit, poses, terms))


def test_terms_that_the_unit_lacks_are_not_selected():
    """For a unit with zero-g, scale factor and misalignment, no other term is supported."""
    rng = np.random.default_rng(8)
    truth = drawn(rng, nominal(), ('bias', 'scale_factor', 'misalignment'))
    terms = term_selection.fit_selected(nominal(), swept(rng, truth))[1]
    assert [term.name for term in terms if term.is_supported] == ['misalignment']


def test_suggested_poses_determine_more_than_others():
    """Suggested poses reduce the covariance more than an equal number of poses of the sweep."""
    sensor, _, poses = swept_unit(9, check_poses=0)
    fit = full_model.fit_full(sensor, poses)
    suggested = full_model.next_poses(fit.unit, poses, fit.names, fit.stage)

    def volume(angles_rad):
        added, settings = poses.subset(np.arange(len(angles_rad))), np.arange(len(angles_rad))
        added = replace(added, alpha_rad=angles_rad[:, 0], beta_rad=angles_rad[:, 1],
                        alpha_setting=settings, beta_setting=settings)
        information = fit.information + full_model.fisher_information(
            fit.unit, added, fit.names, fit.stage) - np.diag(
            full_model.prior_precision(fit.names))
        return -np.linalg.slogdet(information)[1]

    others = np.column_stack([poses.alpha_rad, poses.beta_rad])[[5, 30, 60, 100]]
    assert volume(np.array(suggested)) < volume(others)


def test_a_change_of_temperature_is_reported_and_fitted():
    """A change by 15 °C during the sweep is reported, or fitted by its term."""
    sensor, truth, poses = swept_unit(10, check_poses=0)
    warm = replace(poses, temperature_c=np.linspace(20, 35, len(poses)))
    fit, terms = term_selection.fit_selected(sensor, warm)
    words = full_fit_text.report_lines(fit, warm, terms)
    assert any('temperature moved by 15.0 degC' in line for line in words)
    drift = 1e-3 * truth.scale_v_per_g * (warm.temperature_c[:, None] - 25)
    fit, terms = term_selection.fit_selected(sensor, replace(warm, volts=warm.volts + drift))
    assert fit.fitted.values['temperature_bias']['per_k'] == pytest.approx([1e-3] * 2, rel=0.1)
    assert not any('temperature moved' in line
                   for line in full_fit_text.report_lines(fit, warm, terms))


@pytest.mark.parametrize('planes_deg, lost', [
    ([90], 'cross_axis_z.quadratic_per_g'), ([90, 60], 'scale_factor_z')])
def test_poses_of_too_few_planes_are_refused(planes_deg, lost):
    """The message names the undetermined terms and the poses to add."""
    sensor, _, poses = swept_unit(1, planes_rad=np.radians(planes_deg), check_poses=0)
    with pytest.raises(UserError,
                       match=rf'do not determine .*{lost}.*add poses \(alpha, beta\) = '):
        full_model.fit_full(sensor, poses)


def test_a_simpler_model_is_fitted_if_the_full_one_is_not_determined():
    """Without a chosen model, `calibrate` fits the richest model that the poses determine."""
    sensor, _, poses = swept_unit(1, planes_rad=PLANES_RAD[2:3], check_poses=0)
    fit = calibration.calibrate(sensor, [calibration.RecordedPoses('made', poses)])
    assert fit.fitted.model == 'linear'
    assert fit.report_lines[0].startswith('not full: the full model is not determined')
    assert fit.report_lines[1].startswith('not physical: ')


def test_recordings_of_one_unit_are_fitted_together():
    """Two sweeps together determine the coefficients better than one."""
    rng = np.random.default_rng(12)
    truth = drawn(rng, nominal(), TERMS)
    parts = [swept(rng, truth, check_poses=0) for _ in range(2)]
    parts = [calibration.RecordedPoses(name, part) for name, part in zip('ab', parts)]
    single = calibration.calibrate(nominal(), parts[:1], 'full')
    both = calibration.calibrate(nominal(), parts, 'full')
    assert np.trace(both.fitted.covariance) < 0.7 * np.trace(single.fitted.covariance)


@pytest.mark.parametrize('change, words', [
    (lambda truth: put(truth, [Coefficient('misalignment', 'alpha_rad', axis) for axis in 'xy'],
                       truth.values['misalignment']['alpha_rad'] + [0.02, 0.02]),
     'case is turned by'),
    (lambda truth: put(truth, [Coefficient('bias', 'offset_v', 'x')],
                       truth.values['bias']['offset_v'][:1] + 0.08), 'zero-g of x is shifted by')])
def test_recordings_that_contradict_each_other_are_refused(change, words):
    """The message has the difference and its significance for another mounting or unit."""
    rng = np.random.default_rng(13)
    truth = drawn(rng, nominal(), TERMS)
    parts = [swept(rng, unit, check_poses=0) for unit in (truth, truth, change(truth))]
    with pytest.raises(UserError, match=rf'{words} .* standard deviations\): another unit'):
        calibration.calibrate(
            nominal(), [calibration.RecordedPoses(f'{name}.csv', part)
                        for name, part in zip('abc', parts)], 'full')


@pytest.mark.perf
def test_six_hundred_poses_of_three_axes_take_two_seconds():
    """The time includes stage errors and the selection of terms."""
    sensor, _, poses = swept_unit(2, 'xyz', planes_rad=np.radians(np.linspace(0, 180, 23)))
    assert len(poses) > 600
    with within(2.0):
        fit, _ = term_selection.fit_selected(sensor, poses)
    assert len(fit.names) >= 20


def test_the_noise_determines_the_filter_time_constant(run_tool, tmp_path):
    """`fit` on a simulated sweep estimates the resistor of the filter, and writes it."""
    run_tool('simulate', 'sweep', '--params', NOMINAL, '--effect',
             'bandwidth:resistance_ratio.x=0.2,resistance_ratio.y=-0.15', '--effect',
             'misalignment', '-o', tmp_path / 'sweep.csv')
    done = run_tool('fit', tmp_path / 'sweep.csv', '-o', tmp_path / 'unit.yaml')
    assert done.returncode == 0, done.stderr
    assert '#   bandwidth.resistance_ratio ' in (tmp_path / 'unit.yaml').read_text()
    fitted = parameter_file.load(tmp_path / 'unit.yaml')
    assert fitted.model == 'full'
    ratio = fitted.values['bandwidth']['resistance_ratio']
    assert ratio == pytest.approx([0.2, -0.15], abs=0.04)
    std = np.sqrt(np.diag(fitted.covariance))[-2:]
    assert np.abs((ratio - [0.2, -0.15]) / std).max() < 4


def test_an_additional_effect_on_the_command_line(run_tool, tmp_path):
    """--effect adds a term. A term that poses at rest cannot determine is refused by name."""
    run_tool('simulate', 'sweep', '--params', NOMINAL, '-o', tmp_path / 'sweep.csv')
    run_tool('fit', tmp_path / 'sweep.csv', '--effect', 'stage_eccentricity', '-o',
             tmp_path / 'unit.yaml')
    done = run_tool('fit', tmp_path / 'sweep.csv', '--effect', 'hysteresis', '-o',
                    tmp_path / 'other.yaml')
    assert done.returncode == 1
    assert 'hysteresis' in done.stderr and 'Traceback' not in done.stderr
    done = run_tool('fit', tmp_path / 'sweep.csv', '--effect', 'temprature_bias', '-o',
                    tmp_path / 'other.yaml')
    assert done.returncode == 1 and 'temperature_bias' in done.stderr
    assert not (tmp_path / 'other.yaml').exists()
