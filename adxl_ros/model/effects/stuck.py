# SPDX-License-Identifier: Apache-2.0

"""Stuck samples: the link repeats its last sample for a while."""

from adxl_ros.model.diagnosis_hints import Detector, DiagnosisHints, ProofVariable
from adxl_ros.model.effects.base import ActsOn, Effect, Parameter, Parameters, Place, Role, Signals
import numpy as np

_NEVER = -2 ** 40
"""Index of a start that lies before any recording; chosen: far below 0."""


def apply(signals: Signals, p: Parameters) -> None:
    """Hold all axes for a fixed time, beginning at random instants at a mean rate."""
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


EFFECT = Effect(
    name='stuck',
    place=Place.CODE,
    parameters=(
        Parameter('rate_hz', 'Hz', 0.0, 1000.0, 0.1, 'physics: a bus that times out',
                  'starts per second', ''),
        Parameter('duration_s', 's', 1e-4, 100.0, 0.05, 'physics: a few frames',
                  'time that the sample is held', '', neutral=0.05, role=Role.SHAPE),
    ),
    apply=apply,
    smooth=False,
    acts_on=ActsOn.NOISE,
    cause='The link repeats samples; check the bus, its load and its buffers.',
    diagnosis=DiagnosisHints(detector=Detector.REPEATED_SAMPLES,
                             proof=(ProofVariable.STEP,)),
)
