# SPDX-License-Identifier: Apache-2.0

"""
The chain as polynomials of the specific force, which many samples share.

With the effects of the library, the output of the element is a polynomial of the third degree in
the force, and the volts are linear in this output. Whether that holds for the effects of a sensor
is tried out on drawn forces.
"""

from __future__ import annotations

from adxl_ros.model.analog_stages import AnalogStages, output_volts
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Components, Environment, NOMINAL_ENVIRONMENT
import numpy as np

MANY = 1024
"""Samples from which polynomials are used (chosen: the trial takes as long as 500 samples)."""

_QUADRATIC = 10
"""Monomials up to the second degree; the derivatives of all monomials consist of them."""

_EXPONENTS = np.array([
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1),
    (2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2),
    (3, 0, 0), (2, 1, 0), (2, 0, 1), (1, 2, 0), (1, 1, 1), (1, 0, 2),
    (0, 3, 0), (0, 2, 1), (0, 1, 2), (0, 0, 3)])
"""Exponents of x, y and z of the monomials, in the order of `monomials`."""

_DRAWN = 128
"""Forces that are drawn: half of them determine polynomials, the others try them out. Chosen: 64
are three times the monomials."""

_DRAWN_G = 2.0
"""Largest drawn component, g; chosen: sensors are calibrated at about 1 g."""

_AGREEMENT = 1e-12
"""Largest relative difference of the polynomials from the chain; chosen: far above rounding, and
far below any effect."""


def monomials(force_mps2: np.ndarray) -> np.ndarray:
    """Return the products of the components of forces, g, (20, n), of forces in m/s², (3, n)."""
    powers = np.empty((len(_EXPONENTS), force_mps2.shape[1]))
    powers[0] = 1.0
    x, y, z = np.divide(force_mps2, G0_MPS2, out=powers[1:4])
    np.multiply(x, powers[1:4], out=powers[4:7])
    np.multiply(y, powers[2:4], out=powers[7:9])
    np.multiply(z, z, out=powers[9])
    np.multiply(x, powers[4:10], out=powers[10:16])
    np.multiply(y, powers[7:10], out=powers[16:19])
    np.multiply(z, powers[9], out=powers[19])
    return powers


def drawn() -> tuple[np.ndarray, Environment]:
    """Return forces, m/s², (3, n), and surroundings for a trial."""
    rng = np.random.default_rng(0)
    environment = Environment(rng.uniform(0, 1e4, _DRAWN), rng.uniform(-40, 85, _DRAWN),
                              rng.uniform(3, 6, _DRAWN))
    return rng.uniform(-_DRAWN_G, _DRAWN_G, (3, _DRAWN)) * G0_MPS2, environment


def coefficients_of(force_mps2: np.ndarray, values: np.ndarray, agreement: float = _AGREEMENT
                    ) -> np.ndarray | None:
    """
    Return the polynomials that give values.

    Parameters
    ----------
    force_mps2
        Forces of `drawn`, m/s², (3, n).
    values
        Values at them, (k, n).
    agreement
        Largest difference by the largest value.

    Returns
    -------
    ndarray or None
        Coefficients of the monomials, (k, 20); None where the values are no such polynomials.

    """
    powers = monomials(force_mps2)
    half = _DRAWN // 2
    polynomials = np.linalg.lstsq(powers[:, :half].T, values[:, :half].T)[0].T
    largest = np.abs(values).max(axis=1, keepdims=True, initial=0.0)
    polynomials[np.abs(polynomials) < agreement / _DRAWN * largest] = 0.0
    agrees = np.abs(polynomials @ powers - values) <= agreement * largest
    return polynomials if agrees.all() else None


def _derivatives() -> np.ndarray:
    """Return the derivatives of the monomials by x, y and z, (3, 20, 10)."""
    derivatives = np.zeros((3, len(_EXPONENTS), _QUADRATIC))
    for c in range(3):
        for row, exponents in enumerate(_EXPONENTS):
            if exponents[c]:
                lower = exponents - np.eye(3, dtype=int)[c]
                column = (lower == _EXPONENTS).all(axis=1).argmax()
                derivatives[c, row, column] = exponents[c]
    return derivatives


class PolynomialChain:
    """
    The chain up to the input of the ADC, with the output of the element as polynomials.

    The volts of an axis are offset + gain · output, of which only offset and gain depend on the
    surroundings.
    """

    def __init__(self, stages: AnalogStages, coefficients: np.ndarray) -> None:
        """
        Take the polynomials.

        coefficients: the polynomials of the output of each measured axis, g, (m, 20).
        """
        self._stages, self._coefficients = stages, coefficients
        slopes = [coefficients @ table / G0_MPS2 for table in _derivatives()]
        self._slopes = np.stack(slopes, axis=1).reshape(-1, _QUADRATIC)

    def levels(self, environment: Environment) -> tuple[Components, Components]:
        """Return offset, V, and gain, V/g, by axis, in surroundings; arrays (n,) or floats."""
        axes = len(self._coefficients)
        offset_v, volts = (self._volts(environment, [output] * axes) for output in (0.0, 1.0))
        return offset_v, [v - offset for v, offset in zip(volts, offset_v)]

    def _volts(self, environment: Environment, output: Components) -> Components:
        signals = self._stages.sense([0.0, 0.0, 0.0], environment)
        signals.output = output
        self._stages.amplify(signals)
        return output_volts(signals)

    def volts(self, force: Components, environment: Environment) -> Components:
        """
        Return the volts of each measured axis.

        force: specific force in the case frame, m/s², three components (n,); returns: volts by
        axis, V, (n,) each.
        """
        return [offset + gain * output for offset, gain, output in zip(
            *self.levels(environment), self.output(monomials(np.array(force))))]

    def undo(self, volts: np.ndarray, environment: Environment) -> np.ndarray:
        """
        Return the output of the element by the volts.

        volts: volts by axis, V, (m, n); returns: output by axis, g, (m, n).
        """
        return np.array([(v - offset) / gain for v, offset, gain in zip(
            volts, *self.levels(environment))])

    def output(self, powers: np.ndarray) -> np.ndarray:
        """Return the output of each axis, g, (m, n), at `monomials`, (20, n)."""
        return self._coefficients @ powers

    def slopes(self, powers: np.ndarray) -> np.ndarray:
        """Return derivatives of the output by force, g/(m/s²), (m, 3, n), at `monomials`."""
        return (self._slopes @ powers[:_QUADRATIC]).reshape(-1, 3, powers.shape[1])


def polynomial_chain(stages: AnalogStages) -> PolynomialChain | None:
    """Return the chain of some stages as polynomials; None where it consists of none."""
    force, environment = drawn()
    with np.errstate(all='ignore'):  # an effect may be undefined at drawn forces
        signals = stages.sense(list(force), NOMINAL_ENVIRONMENT)
        stages.respond(signals)
        stages.amplify(signals)
        axes = len(signals.zero_g_v)
        output = np.array([np.broadcast_to(out, _DRAWN) for out in signals.output[:axes]])
        if not np.isfinite(output).all():
            return None
        coefficients = coefficients_of(force, output)
        if coefficients is None:
            return None
        chain = PolynomialChain(stages, coefficients)
        stage_v = stages.volts(list(force), environment)
        polynomial_v = chain.volts(list(force), environment)
    agrees = all((np.abs(p - v) <= _AGREEMENT * np.abs(v).max()).all()
                 for p, v in zip(polynomial_v, stage_v))
    return chain if agrees else None
