# SPDX-License-Identifier: Apache-2.0

"""The verbs of `import adxl_ros` on a simulated unit: what results hold, show and write."""

import copy
import dataclasses
import inspect
import json
import pickle
import re

import adxl_ros as adxl
from matplotlib.figure import Figure
import numpy as np
import pandas as pd
import pytest

G_MPS2 = 9.80665
MISALIGNED_RAD = 0.02  # Misalignment of x that is simulated
BIAS_V = 0.01  # Largest departure of the zero-g that is simulated, 10 mg


@pytest.fixture(scope='module')
def recording() -> adxl.Recording:
    """Make a recording of arrays, as a stranger has them."""
    made = adxl.simulate(
        'tilt_both',
        'adxl203',
        rate=25,
        seed=1,
        effects={'bias': {'offset_v': {'x': BIAS_V, 'y': -BIAS_V / 2}}},
    )
    columns = {name: made.columns[name] for name in ('x_v', 'y_v', 'alpha_rad', 'beta_rad')}
    return adxl.from_arrays(time_s=made.time_s, **columns)


@pytest.fixture(scope='module')
def fit(recording: adxl.Recording) -> adxl.Fit:
    return adxl.fit(recording, 'adxl203', model='linear')


@pytest.fixture(scope='module')
def gap(recording: adxl.Recording) -> adxl.Gap:
    return adxl.diagnose(recording, 'adxl203')


def test_a_fit_finds_the_zero_g_and_saves_itself(fit, tmp_path) -> None:
    (zero_g,) = [row for row in fit.coefficients if (row.name, row.axis) == ('bias.offset_v', 'x')]
    assert abs(zero_g.value - BIAS_V) < 3 * zero_g.half_width and zero_g.unit == 'V'
    assert zero_g.value == fit.sensor.values['bias']['offset_v'][0]
    whole_v = fit.sensor.nominal_zero_g_v[0] + zero_g.value
    assert float(zero_g.shown.split()[0]) == pytest.approx(whole_v, abs=zero_g.half_width)
    assert fit.poses + len(fit.outliers) == len(fit.result.poses)
    fit.save(tmp_path / 'unit.yaml')
    np.testing.assert_allclose(
        adxl.load(tmp_path / 'unit.yaml').zero_g_v, fit.sensor.zero_g_v, rtol=1e-6
    )
    (tmp_path / 'unit.yaml').write_text('precious')
    with pytest.raises(adxl.UserError, match='overwrite=True'):
        fit.save(tmp_path / 'unit.yaml')
    table = fit.to_pandas()
    assert len(table) == len(fit.coefficients) and set(table.unit) == {'V', 'V/g'}
    values = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    assert values['coefficients'][0]['unit'] == 'V'


@pytest.mark.parametrize('names', [['alpha_rad', 'beta_rad'], ['beta_rad']])
def test_stage_angles_in_degrees_are_named_by_each_verb(recording, names) -> None:
    columns = {**recording.columns}
    for name in names:
        columns[name] = np.degrees(columns[name])
    in_degrees = adxl.from_arrays(time_s=recording.time_s, **columns)
    mend = f'multiply {" and ".join(names)} by π/180'
    for model in (None, 'linear'):
        with pytest.raises(adxl.UserError, match=f'arrays: {names[0]}.*{mend}'):
            adxl.fit(in_degrees, 'adxl203', model=model)
    checked = adxl.check(in_degrees, 'adxl203')
    assert not checked.is_sound and checked.faults[0].endswith(mend)
    is_able = {ability.tool: ability.is_able for ability in checked.recordings[0].abilities}
    assert not is_able['fit'] and not is_able['diagnose']
    assert adxl.diagnose(in_degrees, 'adxl203').summary.rstrip('.').endswith(mend)
    assert adxl.check(recording, 'adxl203').is_sound


def test_an_angle_among_the_coefficients_is_in_the_unit_of_its_name() -> None:
    unit = adxl.load('adxl203', effects={'misalignment': {'beta_rad.x': MISALIGNED_RAD}})
    recording = adxl.simulate('rich', unit, rate=25)
    table = adxl.fit(recording, 'adxl203', model='physical').to_pandas()
    (row,) = table[(table.name == 'misalignment.beta_rad') & (table.axis == 'x')].itertuples()
    assert row.unit == 'rad' and abs(row.value - MISALIGNED_RAD) < 3 * row.half_width
    assert row.shown.endswith('°')


def test_samples_are_no_means_of_rests(recording) -> None:
    with pytest.raises(adxl.UserError, match='are samples, and no means; leave means= out'):
        adxl.fit(recording, 'adxl203', means=True)


@pytest.mark.parametrize('verb', ['Fit', 'Gap', 'Corrected', 'Noise', 'Update', 'Check'])
def test_help_names_each_field_of_a_result(verb: str) -> None:
    attributes = inspect.getdoc(getattr(adxl, verb)).partition('Attributes\n')[2]
    named = re.findall(r'^([a-z]\w*)', attributes, re.MULTILINE)
    assert named == [field.name for field in dataclasses.fields(getattr(adxl, verb))]


def test_corrected_arrays_follow_the_stage(recording, fit, tmp_path) -> None:
    corrected = adxl.apply(recording, fit)
    assert corrected.force_mps2.shape == corrected.force_std_mps2.shape == (len(recording), 3)
    assert corrected.force_covariance.shape == (len(recording), 3, 3)
    length_mps2 = np.linalg.norm(corrected.force_mps2, axis=1)
    assert abs(np.nanmedian(length_mps2) - G_MPS2) < 0.01
    corrected.save(tmp_path / 'tilt.csv')
    written, table = pd.read_csv(tmp_path / 'tilt.csv', comment='#'), corrected.to_pandas()
    assert list(written) == list(table)
    np.testing.assert_allclose(written['roll_rad'], table['roll_rad'], atol=1e-6)


def test_a_gap_is_explained_by_what_was_simulated(gap) -> None:
    assert (gap.verdict, [effect.name for effect in gap.effects]) == ('explained', ['bias'])
    found = gap.effects[0].parameters['offset_v.x']
    assert found.low < BIAS_V < found.high and found.unit == 'V'
    figures = gap.figures
    assert figures.after_mps2.value < figures.before_mps2.value
    assert figures.floor_mps2.value == pytest.approx(figures.after_mps2.value, rel=0.2)
    assert gap.sensor.values['bias']['offset_v'][0] == pytest.approx(found.value, rel=1e-3)


def test_a_gap_writes_what_it_returns(gap, tmp_path) -> None:
    files = gap.save(tmp_path / 'gap')
    assert [path.name for path in files] == ['report.html', 'params.yaml', 'report.json']
    report = json.loads((tmp_path / 'gap' / 'report.json').read_text())
    assert report == json.loads(json.dumps(gap.to_dict(), allow_nan=False))
    assert report['verdict']['status'] == gap.verdict
    (tmp_path / 'gap' / 'report.html').write_text('precious')
    with pytest.raises(adxl.UserError, match='overwrite=True'):
        gap.save(tmp_path / 'gap')
    assert gap.compared.command('again').endswith('diagnose RECORDING --params adxl203 -o again')
    commands = [step.command for step in gap.next_steps('gap')]
    assert not any(' arrays' in command for command in commands), commands


def test_results_print_their_screen_and_show_in_a_notebook(fit, gap, recording) -> None:
    assert 'GAP EXPLAINED by 1 effect' in str(gap)
    assert fit.outcome in str(fit)
    for result in (fit, gap, adxl.apply(recording, fit)):
        assert max(map(len, str(result).splitlines())) < 80
        assert '<b>' in result._repr_html_()
        axes = Figure().subplots()
        assert result.plot(axes) is axes


def test_results_are_copied_compared_and_sent_to_other_processes(recording, fit, gap) -> None:
    no_gap = adxl.diagnose(adxl.from_arrays(time_s=[0.0, 0.1], x_v=[2.5, 2.5]), 'adxl203')
    for result in (
        recording,
        fit,
        fit.sensor,
        gap,
        no_gap,
        adxl.apply(recording, fit),
        adxl.check(recording),
    ):
        assert result == result and str(copy.deepcopy(result)) == str(result)
        assert len({result, result}) == 1
        assert str(pickle.loads(pickle.dumps(result))) == str(result)


def test_a_verb_prints_nothing_and_leaves_the_global_seed(recording, fit, capsys) -> None:
    np.random.seed(3)  # noqa: NPY002 a verb must not change it
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    adxl.apply(recording, fit)
    adxl.simulate('tilt_both', fit, rate=25)
    adxl.check(recording)
    assert capsys.readouterr() == ('', '')
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


def test_noise_of_white_samples_is_within_its_interval() -> None:
    rng = np.random.default_rng(5)
    std_mps2, rate_hz = 0.02, 100
    noise = adxl.noise(
        adxl.from_arrays(
            rate=rate_hz,
            **{
                f'a{axis}_mps2': value + rng.normal(0, std_mps2, 20_000)
                for axis, value in zip('xyz', (0, 0, G_MPS2))
            },
        )
    )
    for axis in noise.axes:
        white = axis.fit.white
        assert white.low < std_mps2 / np.sqrt(rate_hz) < white.high
    assert noise.sensor.noise_density_g_per_rthz.shape == (3,)
    assert len(noise.to_pandas()) == 9


def test_an_axis_that_is_stuck_is_not_sound() -> None:
    time_s = np.arange(2000) / 100
    checked = adxl.check(
        adxl.from_arrays(
            time_s=time_s, ax_mps2=np.sin(time_s), ay_mps2=np.zeros(2000), az_mps2=np.cos(time_s)
        )
    )
    assert not checked.is_sound and any('ay_mps2' in fault for fault in checked.faults)
    assert 'NOT SOUND' in str(checked)


def test_a_simulation_has_its_effects_and_its_seed() -> None:
    first, same, other = (
        adxl.simulate('motion', rate=50, seed=seed, effects={'bias': {'offset_v.y': 0.02}})
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.columns['y_v'], same.columns['y_v'])
    assert (first.columns['y_v'] != other.columns['y_v']).any()
    plain = adxl.simulate('motion', rate=50, seed=1)
    shift_v = np.mean(first.columns['y_v'] - plain.columns['y_v'])
    assert shift_v == pytest.approx(0.02, abs=1e-3)


def test_a_fit_is_a_sensor_of_a_simulator(fit) -> None:
    model = adxl.SensorModel(fit, seed=1)
    readings = model(np.tile([0.0, 0.0, G_MPS2], (500, 1)), 0.01)
    assert readings[:, 0].mean() / G_MPS2 == pytest.approx(
        BIAS_V / fit.sensor.nominal_scale_v_per_g[0], abs=2e-3
    )


@pytest.mark.parametrize(
    'call, named',
    [
        (lambda: adxl.simulate('no_such_motion'), 'no_such_motion'),
        (lambda: adxl.simulate('motion', effects=['no_such_effect']), 'no_such_effect'),
        (lambda: adxl.simulate('motion', effects={'bias': {'offset_v': 99}}), '99'),
        (lambda: adxl.simulate('motion', rate='fast'), "rate='fast'"),
        (lambda: adxl.simulate('motion', seed='x'), "seed='x'"),
        (lambda: adxl.simulate('imu'), 'force=RECORDING'),
        (lambda: adxl.load('no_such_sensor'), 'no_such_sensor'),
        (lambda: adxl.fit([]), 'no recording'),
        (lambda: adxl.read('no_such_file.csv'), 'no_such_file.csv'),
    ],
)
def test_errors_name_what_is_wrong(call, named) -> None:
    with pytest.raises(adxl.UserError, match=named):
        call()


def test_a_log_without_noise_has_its_cause() -> None:
    time_s = np.arange(9000) / 100
    force = {
        'ax_mps2': 3 * np.sin(1.9 * time_s),
        'ay_mps2': 2 * np.sin(3.0 * time_s + 1),
        'az_mps2': 9.80665 + 2 * np.sin(1.3 * time_s),
    }
    sim = adxl.from_arrays(time_s=time_s, **force)
    log = adxl.from_arrays(time_s=time_s, **{name: 1.01 * f for name, f in force.items()})
    gap = adxl.diagnose(log, 'any_imu', sim=sim)
    assert gap.verdict == 'explained'
    assert [effect.name for effect in gap.effects] == ['scale_factor']
    assert 'nan' not in str(gap).split()
