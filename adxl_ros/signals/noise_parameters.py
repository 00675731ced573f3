# SPDX-License-Identifier: Apache-2.0

"""The noise of the sensors of a recording at rest, and the parameters of a sensor that has it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import nominal_of
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.model.noise import (
    density_for_variance,
    electronics,
    ONE_SIDED,
    rc_of_white_share,
    white_share,
)
from adxl_ros.model.sensor import Sensor, without_effect
from adxl_ros.signals.allan_deviation import longest_rest, StillStretch
from adxl_ros.signals.block_statistics import DITHERED_STEPS
from adxl_ros.signals.gravity_at_rest import require_unit
from adxl_ros.signals.noise_fit import (
    coefficient_variances,
    fit_noise,
    INTERVAL_DROP,
    LEAST_WHITE,
    NoiseFit,
    NoiseTerm,
)
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.recorded_sensor import load_sensor, RESISTANCE_OHM
import numpy as np

_FLICKER_OF_INSTABILITY = 1 / float(np.sqrt(np.pi))
"""Density of `flicker` at 1 Hz divided by B: over positive frequencies it is B²/(π·f)."""
_CERTAIN_STDS = 2.576  # Standard deviations that refute a filter: 1 of 100 healthy logs is beyond
_FORM_TOLERANCE = 0.2  # Logarithm within which noise has the form of an RC filter. Chosen: 20 %
_DENSITY = 'noise_density_g_per_rthz'  # Field of a sensor that holds its white noise


class FilterEvidence(NamedTuple):
    """What the noise of an axis shows of its filter."""

    # Logarithm of the variance of a sample by that of white noise with the same N
    log_share: float
    std: float  # Standard deviation of this logarithm
    change: float  # Half of the mean square of neighbouring differences, by the variance


@dataclass(frozen=True)
class AxisNoise:
    """The noise of one axis; u is m/s² for an accelerometer, rad/s for a gyroscope."""

    axis: str  # Its letter
    fit: NoiseFit  # White noise, bias instability and random walk, in u
    sample_std: float  # Standard deviation of a sample, u
    resolution: float  # Smallest change of a sample, u
    rounding: float  # N of the rounding to this resolution, u/√Hz, which `fit` does not contain
    # Variance of a sample without rounding, bias instability and random walk, u²
    white_variance: float
    # Half of the mean square of the differences of neighbouring samples without rounding, u²
    change_variance: float

    @property
    def estimates(self) -> tuple[NoiseTerm, ...]:
        """N in u/√Hz, B in u, and K in u/√s."""
        return self.fit.white, self.fit.instability, self.fit.walk

    @property
    def is_coarse(self) -> bool:
        """Whether rounding hides the noise."""
        return _is_coarse(self.sample_std, self.resolution)

    @property
    def sample_white(self) -> float:
        """N of the samples with their rounding, or its upper limit, u/√Hz."""
        white = self.fit.white
        return float(np.hypot(white.value if white.is_seen else white.high, self.rounding))


def _filter_evidence(noise: AxisNoise, rest: StillStretch) -> FilterEvidence | None:
    """Return what the noise shows of a filter; None where slow noise or rounding hides it."""
    white = noise.fit.white
    is_clear = noise.white_variance > LEAST_WHITE * noise.sample_std**2
    if not white.is_seen or not is_clear:
        return None
    share = noise.white_variance / (white.value**2 * rest.rate_hz)
    change = noise.change_variance / noise.white_variance
    repeat = np.clip(1 - change, 0.0, 1.0)
    independent = rest.count * (1 - repeat**2) / (1 + repeat**2)
    # 90 % of a normal distribution are within 1.645 standard deviations.
    white_std = np.log(white.high / white.low) / np.sqrt(INTERVAL_DROP)
    std = float(np.hypot(white_std, np.sqrt(2 / independent)))
    return FilterEvidence(np.log(share), std, change)


@dataclass(frozen=True)
class RecordingNoise:
    """The noise of a recording."""

    path: str  # The recording
    sensor: Sensor  # Its parameter file
    nominal: Sensor  # The nominal sensor that it comes from
    rest: StillStretch  # Its samples at rest
    axes: list[AxisNoise]  # The noise by axis
    # What is wrong with the length of gravity and between neighbouring samples, one line each
    doubts: tuple[str, ...] = ()
    gyro_rest: StillStretch | None = None  # The samples of the gyroscope in the same rest
    gyro: Sequence[AxisNoise] = ()  # Its noise by axis; none without a gyroscope


def recording_noise(
    read: Callable[[], Iterable[Recording]],
    params: Sensor | str | None,
    show: Callable[[float], None] = lambda done: None,
) -> RecordingNoise:
    """Fit the noise of all axes in the longest rest; `read` yields the blocks of a recording."""
    first = next(iter(read()), None)
    if first is None:
        raise UserError('the recording holds no samples')
    sensor = load_sensor(params, first)
    nominal = nominal_of(sensor, first.stream_info, first.axes)
    look = RecordingLook(sensor, first)
    with look.named_in_refusals():
        still = longest_rest(read, nominal, first, look)
    rest = still.accelerometer
    gyro_rest = still.gyroscope
    doubts = require_unit(look.gravity(), first.path)
    share = 1.0 if gyro_rest is None else 0.5
    noises = _axis_noises(rest, nominal.axes, lambda done: show(share * done))
    gyro = (
        _axis_noises(gyro_rest, AXES, lambda done: show(share * (1 + done))) if gyro_rest else []
    )
    if still.gyro_doubt:
        doubts.append(still.gyro_doubt)
    doubts += look.faults()
    return RecordingNoise(
        path=first.path,
        sensor=sensor,
        nominal=nominal,
        rest=rest,
        axes=noises,
        doubts=tuple(doubts),
        gyro_rest=gyro_rest,
        gyro=gyro,
    )


def _axis_noises(rest: StillStretch, axes: str, show: Callable[[float], None]) -> list[AxisNoise]:
    """Fit the noise of each axis of one sensor at rest."""
    variances = coefficient_variances(len(rest.means), rest.step_s)
    noises = []
    for i, axis in enumerate(axes):
        std = float(rest.sample_std[i])
        resolution = float(rest.resolution[i])
        rounding = resolution / float(np.sqrt(12 * rest.rate_hz))
        fit = fit_noise(rest.means[:, i], rest.step_s, variances, rounding)
        rounding_variance = rounding**2 * rest.rate_hz
        tau_s = rest.allan.tau_s[: rest.window_octaves]
        _, instability, walk = fit.lines(tau_s)
        slow_lines = []
        if fit.instability.is_seen:
            slow_lines.append(instability)
        if fit.walk.is_seen:
            slow_lines.append(walk)
        slow = float(np.sum(np.square(slow_lines)) / 2 / (1 - 0.5 ** len(tau_s)))
        noises.append(
            AxisNoise(
                axis=axis,
                fit=without_rounding(fit, std, resolution, rounding),
                sample_std=std,
                resolution=resolution,
                rounding=rounding,
                white_variance=max(std**2 - slow - rounding_variance, 0.0),
                change_variance=max(
                    float(rest.allan.deviation[0, i]) ** 2 - rounding_variance, 0.0
                ),
            )
        )
        show((i + 1) / len(axes))
    return noises


def without_rounding(fit: NoiseFit, std: float, resolution: float, rounding: float) -> NoiseFit:
    """
    Return the noise before the rounding of the samples to a resolution.

    Above 0.6 steps of noise, rounding adds independent noise of the variance step²/12. Less noise
    is hidden: it may be anything up to that, and codes that do not change show less.
    """
    if not _is_coarse(std, resolution):
        before = [float(np.sqrt(max(value**2 - rounding**2, 0.0))) for value in fit.white]
        return replace(fit, white=NoiseTerm(*before))
    widest = max(DITHERED_STEPS * resolution / std, 1.0)

    def widened(term: NoiseTerm) -> NoiseTerm:
        return NoiseTerm(term.value, 0.0, term.high * widest)

    return replace(
        fit,
        white=widened(fit.white),
        instability=widened(fit.instability),
        walk=widened(fit.walk),
    )


def _is_coarse(std: float, resolution: float) -> bool:
    """Whether samples with rounding have less noise than makes rounding independent of them."""
    return std**2 < resolution**2 * (DITHERED_STEPS**2 + 1 / 12)


def with_noise(sensor: Sensor, noises: list[AxisNoise], rest: StillStretch) -> Sensor:
    """
    Give a sensor the measured noise, so that its simulation repeats it at the recorded rate.

    Bias instability is the effect `flicker`, whose density over positive frequencies is B²/(π·f),
    and random walk is `bias_walk`. A term that is not seen on an axis keeps the value of `sensor`
    up to its upper limit. White noise that neither shows stays unstated, so that nobody takes it
    for 0. It has the rounding where `sensor` has no ADC.

    White noise is the density before the filter that gives a sample the measured variance. The
    filter is the stated one unless the noise refutes it: see `_with_filter`. A rest shows neither
    range nor resolution: where they are not stated, the placeholders of `Sensor` stay, which limit
    and round nothing.
    """
    values = {name: value for name, value in sensor.values.items() if name != 'noise_excess'}
    to_g = np.array([ONE_SIDED, _FLICKER_OF_INSTABILITY, 1.0])[:, None] / G0_MPS2
    # By field of an estimate, term and axis.
    value, low, high = (np.array([noise.estimates for noise in noises]) * to_g).T
    for term, (effect, name) in enumerate(
        (('flicker', 'density_g_per_rthz'), ('bias_walk', 'density_g_per_rts')), 1
    ):
        before = sensor.values.get(effect, {}).get(name, 0.0)
        sizes = np.where(low[term] > 0, value[term], np.minimum(before, high[term]))
        values.pop(effect, None)
        if sizes.any():
            values[effect] = {name: sizes}
    if 'bias_walk' in values:
        values['bias_walk']['return_per_s'] = np.array([1 / noise.fit.bound_s for noise in noises])
    kept = [name for name in sensor.effects if name in values]
    sensor = replace(
        sensor, values=values, effects=(*kept, *(name for name in values if name not in kept))
    )
    filtered, is_repeated = _with_filter(sensor, noises, rest)
    is_seen = low[0] > 0
    changed: dict[str, Any] = {'unstated': (_DENSITY,)}
    if _DENSITY not in sensor.unstated or is_seen.all():
        changed = {_DENSITY: _density(filtered, noises, is_repeated), 'unstated': ()}
    return replace(filtered, **changed)


def with_gyro_noise(gyro: Gyroscope, noises: Sequence[AxisNoise]) -> Gyroscope:
    """
    Give a gyroscope the measured noise, by the conventions of `with_noise`.

    A term that is not seen on an axis is 0 there, but for white noise, which is its upper limit.
    """
    if not noises:
        return gyro

    def scaled(factor: float, values: Iterable[float]) -> tuple[float, ...]:
        densities = tuple(factor * value for value in values)
        return densities if any(densities) else ()

    fits = [noise.fit for noise in noises]
    whites = [fit.white.value if fit.white.is_seen else fit.white.high for fit in fits]
    return replace(
        gyro,
        noise_density_radps_per_rthz=scaled(ONE_SIDED, whites),
        flicker_radps_per_rthz=scaled(
            _FLICKER_OF_INSTABILITY, (_seen(fit.instability) for fit in fits)
        ),
        walk_radps_per_rts=scaled(1.0, (_seen(fit.walk) for fit in fits)),
    )


def _seen(estimate: NoiseTerm) -> float:
    return estimate.value if estimate.is_seen else 0.0


def _density(sensor: Sensor, noises: list[AxisNoise], is_repeated: bool) -> np.ndarray:
    """
    Return the white noise before the filter by axis, g/√Hz over positive frequencies, (m,).

    is_repeated: whether the variance of a sample is that of white noise behind the filter.
    """
    circuit = electronics(sensor)
    rate_hz = sensor.rate_hz
    share = white_share(circuit.rc_s, rate_hz)
    variances = []
    for noise, axis_share in zip(noises, share):
        white = noise.fit.white
        if not white.is_seen:
            variance = white.high**2 * rate_hz * axis_share
        elif is_repeated:
            variance = noise.white_variance
        else:
            variance = white.value**2 * rate_hz * axis_share
        if not sensor.adc_bits and white.is_seen:
            variance += noise.rounding**2 * rate_hz
        variances.append(variance / G0_MPS2**2)
    measured = np.sqrt(density_for_variance(np.array(variances), circuit.rc_s, rate_hz))
    measured /= circuit.noise_ratio
    before = sensor.noise_density_g_per_rthz
    stated = np.where(before > 0, before, np.inf)
    is_seen = [noise.fit.white.is_seen for noise in noises]
    return np.where(is_seen, measured, np.minimum(stated, measured))


def _with_filter(
    sensor: Sensor, noises: list[AxisNoise], rest: StillStretch
) -> tuple[Sensor, bool]:
    """
    Return the sensor with a filter that agrees with the noise, and whether one does.

    White noise behind an RC filter has a variance that follows from N and the filter. Less of it
    refutes the stated filter. So does more, but only if the differences of neighbouring samples
    have the form of a filter: vibration and mains add to the variance, too.
    """
    seen = list(filter(None, (_filter_evidence(noise, rest) for noise in noises)))
    if not seen:
        return sensor, False
    weights = np.array([each.std**-2 for each in seen])
    log_share = float(np.average([each.log_share for each in seen], weights=weights))
    limit = _CERTAIN_STDS / float(np.sqrt(weights.sum()))
    is_stated = 'rc_capacitance_f' not in sensor.unstated
    stated_share = white_share(electronics(sensor).rc_s, sensor.rate_hz)
    excess = log_share - float(np.mean(np.log(stated_share)))
    if is_stated and abs(excess) < limit:
        return sensor, True
    share = 1.0 if log_share > -limit else float(np.exp(log_share))
    change = float(np.average([each.change for each in seen], weights=weights))
    has_form = abs(np.log(change * (1 + share) / (2 * share))) < limit + _FORM_TOLERANCE
    is_vibration = excess > 0 and not has_form
    if is_stated and is_vibration:
        return sensor, False
    return replace(
        without_effect(sensor, 'bandwidth'),
        rc_resistance_ohm=RESISTANCE_OHM,
        rc_capacitance_f=rc_of_white_share(share, sensor.rate_hz) / RESISTANCE_OHM,
        filter_rate_hz=sensor.rate_hz,
    ), True
