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

"""The diagnosis of simulated gaps, of faulty recordings, and of real recordings."""

from dataclasses import replace
import json
import re

from adxl_ros.diagnose import report_json
from adxl_ros.diagnose.baseline_comparison import compare
from adxl_ros.diagnose.decision import Verdict, WeightedHypothesis
from adxl_ros.diagnose.diagnosis import diagnose, SETTINGS
from adxl_ros.diagnose.gap_closure import held_out_residual
from adxl_ros.diagnose.hypothesis_fit import fit_hypothesis, Hypothesis
from adxl_ros.diagnose.linear_model import build_linear_model
from adxl_ros.diagnose.next_experiment import propose_next_experiment, RecordedEvidence
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.filters import low_pass
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Held, Knots, Motion
from adxl_ros.simulate.simulator import simulate
from adxl_ros.tools.effect_option import with_effects
import numpy as np
import pytest
from scipy.signal import lfilter
from units import nominal

pytestmark = pytest.mark.long

KEYS = {'schema', 'verdict', 'hypotheses', 'gap', 'where', 'candidates', 'next_experiment'}


def unit(axes='xyz', rate_hz=125.0):
    """Return a calibrated unit."""
    rng = np.random.default_rng(1)
    count = len(axes)
    names = tuple(Coefficient(effect, parameter, axis) for effect, parameter in (
        ('bias', 'offset_v'), ('scale_factor', 'offset_v_per_g')) for axis in axes)
    return replace(
        nominal(axes), rate_hz=rate_hz, stage_resolution_rad=1e-4, model='linear',
        effects=('bias', 'scale_factor'), covariance_names=names,
        covariance=np.eye(2 * count) * 1e-9,
        values={'bias': {'offset_v': rng.normal(size=count) * 0.03},
                'scale_factor': {'offset_v_per_g': rng.normal(size=count) * 0.02}})


def turning_motion():
    """Turn beta in two planes at two speeds, with rests, and warm up by 12 degC."""
    script = trajectories.Script(np.pi / 2, 0.0)
    for alpha in (np.pi / 2, np.pi / 4, 2.0):
        script.go(alpha, 0.0)
        script.rest(3.0)
        for to, speed in ((2.0, 0.6), (0.5, 1.5), (6.0, 1.0), (3.0, 2.5), (0.0, 0.8)):
            script.run('beta', to, speed)
            script.rest(1.0)
    alpha, beta = script.joints()
    warm = Knots([0.0, script.now / 3, 2 * script.now / 3, script.now], [25.0, 25.0, 37.0, 33.0])
    return Motion(script.now, alpha, beta, temperature_c=warm)


def simulated(sensor, effects=(), seed=3, change=None):
    """Simulate a recording with effects of the library."""
    columns = simulate(with_effects(sensor, list(effects)), turning_motion(), seed)
    if change is not None:
        columns = change(columns)
    time_s = columns.pop('time_s')
    return Recording('made', time_s, columns, sensor_info(sensor))


def diagnosis_of(sensor, *effects, change=None):
    """Diagnose such a recording by the library call."""
    diagnosis = diagnose([simulated(sensor, effects, change=change)], sensor)
    report = report_json.as_json(diagnosis)
    assert set(report) >= KEYS
    return report, diagnosis


def test_no_gap():
    """A unit as in its file, with the usual drift, has no gap."""
    report, _ = diagnosis_of(unit(), 'bias_walk:density_g_per_rts=2e-5')
    probability = report['verdict'].pop('probability')
    assert report['verdict'] == {'status': 'no_gap', 'effects': [], 'groups': [], 'of': None,
                                 'data_fault': None}
    assert 0.5 < probability <= 1
    assert report['gap']['floor_source'] == 'still'
    assert report['gap']['before'] == pytest.approx(5.3e-3, rel=0.1)
    low, high = report['gap']['floor_ci']
    assert 0.9 * high < low < report['gap']['floor'] < high


@pytest.mark.parametrize('option, parameter, value', [
    ('temperature_bias:per_k=4e-4', 'per_k.x', 4e-4),
    ('thermal_lag:per_k=-5e-4,tau_s=10', 'tau_s', 10.0),
    ('thermal_hysteresis:half_width_g=4e-3,reach_k=3', 'half_width_g.y', 4e-3),
    ('backlash:alpha_rad=0.004,beta_rad=0.004', 'beta_rad', 0.004),
    ('misalignment:alpha_rad=0.003,beta_rad=-0.002', 'alpha_rad.y', 0.003),
    # The signal is a straight line, which zero-g and scale factor can imitate.
    ('gravity:offset_mps2=0.02', 'offset_mps2', 0.02),
    # As in the parameter file: the estimate plus the value of the baseline.
    ('bias:offset_v=0.04', 'offset_v.y', 0.04)])
def test_one_effect_is_named_and_the_gap_closed(option, parameter, value):
    """The verdict names the effect, and its parameter closes nearly all of the gap."""
    name = option.split(':')[0]
    report, _ = diagnosis_of(unit('xy'), option)
    assert (report['verdict']['status'], report['verdict']['effects']) == ('explained', [name])
    candidate = next(c for c in report['candidates'] if c['effect'] == name)
    assert candidate['parameters'][parameter]['value'] == pytest.approx(value, rel=0.1)
    assert report['gap']['closed'] > 0.95
    assert sum(h['probability'] for h in report['hypotheses']) == pytest.approx(1, abs=1e-9)


def test_a_sensor_without_an_adc_may_have_negative_volts():
    """A digital sensor whose zero-g is 0 pseudo-volts has no rail there."""
    sensor = replace(unit(), adc_bits=0, nominal_zero_g_v=np.zeros(3))
    report, _ = diagnosis_of(sensor, 'temperature_bias:per_k=4e-4')
    assert report['verdict']['effects'] == ['temperature_bias']
    candidate = next(c for c in report['candidates'] if c['effect'] == 'temperature_bias')
    assert [candidate['parameters'][f'per_k.{axis}']['value'] for axis in 'xyz'] \
        == pytest.approx([4e-4] * 3, rel=0.1)


def test_an_effect_outside_the_library_is_unknown():
    """A zero-g that follows the fourth harmonic of beta is unknown over beta."""
    def change(columns):
        for axis, phase in (('x', 0.0), ('y', 1.0)):
            columns[f'{axis}_v'] = columns[f'{axis}_v'] + 4e-3 * np.sin(
                4 * columns['beta_rad'] + phase)
        return columns

    report, _ = diagnosis_of(unit('xy'), change=change)
    assert report['verdict']['status'] == 'unknown'
    likeliest = report['hypotheses'][0]
    assert likeliest['effects'] == ['unknown']
    assert 0.5 < likeliest['probability'] == report['verdict']['probability'] <= 1
    assert 'beta_rad' in report['unknown_where']


def test_a_nominal_file_lacks_zero_g_and_scale_factor():
    """Zero-g and scale factor differ on each axis, and neither alone is the largest gap."""
    def change(columns):
        for axis, zero_v, scale in (('x', 3e-3, 2e-3), ('y', -2e-3, -1.5e-3), ('z', 1e-3, 3e-3)):
            g = columns[f'{axis}_v'] - 2.5
            columns[f'{axis}_v'] = columns[f'{axis}_v'] + zero_v + scale * g
        return columns

    report, _ = diagnosis_of(unit(), change=change)
    assert report['verdict']['effects'] == ['bias', 'scale_factor']
    assert report['gap']['closed'] > 0.95


@pytest.mark.parametrize('amplitude_v, tau_s', [(0.01, 20.0), (0.002, 43.0)])
def test_a_shape_far_from_the_typical_is_estimated_with_its_zero_g(amplitude_v, tau_s):
    """A board settles in a tenth of the usual time. It was calibrated half warm."""
    def change(columns):
        settled = 1 - np.exp(-np.arange(len(columns['z_v'])) / 125.0 / tau_s)
        columns['z_v'] = columns['z_v'] + amplitude_v * (settled - 0.42)
        return columns

    recording = simulated(unit(), change=change)
    diagnosis = diagnose([recording], unit())
    report = report_json.as_json(diagnosis)
    assert report['verdict']['effects'] == ['warm_up']
    assert report['gap']['closed'] > 0.9
    tau = next(c for c in report['candidates'] if c['effect'] == 'warm_up')['parameters']['tau_s']
    assert tau['ci'][0] < tau_s < tau['ci'][1]
    comparison = compare(recording, diagnosis.sensor)
    level_mps2 = (comparison.residual_v(diagnosis.sensor)
                  / comparison.scale_v_per_mps2).mean(axis=0)
    # A healthy zero-g changes by 0.1 mg, and an angle errs by the step of its encoder.
    assert np.abs(level_mps2).max() < 1e-3


def test_the_straight_part_of_an_effect_may_be_in_the_scale_factor():
    """An output that is right at 0 and 1 g and bent between has nonlinearity alone."""
    def change(columns):
        for axis in 'xy':
            g = columns[f'{axis}_v'] - 2.5
            columns[f'{axis}_v'] = columns[f'{axis}_v'] + 0.02 * (g ** 3 - g)
        return columns

    report, _ = diagnosis_of(unit('xy'), change=change)
    assert (report['verdict']['status'], report['verdict']['effects']) == (
        'explained', ['nonlinearity'])
    assert report['gap']['closed'] > 0.95


@pytest.mark.parametrize('option, effect', [
    ('flicker:density_g_per_rthz=3e-4', 'flicker'),
    ('bias_walk:density_g_per_rts=6e-4', 'bias_walk')])
def test_spectrum_separates_the_drifts(option, effect):
    """The spectrum separates 1/f noise from a random walk."""
    assert named(diagnosis_of(unit('xy'), option)[1]) == {effect}


def test_strong_flicker_of_another_spectrum_is_flicker():
    """Relaxations of 0.3 s to minutes with a hundred times the power of the noise are flicker."""
    def drifting(seed):
        def change(columns):
            rng, dt_s = np.random.default_rng(seed), 1 / unit().rate_hz
            for axis in 'xyz':
                total = np.zeros(len(columns['time_s']))
                for tau_s in 10.0 ** np.arange(-0.5, 2.5, 0.5):
                    a = np.exp(-dt_s / tau_s)
                    total += lfilter([np.sqrt(1 - a * a)], [1, -a], rng.normal(size=len(total)))
                columns[f'{axis}_v'] = columns[f'{axis}_v'] + 0.01 * total / total.std()
            return columns
        return named(diagnosis_of(unit(), change=change)[1])

    # A drift of 10 mg looks like a second effect in some recordings, here in the first.
    named_effects = [drifting(seed) for seed in (8, 9)]
    assert all('flicker' in effects for effects in named_effects)
    assert {'flicker'} in named_effects


def test_a_weak_effect_is_named_in_long_recordings():
    """An effect of a fourteenth of the noise shows, although latency imitates most of it."""
    sensor = unit()
    recordings = [simulated(sensor, ['clock_skew:ratio=2.1e-6'], seed) for seed in (3, 4, 5, 6)]
    diagnosis = diagnose(recordings, sensor)
    assert (diagnosis.verdict.status, named(diagnosis)) == ('explained', {'clock_skew'})


def test_a_drift_smoother_than_the_library_is_unknown():
    """A warm draught changes the zero-g within half a minute, and not faster."""
    def change(columns):
        rng = np.random.default_rng(8)
        for axis in 'xy':
            wander = rng.normal(size=len(columns['time_s']))
            for _ in range(3):
                wander = lfilter([0.002], [1, -0.998], wander)
            columns[f'{axis}_v'] = columns[f'{axis}_v'] + 4e-3 * wander / wander.std()
        return columns

    report, _ = diagnosis_of(unit('xy'), change=change)
    assert report['verdict']['status'] == 'unknown'
    assert 'time_s' in report['unknown_where']


def test_a_soft_clip_is_saturation():
    """A clip with the knee of a hyperbolic tangent on y alone is saturation."""
    sensor = unit()

    def change(columns):
        g = columns['y_v'] - sensor.zero_g_v[1]
        return columns | {'y_v': sensor.zero_g_v[1] + np.where(
            np.abs(g) < 0.9, g, np.sign(g) * (0.9 + 0.1 * np.tanh((np.abs(g) - 0.9) / 0.1)))}

    report, _ = diagnosis_of(sensor, change=change)
    assert report['verdict']['status'] == 'explained'
    assert report['verdict']['effects'] == ['saturation']


def test_a_limit_that_one_block_reaches_keeps_its_value():
    """A limit that one block determines also closes the gap in that block, if held out."""
    script, limit_g, knee_g = trajectories.Script(np.pi / 2, 0.0), 1.1, 0.036
    for turn in range(14):
        for to, speed in ((0.8, 1.0), (-0.8, 1.3), *([(1.57, 1.2)] if turn == 7 else [])):
            script.run('beta', to, speed)
            script.rest(1.0)
    sensor = unit()
    columns = simulate(sensor, Motion(script.now, *script.joints()), 3)
    g = (columns['y_v'] - sensor.zero_g_v[1]) / sensor.scale_v_per_g[1]
    beyond = [knee_g * np.logaddexp(0.0, (sign * g - limit_g) / knee_g) for sign in (1, -1)]
    columns['y_v'] -= sensor.scale_v_per_g[1] * (beyond[0] - beyond[1])
    comparison = compare(Recording('made', columns.pop('time_s'), columns, sensor_info(sensor)),
                         sensor)
    linear_model = build_linear_model([comparison], only=['saturation'])
    start = {Coefficient('saturation', 'limit_g', 'y'): limit_g - 1.0,
             Coefficient('saturation', 'knee_g'): knee_g}
    hypothesis = fit_hypothesis(linear_model, ['saturation'], start, {})
    without = held_out_residual(linear_model, [comparison], [], sensor).squares
    held_out = held_out_residual(linear_model, [comparison], hypothesis.effects,
                                 hypothesis.sensor).squares
    assert without.max() > 3 * np.median(without)
    assert held_out.max() < 1.3 * np.median(held_out)


def test_an_effect_of_turning_is_not_a_drift():
    """A ripple of the gears with 40 periods in a turn is unknown."""
    def change(columns):
        return columns | {'x_v': columns['x_v'] + 3e-3 * np.sin(40 * columns['beta_rad'])}

    assert diagnosis_of(unit(), change=change)[0]['verdict']['status'] == 'unknown'


def test_samples_without_numbers_are_ignored():
    """A quarter of a minute without one axis does not change the verdict."""
    def change(columns):
        late = (columns['time_s'] > 20) & (columns['time_s'] < 35)
        return columns | {'y_v': np.where(late, np.nan, columns['y_v'])}

    report, _ = diagnosis_of(unit(), 'misalignment:alpha_rad=0.003,beta_rad=-0.002', change=change)
    assert report['verdict']['effects'] == ['misalignment']


@pytest.mark.parametrize('option, effect', [
    ('mains_hum:amplitude_v=0.003', 'mains_hum'),
    ('noise_excess:ratio=1.0', 'noise_excess'),
    ('spikes:rate_hz=0.5,amplitude_v=0.05', 'spikes'),
    ('stuck:rate_hz=0.2,duration_s=0.1', 'stuck'),
    ('quantisation:lost_bits=4', 'quantisation')])
def test_noise_like_effects_are_named(option, effect):
    """Lines, level, isolated samples, repeated samples and coarse codes have detectors."""
    verdict = diagnosis_of(unit('xy'), option)[0]['verdict']
    assert (verdict['status'], verdict['effects']) == ('explained', [effect])


@pytest.mark.parametrize('change, fault', [
    (lambda c: c | {'x_v': c['y_v'], 'y_v': c['x_v']}, 'axis_swapped'),
    (lambda c: c | {'y_v': 5 - c['y_v']}, 'axis_inverted'),
    (lambda c: c | {a: (c[a] - 2.5) * 9.80665 + 2.5 for a in ('x_v', 'y_v', 'z_v')}, 'unit'),
    (lambda c: c | {a: c[a] * 1e3 for a in ('x_v', 'y_v', 'z_v')}, 'unit'),
    (lambda c: c | {'time_s': c['time_s'] + 40.0 * (c['time_s'] > 30)}, 'clock_jump'),
    (lambda c: c | {a: np.roll(c[a], 300) for a in ('x_v', 'y_v', 'z_v')}, 'time_misaligned'),
    (lambda c: c | {'x_v': np.where(np.arange(len(c['x_v'])) % 2, np.nan, c['x_v'])}, 'missing'),
    (lambda c: c | {'x_v': np.clip(c['x_v'], 2.4, 2.6)}, 'saturated')])
def test_faults_of_the_recording_are_named(change, fault):
    """The verdict names the fault and no effect."""
    report, diagnosis = diagnosis_of(unit(), change=change)
    assert (report['verdict']['status'], report['verdict']['data_fault']) == ('bad_data', fault)
    assert report['verdict']['effects'] == [] and diagnosis.sensor is None


@pytest.mark.parametrize('factor, units', [
    (9.80665, 'm/s² instead of g'), (1 / 9.80665, 'g instead of m/s²'), (1e3, 'mV instead of V')])
def test_a_wrong_unit_is_named_with_the_right_one(factor, units):
    """Volts 9.81 times too small are those of g where m/s² are expected."""
    report, _ = diagnosis_of(unit(), change=lambda c: c | {
        a: (c[a] - 2.5) * factor + 2.5 for a in ('x_v', 'y_v', 'z_v')})
    assert report['verdict']['data_fault'] == 'unit'
    assert f'as values in {units} are' in report['summary']


def test_codes_far_above_the_noise_hide_no_effect_and_cause_none():
    """Rounding to 10 bits follows the pose; beside it, a scale factor is found."""
    report, _ = diagnosis_of(unit(), 'quantisation:lost_bits=6')
    assert report['verdict']['effects'] == ['quantisation']
    report, _ = diagnosis_of(unit(), 'quantisation:lost_bits=6', 'temperature_bias:per_k=2e-3')
    assert report['verdict']['effects'] == ['quantisation', 'temperature_bias']


def test_a_second_harmonic_of_an_eccentric_disc_is_no_further_effect():
    """What the form of an eccentric disc lacks is an error of the angle, too."""
    def change(columns):
        angles = {name: columns[name] - 0.01 * np.sin(columns[name] + 1)
                  - 0.001 * np.sin(2 * columns[name]) for name in ('alpha_rad', 'beta_rad')}
        return columns | angles

    report, _ = diagnosis_of(unit(), change=change)
    assert report['verdict']['effects'] == ['stage_eccentricity']


def test_too_short_is_insufficient():
    """A recording of ten seconds has no verdict."""
    report, _ = diagnosis_of(unit(), change=lambda c: {k: v[:1250] for k, v in c.items()})
    assert report['verdict']['status'] == 'insufficient'
    assert 'too short' in report['summary']


def test_the_command_writes_report_page_and_parameters(run_tool, tmp_path):
    """Two runs give the same bytes. With the written parameters there is no gap."""
    sensor = unit('xy')
    recorded_run = simulated(sensor, ['temperature_bias:per_k=4e-4'])
    recording.write(tmp_path / 'run.csv', recorded_run, sensor)
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    files = []
    for name in ('a', 'b'):
        run = run_tool('diagnose', 'run.csv', '--params', 'unit.yaml', '-o', name)
        assert (run.returncode, run.stderr) == (0, '')
        assert '\nGAP EXPLAINED by 1 effect ' in run.stdout
        assert re.search(r'^ temperature_bias +(> )?9\d % ', run.stdout, re.MULTILINE)
        files.append([(tmp_path / name / f).read_bytes()
                      for f in ('report.json', 'report.html', 'params.yaml')])
    # The page states its command and the time.
    assert files[0][0] == files[1][0] and files[0][2] == files[1][2]
    page = files[0][1].decode()
    assert 'temperature_bias' in page and 'http' not in page
    again = run_tool('diagnose', 'run.csv', '--params', 'a/params.yaml', '-o', 'c', '--json')
    assert json.loads(again.stdout)['verdict']['status'] == 'no_gap'


def test_several_recordings_and_bags(run_tool, tmp_path):
    """A CSV file and a bag of one unit have one diagnosis."""
    sensor = unit('xy')
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    for name, seed in (('a.csv', 3), ('b.mcap', 4)):
        recording.write(tmp_path / name, simulated(sensor, ['time_offset:offset_s=0.004'], seed),
                        sensor)
    run = run_tool('diagnose', 'a.csv', 'b.mcap', '--params', 'unit.yaml', '-o', 'out', '--json')
    report = json.loads(run.stdout)
    assert report['verdict']['effects'] == ['time_offset']
    assert [noise['recording'] for noise in report['gap']['noise']] == ['a.csv', 'b.mcap']


def turning(alphas, speeds, rests_s=2.0):
    """Turn beta forth and back in each plane at each speed."""
    script = trajectories.Script(alphas[0], 0.0)
    for alpha in alphas:
        script.go(alpha, 0.0)
        script.rest(rests_s)
        for speed in speeds:
            for to in (2.5, 0.0):
                script.run('beta', to, speed)
                script.rest(rests_s)
    return script


def record(sensor, motion, effects=(), seed=3):
    """Simulate a recording of a manoeuvre."""
    columns = simulate(with_effects(sensor, list(effects)), motion, seed)
    time_s = columns.pop('time_s')
    return Recording('made', time_s, columns, sensor_info(sensor))


def named(diagnosis):
    """Return the certain effects of a verdict and those of its groups."""
    verdict = report_json.as_json(diagnosis)['verdict']
    return {*verdict['effects'], *(e for group in verdict['groups'] for e in group)}


@pytest.mark.parametrize('effect', ['backlash:beta_rad=0.003', 'time_offset:offset_s=0.005', None])
def test_a_poor_manoeuvre_causes_no_wrong_verdict(effect):
    """A minute on one plane at one speed names the truth, alone or in a group."""
    sensor = unit('xy')
    script = turning([np.pi / 2], [0.7] * 3, 4.0)
    alpha, beta = script.joints()
    diagnosis = diagnose([record(sensor, Motion(script.now, alpha, beta),
                                 [effect] if effect else [])], sensor)
    if effect is None:
        assert diagnosis.verdict.status == 'no_gap'
    else:
        assert effect.split(':')[0] in named(diagnosis)


def test_a_recording_at_rest_is_insufficient():
    """A minute at rest has no verdict. The report says what is not covered."""
    sensor = unit('xy')
    diagnosis = diagnose([record(sensor, Motion(60.0, Held(1.0), Held(0.5)))], sensor)
    report = report_json.as_json(diagnosis)
    assert report['verdict']['status'] == 'insufficient'
    assert 'motion' in report['not_covered'] and report['next_experiment']


def test_repeats_determine_the_noise_floor_without_rests():
    """The difference of two runs of one trajectory is the noise floor."""
    sensor = replace(unit('xy'), stage_resolution_rad=1e-5)
    time_s = np.arange(0.0, 70.0, 0.5)
    alpha, beta = (Knots(time_s, 1.0 + 0.4 * np.sin(rate * time_s), 0.4 * rate * np.cos(
        rate * time_s)) for rate in (0.31, 0.53))
    motion = Motion(65.0, alpha, beta)
    diagnosis = diagnose([record(sensor, motion, seed=seed) for seed in (1, 2)], sensor)
    report = report_json.as_json(diagnosis)
    assert report['gap']['floor_source'] == 'repeats'
    # 110 ug/rtHz behind 15 Hz and 16 bit at 5 V.
    assert report['gap']['floor'] == pytest.approx(5.3e-3, rel=0.1)
    low, high = report['gap']['floor_ci']
    assert low < report['gap']['floor'] < high


def test_noise_is_compared_with_the_simulated_noise():
    """Twice the noise has four times the power, until the simulator has it as well."""
    report, _ = diagnosis_of(unit(), 'noise_excess:ratio=1.0')
    noise = report['gap']['noise'][0]
    assert noise['power_ratio_before'][-1] == pytest.approx(4.0, rel=0.1)
    assert noise['power_ratio_after'][-1] == pytest.approx(1.0, rel=0.1)
    assert noise['log_likelihood_gain'] > 100


def test_next_experiment_separates_most():
    """Heating separates temperature from supply, and a shaker does not."""
    sensor = with_effects(unit('xy'), ['temperature_bias:per_k=3e-4'])
    best = Hypothesis(('temperature_bias',), sensor, (), np.zeros(0), np.zeros(0), 0.0, None, None,
                      0.0)
    rivals = ('temperature_bias', 'supply')
    verdict = Verdict('inseparable', (), (rivals,), 0.9,
                      tuple(WeightedHypothesis((effect,), 0.5) for effect in rivals), best)
    proposal = propose_next_experiment(
        verdict, [], RecordedEvidence(sensor, None, SETTINGS.evidence_factor, 0))
    worth = {m.text: m.nats_per_minute for m in proposal.menu}
    assert proposal.nats_per_minute == max(worth.values()) == worth[proposal.manoeuvre] > 0.05
    assert worth['dwell, heat and cool'] > 0.01
    assert worth['shake along x from 2 to 40 Hz'] < 0.1 * worth['dwell, heat and cool']


def test_what_was_recorded_already_is_not_proposed_again():
    """Two sweeps leave an offset of the stage open. Others tell more than a third sweep."""
    sensor = replace(nominal('xy'), rate_hz=100.0)
    recordings = [record(sensor, trajectories.tilt_both(np.random.default_rng(seed)),
                         ['stage_offset']) for seed in (3, 4)]
    diagnosis = diagnose(recordings, sensor)
    assert diagnosis.verdict.status == 'inseparable'
    proposal = diagnosis.next_experiment
    worth = {m.text: m.nats_per_minute for m in proposal.menu}
    assert worth['sweep a second plane'] < 0.3 * proposal.nats_per_minute
    assert worth['sweep a second plane'] < 0.3 * worth[
        'remount the sensor turned by 180 deg about z, and sweep again']


def test_temperature_is_named_in_a_climatic_chamber(run_tool, tmp_path, shared_dir):
    """A real recording at rest has the slopes of its README: 0.16, -0.15 and -0.43 mg/degC."""
    run = run_tool('diagnose', shared_dir / 'real' / 'thermal_chamber.csv', '-o', tmp_path,
                   '--json')
    report = json.loads(run.stdout)
    assert 'temperature_bias' in report['verdict']['effects']
    candidate = next(c for c in report['candidates'] if c['effect'] == 'temperature_bias')
    # The slopes of the README are those of straight lines, but the data are a parabola at 25 degC.
    read = recording.read(shared_dir / 'real' / 'thermal_chamber.csv')
    warm_k = read.columns['temperature_c'] - 25
    lag = next((c for c in report['candidates'] if c['effect'] == 'thermal_lag'
                and 'thermal_lag' in report['verdict']['effects']), None)
    slopes = []
    for axis in 'xyz':
        per_k, per_k2 = (candidate['parameters'][f'{name}.{axis}']['value']
                         for name in ('per_k', 'per_k2'))
        zero_g = per_k * warm_k + per_k2 * warm_k ** 2
        if lag is not None:
            # A lag lowers the slope of the line, too.
            late_k = low_pass(warm_k, lag['parameters']['tau_s']['value'], 1 / read.rate_hz, {})
            zero_g = zero_g + lag['parameters'][f'per_k.{axis}']['value'] * (late_k - warm_k)
        slopes.append(np.polyfit(warm_k, zero_g, 1)[0])
    assert slopes == pytest.approx([1.6e-4, -1.5e-4, -4.3e-4], rel=0.1)


def test_a_sensor_that_moves_without_a_reference_gets_no_verdict(run_tool, tmp_path, shared_dir):
    """A sensor turned by hand has no reference, and one line reports this."""
    run = run_tool('diagnose', shared_dir / 'real' / 'mpu9150_0.csv', '-o', tmp_path, '--json')
    verdict = json.loads(run.stdout)['verdict']
    assert (verdict['status'], verdict['data_fault']) == ('bad_data', 'reference')


@pytest.mark.parametrize('name', ['no_gap', 'temperature_bias', 'time_offset'])
def test_samples_of_another_generator(run_tool, tmp_path, shared_dir, name):
    """The shared samples have the right verdict after a linear fit."""
    folder = shared_dir / 'samples' / name
    run_tool('fit', folder / 'cal.csv', '--model', 'linear', '-o', tmp_path / 'unit.yaml')
    run = run_tool('diagnose', folder / 'run.csv', '--params', tmp_path / 'unit.yaml', '-o',
                   tmp_path / 'out', '--json')
    verdict = json.loads(run.stdout)['verdict']
    assert verdict['effects'] == ([] if name == 'no_gap' else [name])
    assert verdict['status'] == ('no_gap' if name == 'no_gap' else 'explained')
