# SPDX-License-Identifier: Apache-2.0

"""What is wrong with another simulator, or was not measured, is named for its own reason."""

from dataclasses import replace
import re

from adxl_ros.api.recordings import read_ideal
from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.data_checks import check_gravity, compare_checked
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.noise_effects import residual_detections
from adxl_ros.diagnose.sample_faults import sample_faults
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import to_volts
from adxl_ros.simulate.motion import ForcePath, Motion
from adxl_ros.simulate.recorded_motion import motion_from_force
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from units import nominal

RATE_HZ, SECONDS, REST_S = 100.0, 60.0, 8.0
NOISE_MPS2 = 0.006
LARGEST_LEFT_MPS2 = 10 * NOISE_MPS2  # 0.1 s late, the force is wrong by more.


class Carried:
    """A sensor that rests, is carried about, and rests again, and its simulator."""

    def __init__(self, seed=3, seconds=SECONDS):
        rng = np.random.default_rng(seed)
        self.time_s = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
        begin = np.clip((self.time_s - REST_S) / 3, 0, 1)
        end = np.clip((seconds - REST_S - self.time_s) / 3, 0, 1)
        envelope = begin**2 * (3 - 2 * begin) * end**2 * (3 - 2 * end)

        def wander(highest_hz, rms):
            hz, phase, size = (
                rng.uniform(0.05, highest_hz, 16),
                rng.uniform(0, 6.28, 16),
                rng.normal(0, 0.25, 16),
            )
            waves = np.sin(2 * np.pi * hz * self.time_s[:, None] + phase)
            return rms * np.sqrt(2) * envelope * (waves @ size)

        turned = Rotation.from_euler('ZYX', np.column_stack([wander(0.3, 0.5) for _ in range(3)]))
        self.frame = turned.inv()
        self.acceleration = np.column_stack([wander(0.8, 0.4) for _ in range(3)])
        self.noise = rng.normal(0, NOISE_MPS2, self.acceleration.shape)

    def force(self, factor=1.0):
        """Return the specific force, m/s², (n, 3), whose dynamic part has a factor."""
        return self.frame.apply(factor * self.acceleration + [0, 0, G0_MPS2])

    def recorded(self, change=lambda force: force):
        """Return the recording of a sensor."""
        sensor = replace(nominal('xyz'), rate_hz=RATE_HZ)
        volts = to_volts(change(self.force() + self.noise), sensor)
        columns = {f'{axis}_v': v for axis, v in zip('xyz', volts.T)}
        return Recording('carried', self.time_s, columns, sensor_info(sensor))

    def simulated(self, folder, force=None, time_s=None, unit=''):
        """Return the motion that a file of a simulator has."""
        time_s = self.time_s if time_s is None else time_s
        rows = [time_s, self.force() if force is None else force]
        np.savetxt(
            folder / 'sim.csv',
            np.column_stack(rows),
            '%.6f',
            ',',
            comments='',
            header='time_s,ax_mps2,ay_mps2,az_mps2',
        )
        return motion_from_force(read_ideal(folder / 'sim.csv', 0, unit), False)

    def beside(self, folder, recorded, force=None, time_s=None, may_shift=False):
        """Put a recording beside a simulator."""
        sim = self.simulated(folder, force, time_s)
        return compare_checked(recorded, replace(nominal('xyz'), rate_hz=RATE_HZ), sim, may_shift)


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
@pytest.mark.parametrize('gravity_mps2', [1.62, 3.73])
def test_a_world_with_another_gravity_is_no_fault_of_the_sensor(tmp_path, gravity_mps2, axes):
    carried = Carried()
    force = carried.frame.apply(carried.acceleration + [0, 0, gravity_mps2])
    sensor, sim = replace(nominal(axes), rate_hz=RATE_HZ), carried.simulated(tmp_path, force)
    recorded = carried.recorded()
    kept = {name: v for name, v in recorded.columns.items() if name[0] in axes}
    with pytest.raises(DataFault) as raised:
        check_gravity(replace(recorded, columns=kept, info=sensor_info(sensor)), sensor, sim)
    assert raised.value.name == 'reference'
    assert f'{gravity_mps2:g} m/s² long' in raised.value.message


@pytest.mark.parametrize('factor', [0.5, 1.5, 4.0])
def test_a_wrong_dynamic_part_is_an_error_of_the_simulator(tmp_path, factor):
    carried = Carried()
    with pytest.raises(DataFault) as raised:
        carried.beside(tmp_path, carried.recorded(), carried.force(factor))
    assert raised.value.name == 'reference'
    assert f'{factor:g} times' in raised.value.message


@pytest.mark.parametrize(
    'change',
    [lambda force: force, lambda force: 1.03 * force, lambda force: force + [0.2, -0.1, 0.3]],
)
def test_a_right_simulator_is_compared(tmp_path, change):
    """Errors of the sensor are none of the simulator, and no rest is left out."""
    carried = Carried()
    comparison = carried.beside(tmp_path, carried.recorded(change))
    assert comparison.used[comparison.at_rest].all() and comparison.used.mean() > 0.9


@pytest.mark.parametrize(
    'per_mps2, advice',
    [
        (1 / G0_MPS2, 'state it by --sim-unit g'),
        (1e3 / G0_MPS2, 'state it by --sim-unit mg'),
        (1e3, 'state it by --sim-unit mmps2'),
        (1e-3, 'multiply its readings by 1000'),
        (16384 / G0_MPS2, 'multiply its readings by 0.00059855'),
    ],
)
def test_the_advice_on_a_simulator_in_another_unit_works(tmp_path, per_mps2, advice):
    carried, sensor = Carried(), replace(nominal('xyz'), rate_hz=RATE_HZ)
    recorded, force = carried.recorded(), carried.force() * per_mps2
    with pytest.raises(DataFault) as raised:
        check_gravity(recorded, sensor, carried.simulated(tmp_path, force))
    assert raised.value.name == 'unit' and raised.value.message.endswith(f'; {advice}')
    value = advice.split()[-1]
    mended = (
        carried.simulated(tmp_path, force, unit=value)
        if '--sim-unit' in advice
        else carried.simulated(tmp_path, force * float(value))
    )
    check_gravity(recorded, sensor, mended)
    assert left_mps2(compare_checked(recorded, sensor, mended, False)) < LARGEST_LEFT_MPS2


@pytest.mark.parametrize('step_s, fault', [(0.05, 'clock_jump'), (0.0, None)])
def test_a_step_of_the_simulators_clock_is_named(tmp_path, step_s, fault):
    """A constant delay, which an effect describes, is no step."""
    carried = Carried()
    late_s = np.where(carried.time_s > SECONDS / 2, 0.02 + step_s, 0.02)
    try:
        carried.beside(tmp_path, carried.recorded(), time_s=carried.time_s + late_s)
    except DataFault as raised:
        assert raised.name == fault and f'{step_s:g} s' in raised.message
    else:
        assert fault is None


def left_mps2(comparison):
    """Return the rms of the residual of a comparison, m/s², where it is used."""
    residual_g = comparison.residual_v(comparison.sensor) / comparison.sensor.scale_v_per_g
    return np.sqrt(np.mean(residual_g[comparison.used] ** 2)) * G0_MPS2


def only(recorded: Recording, rows: np.ndarray) -> Recording:
    """Return some rows, (n,) bool, of a recording."""
    columns = {name: values[rows] for name, values in recorded.columns.items()}
    return replace(recorded, time_s=recorded.time_s[rows], columns=columns)


@pytest.mark.parametrize(
    'step_s, at_s',
    [
        (0.4, 30.0),
        (3.0, 30.0),
        (-0.4, 30.0),
        (0.15, 11.0),
        (0.4, 13.0),
        (-0.25, 15.0),
        (2.0, 48.0),
        (10.0, 13.0),
    ],
)
def test_the_advice_on_a_clock_that_steps_can_be_followed(tmp_path, step_s, at_s):
    """No shift makes both parts fit; each of them fits with --align."""
    carried = Carried()
    recorded = carried.recorded()
    stamps_s = carried.time_s + step_s * (carried.time_s > at_s)
    kept = (carried.time_s <= at_s) | (stamps_s > at_s)
    stepped = only(replace(recorded, time_s=stamps_s), kept)
    for may_shift in (False, True):
        with pytest.raises(DataFault) as raised:
            carried.beside(tmp_path, stepped, may_shift=may_shift)
        assert raised.value.name == 'clock_jump' and '--align' in raised.value.message
    stated_s = float(re.search(r'at about ([\d.]+) s', raised.value.message)[1])
    # Stamps that jump leave a part without samples.
    assert at_s - 0.1 < stated_s < at_s + max(step_s, 0.0) + 0.1
    assert f'steps by {abs(step_s):.2g} s' in raised.value.message
    for rows in (stepped.time_s < stated_s, stepped.time_s > stated_s):
        comparison = carried.beside(tmp_path, only(stepped, rows), may_shift=True)
        assert left_mps2(comparison) < LARGEST_LEFT_MPS2


@pytest.mark.parametrize('stalled_s', [0.6, 3.0])
@pytest.mark.parametrize('read_s', [1e-4, 4e-3])
def test_a_host_that_stalls_is_no_clock_that_steps(tmp_path, stalled_s, read_s):
    """What waited is read at once, or faster than the sensor makes it."""
    carried = Carried()
    stamps_s = carried.time_s + 2e-4 * np.sin(np.arange(len(carried.time_s)))
    waits = (stamps_s > 20.0) & (stamps_s < 20.0 + stalled_s)
    earliest_s = np.where(waits, 20.0 + stalled_s, stamps_s)
    numbers_s = read_s * np.arange(len(stamps_s))
    stamps_s = np.maximum.accumulate(earliest_s - numbers_s) + numbers_s
    comparison = carried.beside(tmp_path, replace(carried.recorded(), time_s=stamps_s))
    assert left_mps2(comparison) < LARGEST_LEFT_MPS2
    (note,) = [text for text in comparison.notes if 'stalls' in text]
    assert f'{stalled_s:.2g} s late' in note or f'{stalled_s - 0.01:.3g} s late' in note
    assert float(re.search(r'first at ([\d.]+) s', note)[1]) == pytest.approx(20.0, abs=0.02)


def test_a_recording_beside_itself_is_named(tmp_path):
    carried = Carried()
    sim = carried.simulated(tmp_path, carried.force() + carried.noise)
    unfiltered = replace(nominal('xyz'), rate_hz=RATE_HZ, rc_capacitance_f=0.0)
    with pytest.raises(DataFault) as raised:
        compare_checked(carried.recorded(), unfiltered, sim, False)
    assert raised.value.name == 'reference' and 'the recording itself' in raised.value.message


@pytest.mark.parametrize('ratio, seconds', [(1e-2, 40.0), (-5e-3, 120.0), (2e-3, 300.0)])
@pytest.mark.parametrize('may_shift', [False, True])
def test_the_advice_on_clocks_that_drift_apart_can_be_followed(
    tmp_path, ratio, seconds, may_shift
):
    """No shift fits from begin to end, and there is no place to cut; another rate fits."""
    carried = Carried(seconds=seconds)
    recorded, stated_s = carried.recorded(), 5.0 + (1 + ratio) * carried.time_s
    with pytest.raises(DataFault) as raised:
        carried.beside(tmp_path, recorded, time_s=stated_s, may_shift=may_shift)
    assert raised.value.name == 'clock_drift'
    drift_s = re.search(r'([\d.]+) s in 100 s', raised.value.message)
    assert float(drift_s[1]) == pytest.approx(abs(100 * ratio), rel=0.02)
    rate_hz = float(re.search(r'--rate ([\d.]+)', raised.value.message)[1])
    mended = replace(recorded, time_s=np.arange(len(recorded)) / rate_hz)
    comparison = carried.beside(tmp_path, mended, time_s=stated_s, may_shift=True)
    assert left_mps2(comparison) < LARGEST_LEFT_MPS2


def test_no_rate_is_advised_where_samples_are_missing(tmp_path):
    """The number of a sample does not tell its time there."""
    carried = Carried()
    kept = (carried.time_s < 20) | (carried.time_s > 21)
    with pytest.raises(DataFault) as raised:
        carried.beside(tmp_path, only(carried.recorded(), kept), time_s=1.01 * carried.time_s)
    assert raised.value.name == 'clock_drift'
    factor = float(re.search(r'multiply its stamps by ([\d.]+)', raised.value.message)[1])
    assert factor == pytest.approx(1.01, abs=1e-4)


@pytest.mark.parametrize('ratio', [-1e-3, 2e-3])
def test_a_small_drift_is_left_to_the_effect_of_a_clock_skew(tmp_path, ratio):
    carried = Carried()
    carried.beside(tmp_path, carried.recorded(), time_s=(1 + ratio) * carried.time_s)


@pytest.mark.parametrize('size_g, count', [(24.0, 8), (2.0, 60), (0.2, 30)])
def test_samples_that_stand_alone_are_counted_with_their_size(tmp_path, size_g, count):
    rng = np.random.default_rng(4)
    carried = Carried()
    rows = rng.choice(np.arange(10, len(carried.time_s) - 10, 9), count, False)

    def struck(force):
        force = 1.01 * force
        force[rows] += size_g * G0_MPS2 * rng.choice([-1, 1], (count, 3))
        return force

    comparison = carried.beside(tmp_path, carried.recorded(struck))
    (part,) = [part for part in comparison.left_out if part.effect is not None]
    assert part.samples == pytest.approx(count, abs=0.1 * count)
    assert part.rms_mps2 == pytest.approx(size_g * G0_MPS2, rel=0.1)
    # They make no motion that the simulator would lack.
    assert comparison.fading_hz is None
    assert comparison.used.mean() > 0.9


@pytest.mark.parametrize('stuck_s, fault', [(SECONDS, 'constant'), (5.0, None)])
def test_an_axis_that_sticks_is_not_fast_motion(tmp_path, stuck_s, fault):
    carried = Carried()

    def sticks(force):
        begin = round(20 * RATE_HZ) if stuck_s < SECONDS else 0
        force[begin : begin + round(stuck_s * RATE_HZ), 1] = force[begin, 1]
        return force

    try:
        comparison = carried.beside(tmp_path, carried.recorded(sticks))
    except DataFault as raised:
        assert raised.name == fault
    else:
        assert fault is None
        (part,) = comparison.left_out
        assert 'y does not change' in part.reason
        assert part.duration_s == pytest.approx(stuck_s, abs=0.1)


@pytest.mark.parametrize('low_mps2, high_mps2', [(-2.0, np.inf), (-np.inf, 2.0), (-3.0, 2.0)])
def test_an_axis_that_is_held_at_an_end_of_its_range_is_left_out(tmp_path, low_mps2, high_mps2):
    carried = Carried()

    def clipped(force):
        force = force + [0.1, 0.0, 0.0]
        force[:, 0] = np.clip(force[:, 0], low_mps2, high_mps2)
        return force

    comparison = carried.beside(tmp_path, carried.recorded(clipped))
    x_mps2 = carried.force()[:, 0] + carried.noise[:, 0] + 0.1
    (part,) = [part for part in comparison.left_out if part.effect == 'saturation']
    assert part.samples == np.sum((x_mps2 <= low_mps2) | (x_mps2 >= high_mps2))
    for end_mps2 in filter(np.isfinite, (low_mps2, high_mps2)):
        assert f'{end_mps2:g}' in part.reason.split(' m/s²')[0]
    (found,) = sample_faults(comparison).detections
    limit_g, offset_g = found.values['limit_g'], found.values['offset_g']
    assert limit_g[1:].tolist() == [1000.0, 1000.0]
    is_unchanged = (x_mps2 > low_mps2) & (x_mps2 < high_mps2)
    simulated_g = np.clip(x_mps2 / G0_MPS2, *(offset_g[0] + [-limit_g[0], limit_g[0]]))
    assert np.allclose(simulated_g[is_unchanged] * G0_MPS2, x_mps2[is_unchanged], atol=1e-6)
    assert np.allclose(simulated_g * G0_MPS2, np.clip(x_mps2, low_mps2, high_mps2), atol=1e-6)


def test_an_axis_that_is_held_most_of_the_time_stays_for_the_fit_of_its_range(tmp_path):
    carried = Carried()

    def clipped(force):
        limit_mps2 = np.quantile(np.abs(force[:, 0]), 0.3)
        force[:, 0] = np.clip(force[:, 0], -limit_mps2, limit_mps2)
        return force

    comparison = carried.beside(tmp_path, carried.recorded(clipped))
    assert not [part for part in comparison.left_out if part.effect == 'saturation']


@pytest.mark.parametrize('step_mps2', [0.01, 0.3])
@pytest.mark.parametrize('late_s', [0.0, 0.08])
def test_codes_that_repeat_in_an_extreme_pose_are_no_end_of_the_range(tmp_path, step_mps2, late_s):
    """Zero-g, scale factor and a latency leave the simulation beyond the largest code."""
    carried = Carried()

    def coarse(force):
        return np.round((0.9 * force - 0.4) / step_mps2) * step_mps2

    time_s = carried.time_s - late_s
    comparison = carried.beside(tmp_path, carried.recorded(coarse), time_s=time_s)
    assert not sample_faults(comparison).held.any()


def test_pulses_beyond_the_range_are_named(tmp_path):
    carried = Carried()
    sensor = replace(nominal('xyz'), rate_hz=RATE_HZ)

    def pulses(force):
        for place in (2000, 3000, 4000):
            force[place : place + 4, 0] = (sensor.range_g + 0.5) * G0_MPS2
        return force

    notes = ' '.join(carried.beside(tmp_path, carried.recorded(pulses)).notes)
    assert f'range of {sensor.range_g:g} g' in notes and '12 samples' in notes
    assert 'too fast' not in notes


def test_a_sensor_that_always_moves_has_no_rest():
    """No part of it is quiet enough to tell what moves, but the simulator does."""
    time_s = np.arange(0, 40, 0.004)
    angle = 0.3 * np.sin(np.outer(time_s, [6.2, 9.1, 13.3]))
    swinging = Rotation.from_rotvec(angle).apply([0, 0, G0_MPS2])
    noise = np.random.default_rng(0).normal(0, 0.003, swinging.shape)
    sensor = replace(nominal('xyz'), rate_hz=250.0)

    def at_rest(force):
        volts = to_volts(force + noise, sensor)
        columns = {f'{axis}_v': v for axis, v in zip('xyz', volts.T)}
        read = Recording('run', time_s, columns, sensor_info(sensor))
        return compare(read, sensor, Motion(40.0, force=ForcePath(time_s, force))).at_rest

    assert not at_rest(swinging).any()
    halted = np.where(time_s[:, None] < 20, swinging, swinging[5000])
    assert not at_rest(halted)[:4900].any() and at_rest(halted)[5200:].mean() > 0.9


def test_samples_that_share_the_filter_of_a_spike_are_left_out_with_it(tmp_path):
    carried = Carried()
    places = np.arange(400, len(carried.time_s) - 400, 200)

    def knocked(force):
        force[places, 0] += 20.0
        force[places + 1, 0] += 5.0
        return force

    comparison = carried.beside(tmp_path, carried.recorded(knocked))
    assert not comparison.used[np.concatenate([places, places + 1])].any()


@pytest.fixture
def with_gaps(tmp_path):
    carried = Carried()
    comparison = carried.beside(tmp_path, carried.recorded())
    is_kept = np.arange(len(comparison)) % 400 > 150
    return replace(comparison, used=comparison.used & is_kept)


def test_excess_noise_has_its_size_although_samples_are_left_out(with_gaps):
    residual_v = 3 * with_gaps.simulated_noise_v(with_gaps.sensor, 5)
    (found,) = residual_detections(with_gaps, residual_v, with_gaps.sensor)
    assert found.values['ratio'] == pytest.approx(2.0, rel=0.1)


def test_a_line_that_gaps_spread_is_no_excess_noise(with_gaps):
    line_v = 0.2 * np.sin(2 * np.pi * 49.98 * with_gaps.time_s)[:, None]
    residual_v = with_gaps.simulated_noise_v(with_gaps.sensor, 5) + line_v
    (found,) = residual_detections(with_gaps, residual_v, with_gaps.sensor)
    assert found.effect == 'mains_hum'
