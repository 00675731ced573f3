# SPDX-License-Identifier: Apache-2.0

"""Resonance of the mount: it transmits the motion like a spring and a damper."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
from adxl_ros.model.filters import resonator


def apply(signals: Signals, p: Parameters) -> None:
    """Filter a part of the force by ω²/(s² + 2·ζ·ω·s + ω²)."""
    for d, gain in enumerate(p['gain']):
        if gain:
            sensed = signals.sensed[d]
            transmitted = resonator(sensed, p['frequency_hz'], p['damping_ratio'], signals.dt_s,
                                    signals.memory.setdefault(d, {}))
            signals.sensed[d] = sensed + gain * (transmitted - sensed)


EFFECT = Effect(
    name='mount_resonance',
    place=Place.MOUNTING,
    parameters=(
        Parameter('gain', '1', -2.0, 2.0, 1.0, 'physics: 0 is rigid, 1 all through the mount',
                  'part of the force that comes through the mount'),
        Parameter('frequency_hz', 'Hz', 2.0, 450.0, 120.0, 'physics: a board on standoffs',
                  'natural frequency, undamped', '', neutral=120.0, role=Role.SHAPE,
                  starts=(8.0, 14.0, 24.0, 40.0, 70.0, 120.0, 250.0)),
        Parameter('damping_ratio', '1', 0.001, 0.95, 0.05, 'physics: metal and FR4',
                  'damping divided by the critical one', '', neutral=0.05, role=Role.SHAPE),
    ),
    apply=apply,
    cause='The mount is a spring; stiffen it, or keep the motion away from its resonance.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,),
                             proof=(ProofVariable.FREQUENCY,)),
)
