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

"""The diagnosis as a whole, as a library call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from adxl_ros.diagnose import (
    data_checks,
    decision,
    model_discrepancy,
    model_search,
    noise_detectors,
)
from adxl_ros.diagnose.baseline_comparison import Series, series_of, thinned
from adxl_ros.diagnose.data_checks import Fault
from adxl_ros.diagnose.decision import Verdict
from adxl_ros.diagnose.gap_closure import held_out, Shrunk, shrunk
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.linear_model import FOLLOWED, STRAIGHT, study, TOLERANCE
from adxl_ros.diagnose.next_experiment import Next, proposed
from adxl_ros.diagnose.noise_comparison import Likeness, likeness
from adxl_ros.diagnose.noise_detectors import Sign
from adxl_ros.diagnose.noise_floor import Floor, floor
from adxl_ros.diagnose.noise_whitening import DRIFTS, drifts_among
from adxl_ros.diagnose.residual_map import Cell, covered, map_of
from adxl_ros.diagnose.single_effect_scores import Score, scores
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_unit import check_unit
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.simulate.motion import Motion
import numpy as np


@dataclass(frozen=True)
class Diagnosis:
    """
    All that was found.

    Attributes
    ----------
    fault
        Of the recording; then there is nothing else.
    series, used
        The recordings at the rate of the search, and the samples that count.
    verdict, hypotheses
        The answer, and what was weighed.
    contributions
        What each effect of the verdict's hypothesis makes, rms m/s².
    scores
        Of each effect alone, on tangents.
    alike
        Recorded noise by simulated noise, recording by recording, before and after.
    sensor
        The baseline with what was found, ready for `simulate`.

    """

    fault: Fault | None
    series: list[Series]
    used: list[np.ndarray]
    floor: Floor | None = None
    verdict: Verdict | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    signs: tuple[Sign, ...] = ()
    shrunk: Shrunk | None = None
    cells: tuple[Cell, ...] = ()
    missing: tuple[str, ...] = ()
    proposal: Next | None = None
    contributions: dict[str, float] = field(default_factory=dict)
    scores: dict[str, Score] = field(default_factory=dict)
    alike: tuple[tuple[Likeness, ...], tuple[Likeness, ...]] = ((), ())
    sensor: Sensor | None = None


def diagnose(recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None,
             seed: int = 0, show: Callable[[float], None] = lambda done: None) -> Diagnosis:
    """
    Compare recordings of one unit with the simulator, and find what the simulator lacks.

    Parameters
    ----------
    recordings
        Read as a whole.
    sensor
        The baseline: stated figures and modelled effects.
    sim
        Specific force by another simulator, in place of the stage.
    seed
        Of bootstraps.
    show
        Takes the fraction that is done.

    Raises
    ------
    UserError
        A recording is of another unit, or its reference cannot be followed.

    """
    if not sensor.effects:
        sensor = with_axes(sensor, recordings[0].axes)
    full, series, counted, used = [], [], [], []
    signs: list[Sign] = []
    alone: list[Sign | None] = []
    for read in recordings:
        check_unit(read.stream_info, read.axes, sensor)
        one = series_of(read, replace(sensor, rate_hz=read.rate_hz), sim)
        thin = thinned(one)
        fault = data_checks.look(one, thin)
        if fault is not None:
            return Diagnosis(fault, [one], [np.ones(len(one), bool)])
        coarse = noise_detectors.coarse_steps(one.volts, sensor)
        if coarse is not None:
            signs.append(coarse)
            bits = round(sensor.adc_bits - float(coarse.values['lost_bits']))
            one, thin = (replace(s, sensor=replace(s.sensor, adc_bits=bits)) for s in (one, thin))
        good, of_samples = noise_detectors.bad_samples(one.volts, one.time_s, one.sensor,
                                                       coarse is not None)
        full.append(one)
        series.append(thin)
        counted.append(good)
        used.append(good[::round(one.sensor.rate_hz / thin.sensor.rate_hz)])
        signs += [sign for sign in of_samples if sign.effect != 'spikes']
        alone.append(next((sign for sign in of_samples if sign.effect == 'spikes'), None))
    show(0.05)
    weighed = study(series, used, lambda done: show(0.05 + 0.25 * done))
    base = floor(full, counted)
    noise_mps2 = float(np.sqrt(np.mean((base.noise_v / series[0].scale_v_per_mps2) ** 2)))
    found = decision.worthy(weighed, model_search.search(
        weighed, lambda done: show(0.3 + 0.4 * done)), noise_mps2)
    without = held_out(weighed, full, counted, (), series[0].sensor)
    found, far = _holding(found, lambda one: shrunk(weighed, full, counted, one, without, base,
                                                    seed))
    best = found[0]
    show(0.8)
    beside = model_discrepancy.discrepancy(weighed, best)
    instead = model_discrepancy.instead_of_drift(weighed, found)
    left = [one.residual(best.sensor) for one in full]
    for one, mask, off, spikes in zip(full, counted, left, alone):
        there = replace(best.sensor, rate_hz=one.sensor.rate_hz)
        if spikes is not None and noise_detectors.still_alone(spikes, off, mask, there):
            signs.append(spikes)
        signs += noise_detectors.of_residual(off, mask, replace(one, sensor=there))
    signs = list({sign.effect: sign for sign in sorted(signs, key=lambda s: s.nats)}.values())
    loud = _with_signs(best, signs, sensor)
    before = [one.residual(sensor) for one in full]
    alike = [tuple(likeness(one, off, mask, whole, seed)
                   for one, off, mask in zip(full, offs, counted))
             for offs, whole in ((before, sensor), (left, loud))]
    explained = float(np.sqrt(max(far.before_mps2 ** 2 - far.within_mps2 ** 2, 0.0)))
    as_noise = float(np.sqrt(np.mean([one.sigma_mps2 ** 2 for one in alike[1]])))
    answer = decision.judge(weighed, found, beside, instead, signs, noise_mps2, explained,
                            decision.left(weighed, best, far, as_noise))
    answer = _insufficient(answer, series)
    show(0.9)
    cells = map_of(series[0], series[0].residual(series[0].sensor), used[0], base.rms_mps2, seed)
    missing = covered(series)
    by_effect = scores(weighed, seed)
    show(1.0)
    return Diagnosis(None, series, used, base, answer, tuple(found), tuple(signs), far,
                     tuple(cells), tuple(missing), proposed(answer, missing, seed),
                     {effect: decision.contribution_mps2(weighed, answer.best, effect)
                      for effect in answer.best.effects}, by_effect, (alike[0], alike[1]),
                     sensor if answer.status in ('no_gap', 'unknown', 'insufficient') else loud)


def _holding(found: list[Hypothesis], compared: Callable[[Hypothesis], Shrunk]
             ) -> tuple[list[Hypothesis], Shrunk]:
    """
    Leave out what does not hold on stretches held out: it is not the cause.

    Zero-g, scale, filter and latency follow the recording within limits in any case, scale what
    gravity does. A drift may only take up what the form of the effects beside it lacks: it must
    predict more than they do.
    """
    known: dict[frozenset[str], Shrunk] = {}

    def of(one: Hypothesis) -> Shrunk:
        if (effects := frozenset(one.effects)) not in known:
            known[effects] = compared(one)
        return known[effects]

    while (effects := frozenset(found[0].effects)):
        far = of(found[0])
        steady = [one for one in found[1:] if 0 < len(one.effects) < len(effects)
                  and frozenset(one.effects) == effects - frozenset(DRIFTS)]
        if not far.harm and (far.predicted > 0 or effects <= set(FOLLOWED)) and not any(
                far.predicted - of(one).predicted < model_search.WORTH for one in steady):
            break
        found = found[1:]
    return found, of(found[0])


def _insufficient(answer: Verdict, series: Sequence[Series]) -> Verdict:
    """Take back "no gap" where nothing moves or warms: such a recording cannot say it."""
    if answer.status != 'no_gap':
        return answer
    for one in series:
        moved = one.reference == 'sim' or (one.reference == 'stage' and not one.still.all())
        around = [getattr(one.motion, name) for name in ('temperature_c', 'supply_v')]
        changed = any(path is not None and np.ptp(path(one.time_s)) > least
                      for path, least in zip(around, (1.0, 0.02)))
        if moved or changed:
            return answer
    return replace(answer, status='insufficient')


def _with_signs(best: Hypothesis, signs: Sequence[Sign], baseline: Sensor) -> Sensor:
    """Put the noise-like effects beside those of the mean, at the baseline's rate."""
    found = best.sensor
    # Filter and latency within their tolerance are not worth an effect. Where no effect of the
    # mean is named, nothing is; and where zero-g wandered here says nothing of the next recording.
    by_mean = any(effect_named(effect).acts_on is ActsOn.MEAN for effect in best.effects)
    wandered = {'bias'} if drifts_among(best.effects) else set()
    as_filed = (wandered if by_mean else set(TOLERANCE)) - set(best.effects)
    effects = [e for e in found.effects if e in (*baseline.effects, *best.effects)
               or e in set(STRAIGHT) - as_filed]
    values = {name: (baseline if name in as_filed else found).values[name] for name in effects}
    for sign in signs:
        if sign.effect != 'unknown':
            if sign.effect not in effects:
                effects.append(sign.effect)
            values[sign.effect] = sign.values
    known = [i for i, name in enumerate(baseline.covariance_names)
             if name.effect in effects]
    return replace(found, effects=tuple(effects), values=values, rate_hz=baseline.rate_hz,
                   adc_bits=baseline.adc_bits,
                   covariance=baseline.covariance[np.ix_(known, known)],
                   covariance_names=tuple(baseline.covariance_names[i] for i in known))
