# SPDX-License-Identifier: Apache-2.0

"""Temperature: zero-g and scale factor that follow it, at once, late or by a loop."""

from adxl_ros.model.constants import NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects.base import (
    DiagnosisHints,
    effect,
    FormDimension,
    Manoeuvre,
    Parameter,
    Parameters,
    Place,
    ProofVariable,
    Role,
    Signals,
)
from adxl_ros.model.filters import loop, low_pass
import numpy as np


@effect(Place.ELECTRONICS,
        Parameter('per_k', 'g/K', -0.1, 0.1, 1e-4, 'ADXL203 datasheet: 0.1 mg/degC',
                  'slope of the zero-g over temperature at 25 degC'),
        Parameter('per_k2', 'g/K^2', -0.01, 0.01, 1e-6,
                  'physics: a slope that changes by 1 % a degree',
                  'curvature of the zero-g over temperature', typical=0.0, role=Role.OPTIONAL),
        invertible=True, follows=('temperature_c',),
        cause='The zero-g follows the temperature; measure it and correct, or keep it steady.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, form=(FormDimension.TEMPERATURE,),
                                 proof=(ProofVariable.TEMPERATURE,)))
def temperature_bias(signals: Signals, p: Parameters) -> None:
    """
    Zero-g that changes with temperature.

    Add k·(T − 25 °C) + k2·(T − 25 °C)² to the output, g.
    """
    warmer_k = signals.environment.temperature_c - NOMINAL_TEMPERATURE_C
    for d, (per_k, per_k2) in enumerate(zip(p['per_k'], p['per_k2'])):
        signals.output[d] = signals.output[d] + warmer_k * (per_k + warmer_k * per_k2)


@effect(Place.ELECTRONICS,
        Parameter('per_k', '1/K', -0.01, 0.01, 1e-4,
                  'ADXL203 datasheet: sensitivity +-0.3 % over temperature',
                  'relative slope of the scale factor over temperature, from 25 degC on'),
        Parameter('per_k2', '1/K^2', -0.001, 0.001, 1e-6,
                  'physics: a slope that changes by 1 % a degree',
                  'relative curvature of the scale factor over temperature', typical=0.0,
                  role=Role.OPTIONAL),
        invertible=True, follows=('temperature_c',),
        cause='The scale factor follows the temperature; measure it and correct, or keep it '
              'steady.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, form=(FormDimension.TEMPERATURE,),
                                 proof=(ProofVariable.TEMPERATURE,)))
def temperature_scale(signals: Signals, p: Parameters) -> None:
    """
    Scale factor that changes with temperature.

    Multiply the scale factor by 1 + k·(T − 25 °C) + k2·(T − 25 °C)².
    """
    warmer_k = signals.environment.temperature_c - NOMINAL_TEMPERATURE_C
    for d, (per_k, per_k2) in enumerate(zip(p['per_k'], p['per_k2'])):
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * (
            1 + warmer_k * (per_k + warmer_k * per_k2))


@effect(Place.ELECTRONICS,
        Parameter('per_k', 'g/K', -0.1, 0.1, 1e-4, 'ADXL203 datasheet: 0.1 mg/degC',
                  'slope of the zero-g over the temperature that lags the thermometer'),
        Parameter('tau_s', 's', 1.0, 1e4, 60.0, 'physics: a small board in moving air',
                  'time constant between thermometer and sensor', '', neutral=60.0,
                  role=Role.SHAPE, starts=(8.0, 25.0, 80.0, 250.0)),
        follows=('temperature_c',),
        cause='The thermometer is warm earlier or later than the sensor; mount it at the sensor, '
              'or change the temperature slowly.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, time_constant='tau_s',
                                 form=(FormDimension.TEMPERATURE, FormDimension.WARMING),
                                 proof=(ProofVariable.TEMPERATURE_RATE,)))
def thermal_lag(signals: Signals, p: Parameters) -> None:
    """
    Lag of the sensor behind its thermometer, or lead, so that the zero-g is late or early.

    Add k·(θ − T) to the output, g; θ follows the measured temperature T by 1/(1 + τ·s).

    A sensor that lags its thermometer has the slope of its zero-g over temperature as k: its
    zero-g then follows θ. A sensor that leads its thermometer has a k of the opposite sign.
    """
    temperature_c = signals.environment.temperature_c
    if not any(p['per_k']) or not np.ndim(temperature_c):
        return
    lag_k = low_pass(temperature_c, p['tau_s'], signals.dt_s, signals.memory) - temperature_c
    for d, per_k in enumerate(p['per_k']):
        signals.output[d] = signals.output[d] + per_k * lag_k


@effect(Place.ELECTRONICS,
        Parameter('half_width_g', 'g', -0.1, 0.1, 2e-3,
                  'physics: friction and creep in solder and die attach',
                  'zero-g while cooling minus that while warming, divided by 2'),
        Parameter('reach_k', 'K', 0.1, 200.0, 10.0, 'physics: part of the range',
                  'half of the change after a reversal that opens the loop', '',
                  neutral=10.0, role=Role.SHAPE, starts=(2.0, 10.0, 50.0)),
        smooth=False, follows=('temperature_c',),
        cause='The zero-g depends on whether the sensor warms or cools; relieve its package of '
              'stress, or state the loop as an uncertainty.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT,
                                 form=(FormDimension.TEMPERATURE, FormDimension.WARMING),
                                 proof=(ProofVariable.TEMPERATURE_RATE,
                                        ProofVariable.TEMPERATURE)))
def thermal_hysteresis(signals: Signals, p: Parameters) -> None:
    """
    Thermal hysteresis: a zero-g that differs between warming and cooling.

    Add a loop over temperature to the zero-g, which begins when the temperature turns back.

    The loop has its full width when the temperature has changed by 2·`reach_k` since. It does not
    depend on how fast the temperature changes. The first branch belongs to `temperature_bias`.
    """
    temperature_c = signals.environment.temperature_c
    if not any(p['half_width_g']) or not np.ndim(temperature_c):
        return
    branch = loop(temperature_c, p['reach_k'], signals.memory)
    for d, half_width in enumerate(p['half_width_g']):
        signals.output[d] = signals.output[d] - half_width * branch


@effect(Place.ELECTRONICS,
        Parameter('amplitude_g', 'g', -0.5, 0.5, 2e-3, 'physics: self-heating by 20 K, 0.1 mg/K',
                  'zero-g at power-on minus the settled one'),
        Parameter('tau_s', 's', 1.0, 1e5, 300.0, 'physics: a board in still air',
                  'time constant of settling', '', neutral=300.0, role=Role.SHAPE,
                  starts=(15.0, 60.0, 300.0, 1500.0)),
        invertible=True, follows=('time_s',),
        cause='The sensor warms up after power-on; wait some time constants before measuring.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, form=(FormDimension.TIME,),
                                 proof=(ProofVariable.TIME,)))
def warm_up(signals: Signals, p: Parameters) -> None:
    """
    Warm-up: a zero-g that settles after power-on.

    Add A·exp(−t/τ) to the output, g; t is the time since power-on.
    """
    unsettled = np.exp(-signals.environment.time_s / p['tau_s'])
    for d, amplitude in enumerate(p['amplitude_g']):
        signals.output[d] = signals.output[d] + amplitude * unsettled
