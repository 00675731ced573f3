# SPDX-License-Identifier: Apache-2.0

"""A thermometer that differs from the sensor in time, so that the zero-g is late or early."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
from adxl_ros.model.filters import low_pass
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """
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


EFFECT = Effect(
    name='thermal_lag',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('per_k', 'g/K', -0.1, 0.1, 1e-4, 'ADXL203 datasheet: 0.1 mg/degC',
                  'slope of the zero-g over the temperature that lags the thermometer'),
        Parameter('tau_s', 's', 1.0, 1e4, 60.0, 'physics: a small board in moving air',
                  'time constant between thermometer and sensor', '', neutral=60.0,
                  role=Role.SHAPE, starts=(8.0, 25.0, 80.0, 250.0)),
    ),
    apply=apply,
    follows=('temperature_c',),
    cause='The thermometer is warm earlier or later than the sensor; mount it at the sensor, or '
          'change the temperature slowly.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, time_constant='tau_s',
                             form=(FormDimension.TEMPERATURE, FormDimension.WARMING),
                             proof=(ProofVariable.TEMPERATURE_RATE,)),
)
