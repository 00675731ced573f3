# SPDX-License-Identifier: Apache-2.0

"""
What is known of the coefficients of a sensor, as a bank of Kalman filters.

The state is the departure of p coefficients from the calibration in use, then the q components of
the direction of the present stay. A rest reads r = H·δ + T·d + noise: H has the derivatives of the
force by the coefficients, T spans the directions in which the force may turn. d is unknown at the
begin of each stay, so that nothing is learnt of a slope, however long it lasts.

How strongly a unit drifts with time and temperature, and how much its rests scatter, is not known
beforehand. Each filter of the bank has its own, and the weight by which it has predicted the rests
(multiple-model estimation; Bar-Shalom, Li and Kirubarajan 2001, 11.6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy

_DRIFTS = (1.0, 2.5, 6.0)
"""Drifts of the filters with time, and with temperature, multiples of the stated ones. Chosen:
steps of 2.5, beyond five times."""
_SCATTERS_G = (1e-4, 2.5e-4, 6e-4, 1.5e-3)
"""Scatters of the rests beyond the noise of their means, g. Chosen: from that of a good analog
sensor to that of one that is disturbed, in the same steps. Between two filters a factor r apart,
the likelier one is wrong by √(2·ln r / (1 − r⁻²)) at most: 1.5, and 1.8 with steps of 5."""
LARGEST_DRIFT = max(_DRIFTS)
_DRIFT, _SLOPE, _SCATTER_G = np.array([*product(_DRIFTS, _DRIFTS, _SCATTERS_G)]).T
"""Drift with time and with temperature, and scatter, by filter, (l,) each."""
_DIRECTION_STD_G = 10.0
"""Standard deviation of a direction before its stay, g. It stands for "unknown": each stay says of
the zero-g what this allows, and those of a year together still 0.15 g, far above any zero-g error.
"""
_CREEP_G2_PER_DAY = (3e-4**2) * 24
"""Growth of the variance of a direction within a stay, g²/day. Chosen: 0.3 mg in an hour, by
tyres."""
_LEAST_LOG_WEIGHT = -30.0
"""Least logarithm of a weight; chosen: a filter that was wrong can still come back."""
_LEAST_LOG_SHARE = np.log(1e-3)
"""Least logarithm of the share of a drift with time among filters that are else alike. Chosen: a
unit may begin to drift, so that one change after a quiet time is no knock unless it is large."""


class SeenRest(NamedTuple):
    """A rest to first order."""

    residual_g: np.ndarray  # Force by the calibration in use, minus gravity in its direction, (m,)
    design: np.ndarray  # Derivatives of the force by the coefficients, g, (m, p)
    basis: np.ndarray  # Directions in which the force may turn, (m, q)
    variance_g2: np.ndarray  # Variance of the means by noise, g², (m,)


class Innovation(NamedTuple):
    """What a rest says to each of l filters."""

    departure_g: np.ndarray  # Residual minus its prediction, g, (l, m)
    covariance_g2: np.ndarray  # Covariance of the departure, g², (l, m, m)
    gain: np.ndarray  # Gain of the filter, (l, p + q, m)
    design: np.ndarray  # Design with the directions, (m, p + q)
    plausibility: float  # Probability of a departure as large as this

    @property
    def distance2(self) -> np.ndarray:
        """Return the squared Mahalanobis distances, (l,)."""
        solved = np.linalg.solve(self.covariance_g2, self.departure_g[..., None])[..., 0]
        return np.asarray((self.departure_g * solved).sum(axis=-1))


@dataclass(frozen=True)
class Belief:
    """Means and covariances of the filters."""

    mean: np.ndarray  # (l, p + q)
    covariance: np.ndarray  # (l, p + q, p + q)
    log_weight: np.ndarray  # Logarithms of the weights, (l,); the largest is 0
    directions: int  # q

    @classmethod
    def prior(cls, known: np.ndarray, drifting: np.ndarray, directions: int) -> Belief:
        """
        Begin with the covariance of a calibration, (p, p).

        drifting: covariance that temperature adds in a unit of the stated drift, (p, p).
        """
        count = len(known) + directions
        covariance = np.zeros((len(_DRIFT), count, count))
        covariance[:, : len(known), : len(known)] = known + _SLOPE[:, None, None] ** 2 * drifting
        return cls(np.zeros((len(_DRIFT), count)), covariance, np.zeros(len(_DRIFT)), directions)

    @property
    def weight(self) -> np.ndarray:
        """Return the weights of the filters, (l,)."""
        return np.asarray(scipy.special.softmax(self.log_weight))

    @property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean, (p,), and covariance, (p, p), of the coefficients over all filters."""
        count = self.mean.shape[1] - self.directions
        means = self.mean[:, :count]
        weight = self.weight
        mean = weight @ means
        spread = np.einsum('l,li,lj->ij', weight, means - mean, means - mean)
        return mean, np.tensordot(weight, self.covariance[:, :count, :count], 1) + spread

    def aged(self, variance_per_day: np.ndarray, days: float) -> Belief:
        """Let the coefficients drift, and the direction creep; variances a day, (p,)."""
        growth = np.zeros_like(self.mean)
        growth[:, : len(variance_per_day)] = _DRIFT[:, None] ** 2 * variance_per_day
        growth[:, len(variance_per_day) :] = _CREEP_G2_PER_DAY
        covariance = self.covariance.copy()
        diagonal = np.arange(covariance.shape[-1])
        covariance[:, diagonal, diagonal] += growth * max(days, 0.0)
        return replace(self, covariance=covariance)

    def moved(self) -> Belief:
        """Forget the direction, because the robot has moved."""
        first = self.mean.shape[1] - self.directions
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[:, first:] = 0.0
        covariance[:, first:, :] = covariance[:, :, first:] = 0.0
        covariance[:, first:, first:] = _DIRECTION_STD_G**2 * np.eye(self.directions)
        return replace(self, mean=mean, covariance=covariance)

    def shifted(self, change: np.ndarray) -> Belief:
        """Count the departures from a calibration that was changed, (p,)."""
        mean = self.mean.copy()
        mean[:, : len(change)] -= change
        return replace(self, mean=mean)

    def innovation(self, rest: SeenRest, freedom: int) -> Innovation:
        """Compare a rest with its prediction; freedom: numbers in it that the stay determines."""
        design = np.hstack([rest.design, rest.basis])
        spread = self.covariance @ design.T
        noise = np.eye(len(design)) * (rest.variance_g2 + _SCATTER_G[:, None] ** 2)[:, None, :]
        covariance = design @ spread + noise
        gain = np.swapaxes(np.linalg.solve(covariance, np.swapaxes(spread, 1, 2)), 1, 2)
        found = Innovation(rest.residual_g - self.mean @ design.T, covariance, gain, design, 1.0)
        if not freedom:
            return found
        chance = scipy.special.chdtrc(freedom, found.distance2)
        return found._replace(plausibility=float(self.weight @ chance))

    def learnt(self, found: Innovation) -> Belief:
        """Take a rest into account."""
        _, log_determinant = np.linalg.slogdet(found.covariance_g2)
        log_weight = self.log_weight - (found.distance2 + log_determinant) / 2
        covariance = self.covariance - found.gain @ found.design @ self.covariance
        return replace(
            self,
            mean=self.mean + (found.gain @ found.departure_g[..., None])[..., 0],
            covariance=(covariance + np.swapaxes(covariance, 1, 2)) / 2,
            log_weight=_bounded(log_weight),
        )


def _bounded(log_weight: np.ndarray) -> np.ndarray:
    """Return logarithms of weights, (l,), with the largest at 0 and none too small."""
    by_drift = log_weight.reshape(len(_DRIFTS), -1)
    shared = np.maximum(by_drift, by_drift.max(axis=0) + _LEAST_LOG_SHARE).ravel()
    return np.maximum(shared - shared.max(), _LEAST_LOG_WEIGHT)
