# SPDX-License-Identifier: Apache-2.0

"""What a diagnosis says of simulated gaps, of faulty recordings, and of real recordings."""

from dataclasses import replace
from functools import cache
import json

from adxl_ros.diagnose.diagnosis import diagnose
from adxl_ros.diagnose.next_experiment import MENU, propose_next_experiment
from adxl_ros.diagnose.report_json import as_json
from adxl_ros.diagnose.verdict import WeightedHypothesis
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Manoeuvre, Need
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Held, Knots, Motion
from gaps import simulated, turning, unit, warm
import numpy as np
import pytest
from units import nominal, with_effects

pytestmark = pytest.mark.long


def report_of(diagnosis):
    report = as_json(diagnosis)
    json.dumps(report, allow_nan=False)
    probabilities = [h['probability'] for h in report['hypotheses']]
    if probabilities:
        assert sum(probabilities) == pytest.approx(1, abs=1e-5)
        assert max(probabilities) == probabilities[0]
        assert 0 < report['verdict']['probability'] <= 1
    for candidate in report['candidates']:
        ends = [p['ci'] for p in candidate['parameters'].values() if p.get('ci')]
        if ends and candidate['effect'] in named(report):
            assert not all(low <= 0 <= high for low, high in ends), candidate
    return report


@cache
def diagnosed(*effects):
    diagnosis = diagnose([simulated(unit(), *effects)], unit())
    return diagnosis, report_of(diagnosis)


def named(report):
    verdict = report['verdict']
    return {*verdict['effects'], *(e for group in verdict['groups'] for e in group)}


def test_no_gap_has_an_upper_limit():
    diagnosis, report = diagnosed()
    assert (report['verdict']['status'], named(report)) == ('no_gap', set())
    assert 1e-4 < report['gap']['upper_limit'] < report['gap']['floor']
    assert report['gap']['floor_source'] == 'still'
    low, high = report['gap']['floor_ci']
    assert low < report['gap']['floor'] < high
    assert report['gap']['closed'] is None
    assert diagnosis.report.sensor.values == diagnosis.report.baseline.values


@pytest.mark.parametrize(
    'option, parameter, value',
    [
        ('backlash:alpha_rad=0.004,beta_rad=0.004', 'beta_rad', 0.004),
        ('misalignment:alpha_rad=0.003,beta_rad=-0.002', 'alpha_rad.y', 0.003),
        # As in the parameter file: the estimate plus the value of the baseline.
        ('bias:offset_v=0.04', 'offset_v.y', 0.04),
    ],
)
def test_one_effect_is_named_and_the_gap_closed(option, parameter, value):
    name, report = option.split(':')[0], diagnosed(option)[1]
    assert (report['verdict']['status'], report['verdict']['effects']) == ('explained', [name])
    found = next(c for c in report['candidates'] if c['effect'] == name)['parameters'][parameter]
    assert found['value'] == pytest.approx(value, rel=0.1)
    assert report['gap']['closed'] > 0.95


@pytest.mark.parametrize(
    'option, effect',
    [
        ('mains_hum:amplitude_v=0.003', 'mains_hum'),
        ('noise_excess:ratio=1.0', 'noise_excess'),
        ('spikes:rate_hz=0.5,amplitude_v=0.05', 'spikes'),
        ('stuck:rate_hz=0.2,duration_s=0.1', 'stuck'),
        ('quantisation:lost_bits=4', 'quantisation'),
    ],
)
def test_effects_of_the_noise_are_named(option, effect):
    report = diagnosed(option)[1]
    assert (report['verdict']['status'], report['verdict']['effects']) == ('explained', [effect])


def test_a_limit_that_one_axis_never_reaches_is_saturation():
    """Within half a radian of its start, x moves about its limit, and y stays far away."""
    script = trajectories.Script(np.pi / 2, 0.0)
    script.rest(3.0)
    for to in (0.5, -0.4, 0.3, -0.5, 0.4, 0.0) * 3:
        script.run('beta', to, 0.5)
        script.rest(1.0)
    motion = Motion(script.now_s, *script.joints())
    recording = simulated(unit(), 'saturation:limit_g=0.97,knee_g=0.01', motion=motion)
    verdict = as_json(diagnose([recording], unit()))['verdict']
    assert (verdict['status'], verdict['effects']) == ('explained', ['saturation'])


def test_coarse_codes_of_one_axis_are_no_other_effect():
    """Steps of 20 mg are far above the noise: each rest has an error of its own."""
    report = diagnosed('quantisation:axis_lost_bits.y=8')[1]
    assert (report['verdict']['status'], named(report)) == ('explained', {'quantisation'})
    assert report['gap']['before'] == pytest.approx(report['gap']['floor'], rel=0.1)


def test_noise_is_compared_with_the_simulated_noise():
    """Twice the noise has four times the power, until the simulator has it as well."""
    noise = diagnosed('noise_excess:ratio=1.0')[1]['gap']['noise'][0]
    assert noise['power_ratio_before'][-1] == pytest.approx(4.0, rel=0.15)
    assert noise['power_ratio_after'][-1] == pytest.approx(1.0, rel=0.15)


def test_two_effects_and_the_parameters_that_close_their_gap(run_tool, two_effects):
    screen = (two_effects / 'screen.txt').read_text()
    assert 'GAP EXPLAINED by 2 effects' in screen
    assert 'self-check: 1 of 1 simulated recordings had the same verdict' in screen
    report = json.loads((two_effects / 'gap' / 'report.json').read_text())
    assert set(report['verdict']['effects']) == {'lever_arm', 'temperature_bias'}
    found = {c['effect']: c['parameters'] for c in report['candidates']}
    # An interval of 90 % is 1.645 standard deviations wide on either side, and 4 always hold.
    for effect, key, value in (
        ('lever_arm', 'x_m', 0.03),
        ('lever_arm', 'y_m', 0.02),
        ('temperature_bias', 'per_k.x', 4e-4),
        ('temperature_bias', 'per_k.y', 4e-4),
    ):
        low, high = found[effect][key]['ci']
        assert abs(value - (low + high) / 2) < 4 / 1.645 * (high - low) / 2
    sensor = parameter_file.load(two_effects / 'gap' / 'params.yaml')
    assert set(sensor.effects) == {'lever_arm', 'temperature_bias'}
    page = (two_effects / 'gap' / 'report.html').read_text()
    assert 'temperature_bias' in page and 'http' not in page
    again = run_tool(
        'diagnose',
        two_effects / 'run.csv',
        '--params',
        two_effects / 'gap' / 'params.yaml',
        '-o',
        'again',
        '--json',
    )
    assert json.loads(again.stdout)['verdict']['status'] == 'no_gap'


def test_what_recordings_cannot_separate_is_one_group():
    """Where the supply follows the temperature, both give the same samples."""
    motion = warm(turning())
    motion = replace(
        motion, supply_v=Knots(np.linspace(0.0, motion.duration_s, 4), [5.0, 5.0, 5.06, 5.04])
    )
    diagnosis = diagnose([simulated(unit(), 'temperature_bias:per_k=4e-4', motion=motion)], unit())
    report = report_of(diagnosis)
    assert 'temperature_bias' in named(report)
    assert len(named(report)) == 1 or report['verdict']['status'] == 'inseparable'


def test_an_effect_outside_the_library_is_unknown():
    """A zero-g that follows the fourth harmonic of beta is unknown over beta."""

    def change(columns):
        for axis, phase in (('x', 0.0), ('y', 1.0)):
            columns[f'{axis}_v'] += 4e-3 * np.sin(4 * columns['beta_rad'] + phase)
        return columns

    report = report_of(diagnose([simulated(unit(), change=change)], unit()))
    assert report['verdict']['status'] in ('unknown', 'partly')
    assert 'beta_rad' in report['rest_follows']


def test_vibration_while_joints_move_is_of_the_stage():
    """It is larger than what the lever arm adds, and does not hide it."""
    added_v = 0.0

    def shaken(columns):
        nonlocal added_v
        moves = np.abs(np.gradient(columns['beta_rad'])) > 1e-4
        added_v = moves[:, None] * np.random.default_rng(5).normal(0, 0.008, (len(moves), 2))
        return {
            **columns,
            'x_v': columns['x_v'] + added_v[:, 0],
            'y_v': columns['y_v'] + added_v[:, 1],
        }

    recording = simulated(unit(), 'lever_arm:x_m=0.01,y_m=0.01', change=shaken)
    diagnosis = diagnose([recording], unit())
    verdict = diagnosis.report.verdict
    assert (verdict.status, verdict.effects) == ('partly', ('lever_arm',))
    vibration_mps2 = G0_MPS2 * np.sqrt(np.mean(added_v**2))
    assert verdict.vibration_mps2 == pytest.approx(vibration_mps2, rel=0.1)
    assert 'only while joints move' in as_json(diagnosis)['summary']


def test_the_nominal_file_lacks_zero_g_and_scale_factor():
    """The first diagnosis of a unit, without its calibration, names what a calibration gives."""
    report = report_of(
        diagnose(
            [simulated(unit())], replace(nominal('xy'), rate_hz=125.0, stage_resolution_rad=1e-4)
        )
    )
    assert report['verdict']['effects'] == ['bias', 'scale_factor']
    assert report['gap']['closed'] > 0.95


def values(change):
    """Return a change of the volts of all axes about the zero-g."""
    return lambda c: c | {a: change(c[a] - 2.5) + 2.5 for a in ('x_v', 'y_v')}


@pytest.mark.parametrize(
    'change, fault',
    [
        (lambda c: c | {'x_v': c['y_v'], 'y_v': c['x_v']}, 'axis_swapped'),
        (lambda c: c | {'y_v': 5 - c['y_v']}, 'axis_inverted'),
        (values(lambda v: v * 9.80665), 'unit: m/s² instead of g'),
        (values(lambda v: v / 9.80665), 'unit: g instead of m/s²'),
        (values(lambda v: v * 1e3), 'unit: mV instead of V'),
        (lambda c: c | {'time_s': c['time_s'] + 40.0 * (c['time_s'] > 30)}, 'clock_jump'),
        (values(lambda v: np.roll(v, 300)), 'time_misaligned'),
        (
            lambda c: c | {'x_v': np.where(np.arange(len(c['x_v'])) % 2, np.nan, c['x_v'])},
            'missing',
        ),
        (lambda c: c | {'x_v': np.full(len(c['x_v']), 2.5)}, 'constant'),
        (lambda c: c | {'x_v': np.clip(c['x_v'], 2.4, 2.6)}, 'saturated'),
        (lambda c: {k: v[:1250] for k, v in c.items()}, 'too_short'),
    ],
)
def test_faults_of_the_recording_are_one_line(change, fault):
    name, _, text = fault.partition(': ')
    diagnosis = diagnose([simulated(unit(), change=change)], unit())
    report = report_of(diagnosis)
    assert (diagnosis.fault.name, diagnosis.report) == (name, None)
    assert report['verdict']['status'] in ('bad_data', 'insufficient')
    assert report['verdict']['effects'] == [] and '\n' not in report['summary']
    assert text in report['summary']


def drawn(seed):
    rng = np.random.default_rng(seed)
    axes = str(rng.choice(['x', 'xy', 'xyz']))
    sensor = replace(
        nominal(axes), adc_bits=int(rng.choice([0, 16])), rate_hz=float(10 ** rng.uniform(1, 3.3))
    )
    name = str(rng.choice(['rich', 'tilt_both', 'tumble', 'soak']))
    motion = trajectories.TRAJECTORIES[name](rng)
    motion = replace(motion, duration_s=min(motion.duration_s, rng.uniform(25, 50)))
    known = sorted(e.name for e in library().values() if Need.ROBOT not in e.needs)
    effects = rng.choice(known, rng.integers(0, 3), replace=False)
    effects = [e for e in map(str, effects) if sensor.adc_bits or e != 'quantisation']

    def change(columns):
        name = str(rng.choice([c for c in columns if c != 'time_s']))
        column = columns[name]
        odd = (
            column,
            np.full(len(column), column[0]),
            np.full(len(column), np.nan),
            column * 10.0 ** rng.uniform(3, 100),
            column * 10.0 ** -rng.uniform(3, 100),
            np.where(rng.random(len(column)) < 0.2, np.nan, column),
        )[seed % 6]
        return columns | {name: odd}

    return simulated(sensor, *effects, motion=motion, seed=seed, change=change), sensor


@pytest.mark.parametrize('seed', range(6))
def test_any_recording_ends_with_a_verdict_or_one_line(seed):
    made, sensor = drawn(seed)
    try:
        report_of(diagnose([made], sensor))
    except UserError as error:
        assert '\n' not in str(error)


def test_a_recording_at_rest_is_insufficient():
    still = Motion(60.0, Held(1.0), Held(0.5))
    report = report_of(diagnose([simulated(unit(), motion=still)], unit()))
    assert report['verdict']['status'] == 'insufficient'
    assert 'motion' in report['not_covered'] and report['next_experiment']


def test_an_unknown_pose_moves_no_zero_g():
    """What is fitted beside the effect is relative to the median output of the recording."""
    sensor = replace(unit(), rate_hz=10.0)
    heated = Knots(np.array([0.0, 300.0, 600.0]), [20.0, 50.0, 30.0])
    still = Motion(600.0, Held(1.0), Held(0.5), temperature_c=heated)
    made = simulated(sensor, 'temperature_bias:per_k=4e-4', motion=still)
    found = diagnose([made], sensor).report
    assert 'temperature_bias' in found.verdict.named
    np.testing.assert_array_equal(
        found.sensor.values['bias']['offset_v'], sensor.values['bias']['offset_v']
    )


def test_blocks_that_leave_the_zero_g_open_make_no_gap():
    sensor = replace(nominal('xy'), rate_hz=20.0)
    soak = trajectories.TRAJECTORIES['soak'](np.random.default_rng(0))
    report = report_of(diagnose([simulated(sensor, motion=soak, seed=4)], sensor))
    assert report['verdict']['status'] == 'no_gap'


def test_next_experiment_separates_most():
    """Heating separates temperature from supply, and a shaker does not."""
    rivals, sensor = (
        ('temperature_bias', 'supply'),
        with_effects(unit(), ['temperature_bias:per_k=3e-4']),
    )
    verdict = diagnosed()[0].report.verdict
    verdict = replace(
        verdict,
        status='inseparable',
        groups=(rivals,),
        hypotheses=tuple(WeightedHypothesis((effect,), 0.5) for effect in rivals),
    )
    proposal = propose_next_experiment(verdict, [], sensor, None, 0)
    worth = {m.name: m.per_minute for m in proposal.menu}
    best = proposal.menu[0]
    assert MENU[Manoeuvre[best.name]].text == proposal.manoeuvre
    assert max(worth.values()) == best.per_minute > 0
    assert worth['SHAKE'] < 0.1 * worth['HEAT']


def test_a_baseline_that_no_stage_can_move_gets_a_manoeuvre_without_a_menu():
    """The zero of a robot's joint is no effect of a stage, which could simulate nothing."""
    rivals = ('temperature_bias', 'supply')
    verdict = replace(
        diagnosed()[0].report.verdict, status='inseparable', effects=(), groups=(rivals,)
    )
    robot = with_effects(unit(), ['joint_offset:joint1_rad=0.01'])
    proposal = propose_next_experiment(verdict, [], robot, None, 0)
    assert proposal.manoeuvre == MENU[Manoeuvre.HEAT].text
    assert (proposal.why, proposal.menu) == ('to separate temperature_bias and supply', ())


def test_a_sensor_that_moves_without_a_reference_gets_no_verdict(run_tool, tmp_path, shared_dir):
    run = run_tool('diagnose', shared_dir / 'real' / 'mpu9150_0.csv', '-o', tmp_path, '--json')
    verdict = json.loads(run.stdout)['verdict']
    assert (verdict['status'], verdict['data_fault']) == ('bad_data', 'reference')


@pytest.mark.parametrize('name', ['no_gap', 'time_offset'])
def test_samples_of_another_generator(run_tool, tmp_path, shared_dir, name):
    folder = shared_dir / 'samples' / name
    run_tool('fit', folder / 'cal.csv', '--model', 'linear', '-o', tmp_path / 'unit.yaml')
    run = run_tool(
        'diagnose',
        folder / 'run.csv',
        '--params',
        tmp_path / 'unit.yaml',
        '-o',
        tmp_path / 'out',
        '--json',
    )
    verdict = json.loads(run.stdout)['verdict']
    assert (verdict['status'], verdict['effects']) == (
        ('no_gap', []) if name == 'no_gap' else ('explained', [name])
    )


def test_the_upper_limit_holds_a_latency_that_is_within_tolerance():
    diagnosis = diagnose([simulated(unit(), 'time_offset:offset_s=2.5e-4')], unit())
    late = with_effects(unit(), ['time_offset:offset_s=2.5e-4'])
    compared = diagnosis.full_rate[0]
    change_mps2 = (compared.simulated_v(late) - compared.simulated_v(unit())) / (
        compared.scale_v_per_mps2
    )
    verdict = diagnosis.report.verdict
    assert verdict.status == 'no_gap'
    assert verdict.tolerated_mps2 == pytest.approx(np.sqrt(np.mean(change_mps2**2)), rel=0.1)
    assert verdict.tolerated_mps2 < verdict.upper_limit_mps2
    assert 'latency' in as_json(diagnosis)['summary']
