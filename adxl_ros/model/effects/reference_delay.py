# SPDX-License-Identifier: Apache-2.0


"""Delay of the reference: its stamps are late."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Put each sample of the reference earlier than its stamp."""
    signals.time_s = signals.time_s - p['delay_s']


EFFECT = Effect(
    name='reference_delay',
    place=Place.REFERENCE,
    parameters=(
        Parameter('delay_s', 's', 0.0, 1.0, 5e-3, 'physics: filters and transport of a tracker',
                  'delay of the stamps of the reference behind its motion', ''),
    ),
    apply=apply,
    exact=True,
    cause='The reference is late, or the stamps of the sensor are early; synchronise the clocks, '
          'or state the delay.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS, imitated_by='time_offset',
                             proof=(ProofVariable.FORCE_RATE,)),
)
