# SPDX-License-Identifier: Apache-2.0

"""Mains hum: a sine at the input of the ADC."""

from adxl_ros.model.diagnosis_hints import Detector, DiagnosisHints, ProofVariable
from adxl_ros.model.effects.base import ActsOn, Effect, Parameter, Parameters, Place, Role, Signals
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """Add A·sin(2π·f·t + φ) to the volts of each axis."""
    wave = np.sin(2 * np.pi * p['frequency_hz'] * signals.environment.time_s + p['phase_rad'])
    for d, amplitude in enumerate(p['amplitude_v']):
        signals.volts[d] = signals.volts[d] + amplitude * wave


EFFECT = Effect(
    name='mains_hum',
    place=Place.ADC,
    parameters=(
        Parameter('amplitude_v', 'V', -1.0, 1.0, 1e-3, 'physics: unshielded cable',
                  'amplitude of the sine'),
        Parameter('frequency_hz', 'Hz', 1.0, 1000.0, 50.0, 'mains: 50 or 60 Hz',
                  'frequency of the sine', '', neutral=50.0, role=Role.SHAPE),
        Parameter('phase_rad', 'rad', -7.0, 7.0, 1.0, 'chosen: any', 'phase at time 0', '',
                  typical=0.0, role=Role.OPTIONAL),
    ),
    apply=apply,
    acts_on=ActsOn.NOISE,
    cause='The mains couple into the signal; shield and twist the cable, and ground one end.',
    diagnosis=DiagnosisHints(detector=Detector.MAINS_LINE,
                             proof=(ProofVariable.FREQUENCY,)),
)
