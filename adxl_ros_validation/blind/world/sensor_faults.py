# SPDX-License-Identifier: Apache-2.0
"""Faults of stage, site and clock, of the sensing element, and of its electronics."""

from __future__ import annotations

from functools import partial
import math

from adxl_ros_validation.blind.world.simulator import (
    Act,
    all_axes,
    by_axis,
    column,
    Draw,
    draw_weights,
    equal_weights,
    FaultKind,
    G0,
    low_pass,
    Place,
    Run,
    Shape,
    single_weights,
    travel_memory,
    Unit,
    weights,
)
import numpy as np
import scipy


def _stage_offset(run: Run, size: float, shape: Shape) -> None:
    """Shift the zeros of both joints, rad."""
    run.alpha += size * shape['w'][0]
    run.beta += size * shape['w'][1]


def _stage_eccentricity(run: Run, size: float, shape: Shape) -> None:
    """Add a Fourier series of the angle, rad: three harmonics to beta and one to alpha."""
    c = np.asarray(shape['w'])
    beta, alpha = run.beta.copy(), run.alpha.copy()
    for h, part in ((1, 1.0), (2, 0.06), (3, 0.02)):
        run.beta += size * part * (c[0] * np.sin(h * beta) + c[1] * np.cos(h * beta))
    run.alpha += size * (c[2] * np.sin(alpha) + c[3] * np.cos(alpha))


def _backlash(run: Run, size: float, shape: Shape) -> None:
    """Follow with a gap that closes exponentially (Dahl), as of worn teeth with grease, rad."""
    if size:
        for joint, w in ((run.alpha, shape['w'][0]), (run.beta, shape['w'][1])):
            if w:
                joint -= 0.5 * size * abs(w) * travel_memory(joint, abs(size * w))


def _base_tilt(run: Run, size: float, shape: Shape) -> None:
    """Tilt the base, rad."""
    up = run.up + size * np.array([shape['w'][0], shape['w'][1], 0.0])
    run.up = up / np.linalg.norm(up)


def _gravity(run: Run, size: float, shape: Shape) -> None:
    """Change local gravity by a share, as at another site."""
    run.gravity = G0 * (1 + size * shape['w'][0])


def _lever_arm(run: Run, size: float, shape: Shape) -> None:
    """Shift the sensor off the axes of the stage, m."""
    run.arm = size * np.asarray(shape['w'], float)


def _time_offset(run: Run, size: float, shape: Shape) -> None:
    """Delay all samples, s."""
    run.late += size * shape['w'][0]


def _clock_skew(run: Run, size: float, shape: Shape) -> None:
    """Change the rate of the clock by a share; the oven of the clock makes it wander."""
    run.skew += size * shape['w'][0]


def _mount_resonance(run: Run, size: float, shape: Shape) -> None:
    """Add one mode of the bracket; `size` is its share of the motion."""
    w0, zeta, fs = 2 * np.pi * shape['hertz'], shape['zeta'], 1 / run.dt
    b, a = scipy.signal.bilinear([-1.0, -2 * zeta * w0 * 0.2, 0.0],
                                 [1.0, 2 * zeta * w0, w0 * w0], fs)
    moved = run.force - run.force[:, :1]
    run.force += size * scipy.signal.lfilter(b, a, moved)


def _draw_resonance(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'hertz': float(rng.uniform(14, 38)), 'zeta': float(rng.uniform(0.03, 0.12))}


def _resonances(unit: Unit) -> list[Shape]:
    return [{'hertz': hertz, 'zeta': 0.06} for hertz in (14.0, 20.0, 28.0, 38.0)]


def _draw_sign(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': rng.choice([-1.0, 1.0], 1)}


def _draw_positive(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': np.abs(weights(2, rng))}


def _weighted(name: str, act: Act, count: int, start: float,
              largest: float) -> FaultKind:
    """Return a kind with a number of independent weights."""
    return FaultKind(name, Place.STAGE, act, partial(draw_weights, count),
                     partial(single_weights, count), start, largest)


def _signed(name: str, act: Act, start: float, largest: float
            ) -> FaultKind:
    """Return a kind whose only weight is a sign."""
    return FaultKind(name, Place.STAGE, act, _draw_sign, partial(equal_weights, 1), start,
                     largest)


STAGE_KINDS = (
    _weighted('stage_offset', _stage_offset, 2, start=1e-3, largest=0.03),
    _weighted('stage_eccentricity', _stage_eccentricity, 4, start=1e-3, largest=0.03),
    FaultKind('backlash', Place.STAGE, _backlash, _draw_positive, partial(single_weights, 2),
              start=1e-3, largest=0.03, sizes=(0.3, 1.0, 4.0)),
    _weighted('base_tilt', _base_tilt, 2, start=1e-3, largest=0.03),
    _signed('gravity', _gravity, start=1e-3, largest=5e-3),
    _weighted('lever_arm', _lever_arm, 3, start=0.01, largest=0.3),
    _signed('time_offset', _time_offset, start=1e-3, largest=0.1),
    _signed('clock_skew', _clock_skew, start=1e-5, largest=1e-3),
    FaultKind('mount_resonance', Place.MOUNT, _mount_resonance, _draw_resonance, _resonances,
              start=0.1, largest=1.0),
)
"""The kinds of this file, in the order of the table."""


_ZERO_C = 273.15
"""0 °C in K."""
_OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Row and column of each weight of a misalignment in the matrix of directions."""


def _bias(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g, g."""
    run.volts += size * column(shape) * run.unit.scale_v_per_g[:, None]


def _scale_factor(run: Run, size: float, shape: Shape) -> None:
    """Change the scale factor by a share."""
    run.u *= 1 + size * column(shape)


def _misalignment(run: Run, size: float, shape: Shape) -> None:
    """Turn each axis on its own, rad; its direction keeps the length 1."""
    for (row, col), w in zip(_OFF_DIAGONAL, shape['w']):
        run.directions[row, col] += size * w
    run.directions /= np.linalg.norm(run.directions, axis=1, keepdims=True)
    run.u = (run.directions @ run.force)[run.unit.axis_indices] / G0


def _cross_axis(run: Run, size: float, shape: Shape) -> None:
    """Add an even function of the other axis of the plane, g: the first arch of a cosine."""
    force = run.force / G0
    run.u[:2] += size * column(shape) * (1 - np.cos(1.2 * force[[1, 0]]))


def _cross_axis_z(run: Run, size: float, shape: Shape) -> None:
    """Add an exponential function of the force across the plane, g."""
    run.u[:2] += size * column(shape) * np.expm1(run.force[2] / G0)


def _scale_factor_z(run: Run, size: float, shape: Shape) -> None:
    """Change the scale factor exponentially with the force across the plane."""
    run.u[:2] *= 1 + size * column(shape) * np.expm1(0.8 * run.force[2] / G0)


def _nonlinearity(run: Run, size: float, shape: Shape) -> None:
    """Stiffen the element, g: a hyperbolic sine that is exact at 0 and at full scale."""
    run.u += size * column(shape) * (np.sinh(1.4 * run.u) / math.sinh(1.4) - run.u)


def _quadratic(run: Run, size: float, shape: Shape) -> None:
    """Bend the characteristic, g: a hyperbola through zero."""
    run.u += size * column(shape) * (np.sqrt(1 + 0.8 * run.u ** 2) - 1)


def _saturation(run: Run, size: float, shape: Shape) -> None:
    """Clip softly; `size` is by how many g the limit is below 1.7 g."""
    limit = 1.7 - size * np.abs(column(shape))
    run.u /= (1 + np.abs(run.u / limit) ** 40) ** (1 / 40)


def _hysteresis(run: Run, size: float, shape: Shape) -> None:
    """Add a hysteresis loop of Bouc and Wen, g: exponent 2, unequal branches."""
    every = max(int(0.004 / run.dt), 1)
    for row, w in zip(run.u, shape['w']):
        if w:
            z, loop = 0.0, []
            for step in np.diff(row[::every], prepend=row[0]).tolist():
                branch = 1.0 if step * z > 0 else -0.3
                z = min(max(z + step / 0.12 * (1 - branch * z * z), -1.0), 1.0)
                loop.append(z)
            row += size * w * np.interp(run.t, run.t[::every], loop)


def _temperature_bias(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g exponentially with temperature from 25 °C, g."""
    run.u += size * column(shape) * np.expm1((run.temperature - 25.0) / 25.0)


def _temperature_scale(run: Run, size: float, shape: Shape) -> None:
    """Change the scale factor by the law of Arrhenius from 25 °C."""
    inverse = 1 / (_ZERO_C + 25.0) - 1 / (_ZERO_C + run.temperature)
    run.u *= 1 + size * column(shape) * np.expm1(2500.0 * inverse)


def _warm_up(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g after power-on by a stretched exponential, g."""
    since = np.clip(run.t + 3.0, 0, None)
    run.u += size * column(shape) * np.exp(-(since / shape['lag']) ** 0.75)


def _vibration_rectification(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g by the power of the vibration, with a limit, 1/g."""
    fast = scipy.signal.sosfilt(scipy.signal.butter(2, 2.0, 'high', fs=1 / run.dt, output='sos'),
                                run.u - run.u[:, :1])
    power = low_pass(fast ** 2, 0.4, run.dt)
    run.u += size * column(shape) * power / (1 + 4 * power)


def _supply(run: Run, size: float, shape: Shape) -> None:
    """Scale zero-g and scale factor by the supply to the power 1.13 (560 mV/g at 3 V)."""
    run.volts *= 1 + size * column(shape) * ((run.supply / 5.0) ** 1.13 - 1)


def _bandwidth(run: Run, size: float, shape: Shape) -> None:
    """Move the corner of the filter; a slower filter has a second pole."""
    factor = math.exp(-size * shape['w'][0])
    run.corner_hz *= factor
    if factor < 1:
        run.second_hz = 8 * run.corner_hz / (1 - factor)


def _draw_settling(rng: np.random.Generator, unit: Unit) -> Shape:
    return {**by_axis(rng, unit), 'lag': float(rng.uniform(15, 50))}


def _settlings(unit: Unit) -> list[Shape]:
    return [{'w': np.ones(len(unit.axes)), 'lag': lag} for lag in (15.0, 27.0, 50.0)]


def _draw_clipped_axes(rng: np.random.Generator, unit: Unit) -> Shape:
    count = len(unit.axes)
    single = np.arange(count) == rng.integers(count)
    return {'w': single.astype(float) if rng.random() < 0.4 else np.ones(count)}


def _draw_directions(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': weights(2 * len(unit.axes), rng)}


def _directions(unit: Unit) -> list[Shape]:
    return [{'w': row} for row in np.eye(2 * len(unit.axes))]


def _draw_slower_or_faster(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': rng.choice([1.0, 1.0, -1.0], 1)}


def _axes(name: str, act: Act, largest: float, *, start: float = 1e-3,
          place: Place = Place.ELEMENT, draw: Draw = by_axis) -> FaultKind:
    """Return a kind with a weight for each axis."""
    return FaultKind(name, place, act, draw, all_axes, start, largest, per_axis=True)


def _plane(name: str, act: Act) -> FaultKind:
    """Return a kind of the two axes in the plane, whether or not the unit has a third."""
    return FaultKind(name, Place.ELEMENT, act, partial(draw_weights, 2),
                     partial(equal_weights, 2), start=1e-3, largest=0.05, per_axis=True)


ELEMENT_KINDS = (
    _axes('bias', _bias, 0.1, place=Place.ELECTRONICS),
    _axes('scale_factor', _scale_factor, 0.05),
    FaultKind('misalignment', Place.ELEMENT, _misalignment, _draw_directions, _directions,
              start=1e-3, largest=0.05),
    _plane('cross_axis', _cross_axis),
    _plane('cross_axis_z', _cross_axis_z),
    _plane('scale_factor_z', _scale_factor_z),
    _axes('nonlinearity', _nonlinearity, 0.1),
    _axes('quadratic', _quadratic, 0.1),
    FaultKind('saturation', Place.ELEMENT, _saturation, _draw_clipped_axes, all_axes, start=0.6,
              largest=1.1, per_axis=True, sizes=(0.8, 1.0, 1.3)),
    _axes('hysteresis', _hysteresis, 0.03),
    _axes('temperature_bias', _temperature_bias, 0.05),
    _axes('temperature_scale', _temperature_scale, 0.1),
    FaultKind('warm_up', Place.ELEMENT, _warm_up, _draw_settling, _settlings, start=1e-3,
              largest=0.1, per_axis=True),
    _axes('vibration_rectification', _vibration_rectification, 3.0, start=1e-2),
    _axes('supply', _supply, 1.5, start=0.1, place=Place.ELECTRONICS),
    FaultKind('bandwidth', Place.ELECTRONICS, _bandwidth, _draw_slower_or_faster,
              partial(equal_weights, 1), start=0.1, largest=1.0, sizes=(-1.0, 1.0, 4.0)),
)
"""The kinds of this file, in the order of the table."""
