# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What an ideal observer of this world could see: power, and what cannot be told apart."""

from __future__ import annotations

from dataclasses import dataclass
import math

from adxl_ros.blind.world.chain import FINE_HZ, LSB, references, render, stamps
from adxl_ros.blind.world.fault_table import Fault, Kind, KINDS, KNOWN
from adxl_ros.blind.world.motion import Manoeuvre
from adxl_ros.blind.world.unit import G0, SCALE_SD, STAGE_SD, Unit, ZERO_SD_G
import numpy as np
from scipy.optimize import lsq_linear, minimize_scalar
from scipy.stats import chi2, ncx2, norm

# Of the observer's test of one effect, so that all of the library together err in 5 %.
LEVEL = 0.05 / len(KNOWN)
# Rivals whose fit leaves less than three standard deviations of the truth are not told apart.
LEFT = 9.0
_COARSE_HZ = 400.0
_NOISE_SD = 0.02


@dataclass(frozen=True)
class Scene:
    """A unit in a manoeuvre; forces and spectra on the sample grid."""

    unit: Unit
    manoeuvre: Manoeuvre
    seed: int

    def response(self, faults: list[Fault], coarse: bool = False) -> np.ndarray:
        """Give what faults change, (axes, n) m/s^2 as the user converts."""
        noise = any(fault.kind.random for fault in faults)
        fine = _COARSE_HZ if coarse else FINE_HZ
        with_faults, without = (render(self.unit, self.manoeuvre, some, self.seed, noise=noise,
                                       fine_hz=fine) for some in (faults, []))
        return (with_faults - without) * self.unit.volts_to_mps2

    def force(self) -> np.ndarray:
        """Give each axis's own specific force without faults, (axes, n) m/s^2."""
        volts = render(self.unit, self.manoeuvre, [], self.seed, noise=False)
        return (volts - self.unit.zero_v[:, None]) * self.unit.volts_to_mps2


def beyond_calibration(unit: Unit, change: np.ndarray, force: np.ndarray) -> np.ndarray:
    """
    Take off what zero-g and scale account for within two standard deviations of the file.

    Both arrays, and what is returned, are (axes, n) m/s^2.
    """
    left = np.empty_like(change)
    for row, own, out in zip(change, force, left):
        columns = np.stack([np.ones_like(own), own], axis=1)
        q, r = np.linalg.qr(columns)
        most = 2 * np.array([ZERO_SD_G * G0, SCALE_SD])
        out[:] = row - columns @ lsq_linear(r, q.T @ row, (-most, most)).x
    return left


def rms(values: np.ndarray) -> float:
    """Give the rms over samples and axes."""
    return float(np.sqrt(np.mean(values ** 2)))


def _spectrum(unit: Unit, count: int) -> np.ndarray:
    """Give the one-sided spectrum of a fault-free recording, (axes, f) (m/s^2)^2/Hz."""
    rate = unit.rate_hz
    f = np.fft.rfftfreq(count, 1 / rate)
    f[0] = f[1]
    power = np.zeros((len(unit.axes), len(f)))
    for fold in range(-8, 9):
        power += unit.noise_g_per_rthz[:, None] ** 2 / (
            1 + ((f + fold * rate) / unit.corner_hz) ** 2)
    w = 2 * np.pi * f
    power += 2 * (unit.walk_g_per_rts[:, None] / w) ** 2
    lags = 0.1 * 10 ** np.arange(0.5, math.log10(20 * count / rate), 0.5)
    power += unit.flicker_g[:, None] ** 2 * sum(4 * lag / (1 + (w * lag) ** 2) for lag in lags)
    # An encoder's rounding stays for a pose's length; the ADC's is white.
    power += unit.resolution_rad ** 2 / 24 * 4 * 2.0 / (1 + (w * 2.0) ** 2)
    power += ((LSB / unit.scale_v_per_g) ** 2 / 12 * 2 / rate)[:, None]
    return G0 ** 2 * power


class Eye:
    """
    The ideal observer: knows every form and the noise, and the calibration as far as stated.

    Vectors are whitened responses, axis after axis, with a row for each stated figure, so that
    sums of squares are log likelihood ratios (twice).
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.force = scene.force()
        self.axes, self.count = self.force.shape
        self.weight = 1 / np.sqrt(_spectrum(scene.unit, self.count) * scene.unit.rate_hz / 2)
        stated = []
        for i, change in enumerate(self._stage()):
            prior = np.zeros(2 * self.axes + 6)
            prior[2 * self.axes + i] = 1.0
            stated.append(np.concatenate([self.whiten(change), prior]))
        for d in range(self.axes):
            for what, sd in ((np.ones_like(self.force[d]), ZERO_SD_G * G0),
                             (self.force[d], SCALE_SD)):
                rows = np.zeros_like(self.force)
                rows[d] = what
                prior = np.zeros(2 * self.axes + 6)
                prior[len(stated) - 6] = 1 / sd
                stated.append(np.concatenate([self.whiten(rows), prior]))
        self.stated = np.linalg.qr(np.stack(stated, axis=1))[0]

    def _stage(self) -> list[np.ndarray]:
        """Give what each error of the stage changes, at its standard deviation."""
        unit = self.scene.unit
        size = STAGE_SD * unit.resolution_rad
        sets = [('stage_offset', [0]), ('stage_eccentricity', [2]), ('stage_eccentricity', [3]),
                ('stage_offset', [1]), ('stage_eccentricity', [0]), ('stage_eccentricity', [1])]
        return [self.scene.response([Fault(KINDS[name], size, {
            'w': np.isin(np.arange(4), which).astype(float)})], coarse=True)
            for name, which in sets]

    def whiten(self, change: np.ndarray) -> np.ndarray:
        """Whiten (axes, n) m/s^2 into one vector."""
        return np.fft.irfft(np.fft.rfft(change) * self.weight, self.count).ravel()

    def seen(self, change: np.ndarray) -> np.ndarray:
        """Whiten a change and take off what the stated calibration may account for."""
        vector = np.concatenate([self.whiten(change), np.zeros(2 * self.axes + 6)])
        return vector - self.stated @ (self.stated.T @ vector)

    def responses(self) -> dict[str, list[np.ndarray]]:
        """Give the responses of every effect of the mean, (axes, n) m/s^2 each."""
        out = {}
        for name in KNOWN:
            kind = KINDS[name]
            if not kind.random or name == 'adc_inl':
                out[name] = [part for shape in kind.spread(self.scene.unit)
                             for times in kind.sizes
                             for part in _parts(kind, self.scene.response(
                                 [Fault(kind, times * kind.start, shape)], coarse=True))]
        return out

    def span(self, responses: list[np.ndarray]) -> np.ndarray:
        """Span whitened responses by orthonormal columns."""
        return _orthonormal([self.seen(change) for change in responses], self.stated.shape[0])

    def plain_choices(self, residual: np.ndarray,
                      responses: dict[str, list[np.ndarray]]) -> dict[str, str]:
        """
        Choose an effect as is often done: by smallest RMSE, and by BIC as if noise were white.

        Parameters
        ----------
        residual
            Recording less simulator, (axes, n) m/s^2; zero-g and scale are refitted freely.
        responses
            Of every effect, in this world's own forms: more than a user has.

        Returns
        -------
        dict
            By `rmse` and `bic` the name of an effect; empty for none.

        """
        axes = range(self.axes)
        affine = _orthonormal([(what * (np.arange(self.axes) == d)[:, None]).ravel()
                               for what in (np.ones_like(self.force), self.force)
                               for d in axes], residual.size)

        def beyond(rows: np.ndarray) -> np.ndarray:
            return rows.ravel() - affine @ (affine.T @ rows.ravel())

        rest = beyond(residual)
        total, cost = float(rest @ rest), math.log(rest.size)
        squares, scores = {}, {'': rest.size * math.log(total)}
        for name, changes in responses.items():
            columns = _orthonormal([beyond(change) for change in changes], rest.size)
            squares[name] = total - float(np.sum((columns.T @ rest) ** 2))
            scores[name] = rest.size * math.log(squares[name]) + columns.shape[1] * cost
        return {'rmse': min(squares, key=squares.__getitem__),
                'bic': min(scores, key=scores.__getitem__)}

    def flexible(self, taken: np.ndarray, vector: np.ndarray) -> float:
        """
        Give the power of a flexible model of force, rate, way, temperature and time.

        Parameters
        ----------
        taken
            Orthonormal columns that the flexible model may not use.
        vector
            A whitened change.

        """
        scene, found, used = self.scene, 0.0, 0
        whole = vector - taken @ (taken.T @ vector)
        hats = _hats(scene, self.force)
        for d in range(self.axes):
            columns = []
            for hat in hats:
                rows = np.zeros_like(self.force)
                rows[d] = hat
                column = self.seen(rows)
                columns.append(column - taken @ (taken.T @ column))
            basis = _orthonormal(columns, len(whole))
            found += float(np.sum((basis.T @ whole) ** 2))
            used += basis.shape[1]
        return float(ncx2.sf(chi2.isf(0.001, used), used, found))


def _parts(kind: Kind, change: np.ndarray) -> list[np.ndarray]:
    if not kind.each:
        return [change]
    return [change * (np.arange(len(change)) == d)[:, None] for d in range(len(change))
            if change[d].any()]


def _orthonormal(columns: list[np.ndarray], length: int) -> np.ndarray:
    """Give an orthonormal basis, (length, k), of what columns of any size span."""
    sizes = [float(np.linalg.norm(column)) for column in columns]
    kept = [column / size for column, size in zip(columns, sizes) if size > 1e-6]
    if not kept:
        return np.zeros((length, 0))
    stack = np.stack(kept, axis=1)
    values, vectors = np.linalg.eigh(stack.T @ stack)
    good = values > 1e-8 * values[-1]
    return stack @ (vectors[:, good] / np.sqrt(values[good]))


def _hats(scene: Scene, force: np.ndarray) -> list[np.ndarray]:
    t = stamps(scene.unit, scene.manoeuvre)
    known = references(scene.unit, scene.manoeuvre, scene.seed)
    rates = [np.gradient(scene.manoeuvre.joints(t)[name], t) for name in ('alpha', 'beta')]
    over = [(own, 7) for own in force] + [(np.tanh(2 * rate), 5) for rate in rates]
    over += [(np.sin(known['beta_rad']), 5), (np.cos(known['beta_rad']), 5),
             (known['temperature_c'], 4), (t, 8)]
    hats = []
    for values, count in over:
        centres = np.linspace(values.min(), values.max(), count)
        width = max(centres[1] - centres[0], 1e-9)
        hats += [np.clip(1 - np.abs(values - centre) / width, 0, None) for centre in centres]
    return hats


def power(strength: float) -> float:
    """Give the chance that a change of this squared visibility is detected."""
    return float(ncx2.sf(chi2.isf(LEVEL, 1), 1, strength))


def told(strength: float) -> float:
    """Give the chance that the truth beats a rival which leaves this much of it."""
    return float(norm.cdf(0.5 * math.sqrt(max(strength, 0.0))))


def noise_visibility(eye: Eye, kind: Kind, change: np.ndarray) -> float:
    """
    Give the squared visibility of a fault that differs from run to run.

    By its spectrum (Whittle), where the stated noise is uncertain by 2 %; spikes also one by
    one, and repeated or missing codes by their number.
    """
    if kind.name in ('mains_hum', 'adc_inl'):
        return float(np.sum(eye.seen(change) ** 2))
    white = eye.weight ** 2 * np.abs(np.fft.rfft(change)) ** 2 / eye.count
    excess = np.stack([_smooth(row) for row in white])[:, 1:]
    out = sum(_whittle(row) for row in excess)
    if kind.name == 'spikes':
        single = (eye.whiten(change)) ** 2
        out = max(out, float(np.sum(np.clip(single - 2 * math.log(single.size), 0, None))))
    elif kind.name == 'stuck':
        out = max(out, 7.0 * np.count_nonzero(np.any(np.abs(change) > 0, axis=0)))
    elif kind.name == 'quantisation' and np.abs(change).max() > 2 * G0 * LSB:
        out = max(out, float(eye.count))
    return float(out)


def _smooth(power: np.ndarray) -> np.ndarray:
    """Average over bands that widen with frequency."""
    edges = np.unique(np.geomspace(1, len(power), 60).astype(int))
    means = np.add.reduceat(power, edges[:-1])[:len(edges) - 1] / np.diff(edges)
    return np.concatenate([power[:1], np.repeat(means, np.diff(edges))])


def _whittle(excess: np.ndarray) -> float:
    def off(level: float) -> float:
        ratio = (1 + excess) / (1 + level)
        return float(2 * np.sum(ratio - 1 - np.log(ratio)) + (level / (2 * _NOISE_SD)) ** 2)
    return minimize_scalar(off, bounds=(-0.2, 0.2), method='bounded').fun
