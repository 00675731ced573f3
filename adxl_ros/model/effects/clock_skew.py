# SPDX-License-Identifier: Apache-2.0

"""Clock skew: the clock that stamps the samples runs fast or slow."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Take samples earlier than their stamps by a fraction of the time since the beginning."""
    signals.time_s = signals.time_s - p['ratio'] * signals.time_s


EFFECT = Effect(
    name='clock_skew',
    place=Place.CLOCK,
    parameters=(
        Parameter('ratio', 's/s', -0.01, 0.01, 1e-4, 'physics: crystals, 100 ppm',
                  'relative excess of the rate of the clock that makes the stamps', ''),
    ),
    apply=apply,
    exact=True,
    cause='The clocks of sensor and stage drift apart; discipline them by one source.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS,
                             proof=(ProofVariable.FORCE_RATE, ProofVariable.TIME)),
)
