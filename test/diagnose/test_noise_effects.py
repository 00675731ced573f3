# SPDX-License-Identifier: Apache-2.0

"""Statistics of noise whose values are known in advance."""

from dataclasses import replace

from adxl_ros.diagnose import noise_effects, noise_remainders, sample_faults
from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.noise_remainders import NoiseRemainder
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import noise
from adxl_ros.model.sensor import with_neutral, with_values
from adxl_ros.model.signal_chain import quantise
import numpy as np
import pytest
from scipy.signal import lfilter, periodogram
from units import nominal

RATE_HZ = 100.0
COUNT = 6000
TIME_S = np.arange(COUNT) / RATE_HZ


def sensor(axes='xy', **changes):
    return nominal(axes, rate_hz=RATE_HZ, **changes)


def white_v(std_v=1e-3, seed=1):
    """Return an output at rest, which has no rounding."""
    return 2.5 + std_v * np.random.default_rng(seed).normal(size=(COUNT, 2))


@pytest.mark.parametrize('count', [COUNT, COUNT - 1])
@pytest.mark.parametrize('window', ['boxcar', 'hann'])
def test_spectra_are_those_of_scipy(count, window):
    values = white_v()[:count] - 2.5
    found = noise_effects.periodogram(values, RATE_HZ, window)
    expected = periodogram(values, RATE_HZ, window, axis=0)
    for own, other in zip(found, expected):
        assert own == pytest.approx(other, rel=1e-9, abs=1e-9 * other.mean())


def test_the_allan_deviation_of_white_noise_falls_with_the_root():
    noise_v = np.random.default_rng(1).normal(size=(200_000, 1))
    for count in (1, 4, 100):
        deviation = noise_remainders.allan_deviation(noise_v, count)
        assert deviation == pytest.approx(count**-0.5, rel=0.05)


def test_the_allan_deviation_of_a_ramp_is_its_rise_over_the_root_of_two():
    ramp_v = 0.3 * np.arange(1000.0)[:, None]
    for count in (1, 10, 100):
        assert noise_remainders.allan_deviation(ramp_v, count) == pytest.approx(
            0.3 * count / np.sqrt(2)
        )


@pytest.mark.parametrize('line_hz', [50.0, 12.3])
def test_the_amplitude_of_a_line_is_that_of_the_sine(line_hz):
    phase_rad = 2 * np.pi * line_hz * np.arange(20_000) / 1000.0
    values_v = np.column_stack([0.2 * np.sin(phase_rad), 0.0 * phase_rad])
    amplitude_v = noise_effects.line_amplitude_v(values_v, np.arange(20_000) / 1000.0, line_hz)
    assert amplitude_v == pytest.approx([0.2, 0.0], abs=1e-3)


def test_a_line_whose_phase_wanders_keeps_its_amplitude():
    wander_rad = np.cumsum(np.random.default_rng(3).normal(0, 0.01, 20_000))
    phase_rad = 2 * np.pi * 50.0 * np.arange(20_000) / 1000.0 + wander_rad
    values_v = np.sin(phase_rad)[:, None]
    amplitude_v = noise_effects.line_amplitude_v(values_v, np.arange(20_000) / 1000.0, 50.0)
    assert amplitude_v == pytest.approx(1.0, rel=0.15)


def test_white_noise_is_estimated_behind_the_filter():
    """An AR(1) sequence of standard deviation 2 mV, with drift and spikes that do not count."""
    made = sensor()
    pole = np.exp(-1 / (RATE_HZ * made.rc_s))
    noise_v = lfilter([np.sqrt(1 - pole**2)], [1, -pole], white_v(2e-3) - 2.5, axis=0)
    assert noise_effects.white_noise_v(noise_v, made) == pytest.approx(2e-3, rel=0.1)
    disturbed_v = noise_v + 0.05 * np.sin(TIME_S / 20)[:, None]
    disturbed_v[500::1000] += 1.0
    assert noise_effects.white_noise_v(disturbed_v, made) == pytest.approx(2e-3, rel=0.1)


def test_long_runs_of_equal_samples_are_repeats():
    volts = white_v()
    volts[1001:1021] = volts[1000]
    volts[3001] = volts[3000]
    used, found = sample_faults.repeated_samples(volts, TIME_S, np.ones(COUNT, bool), sensor())
    assert np.flatnonzero(~used).tolist() == list(range(1001, 1021))
    (repeats,) = found
    assert repeats.effect == 'stuck'
    assert repeats.values['rate_hz'] == pytest.approx(1 / TIME_S[-1])
    assert repeats.values['duration_s'] == pytest.approx(20 / RATE_HZ)


def test_a_short_hold_in_fast_motion_is_no_spike():
    """Three equal samples may be chance, but not where the motion goes on."""
    volts, motion_v = white_v(), np.sin(2 * np.pi * 2 * TIME_S)[:, None]
    volts += motion_v
    starts = np.flatnonzero(np.diff(motion_v[:, 0], prepend=0) > 0.9 * 4 * np.pi / RATE_HZ)[::400]
    for start in starts:
        volts[start : start + 4] = volts[start]
    alone = np.zeros(COUNT, bool)
    alone[starts + 3] = True
    _, (found,) = sample_faults.repeated_samples(
        volts[:, :1], TIME_S, np.ones(COUNT, bool), sensor(axes='x'), alone
    )
    assert found.effect == 'stuck'
    assert found.values['duration_s'] == pytest.approx(3 / RATE_HZ)


def test_a_run_of_equal_codes_may_be_chance():
    """One axis that repeats in half of its samples repeats 30 times in 10⁵ samples."""
    coarse_v = np.random.default_rng(1).integers(0, 2, (100_000, 1)).astype(float)
    assert 25 < sample_faults.shortest_repeat(coarse_v, 1) <= 100
    fine_v = np.random.default_rng(1).normal(size=(100_000, 3))
    assert sample_faults.shortest_repeat(fine_v, 3) <= 4


def test_spikes_are_counted_with_their_size():
    volts = white_v()
    spikes = np.arange(200, COUNT, 400)
    volts[spikes, 0] += 0.5
    used, found = sample_faults.isolated_samples(
        volts, volts, TIME_S, np.ones(COUNT, bool), sensor()
    )
    assert np.flatnonzero(~used).tolist() == spikes.tolist()
    (detection,) = found
    # The rate is that of an axis, of which there are two.
    assert detection.values['rate_hz'] == pytest.approx(len(spikes) / 2 / TIME_S[-1])
    assert detection.values['amplitude_v'] == pytest.approx([0.5, 0.0], abs=0.01)


def test_a_step_is_no_spike():
    volts = white_v()
    volts[COUNT // 2 :] += 0.5
    used, found = sample_faults.isolated_samples(
        volts, volts, TIME_S, np.ones(COUNT, bool), sensor()
    )
    assert (used.all(), found) == (True, ())


@pytest.mark.filterwarnings('error')
def test_where_nothing_is_compared_no_sample_stands_alone():
    none = np.zeros(COUNT, bool)
    used, found = sample_faults.isolated_samples(white_v(), white_v(), TIME_S, none, sensor())
    assert (used.any(), found) == (False, ())


def test_spikes_of_the_residual_alone_are_of_the_reference():
    residual_v = white_v()
    residual_v[200::400] += 0.5
    used, found = sample_faults.isolated_samples(
        white_v(seed=2), residual_v, TIME_S, np.ones(COUNT, bool), sensor()
    )
    assert (used.all(), found) == (True, ())


@pytest.mark.parametrize('bits', [1, 3])
def test_coarse_codes_show_the_lost_bits(bits):
    made = sensor(adc_bits=16)
    step_v = made.lsb_v * 2**bits
    volts = np.rint(white_v(20 * step_v) / step_v) * step_v
    found = sample_faults.coarse_codes(volts, made)
    assert found.values['lost_bits'] == pytest.approx(bits)
    assert noise.electronics(found.added_to(made)).lsb_v == pytest.approx(step_v)


def test_bits_that_one_axis_has_lost_are_its_own():
    made = sensor(adc_bits=16)
    volts = white_v(100 * made.lsb_v)
    steps_v = made.lsb_v * np.array([1.0, 4.0])
    found = sample_faults.coarse_codes(np.rint(volts / steps_v) * steps_v, made)
    assert found.values['lost_bits'] == 0.0
    assert found.values['axis_lost_bits'] == pytest.approx([0.0, 2.0])
    assert noise.electronics(found.added_to(made)).lsb_v == pytest.approx(steps_v)
    assert sample_faults.coarse_codes(np.rint(volts / made.lsb_v) * made.lsb_v, made) is None


def test_coarse_codes_show_although_no_adc_is_stated():
    """Rounding that the stated noise can hold is a part of it."""
    made = sensor(adc_bits=0)
    steps_v = noise.analog_std_v(made) * [20.0, 3.0]
    volts = -np.rint(white_v(200 * steps_v[0]) / steps_v) * steps_v
    found = sample_faults.coarse_codes(volts, made)
    assert found.values['step_v'] == pytest.approx([steps_v[0], 0.0])
    coarse = found.added_to(made)
    lsb_v = noise.electronics(coarse).lsb_v
    assert lsb_v == pytest.approx([steps_v[0], 0.0])
    assert quantise(volts - 0.1 * steps_v, coarse, lsb_v) == pytest.approx(
        volts - [0.0, 0.1 * steps_v[1]]
    )


def test_a_filter_adds_no_noise_where_none_is_stated():
    made = with_neutral(sensor(rc_capacitance_f=0.0), ['bandwidth'])
    for ratio in (1e-6, 1.0, 100.0):
        filtered = with_values(made, 'bandwidth', {'resistance_ratio': np.full(2, ratio)})
        assert np.all(noise.analog_std_v(filtered) <= noise.analog_std_v(made))


def test_the_floor_is_without_lines_and_excess_noise():
    """A line of amplitude a adds a²/2, and excess noise what exceeds the stated noise."""
    hum = NoiseRemainder('mains_hum', 'line', 'm/s^2', 'x', 0.4, 0.4, 0.4**2)
    excess = NoiseRemainder('noise_excess', 'white noise', 'm/s^2', 'x', 0.5, 0.5, 0.5**2)
    assert noise_remainders.floor_without(1.0, [hum], 0.3) == pytest.approx(np.sqrt(1 - 0.08))
    assert noise_remainders.floor_without(1.0, [excess], 0.3) == pytest.approx(
        np.sqrt(1 - 0.25 + 0.09)
    )
    assert noise_remainders.floor_without(0.2, [hum], 0.1) == pytest.approx(0.1)


def test_a_detection_states_its_mean_square():
    """Codes of twice the step have the variance of rounding to them, step²/12."""
    made = replace(sensor(adc_bits=12), nominal_scale_v_per_g=np.array([1.0, 1.0]))
    step_v = 2 * made.lsb_v
    found = sample_faults.coarse_codes(np.rint(white_v(20 * step_v) / step_v) * step_v, made)
    assert found.power_mps2 == pytest.approx((9.80665 * step_v) ** 2 / 12, rel=1e-6)


@pytest.mark.parametrize(('ratio', 'fewest', 'most'), [(1.15, 0, 2), (1.6, 40, 40)])
def test_noise_is_excessive_beyond_the_interval_of_its_level(ratio, fewest, most):
    """Units differ by up to a fifth; ten seconds show a level to some per cent."""
    healthy = sensor()
    noisier = replace(healthy, noise_density_g_per_rthz=ratio * healthy.noise_density_g_per_rthz)
    at_rest = Recording(
        'rest', TIME_S[:1000], dict.fromkeys(('x_v', 'y_v'), 2.5 + 0 * TIME_S[:1000])
    )
    comparison = compare(at_rest, healthy)
    found = 0
    for seed in range(40):
        residual_v = comparison.simulated_noise_v(noisier, seed + 1)
        found += bool(noise_effects.residual_detections(comparison, residual_v, healthy))
    assert fewest <= found <= most
