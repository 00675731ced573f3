# SPDX-License-Identifier: Apache-2.0

"""
The references of a motion: the stage with its site and encoders, or another instrument.

Where another instrument or simulator states the specific force, the effects of REFERENCE turn it
into the one that acts.
"""

from itertools import product
from math import cos, sin

from adxl_ros.model.constants import AXES
from adxl_ros.model.effects.base import (
    Components,
    DiagnosisHints,
    effect,
    FormDimension,
    Joint,
    Manoeuvre,
    Need,
    Parameter,
    Parameters,
    Place,
    ProofVariable,
    Shape,
    Signals,
)
from adxl_ros.model.filters import play
from adxl_ros.model.kinematics import angular_motion, carried_acceleration
import numpy as np

_ROUNDING = 1e-9  # Relative rounding error of a dead band; chosen: far above that of float64
_ORDER = 3.0
"""Number of equal filters, between a Butterworth filter, 1, and a Gaussian, many. Chosen: the
gains of both are met to 1.4 % rms where they exceed 0.2, and that of a mean to 2 %."""
_MARGIN = 10.0
"""Margin at both ends that the filter runs into, in lengths of its kernel. Chosen: far beyond the
kernel."""
_OF_TURNED_FRAME = DiagnosisHints(
    revealed_by=Manoeuvre.PLANES, proof=(ProofVariable.CROSS_FORCE, ProofVariable.FORCE_Z)
)
_OF_FAST_MOTION = DiagnosisHints(
    revealed_by=Manoeuvre.SPEEDS, form=(FormDimension.LAG,), proof=(ProofVariable.FORCE_RATE,)
)
"""Hints of the errors of a robot that grow with its speed."""
ROBOT_JOINTS = 8
"""Joints of a robot whose offsets are errors of their own; chosen: an arm has six or seven."""


@effect(
    Place.STAGE,
    Parameter(
        'offset_mps2',
        unit='m/s^2',
        upper=5.0,
        scale=0.01,
        source='geodesy: 9.780 at the equator, 9.832 at the poles',
        doc='local gravity minus the stated one',
        axes='',
    ),
    exact=True,
    invertible=True,
    needs=(Need.STAGE,),
    cause='Local gravity is not the stated one; look it up for latitude and height.',
    diagnosis=DiagnosisHints(
        imitated=True, revealed_by=Manoeuvre.REMOUNT, proof=(ProofVariable.OWN_FORCE,)
    ),
)
def gravity(signals: Signals, p: Parameters) -> None:
    """Local gravity that differs from the stated one."""
    signals.gravity_mps2 = signals.gravity_mps2 + p['offset_mps2']


@effect(
    Place.STAGE,
    Parameter(
        'x_rad',
        unit='rad',
        upper=0.5,
        scale=1.75e-3,
        source='paper: level of 0.1 deg',
        doc="turn of the vertical about the base's x, across the axis of alpha",
        axes='',
    ),
    Parameter(
        'y_rad',
        unit='rad',
        upper=0.5,
        scale=1.75e-3,
        source='paper: level of 0.1 deg',
        doc='turn of the vertical about the axis of alpha; it equals an offset of alpha',
        axes='',
    ),
    exact=True,
    needs=(Need.STAGE,),
    cause='The base of the stage is not level; level it, or measure its tilt.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.PLANES, proof=(ProofVariable.BETA, ProofVariable.ALPHA)
    ),
)
def base_tilt(signals: Signals, p: Parameters) -> None:
    """
    Tilt of the stage's base: it is not level.

    Turn the vertical about the base's x, and then about its y, the axis of alpha.
    """
    signals.up = _turned(signals.up, p['x_rad'], p['y_rad'])


def _turned(vector: Components, x_rad: float, y_rad: float, z_rad: float = 0.0) -> Components:
    """Turn a vector about x, then about y, then about z."""
    x, y, z = vector
    c, s = cos(x_rad), sin(x_rad)
    y, z = y * c - z * s, y * s + z * c
    c, s = cos(y_rad), sin(y_rad)
    x, z = x * c + z * s, z * c - x * s
    c, s = cos(z_rad), sin(z_rad)
    return [x * c - y * s, x * s + y * c, z]


@effect(
    Place.STAGE,
    Parameter(
        'alpha_rad',
        unit='rad',
        upper=0.5,
        scale=1.75e-3,
        source='paper: level of 0.1 deg',
        doc='true alpha minus the encoder',
        axes='',
    ),
    Parameter(
        'beta_rad',
        unit='rad',
        upper=0.5,
        scale=1.75e-3,
        source='paper: level of 0.1 deg',
        doc='true beta minus the encoder',
        axes='',
    ),
    exact=True,
    needs=(Need.STAGE,),
    cause='The zero of an encoder is wrong; set it by a level, or remount the sensor by 180 deg.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.REMOUNT,
        half_turn='beta_rad',
        proof=(ProofVariable.BETA, ProofVariable.ALPHA),
    ),
)
def stage_offset(signals: Signals, p: Parameters) -> None:
    """Offset of the stage's encoders: true angle minus reading."""
    for joint in ('alpha', 'beta'):
        read = getattr(signals, joint)
        setattr(signals, joint, read._replace(position=read.position + p[f'{joint}_rad']))


@effect(
    Place.STAGE,
    *(
        Parameter(
            f'{joint}_{wave}_rad',
            unit='rad',
            upper=0.2,
            scale=1e-3,
            source='physics: a disc of radius 20 mm, 20 um off its axis',
            doc=f'true {joint} minus the encoder, amplitude of the {wave}',
            axes='',
        )
        for joint, wave in product(('alpha', 'beta'), ('sine', 'cosine'))
    ),
    needs=(Need.STAGE,),
    cause='The disc of an encoder is not centred on its axis; '
    'use two reading heads, or a table of errors.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.PLANES,
        form=(FormDimension.ALPHA, FormDimension.BETA),
        proof=(ProofVariable.BETA, ProofVariable.ALPHA),
    ),
)
def stage_eccentricity(signals: Signals, p: Parameters) -> None:
    """
    Eccentricity of the stage's encoder discs: an error with one period per turn.

    Add s·sin q + c·cos q to each joint, and its derivatives to the motion.
    """
    for joint in ('alpha', 'beta'):
        s, c = p[f'{joint}_sine_rad'], p[f'{joint}_cosine_rad']
        if s or c:
            q, velocity, acceleration = getattr(signals, joint)
            sine, cosine = np.sin(q), np.cos(q)
            slope, bend = s * cosine - c * sine, -s * sine - c * cosine
            setattr(
                signals,
                joint,
                Joint(
                    q + s * sine + c * cosine,
                    velocity + slope * velocity,
                    acceleration + slope * acceleration + bend * velocity * velocity,
                ),
            )


@effect(
    Place.STAGE,
    Parameter(
        'alpha_rad',
        unit='rad',
        lower=0.0,
        upper=0.2,
        scale=1e-3,
        source='physics: worm gears, 3 arcmin',
        doc='dead band of alpha, its full width',
        axes='',
    ),
    Parameter(
        'beta_rad',
        unit='rad',
        lower=0.0,
        upper=0.2,
        scale=1e-3,
        source='physics: worm gears, 3 arcmin',
        doc='dead band of beta, its full width',
        axes='',
    ),
    smooth=False,
    needs=(Need.STAGE,),
    cause='The gears have play; approach each pose from the same side, or preload them.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SPEEDS,
        form=(FormDimension.DIRECTION,),
        proof=(ProofVariable.BETA, ProofVariable.ALPHA),
    ),
)
def backlash(signals: Signals, p: Parameters) -> None:
    """
    Backlash of the stage: a joint follows its encoder with play.

    Let each joint follow with a dead band; it moves while the flanks of its gears touch.
    """
    for joint in ('alpha', 'beta'):
        half = p[f'{joint}_rad'] / 2
        if half:
            q, velocity, acceleration = getattr(signals, joint)
            memory = signals.memory.setdefault(joint, {})
            position = play(q, half, memory)
            touches = abs(q - position) >= half * (1 - _ROUNDING)
            setattr(signals, joint, Joint(position, velocity * touches, acceleration * touches))


@effect(
    Place.FORCE,
    *(
        Parameter(
            f'{axis}_m',
            unit='m',
            upper=2.0,
            scale=0.02,
            source='physics: size of a board',
            doc=f"from the axis to the sensor along the sensor's {axis}",
            axes='',
        )
        for axis in AXES
    ),
    exact=True,
    needs=(Need.ROTATION,),
    cause='The sensor is not on the axis of rotation; mount it there, or state the arm.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SPEEDS,
        proof=(
            ProofVariable.ALPHA_RATE,
            ProofVariable.BETA_RATE,
            ProofVariable.ALPHA_ACCELERATION,
            ProofVariable.BETA_ACCELERATION,
        ),
    ),
)
def lever_arm(signals: Signals, p: Parameters) -> None:
    """Lever arm: rotation accelerates a sensor beside the axes of the stage, or the frame."""
    r = [p['x_m'], p['y_m'], p['z_m']]
    if any(r):
        rotation = signals.rotation or angular_motion(signals.alpha, signals.beta)
        added = carried_acceleration(*rotation, r)
        signals.force = [f + a for f, a in zip(signals.force, added)]


@effect(
    Place.REFERENCE,
    *(
        Parameter(
            f'{axis}_rad',
            unit='rad',
            upper=0.5,
            scale=0.0175,
            source='physics: markers are placed to some 1 deg',
            doc=f'turn of the specific force about {axis}, from the reference to the sensor',
            axes='',
        )
        for axis in AXES
    ),
    exact=True,
    cause='The frame of the reference is turned against that of the sensor; state the '
    'rotation, or align the two.',
    diagnosis=_OF_TURNED_FRAME,
)
def reference_frame(signals: Signals, p: Parameters) -> None:
    """
    Rotation between the frame of the reference and that of the sensor.

    Turn the force of the reference about its x, then about y, then about z.
    """
    signals.force = _turned(signals.force, p['x_rad'], p['y_rad'], p['z_rad'])


@effect(
    Place.REFERENCE,
    Parameter(
        'delay_s',
        unit='s',
        lower=0.0,
        upper=1.0,
        scale=5e-3,
        source='physics: filters and transport of a tracker',
        doc='delay of the stamps of the reference behind its motion',
        axes='',
    ),
    exact=True,
    cause='The reference is late, or the stamps of the sensor are early; synchronise the '
    'clocks, or state the delay.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS, proof=(ProofVariable.FORCE_RATE,)),
)
def reference_delay(signals: Signals, p: Parameters) -> None:
    """Delay of the reference: its stamps are late."""
    signals.time_s = signals.time_s - p['delay_s']


def _restoring_gain(frequency_hz: np.ndarray, p: Parameters) -> np.ndarray:
    """
    Return the complex gain that restores motion, (k,).

    Where the filter passes it is 1/H. Where it leaves less than errors of the reference, nothing
    can be restored, and the gain falls to 0, as that of a Wiener filter.
    """
    relative = (2 * np.pi * frequency_hz * p['length_s']) ** p['steepness']
    log_passed = -_ORDER * np.log1p(relative / (2 * _ORDER))
    passed = np.exp(log_passed)
    restoring = passed / (passed**2 + (p['lost_gain'] * (1 - passed)) ** 2)
    if not p['phase']:
        return restoring
    # The phase of a causal filter follows from the logarithm of its gain.
    cepstrum = np.fft.irfft(log_passed)
    half = len(cepstrum) // 2
    cepstrum[1:half] *= 2
    cepstrum[half + 1 :] = 0.0
    phase_rad = np.fft.rfft(cepstrum).imag[: len(log_passed)]
    return restoring * np.exp(-1j * p['phase'] * phase_rad)


@effect(
    Place.REFERENCE,
    Parameter(
        'length_s',
        unit='s',
        lower=0.0,
        upper=0.5,
        scale=5e-3,
        source='practice: marker positions are smoothed at 3 to 12 Hz, lengths of 40 to 10 ms',
        doc='length σ of the kernel; half of the power is lost near 0.14/σ',
        axes='',
        typical=0.02,
        starts=(0.003, 0.006, 0.012, 0.025, 0.05),
    ),
    Shape(
        'steepness',
        unit='1',
        lower=1.5,
        upper=12.0,
        scale=2.0,
        source='physics: 2.3 is a Gaussian, 3.2 a Butterworth filter of order 2',
        doc='exponent n of the attenuation',
        starts=(2.3, 4.5),
    ),
    Shape(
        'lost_gain',
        unit='1',
        lower=0.1,
        upper=0.5,
        scale=0.2,
        source='measured: optical tracking against an accelerometer, 0.1 to 0.4',
        doc='gain of the filter below which errors of the reference hide the motion',
        starts=(0.12, 0.35),
    ),
    Shape(
        'phase',
        unit='1',
        lower=0.0,
        upper=1.0,
        scale=1.0,
        source='physics: 0 is smoothed forth and back, 1 while it is recorded',
        doc='phase divided by that of a causal filter',
        starts=(0.0, 1.0),
    ),
    cause='The reference is smoother than the motion; use it with less smoothing, or compare '
    'slow motion only.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SPEEDS, form=(FormDimension.LAG,), proof=(ProofVariable.FREQUENCY,)
    ),
)
def reference_filter(signals: Signals, p: Parameters) -> None:
    """
    Filter of the reference: it is smoother than the motion, as optical tracking is.

    Undo a filter of the gain (1 + (ω·σ)^n/6)^(−3), as far as motion is left.
    """
    step_s = signals.dt_s
    first_s, last_s = float(signals.time_s[0]), float(signals.time_s[-1])
    even_s = first_s + step_s * np.arange(max(round((last_s - first_s) / step_s), 2) + 1)
    count = len(even_s)
    margin = min(round(_MARGIN * p['length_s'] / step_s), count - 2)
    # A transform of such a length is fast.
    size = 1 << (count + 2 * margin - 1).bit_length()
    restoring = _restoring_gain(np.fft.rfftfreq(size, step_s), p) - 1
    for d, stated in enumerate(signals.force):
        even = np.interp(even_s, signals.time_s, stated)
        middle = (even[0] + even[-1]) / 2
        padded = np.pad(even - middle, margin, mode='reflect', reflect_type='odd')
        lacking = np.fft.irfft(np.fft.rfft(padded, size) * restoring, size)
        signals.force[d] = stated + np.interp(
            signals.time_s, even_s, lacking[margin : margin + count]
        )


@effect(
    Place.REFERENCE,
    *(
        Parameter(
            f'joint{number}_rad',
            unit='rad',
            upper=0.5,
            scale=5e-3,
            source='practice: joints are mastered to some 0.1 deg',
            doc=f'true angle of joint {number} of the chain minus its encoder; m for a linear one',
            axes='',
        )
        for number in range(1, ROBOT_JOINTS + 1)
    ),
    exact=True,
    needs=(Need.ROBOT,),
    cause='The zero of a joint is wrong, so that the robot stands otherwise than its encoders '
    'say; master the joint again.',
    diagnosis=_OF_TURNED_FRAME,
)
def joint_offset(signals: Signals, p: Parameters) -> None:
    """Offsets of the joints of a robot: true angle minus reading."""
    for number in range(1, ROBOT_JOINTS + 1):
        _add_mode(signals, f'joint{number}', p[f'joint{number}_rad'])


@effect(
    Place.REFERENCE,
    Parameter(
        'compliance_s2',
        unit='s^2',
        lower=0.0,
        upper=0.01,
        scale=1e-4,
        source='physics: a first resonance of 16 Hz, 1/(2*pi*f)^2',
        doc='angle by which a joint lags, divided by its angular acceleration',
        axes='',
    ),
    needs=(Need.ROBOT,),
    cause='The links or gears of the robot yield to their own inertia; move more slowly, or '
    'model them.',
    diagnosis=_OF_FAST_MOTION,
)
def flexible_link(signals: Signals, p: Parameters) -> None:
    """Flexible links of a robot: its joints follow their encoders by q − c·d²q/dt²."""
    _add_mode(signals, 'flexible', p['compliance_s2'])


@effect(
    Place.REFERENCE,
    Parameter(
        'offset_s',
        unit='s',
        upper=0.05,
        scale=2e-3,
        source='practice: one step of a simulator',
        doc='time by which the acceleration of the readings is later than their attitude',
        axes='',
    ),
    needs=(Need.ROBOT,),
    cause='The readings join the acceleration of one time to the attitude of another, as a '
    'simulator does that differentiates a velocity, or a filter of the acceleration alone.',
    diagnosis=_OF_FAST_MOTION,
)
def late_acceleration(signals: Signals, p: Parameters) -> None:
    """Late acceleration: R(t)·(a(t − offset) + g), to first order."""
    _add_mode(signals, 'late_acceleration', p['offset_s'])


def _add_mode(signals: Signals, name: str, size: float) -> None:
    """Add a multiple of what an error of a robot adds to the force."""
    if size and name in signals.modes:
        signals.force = [f + size * m for f, m in zip(signals.force, signals.modes[name])]
