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

"""
Faults of the recording itself, before anything else: axes, units, clocks, what is missing.

A swapped or inverted axis is the commonest gap of all; it must be called what it is.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.diagnose.baseline_comparison import Series
import numpy as np

SHORTEST_S = 30.0
_LEAST_MOTION_G = 0.05
_LEAST_MOVED_G = 0.3
_ALIKE = 0.9
_WORST_MISSING = 0.3
_LEAST_GAIN = 0.5
_SEARCH_S = 1.0
_GAP = 20.0
_RATIOS = {9.80665: 'g instead of m/s²', 1e3: 'mV instead of V', 1e-3: 'kV instead of V',
           1 / 9.80665: 'm/s² instead of g'}


@dataclass(frozen=True)
class Fault:
    """What is wrong: its name in the report, the status that follows, and words."""

    name: str
    status: str
    words: str


def look(series: Series, thin: Series) -> Fault | None:
    """
    Find what makes a diagnosis of effects meaningless.

    Parameters
    ----------
    series, thin
        The recording at its full rate, and at the search's.

    """
    span_s = float(series.time_s[-1] - series.time_s[0])
    if (span_s < SHORTEST_S and series.reference != 'rest') or len(series) < 50:
        return Fault('too_short', 'insufficient',
                     f'{span_s:.3g} s are too short for a verdict; record a minute at least')
    finite = np.isfinite(series.volts).all(axis=1)
    if finite.mean() < 1 - _WORST_MISSING:
        return Fault('missing', 'bad_data', f'{100 * (1 - finite.mean()):.0f} % of the samples '
                     'are not numbers; record again')
    clock = _clock(series)
    if clock is not None:
        return clock
    railed = _railed(series, finite)
    if railed > _WORST_MISSING:
        return Fault('saturated', 'bad_data', f'{100 * railed:.0f} % of the '
                     'samples are at the end of the range; check supply, range and wiring')
    if series.reference == 'rest':
        return _moved(series, finite)
    return _axes(thin, np.isfinite(thin.volts).all(axis=1))


def _moved(series: Series, finite: np.ndarray) -> Fault | None:
    """Tell a sensor that moves while no reference says how."""
    g = series.volts[finite] / series.sensor.scale_v_per_g
    step = np.std(np.diff(g, axis=0), axis=0)
    spread = np.quantile(g, 0.98, axis=0) - np.quantile(g, 0.02, axis=0)
    worst = int(np.argmax(spread))
    if spread[worst] < _LEAST_MOVED_G or step[worst] > spread[worst]:
        return None
    angles = 'its stage angles do not change' if 'alpha_rad' in series.columns else \
        'it has no stage angles'
    return Fault('reference', 'bad_data', f'{series.sensor.axes[worst]} moves by '
                 f'{spread[worst]:.2f} g, but {angles}; give the angles, or --sim with the '
                 'specific force of the same manoeuvre')


def _clock(series: Series) -> Fault | None:
    step = np.diff(series.time_s)
    usual = float(np.median(step))
    back = np.flatnonzero(step <= 0)
    if len(back):
        return Fault('clock_jump', 'bad_data', f'the stamps run backwards at '
                     f'{series.time_s[back[0]]:.6g} s; record again with a steady clock')
    wide = np.flatnonzero(step > _GAP * usual)
    if len(wide) and float(step[wide].sum()) > 0.2 * float(step.sum()):
        return Fault('clock_jump', 'bad_data', f'the stamps jump by {step[wide].max():.3g} s at '
                     f'{series.time_s[wide[0]]:.6g} s; cut the recording there')
    return None


def _railed(series: Series, finite: np.ndarray) -> float:
    """Return the share of samples at an extreme value of their axis that many samples share."""
    worst = 0.0
    for v in series.volts[finite].T:
        for end in (v.max(), v.min()):
            share = float(np.mean(np.abs(v - end) < max(series.sensor.lsb_v, 1e-9) / 2))
            worst = max(worst, share if share > 0.05 and np.ptp(v) > 0.05 else 0.0)
    return worst


def _axes(series: Series, finite: np.ndarray) -> Fault | None:
    """Compare the axes with the force that the reference promises: order, sign, unit, time."""
    sensor = series.sensor
    base = series.simulated(sensor)
    promised = (base - base.mean(axis=0)) / sensor.scale_v_per_g
    seen = (series.volts - series.volts[finite].mean(axis=0)) / sensor.scale_v_per_g
    moving = promised.std(axis=0) > _LEAST_MOTION_G
    if not moving.any():
        return None
    late = _late(series, promised, seen, finite)
    if late is not None:
        return late
    axes = np.flatnonzero(moving)
    alike = np.array([[_correlation(seen[finite, d], promised[finite, c]) for c in axes]
                      for d in axes])
    for i, d in enumerate(axes):
        if alike[i, i] < -_ALIKE:
            return Fault('axis_inverted', 'bad_data', f'{sensor.axes[d]} reads against the '
                         f'reference (correlation {alike[i, i]:.2f}): the axis is inverted; '
                         'correct its sign or the mounting')
        best = int(np.argmax(np.abs(alike[i])))
        if best != i and abs(alike[i, best]) > _ALIKE > 2 * abs(alike[i, i]) - 0.5:
            sign = 'against' if alike[i, best] < 0 else 'with'
            return Fault('axis_swapped', 'bad_data', f'{sensor.axes[d]} moves {sign} the '
                         f'reference of {sensor.axes[axes[best]]} (correlation '
                         f'{alike[i, best]:.2f}): axes are swapped; correct the wiring or '
                         'the mounting')
    gains = [float(np.polyfit(promised[finite, d], seen[finite, d], 1)[0])
             for i, d in enumerate(axes) if alike[i, i] > _ALIKE]
    for ratio, words in _RATIOS.items():
        if gains and abs(np.log(np.median(gains) / ratio)) < 0.1:
            return Fault('unit', 'bad_data', f'the output is {np.median(gains):.4g} times what '
                         f'the reference promises: {words}; correct the unit of the columns')
    if len(axes) and np.max(np.abs(alike)) < _LEAST_GAIN:
        return Fault('reference', 'bad_data', 'the output does not follow the reference at all '
                     f'(correlation {np.max(np.abs(alike)):.2f}): they belong to different '
                     'recordings, or are further apart in time than 30 s')
    return None


def _late(series: Series, promised: np.ndarray, seen: np.ndarray, finite: np.ndarray
          ) -> Fault | None:
    """Tell a sensor that is later than the search's range, by cross-correlation."""
    rate = series.sensor.rate_hz
    most = min(round(30 * rate), len(promised) // 3)
    best, at = 0.0, 0
    here = 0.0
    for d in range(promised.shape[1]):
        a = promised[:, d]
        b = np.where(finite, seen[:, d], 0.0)
        size = 2 ** int(np.ceil(np.log2(2 * len(a))))
        across = np.fft.irfft(np.fft.rfft(b, size) * np.conj(np.fft.rfft(a, size)), size)
        norm = np.sqrt(np.sum(a * a) * np.sum(b * b)) + 1e-12
        lags = np.concatenate([across[-most:], across[:most + 1]]) / norm
        if lags.max() > best:
            best, at = float(lags.max()), int(np.argmax(lags)) - most
            here = float(across[0] / norm)
    if best > _ALIKE and best - here > 0.05 and abs(at) / rate > _SEARCH_S:
        return Fault('time_misaligned', 'bad_data', f'the sensor is {at / rate:+.2f} s late of '
                     'the reference, beyond the 1 s that are searched; shift its stamps')
    return None


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    with np.errstate(all='ignore'):
        return float(np.nan_to_num(np.corrcoef(a, b)[0, 1]))
