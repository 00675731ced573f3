# SPDX-License-Identifier: Apache-2.0

"""Random walk of the zero-g: acceleration random walk, rate noise of an Allan deviation."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, DriftSpectrum, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import (
    ActsOn,
    Effect,
    Parameter,
    Parameters,
    Place,
    Role,
    Signals,
)
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """
    Add the sum of independent steps, g; after a time t its rms is k·√t.

    A walk that returns at the rate r is a Gauss-Markov process: its rms ends at k/√(2·r).
    """
    assert signals.rng is not None
    density = np.array(p['density_g_per_rts'])
    drawn = signals.rng.standard_normal((*np.shape(signals.environment.time_s), len(density)))
    if not density.any():
        return
    last = signals.memory.get('walked', np.zeros(drawn.shape[1:]))
    returns = np.broadcast_to(p.get('return_per_s', 0.0), density.shape) * signals.dt_s
    if returns.any():
        # scipy.signal takes 0.5 s to import.
        from scipy.signal import lfilter
        shrink = -np.expm1(-2 * returns) / np.where(returns, 2 * returns, 1.0)
        drawn *= density * np.sqrt(np.where(returns, shrink, 1.0) * signals.dt_s)
        walk = np.stack([lfilter([1.0], [1.0, -a], drawn[..., d], 0, a * last[None, ..., d])[0]
                         for d, a in enumerate(np.exp(-returns))], axis=-1)
    else:
        drawn *= density * np.sqrt(signals.dt_s)
        drawn[:1] += last
        walk = np.cumsum(drawn, axis=0)
    signals.memory['walked'] = walk[-1] if len(walk) else drawn.sum(axis=0)
    for d, scale in enumerate(signals.nominal_scale_v_per_g):
        signals.volts[d] = signals.volts[d] + walk[..., d] * scale


EFFECT = Effect(
    name='bias_walk',
    place=Place.ADC,
    parameters=(
        Parameter('density_g_per_rts', 'g/sqrt(s)', 0.0, 0.1, 2e-5,
                  'physics: slow stress in package and solder',
                  'rms of the wandering zero-g divided by the root of time'),
        Parameter('return_per_s', '1/s', 0.0, 1.0, 1e-2, 'physics: bounds of the stress',
                  'inverse correlation time of a walk that has bounds', typical=0.0,
                  role=Role.OPTIONAL),
    ),
    apply=apply,
    acts_on=ActsOn.NOISE,
    cause='The zero-g wanders; take the zero again more often, or choose a quieter sensor.',
    # A healthy unit drifts by 0.3 mg within 100 s at most (tuned by hand on simulated
    # recordings).
    diagnosis=DiagnosisHints(drift=DriftSpectrum.RANDOM_WALK, healthy_density=3e-5,
                             revealed_by=Manoeuvre.HEAT,
                             proof=(ProofVariable.FREQUENCY,)),
)
