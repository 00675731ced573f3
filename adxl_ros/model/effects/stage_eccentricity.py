# SPDX-License-Identifier: Apache-2.0

"""Eccentricity of the stage's encoder discs: an error with one period per turn."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Joint, Need, Parameter, Parameters, Place, Signals
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """Add s·sin q + c·cos q to each joint, and its derivatives to the motion."""
    for joint in ('alpha', 'beta'):
        s, c = p[f'{joint}_sine_rad'], p[f'{joint}_cosine_rad']
        if s or c:
            q, velocity, acceleration = getattr(signals, joint)
            sine, cosine = np.sin(q), np.cos(q)
            slope, bend = s * cosine - c * sine, -s * sine - c * cosine
            setattr(signals, joint, Joint(
                q + s * sine + c * cosine, velocity + slope * velocity,
                acceleration + slope * acceleration + bend * velocity * velocity))


EFFECT = Effect(
    name='stage_eccentricity',
    place=Place.STAGE,
    parameters=tuple(
        Parameter(f'{joint}_{wave}_rad', 'rad', -0.2, 0.2, 1e-3,
                  'physics: a disc of radius 20 mm, 20 um off its axis',
                  f'true {joint} minus the encoder, amplitude of the {wave}', '')
        for joint in ('alpha', 'beta') for wave in ('sine', 'cosine')),
    apply=apply,
    needs=(Need.STAGE,),
    cause='The disc of an encoder is not centred on its axis; '
          'use two reading heads, or a table of errors.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                             form=(FormDimension.ALPHA, FormDimension.BETA),
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
