# SPDX-License-Identifier: Apache-2.0

"""Every refusal of a pose names the value, the axis or joint, and the expected value."""

from dataclasses import replace
import re

from adxl_ros.calibrate.guided import running_estimate
from adxl_ros.calibrate.guided.pose_plan import guided, Target
from adxl_ros.calibrate.guided.rest_guides import HandGuide
from adxl_ros.calibrate.guided.screen_contents import CaptureSettings, Phase, StageMode
from adxl_ros.calibrate.guided.stage_guide import MountingError, StageGuide
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import parameter_of
import numpy as np
import pytest
from units import Bench, drawn, Fed, nominal, pose_record, swept

UP = Target(np.pi / 2, 0.0)
NEXT = Target(np.pi / 2, np.pi / 6)


def bench(mode='commanded', targets=(UP, NEXT), sensor=None, accepted=(), **settings):
    sensor = sensor or nominal()
    chosen = CaptureSettings(1.0, np.radians(0.2), 20.0, StageMode(mode), **settings)
    return Bench(StageGuide(nominal(sensor.axes), targets, chosen, accepted), sensor)


def refusal(rig):
    state = rig.sweep.status()
    assert state.phase is Phase.REFUSED and state.late
    assert state.text == rig.sweep.new_refusal()
    return state.text


def test_a_stage_turned_by_hand_is_captured_near_its_target():
    """An error of 3.2° is refused at once. With 1° the angle of the encoder counts."""
    by_hand = bench('encoder', [Target(np.pi / 2, np.radians(30))])
    by_hand.run(0.5, np.pi / 2, np.radians(33.2))
    assert (
        by_hand.sweep.capture()
        == 'beta is 3.2° from the target 30°; turn the stage there and capture again'
    )
    by_hand.run(0.5, np.pi / 2, np.radians(31))
    assert by_hand.sweep.capture() == ''
    assert by_hand.run(4, np.pi / 2, np.radians(31)).beta_rad == pytest.approx(np.radians(31))


def test_a_stage_without_encoder_must_stay_where_it_was_captured():
    by_hand = bench('manual')
    by_hand.run(0.2, np.pi / 2, 0.0)
    assert by_hand.sweep.capture() == ''
    by_hand.run(0.8, np.pi / 2, 0.0)
    assert by_hand.run(3, np.pi / 2, np.radians(4)) is None
    assert 'the pose changed after the capture: y moved by 0.07 g' in refusal(by_hand)


def test_a_silent_encoder_is_reported_and_gives_no_pose():
    dead = bench('encoder')
    dead.run(0.5, np.pi / 2, 0.0)
    dead.run(4, np.pi / 2, 0.0, encoder=False)
    words = 'nothing on stage/joint_states for 4 s'
    assert dead.sweep.capture() == f'{words}: in stage.mode encoder its angle counts'
    state = dead.sweep.status()
    assert state.text == words and state.late
    for mode in ('encoder', 'commanded'):
        dead = bench(mode)
        dead.run(0.2, np.pi / 2, 0.0)
        assert dead.sweep.capture() == ''
        assert dead.run(5, np.pi / 2, 0.0, encoder=False) is None
        state = dead.sweep.status()
        assert state.text == 'nothing on stage/joint_states for 5 s' and state.late
        message = f'{words.replace("4", "3")}; capture again when it is back'
        assert dead.sweep.new_refusal() == (message if mode == 'encoder' else '')
        dead.run(0.5, np.pi / 2, 0.0)
        dead.sweep.capture()
        assert dead.run(3, np.pi / 2, 0.0)


@pytest.mark.parametrize(
    'turned, words',
    [
        (np.pi, 'x reads −1.00 g where +1.00 g was expected: axis inverted or swapped'),
        (-np.pi / 2, 'y reads +1.00 g where +0.00 g was expected: axis inverted or swapped'),
    ],
)
def test_the_first_pose_shows_inverted_or_swapped_axes(turned, words):
    wrong = bench('manual', [Target(np.pi / 2, 0.0)])
    wrong.run(0.2, np.pi / 2, turned, encoder=False)
    wrong.sweep.capture()
    assert wrong.run(4, np.pi / 2, turned, encoder=False) is None
    assert words in refusal(wrong)


def test_a_wrong_pose_is_refused_once_the_unit_is_estimated():
    """After one plane an error of 3°, 52 mg, is refused."""
    sensor = drawn(np.random.default_rng(5), nominal())
    targets = guided([np.pi / 2], np.radians(30), 0)
    poses = swept(np.random.default_rng(1), sensor, [np.pi / 2], 0)
    accepted = [
        pose_record(
            i,
            alpha_rad=np.pi / 2,
            beta_rad=poses.beta_rad[i],
            mean_v=tuple(poses.volts[i]),
            std_v=tuple(poses.std_v[i]),
        )
        for i in range(8)
    ]
    hand = bench('manual', targets, sensor, accepted)
    hand.sweep.skip([].append)  # the check of the mounting
    target = hand.sweep.course.target
    hand.run(0.2, target.alpha_rad, target.beta_rad + np.radians(3), encoder=False)
    hand.sweep.capture()
    assert hand.run(4, target.alpha_rad, target.beta_rad + np.radians(3), encoder=False) is None
    assert re.search('[xy] reads .* g where .* g was expected', refusal(hand))
    hand.sweep.capture()
    assert hand.run(4, target.alpha_rad, target.beta_rad, encoder=False)


@pytest.mark.long
def test_units_at_the_edge_of_the_datasheet_are_never_refused():
    rng = np.random.default_rng(7)
    for _ in range(8):
        truth = drawn(rng, nominal('xyz'))
        truth = replace(
            truth,
            values={
                e: {p: _edge(Coefficient(e, p), v) for p, v in parameters.items()}
                for e, parameters in truth.values.items()
            },
        )
        poses = swept(rng, truth, check_poses=0)
        order = rng.permutation(len(poses))[:12]
        estimate = None
        for count in range(len(order)):
            estimate = running_estimate.from_poses(
                nominal('xyz'), poses.subset(order[:count]), 5.0, 4.2e-4, estimate
            )
            i = order[count]
            target = Target(poses.alpha_rad[i], poses.beta_rad[i])
            assert not estimate.reading_fault(target, poses.volts[i], np.radians(0.2))


def _edge(name, value):
    limit = 2 * parameter_of(name).scale
    return np.clip(4 * value, -limit, limit)


def test_a_change_of_temperature_is_refused():
    warm = bench()
    warm.sweep.readings['temperature'].add(warm.now_ns, 23.0)
    first = warm.run(5, np.pi / 2, 0.0)
    assert first.temperature_c == 23.0
    warm.sweep.take(first)
    warm.sweep.readings['temperature'].add(warm.now_ns, 27.0)
    assert warm.run(4, np.pi / 2, np.pi / 6) is None
    assert refusal(warm).startswith('temperature moved 4.0 °C since the first pose (23.0 to 27.0')
    warm.sweep.readings['temperature'].add(warm.now_ns, 24.0)
    assert warm.run(5, np.pi / 2, np.pi / 6).temperature_c == 24.0


@pytest.mark.parametrize(
    'ahead_s, words',
    [(-40.0, 'stamped 40 s behind imu/data_raw'), (7200.0, 'stamped 2 h ahead of imu/data_raw')],
)
def test_a_stage_on_another_clock_is_reported(ahead_s, words):
    apart = bench()
    for _ in range(80):
        apart.sweep.read_encoder(int(apart.now_ns + ahead_s * 1e9), np.pi / 2, 0.0)
        assert apart.run(0.05, np.pi / 2, 0.0, encoder=False) is None
    state = apart.sweep.status()
    assert state.late and words in state.text and 'use_sim_time' in state.text


@pytest.mark.parametrize(
    'by_rad, words', [(0.0, ''), (np.radians(3), 'mounting changed: in pose 1 y reads')]
)
def test_the_mounting_is_verified_after_an_interruption(by_rad, words):
    before = bench()
    entry = before.run(5, np.pi / 2, 0.0)
    after = bench(accepted=[entry])
    assert after.sweep.to_verify
    assert 'once more, to see that the mounting' in after.sweep.destination()
    assert after.sweep.course.target == UP
    if not words:
        assert after.run(4, np.pi / 2, 0.0) is None
        assert not after.sweep.to_verify and after.sweep.course.target == NEXT
        return
    after.fed = Fed(
        replace(
            nominal(),
            effects=('misalignment',),
            values={'misalignment': {'alpha_rad': np.zeros(2), 'beta_rad': np.full(2, by_rad)}},
        )
    )
    with pytest.raises(MountingError, match=words):
        after.run(4, np.pi / 2, 0.0)


def test_by_hand_directions_are_requested_until_all_are_covered():
    """The requested directions cover faces, edges and corners, and determine the sensor."""
    sensor = nominal('xyz')
    truth = drawn(np.random.default_rng(2), sensor, ('bias', 'scale_factor', 'misalignment'))
    guide = HandGuide(sensor, 3.0)
    fed = Fed(truth, 4)
    now_ns, requests, errors = 10**18, [], []
    for _ in range(16):
        requests.append(guide.destination())
        up = _direction(guide)
        for seconds, shake in ((0.5, 3.0), (2.5, 0.0), (1.6, 3.0)):
            time = np.arange(round(1000 * seconds)) / 1000
            volts = fed([9.80665 * u + shake * np.sin(40 * time) for u in up])
            guide.feed(now_ns + np.arange(len(volts)) * 1_000_000, volts)
            now_ns += len(volts) * 1_000_000
        while (entry := guide.accept()) is not None:
            guide.take(entry)
        errors.append(guide.tilt_error_rad())
    assert len(guide.accepted) == 16
    assert requests[0].startswith('turn it so that +') and 'points up' in requests[0]
    edges = [words for words in requests if ' and ' in words.split(', and hold')[0]]
    assert edges and all(' point up equally' in words for words in edges)
    assert len(set(requests)) == 16, 'a direction was requested twice'
    assert errors[-1] < errors[0] / 20
    assert guide.redo([].append) == 'rest 16 is forgotten; hold the sensor in that direction again'
    assert len(guide.poses_to_fit()) == 15
    assert 'is left out' in guide.skip([].append)


def _direction(guide):
    from adxl_ros.calibrate.fits.cube_directions import UP as EACH

    return EACH[guide.next_up]


def test_a_dead_axis_is_reported_at_the_first_pose_that_should_change_it():
    """A disconnected axis always reads zero-g."""
    dead = bench(sensor=nominal(nominal_scale_v_per_g=np.array([1e-3, 1.0])))
    assert dead.run(4, np.pi / 2, 0.0) is None
    assert 'x reads +0.00 g where +1.00 g was expected' in refusal(dead)
