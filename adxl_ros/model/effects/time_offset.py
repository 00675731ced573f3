# SPDX-License-Identifier: Apache-2.0

"""Time offset: the stamps are late."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Take each sample earlier than its stamp."""
    signals.time_s = signals.time_s - p['offset_s']


EFFECT = Effect(
    name='time_offset',
    place=Place.CLOCK,
    parameters=(
        Parameter('offset_s', 's', -1.0, 1.0, 5e-3, 'physics: buffers between ADC and host',
                  'delay of the stamps behind the samples', ''),
    ),
    apply=apply,
    exact=True,
    cause='The stamps of sensor and stage differ; synchronise the clocks, or state the delay.',
    # Stamps have a latency of some 0.1 ms (chosen: buffers of a board that works).
    diagnosis=DiagnosisHints(healthy_std=1e-4, revealed_by=Manoeuvre.SHAKE,
                             proof=(ProofVariable.FORCE_RATE,)),
)
