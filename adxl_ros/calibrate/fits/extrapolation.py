# SPDX-License-Identifier: Apache-2.0

"""
What a polynomial over temperature may lack outside of the temperatures that were seen.

A polynomial of degree n − 1 that is fitted to one of degree n departs from it by c·p(T). There p
is the polynomial of degree n with the leading coefficient 1 that is orthogonal to the lower
degrees over the temperatures of the fit, so that p has n zeros between them. The size of c is
estimated from the residuals, with a prior: a further degree contributes no more to what was seen
than the last one.
"""

from __future__ import annotations

from typing import NamedTuple

from adxl_ros.model.constants import TINY
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import departure_k, parameter_of
import numpy as np

_DEGREE = 2  # Degree of the zero-g over temperature: slope and curvature
_TYPICAL_K2 = parameter_of(Coefficient('temperature_bias', 'per_k2', 'x')).scale
"""Typical curvature, g/K²: a sensor with a smaller one may still have the next degree."""
_LARGEST_CORRELATION = 0.95
"""Largest correlation of neighbouring residuals. Chosen: beyond it the drift is a random walk."""


class NextDegree(NamedTuple):
    """The degree that a fit over temperature lacks."""

    nodes_c: np.ndarray  # Temperatures at which it does not show, °C, (n,)
    size: np.ndarray  # Root mean square of c by axis, g/K^n, (m,)

    def error_g(self, temperature_c: np.ndarray, zero_g_at_c: float) -> np.ndarray:
        """Return the error of the zero-g that it causes, g rms, by axis, (m, k)."""
        departure = departure_k(temperature_c, self.nodes_c) - departure_k(
            zero_g_at_c, self.nodes_c
        )
        return np.abs(np.outer(self.size, departure))


def next_degree(
    temperature_c: np.ndarray, residual_g: np.ndarray, curvature_k2: np.ndarray
) -> NextDegree:
    """
    Estimate the next degree of the zero-g from the residuals of a fit of slope and curvature.

    temperature_c: in the order of time, (k,); residual_g: by axis, (k, m); curvature_k2: that of
    the fit, g/K², (m,).
    """
    polynomials = _orthogonal_polynomials(temperature_c)
    shape = departure_k(temperature_c, polynomials.nodes_c)
    squares = float(shape @ shape)
    size = shape @ residual_g / squares
    variance_g2 = _residual_variance_g2(residual_g - np.outer(shape, size))
    # A further degree contributes no more to what was seen than the last one.
    curvature = np.maximum(np.abs(curvature_k2), _TYPICAL_K2)
    prior_std = curvature * np.linalg.norm(polynomials.last_k2) / np.linalg.norm(shape)
    information = squares / np.maximum(variance_g2, TINY)
    variance = 1 / (information + prior_std**-2)
    posterior_mean = variance * information * size
    return NextDegree(polynomials.nodes_c, np.sqrt(posterior_mean**2 + variance))


class _OrthogonalPolynomials(NamedTuple):
    """The last degree of a fit over temperature, and the next one, over what was seen."""

    last_k2: np.ndarray  # The last one at the temperatures of the fit, K², (k,)
    nodes_c: np.ndarray  # Temperatures at which the next one is 0, °C


def _orthogonal_polynomials(temperature_c: np.ndarray) -> _OrthogonalPolynomials:
    middle_c = float(np.mean(temperature_c))
    span_k = float(np.ptp(temperature_c))
    place = (temperature_c - middle_c) / span_k
    # The whole span counts as one more sample, so that few temperatures determine all degrees.
    even = np.linspace(place.min(), place.max(), _DEGREE + 2)
    values = np.concatenate([place, even])
    weight = np.sqrt(np.concatenate([np.ones(len(place)), np.full(len(even), 1 / len(even))]))
    last = _orthogonal(values, weight, _DEGREE)
    following = _orthogonal(values, weight, _DEGREE + 1)
    return _OrthogonalPolynomials(
        last_k2=span_k**_DEGREE * np.polyval(last, place),
        nodes_c=middle_c + span_k * np.sort(np.roots(following).real),
    )


def _residual_variance_g2(rest_g: np.ndarray) -> np.ndarray:
    """
    Return the variance of residuals, (k, m), as if they were independent, by axis, (m,).

    Correlated residuals count as fewer independent ones.
    """
    squares_g2 = (rest_g**2).sum(axis=0)
    neighbours_g2 = np.sum(rest_g[1:] * rest_g[:-1], axis=0)
    correlation = np.clip(neighbours_g2 / np.maximum(squares_g2, TINY), 0.0, _LARGEST_CORRELATION)
    freedom = max(len(rest_g) - _DEGREE - 2, 1)
    return squares_g2 / freedom * (1 + correlation) / (1 - correlation)


def _orthogonal(values: np.ndarray, weight: np.ndarray, degree: int) -> np.ndarray:
    """Return x^degree + ..., highest first, that is orthogonal to lower powers over values."""
    powers = np.vander(values, degree + 1)
    rest = np.linalg.lstsq(weight[:, None] * powers[:, 1:], weight * powers[:, 0], rcond=None)[0]
    return np.concatenate([[1.0], -rest])
