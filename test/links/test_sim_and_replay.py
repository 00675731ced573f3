# SPDX-License-Identifier: Apache-2.0

"""The links without ROS: the simulated sensor and stage, and the replay."""

from dataclasses import fields, replace
import sys
import time

from adxl_ros.errors import UserError
import adxl_ros.links
from adxl_ros.links import replay, sim
from adxl_ros.links.support import base
from adxl_ros.model import noise
from adxl_ros.model.effects.base import Joint
from adxl_ros.model.kinematics import specific_force, specific_force_in_motion
from adxl_ros.model.sensor import to_nominal_mps2
from adxl_ros.simulate.simulated_stage import SimulatedStage
import numpy as np
from processes import REPO
import pytest
from units import nominal

MS = 1_000_000
START = 1_700_000_000 * 10**9


def simulated(sensor=None, alpha=np.pi / 2, beta=0.0, seed=0):
    link = sim.open_link(
        sensor or nominal(), sim.Settings(alpha_rad=alpha, beta_rad=beta, seed=seed)
    )
    link.begin(START)
    return link


def ideal():
    """Return a sensor without noise, filter and ADC: its output is the specific force."""
    return nominal('xyz', noise_density_g_per_rthz=np.zeros(3), rc_capacitance_f=0.0, adc_bits=0)


def read_until(link, until_ns, step_ns):
    parts = [link.read(now) for now in range(START, until_ns + 1, step_ns)]
    return (np.concatenate([p.stamp_ns for p in parts]), np.concatenate([p.volts for p in parts]))


def test_every_link_can_be_opened_by_its_name():
    assert base.link_names()[0] == 'sim'
    assert 'replay' in base.link_names()
    for name in base.link_names():
        assert callable(base.link_module(name).open_link)


def test_the_example_of_the_documentation_is_a_link(tmp_path, monkeypatch):
    text = (REPO / 'docs' / 'howto' / 'own_link.md').read_text(encoding='utf-8')
    (tmp_path / 'constant.py').write_text(text.split('```python\n')[1].split('```')[0])
    monkeypatch.setattr(adxl_ros.links, '__path__', [*adxl_ros.links.__path__, str(tmp_path)])
    monkeypatch.delitem(sys.modules, 'adxl_ros.links.constant', raising=False)
    assert 'constant' in base.link_names()
    module = base.link_module('constant')
    assert [option.name for option in fields(module.Settings)] == ['level_v']
    link = module.open_link(nominal(), module.Settings(level_v=1.5))
    assert link.begin(0) == 0
    assert link.read(0).volts.tolist() == [[1.5, 1.5]]
    assert link.status() == base.LinkStatus(base.Level.OK, 'streaming')
    link.close()


def test_sim_samples_a_pose_with_the_stated_noise():
    sensor = nominal()
    stamps, volts = read_until(simulated(sensor), START + 20_000 * MS, 4 * MS)
    assert np.array_equal(stamps, START + MS * np.arange(20_001))
    expected = [2.5 + 1.0, 2.5]  # 1 V/g along the vertical
    count = noise.effective_samples(len(volts), 1e-3, sensor.rc_s)
    std_v = noise.sample_std_v(sensor)
    assert np.abs(volts.mean(0) - expected).max() < 5 * std_v[0] / count**0.5
    assert volts.std(0) == pytest.approx(std_v, rel=0.15)


def turning(t):
    """Return a smooth motion at a time, s: positions and velocities by joint."""
    return (
        {
            'alpha': 0.5 + 0.4 * np.sin(3 * t),
            'beta': -2 * np.cos(t),
            'shift': 0.01 * np.sin(8 * t),
        },
        {'alpha': 1.2 * np.cos(3 * t), 'beta': 2 * np.sin(t), 'shift': 0.08 * np.cos(8 * t)},
    )


def test_sim_senses_the_true_motion_at_its_samples():
    link = simulated(ideal())
    for k in range(101):
        link.sense_stage(START + k * 10 * MS, *turning(k * 0.01))
    samples = link.read(START + 5000 * MS)
    assert samples.until_ns == START + 1000 * MS, 'sensor time waits for the stage'
    t = (samples.stamp_ns - START) * 1e-9
    position, rate = turning(t)
    growth = {'alpha': -3.6 * np.sin(3 * t), 'beta': 2 * np.cos(t), 'shift': -0.64 * np.sin(8 * t)}
    joints = [Joint(position[j], rate[j], growth[j]) for j in ('alpha', 'beta', 'shift')]
    truth = np.column_stack(specific_force_in_motion(*joints, 9.80665))
    error = np.abs(to_nominal_mps2(samples.volts, ideal()) - truth)[1:]
    assert error.max() < 1e-3, 'second derivatives are those of the interpolation'
    assert error[:, 2].max() < 1e-4


def test_sim_waits_for_a_stage_and_holds_the_pose_of_a_lost_one(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, 'monotonic', lambda: clock[0])
    link = simulated(ideal())
    assert link.read(START + 100 * MS).until_ns == START + 100 * MS
    link.sense_stage(START + 200 * MS, {'alpha': 0.3, 'beta': 0.0}, {})
    assert link.read(START + 900 * MS).until_ns == START + 200 * MS
    # A minute between two reads: the process was held up, and the stage perhaps as well.
    clock[0] += 60.0
    assert not len(link.read(START + 1000 * MS).stamp_ns), 'held up, like the stage'
    # A stage counts as lost after 1 s of reads; the long one counts as 0.1 s.
    turn_s = 0.05
    for _ in range(16):
        clock[0] += turn_s
        assert not len(link.read(START + 1100 * MS).stamp_ns), 'silent for 0.9 s'
    for _ in range(8):
        clock[0] += turn_s
        link.read(START + 1100 * MS)
    after = link.read(START + 1300 * MS)
    assert after.until_ns == START + 1300 * MS
    assert link.status().level == base.Level.WARN
    assert 'stage lost' in link.status().text
    held = np.column_stack(specific_force(np.array([0.3]), 0.0, 9.80665))
    assert np.abs(to_nominal_mps2(after.volts, ideal()) - held).max() < 1e-9
    link.sense_stage(START + 1310 * MS, {'alpha': 0.3, 'beta': 0.0}, {})
    assert link.status() == base.LinkStatus(base.Level.OK, 'on the stage')
    assert link.read(START + 9000 * MS).until_ns == START + 1310 * MS


def a_stage(**changes):
    settings = {
        'pose': np.zeros(3),
        'slew': np.array([0.5, 0.5, 0.01]),
        'settling_s': 0.3,
        'resolution': np.array([1.5e-3, 1.5e-3, 0.0]),
        'seed': 3,
    } | changes
    return SimulatedStage(**settings)


def test_stage_moves_at_the_slew_rate_to_the_commanded_encoder_step():
    stage = a_stage()
    stage.command({'alpha': 0.5, 'beta': -0.3})
    fastest = 0.0
    for _ in range(130):
        stage.step(0.01)
        fastest = max(fastest, np.abs(stage.velocity).max())
    assert fastest == pytest.approx(0.5, rel=1e-3)
    assert not stage.moving()
    assert stage.encoder()[:2] == pytest.approx(np.rint(np.array([0.5, -0.3]) / 1.5e-3) * 1.5e-3)
    difference = np.abs(stage.position - stage.encoder())[:2]
    assert (difference <= 0.75e-3).all()
    assert (difference > 1e-6).all(), 'the true pose differs from the reading of the encoder'


@pytest.mark.parametrize(
    'command', [{'gamma': 0.1}, {'alpha': np.nan}, {'alpha': 0.1, 'beta': np.inf}, {'alpha': 1e38}]
)
def test_stage_refuses_a_command_with_one_invalid_joint_completely(command):
    stage = a_stage()
    before = stage.position.copy()
    with pytest.raises(UserError, match=list(command)[-1]):
        stage.command(command)
    stage.step(1.0)
    assert stage.position == pytest.approx(before, abs=1e-12)


def written(path, rows, head='time_s,ax_mps2,ay_mps2,az_mps2'):
    path.write_text('\n'.join([head, *(','.join(map(repr, row)) for row in rows)]) + '\n')
    return path


def opened(path, loop=False, sensor=None):
    link = replay.open_link(sensor or nominal(), replay.Settings(recording=str(path), loop=loop))
    link.begin(START)
    return link


ROWS = [(5.0 + 0.01 * k, 0.1 * k, -1.0, 9.8) for k in range(50)]


def test_replay_returns_every_row_at_its_time(tmp_path):
    link = opened(written(tmp_path / 'r.csv', ROWS))
    assert link.sensor.axes == 'xyz'
    assert link.sensor.rate_hz == pytest.approx(100)
    assert link.start_ns == 5 * 10**9
    first = link.read(START + 95 * MS)
    assert np.allclose(first.stamp_ns, START + 10 * MS * np.arange(10), atol=1, rtol=0)
    assert to_nominal_mps2(first.volts, link.sensor)[:, 0] == pytest.approx(
        0.1 * np.arange(10), abs=1e-12
    )
    rest = link.read(START + 10_000 * MS)
    assert len(rest.stamp_ns) == 40
    assert first.missing == rest.missing == 0
    assert link.status().text == 'playing', 'the last rows are not published yet'
    assert not len(link.read(START + 20_000 * MS).stamp_ns)
    assert link.status().text == 'ended'


def test_replay_loops_without_a_gap(tmp_path):
    link = opened(written(tmp_path / 'r.csv', ROWS), loop=True)
    stamps, now = [], START
    while len(stamps) < 120:
        samples = link.read(now := now + 7 * MS)
        stamps += samples.stamp_ns.tolist()
        assert not samples.missing
    assert np.allclose(np.diff(stamps), 10 * MS, atol=2, rtol=0)
    assert link.status().text == 'playing'


def test_replay_uses_what_the_recording_states(tmp_path):
    path = tmp_path / 'r.csv'
    path.write_text(
        '# serial: 17\n# rate_hz: 200.0\n# nominal_zero_g_v: 1.5, 1.6\n'
        '# nominal_scale_v_per_g: 0.3, 0.4\ntime_s,x_v,y_v,temperature_c\n'
        '0.0,1.5,2.0,20.5\n0.005,1.8,1.6,\n'
    )
    link = opened(path, sensor=replace(nominal(), serial='5'))
    assert (link.sensor.serial, link.sensor.rate_hz, link.sensor.axes) == ('17', 200.0, 'xy')
    assert link.references == ('temperature_c',)
    samples = link.read(START + 1000 * MS)
    assert to_nominal_mps2(samples.volts, link.sensor) == pytest.approx(
        np.array([[0, 9.80665], [9.80665, 0]])
    )
    assert samples.references['temperature_c'][0] == 20.5
    assert np.isnan(samples.references['temperature_c'][1])


@pytest.mark.parametrize(
    'text, reason',
    [
        ('', 'empty'),
        ('time_s,x_v\n0.0,1.0\n0.1,two\n', 'two'),
        ('# rate_hz: fast\ntime_s,x_v\n0.0,1.0\n', 'rate_hz'),
    ],
)
def test_replay_reports_a_fault_in_one_line(tmp_path, text, reason):
    path = tmp_path / 'bad.csv'
    path.write_text(text)
    with pytest.raises(UserError) as error:
        opened(path).read(START + 10_000 * MS)
    assert str(path) in str(error.value)
    assert reason in str(error.value)
    assert '\n' not in str(error.value)
