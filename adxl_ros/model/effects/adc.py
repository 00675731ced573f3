# SPDX-License-Identifier: Apache-2.0

"""The ADC, the link, the clock that stamps the samples, and noise of every spectrum."""

from __future__ import annotations

from functools import lru_cache

from adxl_ros.model.effects.base import (
    ActsOn,
    add,
    Detector,
    DiagnosisHints,
    DriftSpectrum,
    effect,
    FormDimension,
    Manoeuvre,
    Need,
    OptionalSize,
    Parameter,
    Parameters,
    Place,
    ProofVariable,
    Shape,
    Signals,
)
from adxl_ros.model.filters import first_order_recursion
import numpy as np

_BITS = (
    'first_bit_v',
    'second_bit_v',
    'third_bit_v',
    'fourth_bit_v',
    'fifth_bit_v',
    'sixth_bit_v',
)
"""Parameters of the bits, the heaviest first."""


_INL_STARTS = (
    1.0,
    2.4,
    4.0,
    5.8,
    7.6,
    9.4,
    11.2,
    13.0,
    14.8,
    16.6,
    18.4,
    20.2,
    22.0,
    23.8,
    25.6,
    27.4,
    29.2,
    32.0,
    36.0,
    41.0,
    47.0,
    54.0,
    62.0,
)
"""Periods from which a fit starts. Chosen: 1 g of either sign covers 0.4 of the full scale.
A start that differs by a third of a period there, 0.9, explains half of the power of a sine. Above
30 the steps are wider, because converters with so many segments are rare."""
_NEVER = -(2**40)  # Index of a start that lies before any recording; chosen: far below 0
_LOWEST_HZ = 1e-5  # Lowest corner, Hz; chosen: the density is 1/f from ten times this
_HIGHEST_RATIO = 10**-0.5
"""Highest corner divided by the sample rate; chosen: aliasing replaces the missing corners."""
_PER_DECADE = 2
"""Corners per decade; chosen: the density is 1/f within 3 % up to a fifth of the sample rate."""
_MATCHED = 0.02
"""Frequency divided by the sample rate at which the density is exact; chosen: well below the fifth
up to which it is 1/f."""


@effect(
    Place.ADC,
    Parameter(
        'amplitude_v',
        unit='V',
        upper=0.05,
        scale=3e-4,
        source='physics: 4 LSB of 16 bit at 5 V',
        doc='amplitude of the sine by which it deviates from the straight line',
        axes='',
    ),
    OptionalSize(
        'cosine_v',
        unit='V',
        upper=0.05,
        scale=3e-4,
        source='physics: 4 LSB of 16 bit at 5 V',
        doc='amplitude of the cosine, which shifts the sine over the codes',
        axes='',
    ),
    Shape(
        'cycles',
        unit='1',
        lower=0.5,
        upper=64.0,
        scale=8.0,
        source='physics: segments of a converter',
        doc='periods of the deviation over the full scale',
        starts=_INL_STARTS,
    ),
    *(
        OptionalSize(
            name,
            unit='V',
            upper=0.05,
            scale=3e-4,
            source='physics: 4 LSB of 16 bit at 5 V',
            doc=f'error of the weight of bit {i}, the heaviest being 1',
            axes='',
            shaped=False,
        )
        for i, name in enumerate(_BITS, 1)
    ),
    invertible=True,
    cause='The ADC is nonlinear; calibrate it with a voltage source, or choose another.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.REMOUNT, form=(FormDimension.CODE,), proof=(ProofVariable.OUTPUT,)
    ),
)
def adc_inl(signals: Signals, p: Parameters) -> None:
    """
    Integral nonlinearity of the ADC: one curve over its codes for all channels.

    Add A·sin φ + C·cos φ, φ = 2π·n·V/V_ref, and wrong weights of the heaviest bits to the volts.

    The output of a converter that weighs bit by bit has the errors of all bits that are set (van
    de Plassche, "CMOS Integrated Analog-to-Digital Converters", 2003): half of each, up or down.
    """
    turn = 2 * np.pi * p['cycles'] / signals.vref_v
    for d, volts in enumerate(signals.input_v):
        errors_v = [
            p[name] * function(turn * volts)
            for name, function in (('amplitude_v', np.sin), ('cosine_v', np.cos))
            if p[name]
        ]
        if any(p[name] for name in _BITS):
            code = np.floor(volts / signals.vref_v * 2 ** len(_BITS)).astype(int)
            errors_v += [
                p[name] * ((code >> (len(_BITS) - bit) & 1) - 0.5)
                for bit, name in enumerate(_BITS, 1)
                if p[name]
            ]
        signals.volts[d] = sum(errors_v, signals.volts[d])


@effect(
    Place.ELECTRONICS,
    Parameter(
        'lost_bits',
        unit='bit',
        lower=0.0,
        upper=12.0,
        scale=3.0,
        source='physics: a driver that drops low bits',
        doc='number of bits that the ADC loses',
        axes='',
    ),
    OptionalSize(
        'axis_lost_bits',
        unit='bit',
        lower=0.0,
        upper=12.0,
        scale=3.0,
        source='physics: a converter for each axis',
        doc='number of further bits that the axis loses',
    ),
    OptionalSize(
        'step_v',
        unit='V',
        lower=0.0,
        upper=10.0,
        scale=0.01,
        source='physics: an output that is rounded',
        doc='smallest step of the axis, also where the parameter file states no ADC',
    ),
    smooth=False,
    acts_on=ActsOn.NOISE,
    needs=(Need.ADC,),
    cause='The ADC resolves less than stated; check its setting, reference and format.',
    diagnosis=DiagnosisHints(detector=Detector.COARSE_CODES, proof=(ProofVariable.STEP,)),
)
def quantisation(signals: Signals, p: Parameters) -> None:
    """Quantisation that is coarser than the resolution of the ADC."""
    for d, (lost, step_v) in enumerate(zip(p['axis_lost_bits'], p['step_v'])):
        coarser_v = signals.lsb_v[d] * 2.0 ** (p['lost_bits'] + lost)
        signals.lsb_v[d] = max(coarser_v, step_v)


@effect(
    Place.ADC,
    Parameter(
        'rate_hz',
        unit='Hz',
        lower=0.0,
        upper=1000.0,
        scale=0.2,
        source='physics: loose contacts, switching loads',
        doc='spikes per second and axis',
        axes='',
    ),
    Parameter(
        'amplitude_v',
        unit='V',
        lower=0.0,
        upper=10.0,
        scale=0.05,
        source='physics: loose contacts',
        doc='size of a spike, of either sign',
    ),
    smooth=False,
    acts_on=ActsOn.NOISE,
    cause='Single samples have large errors; check for loose contacts and loads that switch.',
    diagnosis=DiagnosisHints(detector=Detector.ISOLATED_SAMPLES, proof=(ProofVariable.STEP,)),
)
def spikes(signals: Signals, p: Parameters) -> None:
    """
    Spikes: single samples with a large error.

    Add plus or minus A to random samples of each axis, at a mean rate.
    """
    assert signals.rng is not None
    axes = len(signals.volts)
    drawn = signals.rng.random((*np.shape(signals.environment.time_s), axes, 2))
    hit = drawn[..., 0] < p['rate_hz'] * signals.dt_s
    sign = np.where(drawn[..., 1] < 0.5, -1.0, 1.0)
    add(
        signals.volts,
        (
            np.where(hit[..., d], amplitude * sign[..., d], 0.0)
            for d, amplitude in enumerate(p['amplitude_v'])
        ),
    )


@effect(
    Place.CODE,
    Parameter(
        'rate_hz',
        unit='Hz',
        lower=0.0,
        upper=1000.0,
        scale=0.1,
        source='physics: a bus that times out',
        doc='starts per second',
        axes='',
    ),
    Shape(
        'duration_s',
        unit='s',
        lower=1e-4,
        upper=100.0,
        scale=0.05,
        source='physics: a few frames',
        doc='time that the sample is held',
    ),
    smooth=False,
    acts_on=ActsOn.NOISE,
    cause='The link repeats samples; check the bus, its load and its buffers.',
    diagnosis=DiagnosisHints(detector=Detector.REPEATED_SAMPLES, proof=(ProofVariable.STEP,)),
)
def stuck(signals: Signals, p: Parameters) -> None:
    """
    Stuck samples: the link repeats its last sample for a while.

    Hold all axes for a fixed time, beginning at random instants at a mean rate.
    """
    assert signals.rng is not None
    shape = np.shape(signals.environment.time_s)
    count = shape[0]
    starts = signals.rng.random(shape) < p['rate_hz'] * signals.dt_s
    length = max(round(p['duration_s'] / signals.dt_s), 1)
    index = np.arange(count).reshape(-1, *[1] * (len(shape) - 1))
    # A sample is stuck where the newest start is less than the length behind.
    newest = np.maximum.accumulate(np.where(starts, index, _NEVER), axis=0)
    newest = np.where(newest < 0, signals.memory.get('newest', _NEVER), newest)
    fresh = index - newest >= length
    # Each stuck sample repeats the last fresh one, which may be in the previous block.
    source = np.maximum.accumulate(np.where(fresh, index, -1), axis=0)
    for d, volts in enumerate(signals.volts):
        previous = signals.memory.get(d, volts[0] if count else 0.0)
        held = np.where(source < 0, previous, np.take_along_axis(volts, np.maximum(source, 0), 0))
        signals.volts[d] = held
        if count:
            signals.memory[d] = held[-1]
    if count:
        signals.memory['newest'] = newest[-1] - count


@effect(
    Place.CLOCK,
    Parameter(
        'offset_s',
        unit='s',
        upper=1.0,
        scale=5e-3,
        source='physics: buffers between ADC and host',
        doc='delay of the stamps behind the samples',
        axes='',
    ),
    exact=True,
    cause='The stamps of sensor and stage differ; synchronise the clocks, or state the delay.',
    # Stamps have a latency of some 0.1 ms (chosen: buffers of a board that works).
    diagnosis=DiagnosisHints(
        healthy_std=1e-4, revealed_by=Manoeuvre.SHAKE, proof=(ProofVariable.FORCE_RATE,)
    ),
)
def time_offset(signals: Signals, p: Parameters) -> None:
    """Time offset: the stamps are late."""
    signals.time_s = signals.time_s - p['offset_s']


@effect(
    Place.CLOCK,
    Parameter(
        'ratio',
        unit='s/s',
        upper=0.01,
        scale=1e-4,
        source='physics: crystals, 100 ppm',
        doc='relative excess of the rate of the clock that makes the stamps',
        axes='',
    ),
    exact=True,
    cause='The clocks of sensor and stage drift apart; discipline them by one source.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SPEEDS, proof=(ProofVariable.FORCE_RATE, ProofVariable.TIME)
    ),
)
def clock_skew(signals: Signals, p: Parameters) -> None:
    """Clock skew: the clock that stamps the samples runs fast or slow."""
    signals.time_s = signals.time_s - p['ratio'] * signals.time_s


@effect(
    Place.ELECTRONICS,
    Parameter(
        'ratio',
        unit='1',
        lower=-0.99,  # A density stays above 0
        upper=100.0,
        scale=0.3,
        source='ADXL203 datasheet: 190 instead of 110 ug/sqrt(Hz) at 3 V',
        doc='noise density divided by the stated one, minus 1',
    ),
    acts_on=ActsOn.NOISE,
    needs=(Need.NOISE,),
    cause='The noise is not the stated one; check the supply, its decoupling and the cable.',
    diagnosis=DiagnosisHints(detector=Detector.NOISE_LEVEL, proof=(ProofVariable.FREQUENCY,)),
)
def noise_excess(signals: Signals, p: Parameters) -> None:
    """White noise beyond the stated density."""
    for d, ratio in enumerate(p['ratio']):
        signals.noise_ratio[d] = signals.noise_ratio[d] * (1 + ratio)


@lru_cache(maxsize=8)
def flicker_filter(rate_hz: float) -> np.ndarray:
    """
    Return the sections that make flicker noise of k = 1 from white noise, as `sosfilt` takes them.

    Between the poles of each two neighbouring corners there is a zero in their geometric mean, so
    that the density falls by a factor of 10 in a decade.
    """
    highest = _HIGHEST_RATIO * rate_hz
    count = int(np.log10(highest / _LOWEST_HZ) * _PER_DECADE) + 1
    corners = 2 * np.pi * highest / rate_hz * 10 ** (-np.arange(count) / _PER_DECADE)
    poles = np.exp(-corners)
    zeros = np.exp(-np.sqrt(corners[:-1] * corners[1:]))
    turn = np.exp(2j * np.pi * _MATCHED)
    passed = np.abs(np.prod(turn - zeros) / np.prod(turn - poles))
    sections = np.zeros((count, 6))
    sections[:, [0, 3]] = 1.0
    sections[:-1, 1], sections[:, 4] = -zeros, -poles
    sections[0, :2] /= passed * np.sqrt(2 * _MATCHED)
    return sections


@effect(
    Place.ADC,
    Parameter(
        'density_g_per_rthz',
        unit='g/sqrt(Hz)',
        lower=0.0,
        upper=0.1,
        scale=1e-4,
        source='physics: corner near 1 Hz at 110 ug/sqrt(Hz)',
        doc='density at 1 Hz; it falls with the root of the frequency',
    ),
    acts_on=ActsOn.NOISE,
    cause='The electronics have 1/f noise; average shorter and take the zero more often.',
    # A healthy unit has 0.2 mg rms over five decades of frequency at most (tuned by hand on
    # simulated recordings).
    diagnosis=DiagnosisHints(
        drift=DriftSpectrum.FLICKER,
        healthy_density=6e-5,
        revealed_by=Manoeuvre.HEAT,
        proof=(ProofVariable.FREQUENCY,),
    ),
)
def flicker(signals: Signals, p: Parameters) -> None:
    """
    Flicker noise: 1/f noise, which is 0 at power-on.

    Add noise of the one-sided density k²/f, g²/Hz, from 10⁻⁴ Hz up to a fifth of the rate.

    White noise passes a filter whose poles and zeros alternate, evenly spaced on a logarithmic
    axis (Plaszczynski 2007).
    """
    assert signals.rng is not None
    shape = (*np.shape(signals.environment.time_s), len(p['density_g_per_rthz']))
    if not shape[0]:
        return
    # scipy.signal takes 0.5 s to import.
    from scipy.signal import sosfilt

    sections = flicker_filter(1 / signals.dt_s)
    noise, signals.memory['state'] = sosfilt(
        sections,
        signals.rng.standard_normal(shape),
        axis=0,
        zi=signals.memory.get('state', np.zeros((len(sections), 2, *shape[1:]))),
    )
    add(
        signals.volts,
        (
            density * noise[..., d] * signals.nominal_scale_v_per_g[d]
            for d, density in enumerate(p['density_g_per_rthz'])
        ),
    )


@effect(
    Place.ADC,
    Parameter(
        'density_g_per_rts',
        unit='g/sqrt(s)',
        lower=0.0,
        upper=0.1,
        scale=2e-5,
        source='physics: slow stress in package and solder',
        doc='rms of the wandering zero-g divided by the root of time',
    ),
    OptionalSize(
        'return_per_s',
        unit='1/s',
        lower=0.0,
        upper=1.0,
        scale=1e-2,
        source='physics: bounds of the stress',
        doc='inverse correlation time of a walk that has bounds',
    ),
    acts_on=ActsOn.NOISE,
    cause='The zero-g wanders; take the zero again more often, or choose a quieter sensor.',
    # A healthy unit drifts by 0.3 mg within 100 s at most (tuned by hand on simulated
    # recordings).
    diagnosis=DiagnosisHints(
        drift=DriftSpectrum.RANDOM_WALK,
        healthy_density=3e-5,
        revealed_by=Manoeuvre.HEAT,
        proof=(ProofVariable.FREQUENCY,),
    ),
)
def bias_walk(signals: Signals, p: Parameters) -> None:
    """
    Random walk of the zero-g: acceleration random walk, rate noise of an Allan deviation.

    Add the sum of independent steps, g; after a time t its rms is k·√t.

    A walk that returns at the rate r is a Gauss-Markov process: its rms ends at k/√(2·r).
    """
    assert signals.rng is not None
    density = np.array(p['density_g_per_rts'])
    drawn = signals.rng.standard_normal((*np.shape(signals.environment.time_s), len(density)))
    if not density.any() or not len(drawn):
        return
    last = signals.memory.get('walked', np.zeros(drawn.shape[1:]))
    returns = np.broadcast_to(p.get('return_per_s', 0.0), density.shape) * signals.dt_s
    shrink = -np.expm1(-2 * returns) / np.where(returns, 2 * returns, 1.0)
    drawn *= density * np.sqrt(np.where(returns, shrink, 1.0) * signals.dt_s)
    walk = np.stack(
        [
            first_order_recursion(1.0, a, drawn[..., d], last[..., d])
            for d, a in enumerate(np.exp(-returns))
        ],
        axis=-1,
    )
    signals.memory['walked'] = walk[-1]
    add(
        signals.volts,
        (walk[..., d] * scale for d, scale in enumerate(signals.nominal_scale_v_per_g)),
    )


@effect(
    Place.ADC,
    Parameter(
        'amplitude_v',
        unit='V',
        upper=1.0,
        scale=1e-3,
        source='physics: unshielded cable',
        doc='amplitude of the sine',
    ),
    Shape(
        'frequency_hz',
        unit='Hz',
        lower=1.0,
        upper=1000.0,
        scale=50.0,
        source='mains: 50 or 60 Hz',
        doc='frequency of the sine',
    ),
    OptionalSize(
        'phase_rad',
        unit='rad',
        upper=7.0,
        scale=1.0,
        source='chosen: any',
        doc='phase at time 0',
        axes='',
    ),
    acts_on=ActsOn.NOISE,
    cause='The mains couple into the signal; shield and twist the cable, and ground one end.',
    diagnosis=DiagnosisHints(detector=Detector.MAINS_LINE, proof=(ProofVariable.FREQUENCY,)),
)
def mains_hum(signals: Signals, p: Parameters) -> None:
    """
    Mains hum: a sine at the input of the ADC.

    Add A·sin(2π·f·t + φ) to the volts of each axis.
    """
    wave = np.sin(2 * np.pi * p['frequency_hz'] * signals.environment.time_s + p['phase_rad'])
    add(signals.volts, (amplitude * wave for amplitude in p['amplitude_v']))
