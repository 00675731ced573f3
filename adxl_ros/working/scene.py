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
"""Units, stages and manoeuvres of working cases, and the calibration that their users have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi
from typing import NamedTuple

from adxl_ros.files import parameter_file
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects.base import Coefficient, Environment, Place, Signals
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.simulate.motion import Knots, Motion
from adxl_ros.simulate.simulator import reference_columns, simulate
from adxl_ros.simulate.trajectories import Script, Steps, Sum, visit
from adxl_ros.working.fault import Fault, in_library
import numpy as np

RATES_HZ = (50.0, 100.0, 125.0, 200.0, 250.0, 500.0, 1000.0)
"""Sample rates, Hz."""
_RATE_SHARES = (0.12, 0.42, 0.06, 0.14, 0.14, 0.08, 0.04)
"""Shares of the rates; chosen: 100 Hz is the most common rate of an IMU."""
SECONDS = (120.0, 600.0)
"""Shortest and longest recording, s; chosen. Durations are log-uniform."""
_RESOLUTIONS_DEG = (0.083, 0.02, 0.005, 0.001)
"""Steps of the encoders, °: that of the paper, and finer ones; chosen."""
ZERO_G_STD_G = 1e-4
"""Standard deviation of a calibrated zero-g, and of its change since, g; chosen."""
SCALE_STD = 1e-4
"""The same of the scale factor, a share; chosen."""
_FILTERS_F = (0.1e-6, 0.05e-6, 0.33e-6)
"""Filter capacitors, F: 50, 100 and 15 Hz."""
_STAGE_SHARE = 0.15
"""Errors of a good stage, as a share of its step; chosen."""
_FASTEST_HZ = 25.0
"""Highest frequency of the shaker, Hz; chosen."""
_SAMPLES_PER_PERIOD = 6.0
"""Fewest samples of a period of the shaker; chosen: less cannot be followed."""
_CALIBRATION_HZ = 100.0
"""Sample rate of the calibration, Hz; chosen."""
_CALIBRATION_DWELL_S = 0.6
"""Dwell of a calibration's pose, s; chosen: the simulated calibration has no noise."""


class Scene(NamedTuple):
    """
    A unit, its manoeuvre, and what its user knows.

    Attributes
    ----------
    true
        The unit on the day of the recording, without faults.
    stated
        The parameter file of its user.
    motion
        The manoeuvre.
    manoeuvre
        Its kind.
    seed
        Seed of the noise.

    """

    true: Sensor
    stated: Sensor
    motion: Motion
    manoeuvre: str
    seed: int


@dataclass(frozen=True)
class Burst:
    """
    A burst of the shaker: a sine of constant frequency that fades in and out.

    Attributes
    ----------
    begin_s, duration_s
        When it begins and how long it lasts, s.
    hertz
        Frequency, Hz.
    amplitude_m
        Amplitude, m.

    """

    begin_s: float
    duration_s: float
    hertz: float
    amplitude_m: float

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative; see `motion.Path`."""
        values = np.zeros(len(time_s))
        active = (time_s > self.begin_s) & (time_s < self.begin_s + self.duration_s)
        t, omega = time_s[active] - self.begin_s, 2 * pi * self.hertz
        end_s = self.duration_s
        fade = Knots([0, 0.3 * end_s, 0.7 * end_s, end_s], [0, 1, 1, 0])
        waves = [omega ** k * np.sin(omega * t + k * pi / 2) for k in range(order + 1)]
        binomial = ((1,), (1, 1), (1, 2, 1))[order]
        values[active] = self.amplitude_m * sum(
            (factor * fade(t, order - k) * waves[k] for k, factor in enumerate(binomial)),
            np.zeros(len(t)))
        return values


def draw(rng: np.random.Generator, needs: Sequence[str], seconds: tuple[float, float] = SECONDS
         ) -> Scene:
    """
    Draw a unit and a manoeuvre.

    Parameters
    ----------
    rng
        The random generator.
    needs
        What the manoeuvre must have, as in `fault.Kind`.
    seconds
        Shortest and longest recording, s.

    Returns
    -------
    Scene
        The scene; its calibration is that of a unit without faults.

    """
    axes = 'xyz' if rng.random() < 0.6 else 'xy'
    count = len(axes)
    nominal = with_axes(parameter_file.load(parameter_file.nominal_path()), axes)
    resolution_rad = float(np.radians(rng.choice(_RESOLUTIONS_DEG)))
    noisy = 300e-6 if rng.random() < 0.2 else 110e-6
    nominal = replace(
        nominal, serial='working', rate_hz=float(rng.choice(RATES_HZ, p=_RATE_SHARES)),
        rc_capacitance_f=float(rng.choice(_FILTERS_F, p=(0.6, 0.2, 0.2))),
        noise_density_g_per_rthz=noisy * np.exp(rng.normal(0, 0.15, count)),
        stage_resolution_rad=resolution_rad)
    values = {'bias': {'offset_v': rng.normal(0, 0.03, count)},
              'scale_factor': {'offset_v_per_g': rng.normal(0, 0.015, count)}}
    if rng.random() < 0.25:
        values['misalignment'] = {name: rng.normal(0, 8e-3, count)
                                  for name in ('alpha_rad', 'beta_rad')}
    stated = _with_covariance(replace(nominal, model='linear', effects=tuple(values),
                                      values=values, provenance={'source': 'sweep'}))
    manoeuvre = 'rich' if needs or rng.random() < 0.65 else str(rng.choice(
        ['planes', 'poses', 'shaker']))
    return Scene(_aged(rng, stated), stated, _motion(rng, manoeuvre, seconds, stated.rate_hz),
                 manoeuvre, int(rng.integers(2 ** 31)))


def _with_covariance(sensor: Sensor) -> Sensor:
    """Return a calibrated sensor with the covariance of its zero-g and scale factor."""
    names = tuple(Coefficient(effect, parameter, axis) for effect, parameter in (
        ('bias', 'offset_v'), ('scale_factor', 'offset_v_per_g')) for axis in sensor.axes)
    std = np.concatenate([ZERO_G_STD_G * sensor.scale_v_per_g, SCALE_STD * sensor.scale_v_per_g])
    return replace(sensor, covariance=np.diag(std ** 2), covariance_names=names)


def _aged(rng: np.random.Generator, stated: Sensor) -> Sensor:
    """Return a healthy unit days after its calibration, on its stage, with its own drift."""
    count, step_rad = len(stated.axes), stated.stage_resolution_rad
    scale = stated.scale_v_per_g
    values = {name: {k: np.array(v, float) for k, v in parameters.items()}
              for name, parameters in stated.values.items()}
    values['bias']['offset_v'] += np.sqrt(2) * ZERO_G_STD_G * scale * rng.normal(size=count)
    values['scale_factor']['offset_v_per_g'] += np.sqrt(2) * SCALE_STD * scale \
        * rng.normal(size=count)
    values['bandwidth'] = {'resistance_ratio': rng.normal(0, 0.01, count)}
    values['time_offset'] = {'offset_s': np.array(rng.normal(0, 5e-5))}
    values['stage_offset'] = {f'{joint}_rad': np.array(_STAGE_SHARE * step_rad * rng.normal())
                              for joint in ('alpha', 'beta')}
    values['bias_walk'] = {'density_g_per_rts': 10 ** rng.uniform(-6.3, -5.2, count)}
    values['flicker'] = {'density_g_per_rthz': 10 ** rng.uniform(-6.0, -4.8, count)}
    noise = stated.noise_density_g_per_rthz * np.exp(rng.normal(0, 0.015, count))
    return replace(stated, values=values, effects=tuple(values), noise_density_g_per_rthz=noise)


def _motion(rng: np.random.Generator, manoeuvre: str, seconds: tuple[float, float],
            rate_hz: float) -> Motion:
    """Draw a manoeuvre of a kind."""
    length_s = float(np.exp(rng.uniform(*np.log(seconds))))
    script, bursts = Script(pi / 2, float(rng.uniform(-pi, pi))), []
    highest_hz = min(_FASTEST_HZ, rate_hz / _SAMPLES_PER_PERIOD)
    script.rest(2.0)
    moves = {'rich': (_plane, _poses, _swing, _plane, _turns), 'planes': (_plane,),
             'poses': (_poses,), 'shaker': (_poses, _turns)}[manoeuvre]
    while script.now < length_s:
        moves[int(rng.integers(len(moves)))](script, rng)
        if manoeuvre in ('rich', 'shaker') and rng.random() < 0.6:
            hertz = float(np.exp(rng.uniform(np.log(3.0), np.log(highest_hz))))
            burst_s = float(rng.uniform(4, 8))
            bursts.append(Burst(script.now + 0.2, burst_s, hertz,
                                float(rng.uniform(0.8, 4.0)) / (2 * pi * hertz) ** 2))
            script.rest(burst_s + 0.5)
    script.rest(1.0)
    alpha, beta = script.joints()
    motion = Motion(script.now, alpha, beta)
    if bursts:
        motion = replace(motion, shift=Sum(tuple(bursts)))
    if manoeuvre == 'rich' or rng.random() < 0.3:
        heat = tuple((float(when_s), NOMINAL_TEMPERATURE_C + float(rng.uniform(-6, 14)))
                     for when_s in np.sort(rng.uniform(0.05, 0.8, 3)) * script.now)
        taps = tuple((float(when_s), NOMINAL_SUPPLY_V + float(rng.normal(0, 0.06)))
                     for when_s in np.sort(rng.uniform(0.05, 0.95, 6)) * script.now)
        motion = replace(
            motion, temperature_c=Steps(NOMINAL_TEMPERATURE_C, heat, float(rng.uniform(8, 25))),
            supply_v=Steps(NOMINAL_SUPPLY_V, taps, 0.5))
    return motion


def _plane(script: Script, rng: np.random.Generator) -> None:
    """Turn beta forth and back in one plane."""
    alpha, step = float(np.radians(rng.uniform(20, 160))), float(np.radians(rng.choice([30, 45])))
    count, dwell_s = int(rng.integers(3, 8)), float(rng.uniform(0.6, 2.0))
    for turn in [step] * count + [-step] * count:
        script.go(alpha, script.beta + turn)
        script.rest(dwell_s)


def _poses(script: Script, rng: np.random.Generator) -> None:
    """Rest in some random poses."""
    for _ in range(int(rng.integers(3, 6))):
        script.go(float(np.radians(rng.uniform(0, 180))),
                  script.beta + float(rng.uniform(-1.5, 1.5)))
        script.rest(float(rng.uniform(0.8, 2.5)))


def _swing(script: Script, rng: np.random.Generator) -> None:
    """Swing one joint to and fro without a rest."""
    joint = rng.choice(['alpha', 'beta'])
    size = float(rng.uniform(0.15, 0.6))
    script.go(float(np.radians(rng.uniform(55, 125))), script.beta)
    middle = script.alpha, script.beta
    for sign in [1, -1] * int(rng.integers(3, 6)):
        script.go(middle[0] + sign * size * (joint == 'alpha'),
                  middle[1] + sign * size * (joint == 'beta'))
    script.go(*middle)


def _turns(script: Script, rng: np.random.Generator) -> None:
    """Turn beta at different speeds, forth and back."""
    script.go(float(np.radians(rng.uniform(50, 130))), script.beta)
    for _ in range(2):
        turn, speed = float(rng.uniform(2.5, 5.0)), float(rng.uniform(0.4, 2.2))
        for sign in (1, -1):
            script.run('beta', script.beta + sign * max(turn, 1.2 * speed), speed)
            script.rest(0.5)


def samples(scene: Scene, faults: Sequence[Fault]) -> np.ndarray:
    """
    Simulate the recording of a scene.

    Parameters
    ----------
    scene
        The unit and its manoeuvre.
    faults
        Its faults.

    Returns
    -------
    numpy.ndarray
        Volts of the ADC, V, (n, m).

    """
    chain = [fault for fault in faults if fault.kind.place not in (Place.ADC, Place.CODE)]
    true = scene.true
    with in_library(chain) as names:
        columns = simulate(replace(true, adc_bits=0, effects=(*true.effects, *names),
                                   values={**true.values, **{name: {} for name in names}}),
                           scene.motion, scene.seed)
    volts = [columns[f'{axis}_v'] for axis in true.axes]
    signals = Signals(Environment(columns['time_s']), input_v=[v.copy() for v in volts],
                      volts=volts, nominal_scale_v_per_g=true.nominal_scale_v_per_g.tolist(),
                      vref_v=true.adc_vref_v, lsb_v=true.lsb_v, dt_s=1 / true.rate_hz)
    for place in (Place.ADC, Place.CODE):
        for i, fault in enumerate(faults):
            if fault.kind.place is place:
                signals.memory, signals.rng = {}, np.random.default_rng([scene.seed, 1, i])
                fault.act(signals)
        if place is Place.ADC:
            coded = signal_chain.quantise(np.column_stack(signals.volts), true,
                                          np.full(len(true.axes), true.lsb_v))
            signals.volts = [column.copy() for column in coded.T]
    return np.column_stack(signals.volts)


def columns(scene: Scene, volts: np.ndarray) -> dict[str, np.ndarray]:
    """
    Return the columns of a recording.

    Parameters
    ----------
    scene
        The unit and its manoeuvre.
    volts
        Its samples, V, (n, m).

    Returns
    -------
    dict
        Columns by canonical name, (n,) each.

    """
    time_s = np.arange(len(volts)) / scene.true.rate_hz
    rng = np.random.default_rng([scene.seed, 2])
    references = reference_columns(scene.stated, scene.motion, time_s)
    for name, std in (('temperature_c', 0.01), ('supply_v', 1e-4)):
        if name in references:
            references[name] = references[name] + std * rng.normal(size=len(time_s))
    return {'time_s': time_s, **{f'{axis}_v': volts[:, d]
                                 for d, axis in enumerate(scene.true.axes)}, **references}


def calibrated(scene: Scene, faults: Sequence[Fault]) -> Sensor:
    """
    Calibrate zero-g and scale factor of a unit that has some faults at rest on its stage already.

    The fit is the straight line through the mean volts of the poses, by the encoders.

    Parameters
    ----------
    scene
        The unit.
    faults
        The faults that it had then.

    Returns
    -------
    Sensor
        The stated unit with what its calibration took up of the faults.

    """
    stated = scene.stated
    planes = (90,) if len(stated.axes) == 2 and scene.seed % 2 else (90, 45, 135)
    poses = [(np.radians(a), np.radians(b)) for a in planes for b in range(0, 360, 30)]
    motion = visit(poses, _CALIBRATION_DWELL_S)
    quiet = replace(stated, rate_hz=_CALIBRATION_HZ,
                    noise_density_g_per_rthz=np.zeros(len(stated.axes)))
    still = scene._replace(true=quiet, motion=motion)
    slopes = [_straight_lines(still, samples(still, chosen)) for chosen in ((), faults)]
    changed = slopes[1] - slopes[0]
    values = {name: dict(parameters) for name, parameters in stated.values.items()}
    values['bias']['offset_v'] = values['bias']['offset_v'] + changed[0]
    values['scale_factor']['offset_v_per_g'] = \
        values['scale_factor']['offset_v_per_g'] + changed[1]
    return replace(stated, values=values)


def _straight_lines(scene: Scene, volts: np.ndarray) -> np.ndarray:
    """Return zero-g, V, and scale factor, V/g, of each axis at rest, (2, m)."""
    made = columns(scene, volts)
    alpha, beta = made['alpha_rad'], made['beta_rad']
    rest = (np.abs(np.gradient(scene.motion.alpha(made['time_s']))) < 1e-9) \
        & (np.abs(np.gradient(scene.motion.beta(made['time_s']))) < 1e-9)
    force = specific_force(alpha[rest], beta[rest], G0_MPS2)
    return np.column_stack([np.linalg.lstsq(
        np.column_stack([np.ones(int(rest.sum())), force[d] / G0_MPS2]), volts[rest, d],
        rcond=None)[0] for d in range(volts.shape[1])])
