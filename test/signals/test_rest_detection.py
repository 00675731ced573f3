# SPDX-License-Identifier: Apache-2.0

"""Rests in simulated and real streams, and equality of live and offline detection."""

import adxl_ros as adxl
from adxl_ros.files import recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.noise import sample_std_v
from adxl_ros.signals.recorded_sensor import load_sensor, measure_unstated
from adxl_ros.signals.rest_detection import find_rests, RestFinder
from adxl_ros.signals.rest_limits import SampleNoise
from adxl_ros.signals.rest_means import rest_means
from adxl_ros.signals.rest_search import Rest, RestRule
from hypothesis import given, settings, strategies
from needs import lack
import numpy as np
from pace import within
import pytest
from scipy.signal import lfilter

SIGMA = 0.05
TAU_S = 32e3 * 0.33e-6
ADXL = SampleNoise(np.full(3, 0.535e-3), TAU_S)


def directions(rng, count):
    """Draw poses: specific force at rest, m/s²."""
    drawn = rng.normal(size=(count, 3))
    return G0_MPS2 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def handled_stream(rng, rate_hz, rest_s, turn_s=1.0, sigma=SIGMA):
    """
    Make a stream of rests with turns between them.

    returns: times (n,), samples (n, 3), first and last rows of the rests (k, 2), and their true
    means (k, 3).
    """
    poses = directions(rng, len(rest_s) + 1)
    parts, bounds, row = [], [], 0
    for pose, next_pose, length_s in zip(poses, poses[1:], rest_s):
        rest, turn = round(length_s * rate_hz), round(turn_s * rate_hz)
        share = np.linspace(0, 1, turn, endpoint=False)[:, None]
        shake = 0.3 * np.sin(2 * np.pi * 3.1 * turn_s * share) * np.sin(np.pi * share)
        parts += [np.tile(pose, (rest, 1)), pose + share * (next_pose - pose) + shake]
        bounds.append((row, row + rest))
        row += rest + turn
    samples = np.concatenate(parts)
    samples += sigma * rng.normal(size=samples.shape)
    return np.arange(len(samples)) / rate_hz, samples, np.array(bounds), poses[:-1]


def filtered_noise(rng, count, sigma, rate_hz=1000.0, tau_s=TAU_S):
    a = np.exp(-1 / (rate_hz * tau_s))
    white = rng.normal(size=(count + 200, 3)) * np.sqrt(1 - a * a)
    return sigma * lfilter([1.0], [1.0, -a], white, axis=0)[200:]


def lost_rows(rests, bounds):
    """Assert that each rest is inside that of `bounds`, and return the number of lost rows."""
    assert len(rests) == len(bounds)
    rows = np.array([(rest.start, rest.stop) for rest in rests])
    assert (rows[:, 0] >= bounds[:, 0]).all()
    assert (rows[:, 1] <= bounds[:, 1]).all()
    return np.diff(bounds, axis=1)[:, 0] - np.diff(rows, axis=1)[:, 0]


@pytest.mark.parametrize('rate_hz', [25.0, 100.0, 285.71, 1000.0, 10000.0])
def test_rests_of_3_s_to_60_s(rate_hz):
    rng = np.random.default_rng(1)
    lengths = [2.6, 3.0, 5.0, 2.8, 60.0, 3.0, 10.0, 2.6]
    time_s, samples, bounds, poses = handled_stream(rng, rate_hz, lengths)
    rests = find_rests(time_s, samples, rate_hz)
    # The first row of a turn hardly moves, so that one block may reach beyond it.
    slack = np.array([-1, 1]) * round(0.06 * rate_hz + 1)
    lost = lost_rows(rests, bounds + slack)
    assert (lost < (0.7 + 0.2 * np.array(lengths)) * rate_hz + 4).all()
    assert np.median(lost) < 0.5 * rate_hz + 4
    mean, error = rest_means(time_s, samples, rests, rate_hz)
    assert np.abs((mean - poses) / error).max() < 6
    assert [r.time_start_s for r in rests] == [time_s[r.start] for r in rests]
    assert [r.time_stop_s for r in rests] == [time_s[r.stop - 1] for r in rests]


def damaged(rng, time_s, samples):
    samples = samples.copy()
    samples[rng.integers(len(samples), size=2), 0] = (1e6, -1e6)
    time_s = time_s.copy()
    for row, step_s in zip(rng.integers(len(samples), size=4), (0.5, 7.0, -0.2, 0.11)):
        time_s[row:] += step_s
    return time_s, samples


@settings(max_examples=40)
@given(
    strategies.integers(0, 2**32 - 1),
    strategies.integers(1, 3),
    strategies.sampled_from([1.0, 20.0, 100.0, 400.0]),
    strategies.booleans(),
    strategies.booleans(),
)
def test_live_equals_offline(seed, axes, rate_hz, known_noise, with_stage):
    rng = np.random.default_rng(seed)
    scale_s = 1.0 if rate_hz > 10 else 30.0
    time_s, samples, _, _ = handled_stream(rng, rate_hz, scale_s * rng.uniform(1, 8, 12), scale_s)
    time_s, samples = damaged(rng, time_s, samples)
    samples = samples[:, :axes]
    noise = SampleNoise(np.full(axes, SIGMA), 0.01) if known_noise else None
    tolerance = 1e-3 if with_stage else None
    angles = np.round(samples[:, [0, 0]] / 3) if with_stage else None
    rule = RestRule(noise, learns=noise is None, angle_tolerance_rad=tolerance)
    offline = find_rests(time_s, samples, rate_hz, rule, angles)
    live = RestFinder(rate_hz, axes, rule)
    cuts = np.sort(rng.integers(0, len(samples), rng.integers(1, 300)))
    for part in np.split(np.arange(len(samples)), cuts):
        live.feed(time_s[part], samples[part], None if angles is None else angles[part])
        if rng.random() < 0.05:
            live.rests()
            live.stillness()
    assert live.rests() == offline
    if offline:
        means = zip(*rest_means(time_s, samples, offline, rate_hz, noise))
        for found, (mean, std) in zip(live.means(offline), means):
            assert (found.mean_v == mean).all()
            assert (found.std_v == std).all()


@pytest.mark.parametrize('fault', ['stuck', 'clipped'])
def test_an_axis_without_noise_in_motion_hides_no_rest(fault):
    """Where it does not change it is stuck or at its limit: that is not its noise."""
    rng = np.random.default_rng(4)
    time_s, samples, bounds, _ = handled_stream(rng, 100.0, [4.0] * 12, turn_s=4.0)
    moves = np.ones(len(time_s), bool)
    for start, stop in bounds:
        moves[max(start - 50, 0) : stop + 50] = False
    if fault == 'stuck':
        samples[moves, 1] = 3.0
    else:
        samples[moves, 1] = np.minimum(samples[moves, 1], -15.0)
    assert len(find_rests(time_s, samples, 100.0)) == len(bounds)
    # Nor is it the noise that no file states
    x, y, z = samples.T
    recorded = adxl.from_arrays(time_s=time_s, ax_mps2=x, ay_mps2=y, az_mps2=z)
    unit, _ = measure_unstated(load_sensor(None, recorded), recorded)
    noise_mps2 = sample_std_v(unit) / unit.scale_v_per_g * G0_MPS2
    assert noise_mps2 == pytest.approx(np.full(3, SIGMA), rel=0.2)


def test_a_knock_neither_ends_nor_moves_a_rest():
    rng = np.random.default_rng(9)
    samples = np.tile([0.0, 0.0, G0_MPS2], (1000, 1)) + SIGMA * rng.normal(size=(1000, 3))
    still = samples.copy()
    samples[500:520, 0] += 30 * np.exp(-np.arange(20) / 4)
    time_s = np.arange(1000) / 100
    rests = find_rests(time_s, samples, 100.0)
    assert len(rests) == 1
    mean, error = rest_means(time_s, samples, rests, 100.0)
    assert np.abs(mean[0] - still.mean(axis=0)).max() < 2 * error.max()


@pytest.mark.parametrize('samples', [np.empty((0, 3)), np.zeros((3, 3))])
def test_streams_without_a_rest(samples):
    time_s = np.arange(len(samples)) / 100
    assert find_rests(time_s, samples, 100.0) == []
    assert RestFinder(100.0, 3).stillness() is None


@pytest.mark.parametrize(('swing_g', 'count'), [(2.0, 0), (0.05, 1)])
def test_a_shaker_that_never_stops_is_no_rest(swing_g, count):
    """Its motion passes for noise; what shakes little reads gravity still."""
    rng = np.random.default_rng(2)
    time_s = np.arange(6000) / 100
    turn = 2 * np.pi * 5.02 * time_s
    circle = G0_MPS2 * swing_g * np.array([np.cos(turn), np.sin(turn), 0 * turn]).T
    samples = circle + [0.0, 0.0, G0_MPS2] + SIGMA * rng.normal(size=(6000, 3))
    assert len(find_rests(time_s, samples, 100.0, RestRule(gravity=G0_MPS2))) == count


def test_known_noise_behind_its_filter():
    """With the noise of the datasheet, all rests of 5 s in every 6 s are found in full length."""
    rng = np.random.default_rng(14)
    poses = directions(rng, 61) / G0_MPS2
    volts = 2.5 + np.repeat(poses[:-1], 6000, axis=0)
    ramp = np.clip((np.arange(len(volts)) % 6000 - 5000) / 1000, 0, 1)[:, None]
    volts += ramp * np.repeat(np.diff(poses, axis=0), 6000, axis=0)
    volts += filtered_noise(rng, len(volts), 0.535e-3)
    volts = np.round(volts / (5 / 2**16)) * 5 / 2**16
    time_s = np.arange(len(volts)) / 1000
    for learns in (False, True):
        rests = find_rests(time_s, volts, 1000.0, RestRule(ADXL, learns))
        assert len(rests) == 60
        lengths = np.array([rest.time_stop_s - rest.time_start_s for rest in rests])
        assert np.median(lengths) > 4.6
        mean, error = rest_means(time_s, volts, rests, 1000.0, ADXL)
        normalized = (mean - 2.5 - poses[:-1]) / error
        assert 0.75 < np.sqrt((normalized**2).mean()) < 1.15
        # 5 s at 1 kHz count for 237 samples.
        assert np.median(error) == pytest.approx(0.535e-3 / np.sqrt(237), rel=0.15)


@pytest.mark.parametrize('tau_s, amplitude', [(0.1, 0.2), (0.5, 0.02), (1.0, 0.01)])
def test_settling_is_excluded_from_a_rest(tau_s, amplitude):
    """The remaining settling biases the mean by little more than its standard error."""
    rng = np.random.default_rng(17)
    worst = []
    for _ in range(10):
        volts = 2.5 + filtered_noise(rng, 10000, 0.535e-3)
        time_s = np.arange(10000) / 1000
        tail = amplitude * np.exp(-time_s / tau_s)
        volts[:, 0] += tail
        rest = find_rests(time_s, volts, 1000.0, RestRule(ADXL, learns=False))[0]
        assert rest.stop >= 9000
        worst.append(tail[rest.start : rest.stop].mean())
    assert np.median(worst) < 2.5 * 0.535e-3 / np.sqrt(237)


def stage_stream(rng, angles, volts_at):
    """Make a stream of a stage at the angles (n, 2) of each row."""
    volts = volts_at(angles) + filtered_noise(rng, len(angles), 0.535e-3)
    return np.arange(len(angles)) / 1000, volts


def test_the_encoder_ends_a_rest_where_the_sensor_does_not_respond():
    """At alpha = 0 the sensor does not respond to beta: only the encoder ends the rests."""
    rng = np.random.default_rng(18)
    beta = np.clip(np.arange(24000) % 6000 / 500 - 10, 0, 1) + np.arange(24000) // 6000
    angles = np.column_stack([np.zeros(24000), np.radians(30) * beta])
    time_s, volts = stage_stream(rng, angles, lambda a: 2.5 + np.zeros((len(a), 3)))
    encoder = np.round(angles / 1.45e-3) * 1.45e-3
    encoder[np.arange(24000) % 20 != 3] = np.nan  # read at 50 Hz
    rule = RestRule(ADXL, learns=False, angle_tolerance_rad=1.45e-3)
    rests = find_rests(time_s, volts, 1000.0, rule, encoder)
    assert len(rests) == 4
    for k, rest in enumerate(rests):
        assert np.ptp(angles[rest.start : rest.stop, 1]) < 2 * 1.45e-3
        assert rest.stop - rest.start > 4600
        # The settling of the filter is excluded as well.
        assert k == 0 or rest.start >= 6000 * k - 500 + 8000 * TAU_S


def test_standard_errors_of_means_are_right():
    """The spectrum is unknown: white, filtered, or that of an anti-alias filter with overshoot."""
    rng = np.random.default_rng(21)
    for shape in ([1.0], [0.2, 0.3, 0.3, 0.2], np.exp(-np.arange(40) / 8), [1.0, 0.4, -0.2]):
        white = rng.normal(size=(150000, 3))
        samples = lfilter(shape, [1.0], white, axis=0)
        rests = [Rest(i, i + 500, i / 100, (i + 499) / 100) for i in range(1000, 149000, 500)]
        mean, error = rest_means(np.arange(150000) / 100, samples, rests, 100.0)
        assert 0.9 < np.sqrt(((mean / error) ** 2).mean()) < 1.25


@pytest.mark.perf
def test_speed():
    """Three million samples of three axes in two seconds."""
    rng = np.random.default_rng(22)
    _, samples, _, _ = handled_stream(rng, 1000.0, [5.0] * 100)
    time_s = np.arange(5 * len(samples)) / 1000
    samples = np.tile(samples, (5, 1))
    assert len(samples) == 3_000_000
    with within(2.0):
        rests = find_rests(time_s, samples, 1000.0)
    assert len(rests) == 500


@pytest.mark.parametrize(
    'name, min_rests, max_rests',
    [
        ('mpu9150_0', 22, 24),
        ('mpu9150_1', 22, 24),
        ('mpu9150_2', 22, 24),
        ('xsens_multiposition', 37, 39),
        ('two_axis_stand', 23, 25),
    ],
)
def test_rests_of_real_recordings(shared_dir, name, min_rests, max_rests):
    """Real recordings have the number of rests that is documented, except for stops of 1 s."""
    path = shared_dir / 'real' / f'{name}.csv'
    if not path.exists():
        pytest.skip(lack('../shared'))
    stream = recording.read(path)
    samples = np.column_stack([stream.columns[f'a{a}_mps2'] for a in 'xyz'])
    assert min_rests <= len(find_rests(stream.time_s, samples, 100.0)) <= max_rests
