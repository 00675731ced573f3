# SPDX-License-Identifier: Apache-2.0

"""Faults between neighbouring samples: repeats, alternating rows, counts that wrap, jumps."""

from adxl_ros.model.constants import G0_MPS2 as G
from adxl_ros.signals.neighbouring_samples import NeighbouringSamples
import numpy as np
import pytest
import scipy

RATE_HZ = 100.0


def faults(samples: np.ndarray, block: int = 10_000) -> list[str]:
    looked = NeighbouringSamples('xyz'[: samples.shape[1]], RATE_HZ)
    time_s = np.arange(len(samples)) / RATE_HZ
    for i in range(0, len(samples), block):
        looked.feed(time_s[i : i + block], samples[i : i + block])
    return looked.faults()


def turning(count: int = 4000, noise_mps2: float = 0.02) -> np.ndarray:
    """Return a sensor that turns slowly about x."""
    angle = np.linspace(0, 6, count)
    force = G * np.column_stack([0 * angle, np.sin(angle), np.cos(angle)])
    return force + np.random.default_rng(1).normal(0, noise_mps2, force.shape)


@pytest.mark.parametrize('block', [50, 333, 10_000])
def test_a_sound_sensor(block: int) -> None:
    assert faults(turning(), block) == []


@pytest.mark.parametrize(('step_mps2', 'noise_mps2'), [(0.04, 0.001), (0.04, 0.02), (0.3, 0.05)])
def test_coarse_codes_repeat_by_chance(step_mps2: float, noise_mps2: float) -> None:
    assert faults(np.round(turning(noise_mps2=noise_mps2) / step_mps2) * step_mps2) == []


@pytest.mark.parametrize('block', [50, 333, 10_000])
@pytest.mark.parametrize('times', [2, 7, 50])
def test_readings_that_stand_for_several_samples(times: int, block: int) -> None:
    (found,) = faults(np.repeat(turning(2000), times, axis=0), block)
    assert f'{times} samples' in found and f'{RATE_HZ / times:.4g} readings' in found


def test_a_host_that_polls_faster_than_the_sensor() -> None:
    polled = turning()[(np.arange(8000) / 2.5).astype(int)]
    (found,) = faults(polled)
    assert '2.5 samples' in found


@pytest.mark.parametrize('sensors', [2, 3])
@pytest.mark.parametrize('differ', [[0.3, -0.2, 0.1], [G, 0, -G]])
def test_rows_of_several_sensors_in_turn(sensors: int, differ: list[float]) -> None:
    samples = turning()
    for phase in range(sensors):
        samples[phase::sensors] += phase * np.array(differ)
    (found,) = [text for text in faults(samples) if 'alternate' in text]
    assert f'{sensors} sensors' in found


def test_alternate_rows_show_in_motion_and_are_no_means_of_rests() -> None:
    moved = turning() + 2 * np.sin(np.arange(4000) / 15)[:, None]
    assert faults(moved) == []
    moved[1::2] += [0.3, -0.2, 0.25]
    (found,) = faults(moved)
    assert '2 sensors' in found
    of_two = turning()
    of_two[1::2] = of_two[1::2, [1, 2, 0]]
    (found,) = faults(of_two)
    assert '2 sensors' in found


def test_counts_whose_sign_was_lost() -> None:
    true_g = np.random.default_rng(3).normal(0, 0.4, (6000, 3))
    counts = np.round(true_g * 16384) % 65536
    (found,) = [text for text in faults(counts / 16384 * G) if 'wrap' in text]
    assert 'signed numbers' in found


@pytest.mark.parametrize('shake_g', [0.4, 0.9])
def test_counts_that_wrap(shake_g: float) -> None:
    true_g = np.random.default_rng(3).normal(0, shake_g, (6000, 3)) + [0, 0, 1]
    true_g[:2000] = [0, 0, 1]
    true_g += np.random.default_rng(4).normal(0, 0.004, true_g.shape)
    counts = (np.round(true_g * 16384) + 32768) % 65536 - 32768
    (found,) = [text for text in faults(counts / 16384 * G) if 'wrap' in text]
    assert '4 g' in found


def test_shocks_and_a_sensor_that_clips_do_not_wrap() -> None:
    true_g = turning(6000) / G
    for later, share in enumerate([1.0, 0.6, -0.3]):
        true_g[1000 + later :: 500, 2] += 2.5 * share
    assert faults(np.clip(true_g, -2, 2 - 1 / 16384) * G) == []
    shaken_g = true_g + np.random.default_rng(3).normal(0, 1.5, true_g.shape)
    assert faults(np.clip(shaken_g, -2, 2 - 1 / 16384) * G) == []
    assert faults(true_g * G) == []


@pytest.mark.parametrize('signs', [[-1, -1, -1], [1, -1, -1]])
@pytest.mark.parametrize('block', [50, 333, 10_000])
def test_a_sensor_that_is_turned_over_between_two_samples(signs: list[int], block: int) -> None:
    samples = turning()
    samples[2000:] *= signs
    (found,) = faults(samples, block)
    assert 'at 19.99 s' in found


def test_a_reading_that_is_repeated_for_a_while_is_no_turn() -> None:
    samples = turning()
    samples[1990:2300] = samples[1990]
    samples[2300:] *= -1
    (found,) = faults(samples)
    assert 'repeated' in found and 'turned over' not in found


def test_rests_that_were_joined_are_no_turns() -> None:
    """A table of rests that were cut out of a recording jumps at each of their ends."""
    directions = np.random.default_rng(3).normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rests = np.repeat(G * directions, 300, axis=0)
    assert faults(rests + np.random.default_rng(4).normal(0, 0.02, rests.shape)) == []


@pytest.mark.parametrize('block', [7, 50, 333, 10_000])
@pytest.mark.parametrize(('spikes', 'size_g'), [(5, 24.0), (60, 0.5)])
def test_single_wrong_samples(spikes: int, size_g: float, block: int) -> None:
    samples, rng = turning(), np.random.default_rng(5)
    rows = 20 + 60 * np.arange(spikes)
    samples[rows] += size_g * G * rng.choice([-1, 1], (spikes, 3))
    (found,) = faults(samples, block)
    assert f'{spikes} single samples' in found
    stated_g = float(found.split(' g ')[0].split()[-1])
    assert stated_g == pytest.approx(size_g, rel=0.02)
    assert f'{rows[0] / RATE_HZ:g} s' in found


@pytest.mark.parametrize('block', [50, 10_000])
@pytest.mark.parametrize('noise_mg', [[4, 4, 4], [5.7, 1, 1], [1, 4, 5.7]])
def test_single_samples_of_seven_standard_deviations(noise_mg: list[float], block: int) -> None:
    """A single sample and the mean of its neighbours have √1.5 times the noise."""
    rng = np.random.default_rng(5)
    samples = turning(20_000, 0.0) + rng.normal(0, 1e-3 * G, (20_000, 3)) * noise_mg
    rows = 400 + 60 * np.arange(300)
    samples[rows] += rng.choice([-0.05, 0.05], (300, 3)) * G
    (found,) = faults(samples, block)
    assert int(found.split()[0]) == pytest.approx(300, abs=10)
    from_g = float(found.split('below about ')[1].split()[0])
    assert from_g == pytest.approx(6 * np.sqrt(1.5) * 1e-3 * max(noise_mg), rel=0.1)


@pytest.mark.parametrize('code', [0.0, 0.3, 1.0, 4.0])
@pytest.mark.parametrize('filtered', [-0.8, 0.0, 0.8])
@pytest.mark.parametrize('shaken', [0.0, 0.3, 3.0, 30.0])
def test_the_noise_and_motion_of_a_sound_sensor_are_no_single_samples(
    code: float, filtered: float, shaken: float
) -> None:
    """Step of the codes and largest vibration are stated by the noise."""
    rng, std = np.random.default_rng(6), 0.04
    noise = rng.normal(0, std, (2, 30_000, 3))
    noise = scipy.signal.lfilter([1.0], [1.0, -filtered], noise, axis=1)
    noise[1] *= shaken * np.sin(np.arange(30_000) / 4000)[:, None] ** 4
    samples = turning(30_000, 0.0) + noise.sum(axis=0)
    assert faults(np.round(samples / (code * std)) * code * std if code else samples) == []


def test_it_is_said_from_which_size_on_single_samples_are_counted() -> None:
    samples, rows = turning(noise_mps2=0.055), 20 + 60 * np.arange(60)
    samples[rows] += np.linspace(0.05, 1.0, 60)[:, None] * G
    (found,) = faults(samples)
    counted, from_g = int(found.split()[0]), float(found.split('below about ')[1].split()[0])
    assert counted == pytest.approx(np.sum(np.linspace(0.05, 1.0, 60) > from_g), abs=5)


@pytest.mark.parametrize('length', [2, 4])
def test_shocks_are_no_wrong_samples(length: int) -> None:
    """A sensor that rings for some samples after a shock may meet one of them alone."""
    samples, since = turning(), np.arange(40)
    ringing = np.exp(-since / length) * np.cos(2.0 * since)
    for row in range(100, 3900, 100):
        samples[row : row + 40, 2] += 2 * G * ringing
    assert faults(samples) == []


def test_codes_that_change_for_one_sample_are_right() -> None:
    steady = np.tile([0.0, 0.0, G], (4000, 1))
    steady[100::50] += 0.04
    steady[125::50, 0] -= 0.04
    assert faults(np.round(steady / 0.04) * 0.04) == []


def test_rows_that_are_means_of_rests() -> None:
    directions = np.random.default_rng(3).normal(size=(49, 3))
    means = G * directions / np.linalg.norm(directions, axis=1)[:, None] * [1.01, 0.99, 1.02]
    (found,) = faults(means + [0.1, -0.2, 0.3])
    assert 'fit --means' in found
    assert (
        faults(np.repeat(means, 50, axis=0) + 0.02 * np.sin(np.arange(2450 * 3)).reshape(-1, 3))
        == []
    )
