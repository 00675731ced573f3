# SPDX-License-Identifier: Apache-2.0
"""The ideal observer of this world: the power of detection, and what it cannot separate."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
import math
from typing import NamedTuple

from adxl_ros_validation.blind import simulator as sim
from adxl_ros_validation.blind.faults import KINDS, KNOWN
from adxl_ros_validation.blind.simulator import Fault, G0, Kind, Scene, Shape, Unit
import numpy as np
import scipy

KNOWN_KINDS = {name: KINDS[name] for name in KNOWN}
"""Kinds of this world that have a counterpart in the library."""
TEST_LEVEL = 0.05 / len(KNOWN)
"""Level of the test of one effect, so that the tests of all effects together have 5 %."""
INSEPARABLE_BELOW = 9.0
"""A rival is inseparable where its fit leaves less than this of the squared visibility.

These are three standard deviations; chosen.
"""
_NOISE_STD = 0.02
"""Uncertainty of the stated noise density, a share; that of units is 0.015."""
_DRAWN_FORMS = 6
"""Draws of the numbers of a kind that states no list for them. Chosen: run time."""
_DISTINCT = 1e-4
"""Smallest length of a unit vector beside others that still is another direction. Chosen: far
above rounding."""
_RECOGNISABLE_SAMPLE = 7.0
"""Squared visibility of one repeated sample; chosen."""

Forms = Mapping[str, Sequence[np.ndarray]]
"""Changes that span those of each effect, m/s², (m, n)."""


def beyond_calibration(unit: Unit, change: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Remove what zero-g and scale factor explain within two standard deviations of the file."""
    rest = np.empty_like(change)
    bounds = 2 * np.array([sim.ZERO_G_STD_G * G0, sim.SCALE_STD])
    for row, along, out in zip(change, force, rest):
        columns = np.stack([np.ones_like(along), along], axis=1)
        q, r = np.linalg.qr(columns)
        out[:] = row - columns @ scipy.optimize.lsq_linear(r, q.T @ row, (-bounds, bounds)).x
    return rest


def rms(values: np.ndarray) -> float:
    """Return the rms over samples and axes."""
    return float(np.sqrt(np.mean(values**2)))


def line(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return zero and slope of a straight line by least squares."""
    return np.linalg.lstsq(np.column_stack([np.ones_like(x), x]), y, rcond=None)[0]


def _spectrum(unit: Unit, count: int) -> np.ndarray:
    """Return the one-sided spectrum of a recording without faults, (m/s²)²/Hz, (m, f)."""
    rate = unit.rate_hz
    f = np.fft.rfftfreq(count, 1 / rate)
    f[0] = f[1]
    power = np.zeros((len(unit.axes), len(f)))
    for fold in range(-8, 9):
        power += unit.noise_g_per_rthz[:, None] ** 2 / (
            1 + ((f + fold * rate) / unit.corner_hz) ** 2
        )
    w = 2 * np.pi * f
    power += 2 * (unit.walk_g_per_rts[:, None] / w) ** 2
    lags = 0.1 * 10 ** np.arange(0.5, math.log10(20 * count / rate), 0.5)
    power += unit.flicker_g[:, None] ** 2 * sum(4 * lag / (1 + (w * lag) ** 2) for lag in lags)
    # The rounding of the encoder stays for the length of a pose; that of the ADC is white.
    power += unit.resolution_rad**2 / 24 * 4 * 2.0 / (1 + (w * 2.0) ** 2)
    power += ((sim.LSB_V / unit.scale_v_per_g) ** 2 / 12 * 2 / rate)[:, None]
    return G0**2 * power


class IdealObserver:
    """
    It knows the form of every effect and the noise, and the calibration as far as it is stated.

    Its vectors are whitened responses, axis after axis, with a row for each stated value. Sums of
    their squares are twice a log likelihood ratio.
    """

    def __init__(self, scene: Scene, known: Mapping[str, Kind] = KNOWN_KINDS) -> None:
        """
        Prepare for the recordings of a scene.

        known: the kinds that could be the cause, by name, in the forms of the world.
        """
        self.scene, self.known = scene, known
        self.force = scene.force()
        self.axes, self.count = self.force.shape
        self.weight = 1 / np.sqrt(_spectrum(scene.unit, self.count) * scene.unit.rate_hz / 2)
        stage_error = sim.STAGE_STD * scene.unit.resolution_rad
        # What is stated only to its standard deviation: the stage, zero-g and scale factor.
        stated = [
            (scene.response([Fault(KINDS[name], stage_error, {'w': row})], coarse=True), 1.0)
            for name, count in (('stage_offset', 2), ('stage_eccentricity', 4))
            for row in np.eye(count)
        ]
        self.state(stated, np.ones(self.count))

    def state(self, stated: list[tuple[np.ndarray, float]], offset: np.ndarray) -> None:
        """
        Take as known to a standard deviation only: some changes, m/s², zero-g and scale factor.

        offset: what 1 m/s² of zero-g changes, m/s², (n,).
        """
        for d in range(self.axes):
            stated.append((self.of_axis(d, offset), sim.ZERO_G_STD_G * G0))
            stated.append((self.of_axis(d, self.force[d]), sim.SCALE_STD))
        self._take(stated)

    def _take(self, stated: list[tuple[np.ndarray, float]]) -> None:
        """Take some changes as known to a standard deviation only."""
        self._stated_changes, self._no_prior = stated, np.zeros(len(stated))
        priors = np.diag([1 / std for _, std in stated])
        rows = [
            np.concatenate([self._white_spectrum(change), prior])
            for (change, _), prior in zip(stated, priors)
        ]
        self.stated = np.linalg.qr(np.stack(rows, axis=1))[0]

    def less_certain(self, tolerated: Iterable[tuple[np.ndarray, float]]) -> IdealObserver:
        """Return the observer to whom further changes are known to a standard deviation only."""
        other = copy(self)
        other._take([*self._stated_changes, *tolerated])
        return other

    def of_axis(self, d: int, row: np.ndarray) -> np.ndarray:
        """Return a change of one axis only, m/s², (m, n)."""
        rows = np.zeros_like(self.force)
        rows[d] = row
        return rows

    def whiten(self, change: np.ndarray) -> np.ndarray:
        """Whiten a change, m/s², (m, n), into one vector."""
        return np.fft.irfft(np.fft.rfft(change) * self.weight, self.count).ravel()

    def _white_spectrum(self, change: np.ndarray) -> np.ndarray:
        """Return the real and imaginary parts of a whitened spectrum, with the same products."""
        # Each frequency but the first and the last stands for itself and its negative.
        frequencies = np.arange(self.weight.shape[1])
        scale = self.weight * np.sqrt((2 - (frequencies * 2 % self.count == 0)) / self.count)
        white = np.zeros(scale.shape, complex)
        for d in np.flatnonzero(change.any(axis=1)):
            white[d] = np.fft.rfft(change[d]) * scale[d]
        return white.view(float).ravel()

    def project(self, change: np.ndarray) -> np.ndarray:
        """Whiten a change and remove what the uncertainty of the calibration explains."""
        vector = np.concatenate([self._white_spectrum(change), self._no_prior])
        return vector - self.stated @ (self.stated.T @ vector)

    def forms(self) -> dict[str, list[np.ndarray]]:
        """Return changes that span those of each effect that is not like noise, m/s², (m, n)."""
        forms = {}
        for name, kind in self.known.items():
            if kind.random:
                continue
            changes = [
                self.scene.response([Fault(kind, multiple * kind.start, shape)], True)
                for shape in _forms(kind, self.scene.unit)
                for multiple in kind.sizes
            ]
            if kind.per_axis:
                changes = [
                    self.of_axis(d, change[d])
                    for change in changes
                    for d in range(self.axes)
                    if change[d].any()
                ]
            forms[name] = changes
        return forms

    def rivals(self) -> dict[str, np.ndarray]:
        """Return columns that span the responses of each effect that is not like noise, (v, k)."""
        return {
            name: self.span([self.project(change) for change in changes])
            for name, changes in self.forms().items()
        }

    def span(self, vectors: list[np.ndarray]) -> np.ndarray:
        """Return orthonormal columns that span some vectors, (v, k)."""
        return _orthonormal(vectors, self.stated.shape[0])

    def flexible_power(self, reserved: np.ndarray, vector: np.ndarray) -> float:
        """
        Return the power of a flexible model of force, rate, angle, temperature and time.

        The level of its test is 0.001.
        """
        scene, explained, used = self.scene, 0.0, 0
        rest = vector - reserved @ (reserved.T @ vector)
        hats = _hats(scene, self.force)
        for d in range(self.axes):
            columns = [self.project(self.of_axis(d, hat)) for hat in hats]
            basis = _orthonormal(
                [column - reserved @ (reserved.T @ column) for column in columns], len(rest)
            )
            explained += float(np.sum((basis.T @ rest) ** 2))
            used += basis.shape[1]
        threshold = scipy.stats.chi2.isf(0.001, used)
        return float(scipy.stats.ncx2.sf(threshold, used, explained))


def _forms(kind: Kind, unit: Unit) -> list[Shape]:
    """Return shapes whose responses span those of a kind; numbers without a list are drawn."""
    shapes = kind.spread(unit)
    rng = np.random.default_rng(0)
    drawn = [kind.draw(rng, unit) for _ in range(_DRAWN_FORMS)]
    if not any(drawn[0].keys() - shape.keys() for shape in shapes):
        return shapes
    return [{**numbers, **shape} for shape in shapes for numbers in drawn]


def _orthonormal(columns: list[np.ndarray], length: int) -> np.ndarray:
    """Return an orthonormal basis of the span of columns of any size, (length, k)."""
    sizes = [float(np.linalg.norm(column)) for column in columns]
    kept = [column / size for column, size in zip(columns, sizes) if size > 1e-6]
    if not kept:
        return np.zeros((length, 0))
    return _basis(np.stack(kept, axis=1))


def _basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of columns of length 1, or of what others left of them."""
    squares, vectors = np.linalg.eigh(columns.T @ columns)
    kept = squares > _DISTINCT**2
    return columns @ (vectors[:, kept] / np.sqrt(squares[kept]))


def _hats(scene: Scene, force: np.ndarray) -> list[np.ndarray]:
    """Return the hat functions of the flexible model, (n,) each."""
    t, measured = scene.stamps(), scene.references()
    rates = [np.gradient(scene.manoeuvre.joints(t)[name], t) for name in ('alpha', 'beta')]
    over = [(along, 7) for along in force] + [(np.tanh(2 * rate), 5) for rate in rates]
    over += [
        (np.sin(measured['beta_rad']), 5),
        (np.cos(measured['beta_rad']), 5),
        (measured['temperature_c'], 4),
        (t, 8),
    ]
    hats = []
    for values, count in over:
        centres = np.linspace(values.min(), values.max(), count)
        width = max(centres[1] - centres[0], 1e-9)
        hats += [np.clip(1 - np.abs(values - centre) / width, 0, None) for centre in centres]
    return hats


def power(strength: float) -> float:
    """Return the probability that a change of a squared visibility is detected."""
    return float(scipy.stats.ncx2.sf(scipy.stats.chi2.isf(TEST_LEVEL, 1), 1, strength))


def separation_probability(strength: float) -> float:
    """Return the probability that the truth beats a rival that leaves a squared visibility."""
    return float(scipy.stats.norm.cdf(0.5 * math.sqrt(max(strength, 0.0))))


class Bracket(NamedTuple):
    """Bounds of the probability with which an ideal observer names the truth."""

    low: float
    high: float


def bracket(distances: Iterable[float]) -> Bracket:
    """
    Return the bounds by how far the truth is from each rival, whitened.

    Two hypotheses at a distance d are confused with the probability Φ(-d/2). All of them together
    are at most the sum of the single ones, and no more is told than about the nearest rival.
    """
    confused = scipy.special.ndtr(-np.array([*distances]) / 2)
    return Bracket(max(1 - float(confused.sum()), 0.0), 1 - float(confused.max()))


class Told(NamedTuple):
    """How probably an ideal observer names all causes."""

    exactly: Bracket
    in_set: Bracket  # Whether it sees them at all, so that it may name all rivals, too


Rivals = Mapping[str, Sequence[np.ndarray]]
"""Columns that span the responses of each effect, in sets of which one is the best, (v, k)."""


def told_apart(
    observer: IdealObserver,
    faults: Sequence[Fault],
    changes: Sequence[np.ndarray],
    library: Rivals | None = None,
) -> Told:
    """
    Return how probably the observer names all of some faults, by what each changes, m/s².

    library: other forms of the effects, in place of the world's; the truth has such a form, too.
    """
    if library is None:
        rivals: Rivals = {name: [columns] for name, columns in observer.rivals().items()}
    else:
        rivals = library
    distances, from_none = list[float](), list[float]()
    for fault, change in zip(faults, changes):
        name = fault.kind.name
        if fault.kind.random:
            seen = [math.sqrt(noise_visibility(observer, fault.kind, change))]
        else:
            # The other causes are there in any case; one, or none, is in place of this one.
            beside = [np.zeros((observer.stated.shape[0], 0))]
            for other in faults:
                if other is not fault:
                    beside += rivals.get(other.kind.name, ())
            seen = _distances(
                observer.project(change),
                np.hstack(beside),
                [sets for rival, sets in rivals.items() if rival != name],
                None if library is None else rivals.get(name),
            )
        distances += seen
        from_none.append(seen[0])
    return Told(bracket(distances), bracket(from_none))


def _distances(
    vector: np.ndarray,
    beside: np.ndarray,
    rivals: Sequence[Sequence[np.ndarray]],
    own: Sequence[np.ndarray] | None,
) -> list[float]:
    """
    Return how far a vector is from no cause, and from each rival, beside others.

    Where the truth has another form, `own`, which leaves r₀ of the vector, and a rival leaves rⱼ,
    the likelihood ratio is normal with the mean (rⱼ² - r₀²)/2 and the deviation |rⱼ - r₀|. Twice
    their ratio is the distance.
    """
    fixed = _basis(beside)
    rest = vector - fixed @ (fixed.T @ vector)

    def left_by(sets: Sequence[np.ndarray]) -> np.ndarray:
        bases = [_basis(columns - fixed @ (fixed.T @ columns)) for columns in sets]
        return min((rest - basis @ (basis.T @ rest) for basis in bases), key=np.linalg.norm)

    by_truth = np.zeros_like(rest) if own is None else left_by(own)

    def distance(left: np.ndarray) -> float:
        apart = max(float(np.linalg.norm(left - by_truth)), _DISTINCT)
        return float(left @ left - by_truth @ by_truth) / apart

    return [distance(rest), *(distance(left_by(sets)) for sets in rivals)]


def alone(observer: IdealObserver, forms: Forms, strength_mps2: float) -> Bracket:
    """Return how probably no cause is told from effects of a strength in their nearest forms."""
    distances = []
    for changes in filter(None, forms.values()):
        per_mps2 = [
            float(np.linalg.norm(observer.project(change)))
            / max(rms(beyond_calibration(observer.scene.unit, change, observer.force)), 1e-12)
            for change in changes
        ]
        distances.append(strength_mps2 * min(per_mps2))
    return bracket(distances)


def noise_visibility(observer: IdealObserver, kind: Kind, change: np.ndarray) -> float:
    """
    Return the squared visibility of a fault that differs from run to run.

    It follows from the spectrum (Whittle), with an uncertainty of the stated noise of 2 %. Spikes
    also show one by one, and repeated or missing codes by their number.
    """
    if kind.name == 'mains_hum':
        return float(np.sum(observer.project(change) ** 2))
    white = observer.weight**2 * np.abs(np.fft.rfft(change)) ** 2 / observer.count
    excess = np.stack([_smooth(row) for row in white])[:, 1:]
    visibility = sum(_whittle(row) for row in excess)
    if kind.name == 'spikes':
        samples = (observer.whiten(change)) ** 2
        outstanding = np.clip(samples - 2 * math.log(samples.size), 0, None)
        visibility = max(visibility, float(np.sum(outstanding)))
    elif kind.name == 'stuck':
        repeated = np.count_nonzero(np.any(np.abs(change) > 0, axis=0))
        visibility = max(visibility, _RECOGNISABLE_SAMPLE * repeated)
    elif kind.name == 'quantisation' and np.abs(change).max() > 2 * G0 * sim.LSB_V:
        visibility = max(visibility, float(observer.count))
    return float(visibility)


def _smooth(power: np.ndarray) -> np.ndarray:
    """Average over bands that widen with frequency."""
    edges = np.unique(np.geomspace(1, len(power), 60).astype(int))
    means = np.add.reduceat(power, edges[:-1])[: len(edges) - 1] / np.diff(edges)
    return np.concatenate([power[:1], np.repeat(means, np.diff(edges))])


def _whittle(excess: np.ndarray) -> float:
    """Return the squared visibility of an excess of the spectrum by the Whittle likelihood."""

    def misfit(level: float) -> float:
        ratio = (1 + excess) / (1 + level)
        return float(2 * np.sum(ratio - 1 - np.log(ratio)) + (level / (2 * _NOISE_STD)) ** 2)

    return scipy.optimize.minimize_scalar(misfit, bounds=(-0.2, 0.2), method='bounded').fun
