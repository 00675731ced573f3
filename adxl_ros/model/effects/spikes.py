# SPDX-License-Identifier: Apache-2.0

"""Spikes: single samples with a large error."""

from adxl_ros.model.diagnosis_hints import Detector, DiagnosisHints, ProofVariable
from adxl_ros.model.effects.base import ActsOn, Effect, Parameter, Parameters, Place, Signals
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """Add plus or minus A to random samples of each axis, at a mean rate."""
    assert signals.rng is not None
    axes = len(signals.volts)
    drawn = signals.rng.random((*np.shape(signals.environment.time_s), axes, 2))
    hit = drawn[..., 0] < p['rate_hz'] * signals.dt_s
    sign = np.where(drawn[..., 1] < 0.5, -1.0, 1.0)
    for d, amplitude in enumerate(p['amplitude_v']):
        signals.volts[d] = signals.volts[d] + np.where(hit[..., d], amplitude * sign[..., d], 0.0)


EFFECT = Effect(
    name='spikes',
    place=Place.ADC,
    parameters=(
        Parameter('rate_hz', 'Hz', 0.0, 1000.0, 0.2, 'physics: loose contacts, switching loads',
                  'spikes per second and axis', ''),
        Parameter('amplitude_v', 'V', 0.0, 10.0, 0.05, 'physics: loose contacts',
                  'size of a spike, of either sign'),
    ),
    apply=apply,
    smooth=False,
    acts_on=ActsOn.NOISE,
    cause='Single samples have large errors; check for loose contacts and loads that switch.',
    diagnosis=DiagnosisHints(detector=Detector.ISOLATED_SAMPLES,
                             proof=(ProofVariable.STEP,)),
)
