# SPDX-License-Identifier: Apache-2.0

"""
The accelerometer: mounting, sensing element and electronics, from the force to the ADC's input.

Force along and across the axes, and their directions; zero-g, scale factor, supply, temperature,
output stage and filter.
"""

from adxl_ros.model.constants import NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects.base import (
    add,
    ARRAYS,
    Components,
    Detector,
    DiagnosisHints,
    effect,
    FLOATS,
    FormDimension,
    Manoeuvre,
    Need,
    OptionalSize,
    Parameter,
    Parameters,
    Place,
    ProofVariable,
    Role,
    Shape,
    Signals,
    StraightLine,
    Value,
)
from adxl_ros.model.filters import loop, low_pass, resonator, stop
import numpy as np

_IN_PLANE = (1, 0, 0)  # Index of the other in-plane axis for x, y and z, which has x
_OUT_OF_PLANE = (2, 2, 1)  # Index of the out-of-plane axis for x, y and z, which has y
OTHER_AXIS = {
    'cross_axis': _IN_PLANE,
    'scale_factor_cross': _IN_PLANE,
    'cross_axis_z': _OUT_OF_PLANE,
    'scale_factor_z': _OUT_OF_PLANE,
}
"""By effect: index of the axis c that acts on x, y and z."""
_OF_OWN_FORCE = DiagnosisHints(
    revealed_by=Manoeuvre.PLANES, form=(FormDimension.FORCE,), proof=(ProofVariable.OWN_FORCE,)
)
_OF_TEMPERATURE = DiagnosisHints(
    revealed_by=Manoeuvre.HEAT,
    form=(FormDimension.TEMPERATURE, FormDimension.WARMING),
    proof=(ProofVariable.TEMPERATURE,),
)
_SCALE_EXPONENT = 1.135
"""Typical exponent of the scale factor, ln(560/1000)/ln(3/5): 560 mV/g at 3 V and 1000 mV/g at 5 V
(ADXL203 datasheet, specifications)."""
_WITHOUT_FILTER_S = 1e-3
"""Time constant that r counts in where no filter is stated, s; chosen: r is then one in ms."""


def _bias_by(others: tuple[int, int, int], signals: Signals, p: Parameters) -> None:
    """Add p1·A_c + p2·A_c² of another axis c to each measured axis."""
    other = [signals.sensed[other] for other in others]
    add(
        signals.output,
        ((p1 + p2 * c) * c for p1, p2, c in zip(p['linear'], p['quadratic_per_g'], other)),
    )


@effect(
    Place.ELEMENT,
    Parameter(
        'linear',
        unit='g/g',
        upper=0.3,
        scale=0.015,
        source='ADXL203 datasheet: cross-axis 1.5 %',
        doc='p1 of equation 11; to first order the same as a misalignment',
    ),
    Parameter(
        'quadratic_per_g',
        unit='1/g',
        upper=0.3,
        scale=0.01,
        source='paper, figure 4',
        doc='p2 of equation 11',
    ),
    invertible=True,
    cause='The other in-plane axis shifts the bias; calibrate with the plane alpha = 90 deg.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.PLANES,
        form=(FormDimension.CROSS_FORCE,),
        proof=(ProofVariable.CROSS_FORCE,),
    ),
)
def cross_axis(signals: Signals, p: Parameters) -> None:
    """Bias from the other in-plane axis: g(V_c) of equations 10 and 11, centred and in g."""
    _bias_by(_IN_PLANE, signals, p)


@effect(
    Place.ELEMENT,
    Parameter(
        'linear',
        unit='g/g',
        upper=0.3,
        scale=0.015,
        source='ADXL203 datasheet: cross-axis 1.5 %',
        doc='q1 of equation 13; to first order the same as a misalignment',
    ),
    Parameter(
        'quadratic_per_g',
        unit='1/g',
        upper=0.3,
        scale=0.01,
        source='paper, figure 6',
        doc='q2 of equation 13',
    ),
    invertible=True,
    cause='The out-of-plane axis shifts the bias; calibrate with several planes alpha.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.PLANES,
        form=(FormDimension.CROSS_FORCE,),
        proof=(ProofVariable.FORCE_Z,),
    ),
)
def cross_axis_z(signals: Signals, p: Parameters) -> None:
    """Bias from the out-of-plane axis: h(V_z) of equations 12 and 13, centred and in g."""
    _bias_by(_OUT_OF_PLANE, signals, p)


@effect(
    Place.ELEMENT,
    Parameter(
        'linear_per_g',
        unit='1/g',
        upper=0.3,
        scale=0.01,
        source='as scale_factor_z: paper, figure 8',
        doc='relative change of the scale factor for 1 g on the other axis',
    ),
    invertible=True,
    cause='The other in-plane axis changes the scale factor; calibrate with several planes alpha.',
    diagnosis=DiagnosisHints(
        form=(FormDimension.FORCE, FormDimension.CROSS_FORCE),
        proof=(ProofVariable.CROSS_FORCE, ProofVariable.OWN_FORCE),
    ),
)
def scale_factor_cross(signals: Signals, p: Parameters) -> None:
    """
    Scale factor that depends on the other in-plane axis; that of the z axis depends on x.

    The paper has only the dependence on z (15). At rest A_c² of the other axis is g² minus the
    squares of the other two. A quadratic term would equal a sum of `nonlinearity`,
    `scale_factor_z` and `scale_factor`, so that the effect has none.
    """
    add(
        signals.output,
        (
            s * sensed * signals.sensed[other]
            for s, sensed, other in zip(p['linear_per_g'], signals.sensed, _IN_PLANE)
        ),
    )


@effect(
    Place.ELEMENT,
    Parameter(
        'linear_per_g',
        unit='1/g',
        upper=0.3,
        scale=0.01,
        source='paper, figure 8',
        doc='r1 over r0 of equation 15',
    ),
    Parameter(
        'quadratic_per_g2',
        unit='1/g^2',
        upper=0.3,
        scale=0.01,
        source='paper, figure 8',
        doc='r2 over r0 of equation 15',
    ),
    invertible=True,
    cause='The out-of-plane axis changes the scale factor; calibrate with several planes alpha.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.PLANES,
        form=(FormDimension.FORCE, FormDimension.CROSS_FORCE),
        proof=(ProofVariable.FORCE_Z, ProofVariable.OWN_FORCE),
    ),
)
def scale_factor_z(signals: Signals, p: Parameters) -> None:
    """Scale factor by the out-of-plane axis, y for z: equations 15 and 17, centred and in g."""
    other = [signals.sensed[other] for other in _OUT_OF_PLANE]
    add(
        signals.output,
        (
            sensed * (r1 + r2 * c) * c
            for sensed, r1, r2, c in zip(
                signals.sensed, p['linear_per_g'], p['quadratic_per_g2'], other
            )
        ),
    )


@effect(
    Place.ELEMENT,
    Parameter(
        'cubic_per_g2',
        unit='1/g^2',
        upper=0.1,
        scale=7e-4,
        source='ADXL203 datasheet: nonlinearity 0.2 % of 1.7 g full scale',
        doc='coefficient of the cube of the acceleration along the axis',
    ),
    invertible=True,
    cause='The scale factor changes with the input; calibrate with poses between 0 and 1 g.',
    diagnosis=_OF_OWN_FORCE,
)
def nonlinearity(signals: Signals, p: Parameters) -> None:
    """
    Odd nonlinearity of an axis: its scale factor changes with its own input.

    Add k·a³ of the axis's own acceleration, g.
    """
    add(signals.output, (k * a * a * a for k, a in zip(p['cubic_per_g2'], signals.sensed)))


@effect(
    Place.ELEMENT,
    Parameter(
        'quadratic_per_g',
        unit='1/g',
        upper=0.1,
        scale=1.2e-3,
        source='ADXL203 datasheet: nonlinearity 0.2 % of 1.7 g full scale',
        doc='coefficient of the square of the acceleration along the axis',
    ),
    invertible=True,
    cause='Scale factors up and down differ; calibrate, and let no supply clip one side.',
    diagnosis=_OF_OWN_FORCE,
)
def quadratic(signals: Signals, p: Parameters) -> None:
    """
    Even nonlinearity of an axis: its scale factors up and down differ.

    Add k·a² of the axis's own acceleration, g.
    """
    add(signals.output, (k * a * a for k, a in zip(p['quadratic_per_g'], signals.sensed)))


@effect(
    Place.ELEMENT,
    Parameter(
        'half_width_g',
        unit='g',
        upper=0.1,
        scale=2e-3,
        source='physics: friction in die and package',
        doc='largest lag behind the input: half of the width of the loop',
    ),
    Shape(
        'reach_g',
        unit='g',
        lower=1e-3,
        upper=2.0,
        scale=0.2,
        source='physics: part of the range',
        doc='change of the input after a reversal that builds up half of the lag',
        starts=(0.04, 0.2, 1.0),
    ),
    smooth=False,
    cause='The reading depends on the direction of the last change; approach poses from both '
    'sides and average, or relieve the package of mounting stress.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SPEEDS,
        form=(FormDimension.FORCE, FormDimension.DIRECTION, FormDimension.LAG),
        proof=(ProofVariable.FORCE_RATE, ProofVariable.OWN_FORCE),
    ),
)
def hysteresis(signals: Signals, p: Parameters) -> None:
    """
    Hysteresis of the sensing element: a Prandtl-Ishlinskii operator of the acceleration.

    Let the output lag by a stop operator of the force along the sensing axis.

    The lag is at most `half_width_g`. It reaches that when the input has changed by 2·`reach_g`
    after a reversal.
    """
    for d, half_width in enumerate(p['half_width_g']):
        if half_width:
            lag = stop(signals.sensed[d], p['reach_g'], signals.memory.setdefault(d, {}))
            signals.output[d] = signals.output[d] - half_width * lag


@effect(
    Place.ELEMENT,
    Parameter(
        'coefficient_per_g',
        unit='g/g^2',
        upper=10.0,
        scale=0.05,
        source='physics: asymmetry of the element, clipping of fast peaks',
        doc='shift of the zero-g divided by the mean square of the vibration',
    ),
    Shape(
        'tau_s',
        unit='s',
        lower=0.01,
        upper=60.0,
        scale=0.5,
        source='physics: slower than any vibration',
        doc='time over which the mean square is taken',
        starts=(0.1, 0.5, 2.5),
    ),
    Shape(
        'mean_s',
        unit='s',
        lower=0.01,
        upper=10.0,
        scale=0.1,
        source='physics: shorter than a move, longer than a vibration',
        doc='time over which the mean is taken about which the sensor vibrates',
    ),
    cause='Vibration shifts the zero-g; damp the mount, or stay away from its resonance.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,), proof=(ProofVariable.TIME,)
    ),
)
def vibration_rectification(signals: Signals, p: Parameters) -> None:
    """
    Vibration rectification: vibration shifts the zero-g by its mean square.

    Add k times the mean square of the acceleration along the axis about its mean, g. The mean is
    taken twice, so that a move that is slow beside its time is no vibration.
    """
    for d, k in enumerate(p['coefficient_per_g']):
        if not k:
            continue
        vibration = signals.sensed[d]
        for order in range(2):
            of_mean = signals.memory.setdefault((d, order), {})
            vibration = vibration - low_pass(vibration, p['mean_s'], signals.dt_s, of_mean)
        of_square = signals.memory.setdefault((d, 'square'), {})
        mean_square = low_pass(vibration * vibration, p['tau_s'], signals.dt_s, of_square)
        signals.output[d] = signals.output[d] + k * mean_square


def direction(axis: int, alpha_rad: Value, beta_rad: Value) -> Components:
    """
    Return the unit vector of one sensing axis in the case frame.

    Θx = R_y(α)·R_z(β)·[1 0 0]ᵀ (18), Θy = R_x(α)·R_z(β)·[0 1 0]ᵀ (19), and in the same manner
    Θz = R_x(α)·R_y(β)·[0 0 1]ᵀ.
    """
    maths = ARRAYS if np.ndim(alpha_rad) or np.ndim(beta_rad) else FLOATS
    sa, ca = maths.sin(alpha_rad), maths.cos(alpha_rad)
    sb, cb = maths.sin(beta_rad), maths.cos(beta_rad)
    return [[ca * cb, sb, -sa * cb], [-sb, ca * cb, sa * cb], [sb, -sa * cb, ca * cb]][axis]


@effect(
    Place.MOUNTING,
    Parameter(
        'alpha_rad',
        unit='rad',
        upper=0.5,
        scale=0.0175,
        source='ADXL203 datasheet: package alignment 1 deg',
        doc='tilt of the sensing axis out of the plane (z: about x), equations 18 and 19',
    ),
    Parameter(
        'beta_rad',
        unit='rad',
        upper=0.5,
        scale=0.0175,
        source='ADXL203 datasheet: package alignment 1 deg, x to y 0.1 deg',
        doc='turn of the sensing axis in the plane (z: about y), equations 18 and 19',
    ),
    exact=True,
    invertible=True,
    cause='The sensing axes are not those of the case; calibrate, or mount the package better.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.PLANES, proof=(ProofVariable.CROSS_FORCE, ProofVariable.FORCE_Z)
    ),
)
def misalignment(signals: Signals, p: Parameters) -> None:
    """Directions of the sensing axes in the case: equations 18 and 19, and the same for z."""
    alpha_rad = p['alpha_rad']
    beta_rad = p['beta_rad']
    memory = signals.memory
    # Live samples share their values, so that the directions are computed once.
    if memory.get('alpha_rad') is not alpha_rad or memory.get('beta_rad') is not beta_rad:
        memory.update(
            alpha_rad=alpha_rad,
            beta_rad=beta_rad,
            directions=[
                direction(d, *angles) for d, angles in enumerate(zip(alpha_rad, beta_rad))
            ],
        )
    force = list(signals.sensed)
    for d, (tx, ty, tz) in enumerate(memory['directions']):
        signals.sensed[d] = tx * force[0] + ty * force[1] + tz * force[2]


@effect(
    Place.MOUNTING,
    Parameter(
        'gain',
        unit='1',
        upper=2.0,
        scale=1.0,
        source='physics: 0 is rigid, 1 all through the mount',
        doc='part of the force that comes through the mount',
    ),
    Shape(
        'frequency_hz',
        unit='Hz',
        lower=2.0,
        upper=450.0,  # Below half of the 1000 Hz at which a motion is computed
        scale=120.0,
        source='physics: a board on standoffs',
        doc='natural frequency, undamped',
        starts=(8.0, 14.0, 24.0, 40.0, 70.0, 120.0, 250.0),
    ),
    Shape(
        'damping_ratio',
        unit='1',
        lower=0.001,
        upper=0.95,  # At 1 and above it is no resonator
        scale=0.05,
        source='physics: metal and FR4',
        doc='damping divided by the critical one',
    ),
    cause='The mount is a spring; stiffen it, or keep the motion away from its resonance.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,), proof=(ProofVariable.FREQUENCY,)
    ),
)
def mount_resonance(signals: Signals, p: Parameters) -> None:
    """
    Resonance of the mount: it transmits the motion like a spring and a damper.

    Filter a part of the force by ω²/(s² + 2·ζ·ω·s + ω²).
    """
    for d, gain in enumerate(p['gain']):
        if gain:
            sensed = signals.sensed[d]
            transmitted = resonator(
                sensed,
                p['frequency_hz'],
                p['damping_ratio'],
                signals.dt_s,
                signals.memory.setdefault(d, {}),
            )
            signals.sensed[d] = sensed + gain * (transmitted - sensed)


@effect(
    Place.ELECTRONICS,
    Parameter(
        'offset_v',
        unit='V',
        upper=2.0,
        scale=0.1,
        source='ADXL203 datasheet: zero-g 2.4 to 2.6 V',
        doc='zero-g output minus the nominal one',
    ),
    exact=True,
    invertible=True,
    cause='The zero-g output of this unit is not the nominal one; calibrate the unit.',
    # Zero-g of a healthy unit changes by 0.1 mg from day to day (tuned by hand on simulated
    # recordings).
    diagnosis=DiagnosisHints(
        straight_line=StraightLine.ZERO_G,
        healthy_std=1e-4,
        revealed_by=Manoeuvre.REMOUNT,
        proof=(ProofVariable.TIME,),
    ),
)
def bias(signals: Signals, p: Parameters) -> None:
    """Zero-g of a unit minus the nominal one (B of equation 2)."""
    add(signals.zero_g_v, p['offset_v'])


@effect(
    Place.ELECTRONICS,
    Parameter(
        'offset_v_per_g',
        unit='V/g',
        lower=-0.9,  # A scale factor of 1 V/g stays above 0
        upper=9.0,
        scale=0.04,
        source='ADXL203 datasheet: 960 to 1040 mV/g',
        doc='scale factor minus the nominal one',
    ),
    exact=True,
    invertible=True,
    cause='The scale factor of this unit is not the nominal one; calibrate the unit.',
    # The scale factor of a healthy unit changes by 0.01 % from day to day (tuned by hand on
    # simulated recordings).
    diagnosis=DiagnosisHints(
        straight_line=StraightLine.SCALE_FACTOR,
        healthy_std=1e-4,
        revealed_by=Manoeuvre.REMOUNT,
        proof=(ProofVariable.OWN_FORCE,),
    ),
)
def scale_factor(signals: Signals, p: Parameters) -> None:
    """Scale factor of a unit minus the nominal one (SF of equation 1)."""
    add(signals.scale_v_per_g, p['offset_v_per_g'])


@effect(
    Place.ELECTRONICS,
    Parameter(
        'zero_g_exponent',
        unit='1',
        upper=3.0,
        scale=1.0,
        source='ADXL203 datasheet: ratiometric',
        doc='exponent of the supply voltage in the zero-g; 0 is independent of it',
    ),
    Parameter(
        'scale_exponent',
        unit='1',
        upper=3.0,
        scale=_SCALE_EXPONENT,
        source='ADXL203 datasheet: 560 mV/g at 3 V, not 600',
        doc='exponent of the supply voltage in the scale factor; 0 is independent of it',
    ),
    Shape(
        'nominal_v',
        unit='V of the supply',
        lower=1.0,
        upper=30.0,
        scale=NOMINAL_SUPPLY_V,
        source='ADXL203 datasheet: values at 5 V',
        doc='supply voltage of the datasheet values',
        held=True,
    ),
    invertible=True,
    follows=('supply_v',),
    cause='The output follows the supply; measure the supply and correct, or regulate it.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.SUPPLY, form=(FormDimension.SUPPLY,), proof=(ProofVariable.SUPPLY,)
    ),
)
def supply(signals: Signals, p: Parameters) -> None:
    """Supply voltage: zero-g and scale factor follow it, though not exactly in proportion."""
    ratio = signals.environment.supply_v / p['nominal_v']
    for d, (zero, scale) in enumerate(zip(p['zero_g_exponent'], p['scale_exponent'])):
        signals.zero_g_v[d] = signals.zero_g_v[d] * ratio**zero
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * ratio**scale


@effect(
    Place.ELECTRONICS,
    Parameter(
        'limit_g',
        unit='g',
        lower=0.1,
        upper=1000.0,  # Does not clip
        scale=1.0,
        source='ADXL203 datasheet: range 1.7 g at least; lower with a low supply',
        doc='largest output of either sign; 1000 does not clip',
        neutral=1000.0,
        role=Role.LIMIT,
    ),
    OptionalSize(
        'knee_g',
        unit='g',
        lower=0.0,
        upper=0.5,
        scale=0.02,
        source='physics: an amplifier near its rail',
        doc='width of a soft clip; 0 is hard',
        axes='',
    ),
    OptionalSize(
        'offset_g',
        unit='g',
        upper=0.5,
        scale=0.02,
        source='ADXL203 datasheet: zero-g 2.4 to 2.6 V between rails of 0 and 5 V',
        doc='middle of the two limits',
    ),
    smooth=False,
    cause='The output clips; raise the supply, lower the gain, or choose a wider range.',
    diagnosis=DiagnosisHints(
        detector=Detector.HELD_AT_END,
        form=(FormDimension.FORCE,),
        proof=(ProofVariable.OWN_FORCE,),
    ),
)
def saturation(signals: Signals, p: Parameters) -> None:
    """
    Saturation: the output stage clips at its limit.

    Clip the output of each axis at plus and minus its limit about an offset, g.

    With a knee w the clip is soft: x − w·ln(1 + exp((x − limit)/w)), and the same below. The
    offset is that of the zero-g from the middle of the rails.
    """
    knee_g = float(p['knee_g'])
    for d, (limit, offset) in enumerate(zip(p['limit_g'], p['offset_g'])):
        x = signals.output[d]
        upper = offset + limit
        lower = offset - limit
        if not knee_g:
            signals.output[d] = np.clip(x, lower, upper)
        else:
            above = np.logaddexp(0.0, (x - upper) / knee_g)
            below = np.logaddexp(0.0, (lower - x) / knee_g)
            signals.output[d] = x - knee_g * (above - below)


@effect(
    Place.ELECTRONICS,
    Parameter(
        'resistance_ratio',
        unit='1',
        lower=-0.95,  # A resistance stays above 0
        upper=1000.0,  # Registers set the ADXL355 from 1 to 1000 Hz
        scale=1.0,
        source='ADXL203 datasheet: 32 kOhm +-25 %; ADXL355: settings from 1 to 1000 Hz',
        doc="filter's resistance divided by the stated one, minus 1; ms without a filter",
        typical=0.15,
        starts=(0.03, *(2.0**n for n in range(7))),
    ),
    needs=(Need.FILTER,),
    cause='The output filter is not the stated one; measure its resistor and capacitor.',
    # The RC product of a healthy unit is within some 2 % of the measured one (chosen:
    # resistors and capacitors of 1 %, and their temperature).
    diagnosis=DiagnosisHints(
        healthy_std=0.02,
        stated_by=('rc_resistance_ohm', 'rc_capacitance_f'),
        revealed_by=Manoeuvre.SHAKE,
        form=(FormDimension.LAG,),
        proof=(ProofVariable.FREQUENCY,),
    ),
)
def bandwidth(signals: Signals, p: Parameters) -> None:
    """Bandwidth of the output filter: on-chip resistors differ by 25 %, registers set the rest."""
    for d, ratio in enumerate(p['resistance_ratio']):
        signals.rc_s[d] = (
            signals.rc_s[d] * (1 + ratio)
            if signals.rc_s[d]
            else _WITHOUT_FILTER_S * max(ratio, 0.0)
        )


@effect(
    Place.ELECTRONICS,
    Parameter(
        'per_k',
        unit='g/K',
        upper=0.1,
        scale=1e-4,
        source='ADXL203 datasheet: 0.1 mg/degC',
        doc='slope of the zero-g over temperature at 25 degC',
    ),
    OptionalSize(
        'per_k2',
        unit='g/K^2',
        upper=0.01,
        scale=1e-6,
        source='physics: a slope that changes by 1 % a degree',
        doc='curvature of the zero-g over temperature',
    ),
    invertible=True,
    follows=('temperature_c',),
    cause='The zero-g follows the temperature; measure it and correct, or keep it steady.',
    diagnosis=_OF_TEMPERATURE,
)
def temperature_bias(signals: Signals, p: Parameters) -> None:
    """
    Zero-g that changes with temperature.

    Add k·(T − 25 °C) + k2·(T − 25 °C)² to the output, g.
    """
    warmer_k = signals.environment.temperature_c - NOMINAL_TEMPERATURE_C
    add(
        signals.output,
        (warmer_k * (per_k + warmer_k * per_k2) for per_k, per_k2 in zip(p['per_k'], p['per_k2'])),
    )


@effect(
    Place.ELECTRONICS,
    Parameter(
        'per_k',
        unit='1/K',
        upper=0.01,
        scale=1e-4,
        source='ADXL203 datasheet: sensitivity +-0.3 % over temperature',
        doc='relative slope of the scale factor over temperature, from 25 degC on',
    ),
    OptionalSize(
        'per_k2',
        unit='1/K^2',
        upper=0.001,
        scale=1e-6,
        source='physics: a slope that changes by 1 % a degree',
        doc='relative curvature of the scale factor over temperature',
    ),
    invertible=True,
    follows=('temperature_c',),
    cause='The scale factor follows the temperature; measure it and correct, or keep it steady.',
    diagnosis=_OF_TEMPERATURE,
)
def temperature_scale(signals: Signals, p: Parameters) -> None:
    """
    Scale factor that changes with temperature.

    Multiply the scale factor by 1 + k·(T − 25 °C) + k2·(T − 25 °C)².
    """
    warmer_k = signals.environment.temperature_c - NOMINAL_TEMPERATURE_C
    for d, (per_k, per_k2) in enumerate(zip(p['per_k'], p['per_k2'])):
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * (
            1 + warmer_k * (per_k + warmer_k * per_k2)
        )


@effect(
    Place.ELECTRONICS,
    Parameter(
        'per_k',
        unit='g/K',
        upper=0.1,
        scale=1e-4,
        source='ADXL203 datasheet: 0.1 mg/degC',
        doc='slope of the zero-g over the temperature that lags the thermometer',
    ),
    Shape(
        'tau_s',
        unit='s',
        lower=1.0,
        upper=1e4,
        scale=60.0,
        source='physics: a small board in moving air',
        doc='time constant between thermometer and sensor',
        starts=(8.0, 25.0, 80.0, 250.0),
    ),
    follows=('temperature_c',),
    cause='The thermometer is warm earlier or later than the sensor; mount it at the sensor, '
    'or change the temperature slowly.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.HEAT,
        time_constant='tau_s',
        form=(FormDimension.TEMPERATURE, FormDimension.WARMING),
        proof=(ProofVariable.TEMPERATURE_RATE,),
    ),
)
def thermal_lag(signals: Signals, p: Parameters) -> None:
    """
    Lag of the sensor behind its thermometer, or lead, so that the zero-g is late or early.

    Add k·(θ − T) to the output, g; θ follows the measured temperature T by 1/(1 + τ·s).

    A sensor that lags its thermometer has the slope of its zero-g over temperature as k: its
    zero-g then follows θ. A sensor that leads its thermometer has a k of the opposite sign.
    """
    temperature_c = signals.environment.temperature_c
    if not any(p['per_k']) or not np.ndim(temperature_c):
        return  # At a single, steady temperature nothing lags
    lag_k = low_pass(temperature_c, p['tau_s'], signals.dt_s, signals.memory) - temperature_c
    add(signals.output, (per_k * lag_k for per_k in p['per_k']))


@effect(
    Place.ELECTRONICS,
    Parameter(
        'half_width_g',
        unit='g',
        upper=0.1,
        scale=2e-3,
        source='physics: friction and creep in solder and die attach',
        doc='zero-g while cooling minus that while warming, divided by 2',
    ),
    Shape(
        'reach_k',
        unit='K',
        lower=0.1,
        upper=200.0,
        scale=10.0,
        source='physics: part of the range',
        doc='half of the change after a reversal that opens the loop',
        starts=(2.0, 10.0, 50.0),
    ),
    smooth=False,
    follows=('temperature_c',),
    cause='The zero-g depends on whether the sensor warms or cools; relieve its package of '
    'stress, or state the loop as an uncertainty.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.HEAT,
        form=(FormDimension.TEMPERATURE, FormDimension.WARMING),
        proof=(ProofVariable.TEMPERATURE_RATE, ProofVariable.TEMPERATURE),
    ),
)
def thermal_hysteresis(signals: Signals, p: Parameters) -> None:
    """
    Thermal hysteresis: a zero-g that differs between warming and cooling.

    Add a loop over temperature to the zero-g, which begins when the temperature turns back.

    The loop has its full width when the temperature has changed by 2·`reach_k` since. It does not
    depend on how fast the temperature changes. The first branch belongs to `temperature_bias`.
    """
    temperature_c = signals.environment.temperature_c
    if not any(p['half_width_g']) or not np.ndim(temperature_c):
        return  # A single temperature has no branch
    branch = loop(temperature_c, p['reach_k'], signals.memory)
    add(signals.output, (-half_width * branch for half_width in p['half_width_g']))


@effect(
    Place.ELECTRONICS,
    Parameter(
        'amplitude_g',
        unit='g',
        upper=0.5,
        scale=2e-3,
        source='physics: self-heating by 20 K, 0.1 mg/K',
        doc='zero-g at power-on minus the settled one',
    ),
    Shape(
        'tau_s',
        unit='s',
        lower=1.0,
        upper=1e5,
        scale=300.0,
        source='physics: a board in still air',
        doc='time constant of settling',
        starts=(15.0, 60.0, 300.0, 1500.0),
    ),
    invertible=True,
    follows=('time_s',),
    cause='The sensor warms up after power-on; wait some time constants before measuring.',
    diagnosis=DiagnosisHints(
        revealed_by=Manoeuvre.HEAT, form=(FormDimension.TIME,), proof=(ProofVariable.TIME,)
    ),
)
def warm_up(signals: Signals, p: Parameters) -> None:
    """
    Warm-up: a zero-g that settles after power-on.

    Add A·exp(−t/τ) to the output, g; t is the time since power-on.
    """
    unsettled = np.exp(-signals.environment.time_s / p['tau_s'])
    add(signals.output, (amplitude * unsettled for amplitude in p['amplitude_g']))
