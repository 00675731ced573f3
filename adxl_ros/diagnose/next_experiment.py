# SPDX-License-Identifier: Apache-2.0
"""
The next experiment: what each manoeuvre is expected to tell, given the samples so far.

Each hypothesis has a posterior of its coefficients by the samples so far. The manoeuvre is
simulated with the baseline and goes through the same comparison as a recording, with the steps of
the encoder. Its sensitivities to the library then predict the response of each hypothesis. The
manoeuvre with the largest expected information per minute is proposed.

All hypotheses predict y = J·θ + e with white noise e of variance 1. They differ in what they know
of θ: mean m and covariance S. Only the products G = Jᵀ·J matter, so that the number of samples
does not.

The mutual information between hypothesis and data has no closed form. Pairwise Bhattacharyya
distances bound it from below (Kolchinsky and Tracey 2017, Entropy 19, 361, equation 10).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.comparison import at_search_rate, compare, Reference
from adxl_ros.diagnose.evidence import LinearFit
from adxl_ros.diagnose.linear_model import build_linear_model, LinearModel
from adxl_ros.diagnose.noise_effects import UNKNOWN
from adxl_ros.diagnose.noise_model import drifts_among
from adxl_ros.diagnose.verdict import Verdict, WeightedHypothesis
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.diagnosis_hints import FormDimension, Manoeuvre
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Coefficient, Effect
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate_blocks
import numpy as np


@dataclass(frozen=True)
class Belief:
    """What a hypothesis knows of k coefficients."""

    mean: np.ndarray  # Mean, (k,)
    root: np.ndarray  # Square root of the covariance, S = root·rootᵀ, (k, r)


def _distance(gram: np.ndarray, first: Belief, second: Belief) -> float:
    """Return the part of the Bhattacharyya distance that is not of one belief alone."""
    both = np.hstack([first.root, second.root]) / np.sqrt(2)
    difference = first.mean - second.mean
    projected = gram @ difference
    values, vectors = _eigen(both.T @ gram @ both)
    across = vectors.T @ (both.T @ projected)
    # Woodbury: (1 + J·S·Jᵀ)⁻¹ within the span of J.
    square = float(difference @ projected - np.sum(across ** 2 / (1 + values)))
    return max(square, 0.0) / 8 + 0.5 * float(np.log1p(values).sum())


def _log_det_of(gram: np.ndarray, belief: Belief) -> float:
    """Return the log determinant of the covariance of a prediction, in units of the noise."""
    return float(np.log1p(_eigen(belief.root.T @ gram @ belief.root)[0]).sum())


def _eigen(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues and vectors; 1 + products is singular in floats where one is huge."""
    values, vectors = np.linalg.eigh((products + products.T) / 2)
    return np.maximum(values, 0.0), vectors


def expected_information(gram: np.ndarray, probabilities: Sequence[float],
                         beliefs: Sequence[Belief], factor: float = 1.0) -> float:
    """
    Return a lower bound of the information that an experiment gives on the hypothesis.

    gram: products of the sensitivities, in units of the noise, (k, k).
    """
    weights = np.asarray(probabilities, float)
    count = len(weights)
    overlap = np.eye(count)
    # One each, not one for each pair.
    log_dets = [_log_det_of(gram, belief) for belief in beliefs]
    for i in range(count):
        for j in range(i):
            distance = factor * (_distance(gram, beliefs[i], beliefs[j])
                                 - 0.25 * (log_dets[i] + log_dets[j]))
            overlap[i, j] = overlap[j, i] = np.exp(-max(distance, 0.0))
    positive = weights > 0
    return max(float(-weights[positive] @ np.log((overlap @ weights)[positive])), 0.0)


def entropy(probabilities: Sequence[float]) -> float:
    """Return the entropy of probabilities, nat."""
    weights = np.asarray(probabilities, float)
    weights = weights[weights > 0]
    return float(-weights @ np.log(weights))


_RATE_HZ = 62.5
"""Sample rate of the simulated manoeuvres, Hz. Chosen: run time; a stage moves far slower."""
_SMALLEST_PROBABILITY = 1e-3
"""Probability below which a hypothesis does not lead the choice. Chosen: together they are far
below the 5 % that remain at the end."""
_MOST_HYPOTHESES = 40
"""Largest number of hypotheses that lead the choice. Chosen: run time."""
_UNKNOWN_G = 1e-3
"""Rms of an unknown function, g. Chosen: the middle of those of the diagnosis."""


_EVIDENCE_FACTOR = 0.3
"""Factor of the information, because no model of a sensor is exact (Miller and Dunson 2019)."""


class Experiment(Protocol):
    """A manoeuvre that can be recorded next."""

    @property
    def name(self) -> str:
        """Return its name."""

    @property
    def motion(self) -> Motion:
        """Return its motion."""

    @property
    def begin_s(self) -> float:
        """Return the time of its motion at which it begins, s."""

    @property
    def minutes(self) -> float:
        """Return its duration, min."""


class ColumnKey(NamedTuple):
    """A coefficient of one variant of an effect, or of a flexible function."""

    variant: tuple  # Effect, shape and step; dimension, channel and number of a flexible function
    name: Coefficient | None  # The coefficient; None of a flexible function


@dataclass(frozen=True)
class ManoeuvreWorth:
    """What a manoeuvre is expected to tell."""

    manoeuvre: Experiment  # The manoeuvre
    information: float  # Expected decrease of the entropy of the hypotheses, nat

    @property
    def per_minute(self) -> float:
        """Return the expected information per minute, nat/min."""
        return self.information / self.manoeuvre.minutes


@dataclass(frozen=True)
class PredictedResponse:
    """Products of the sensitivities of one manoeuvre."""

    manoeuvre: Experiment  # The manoeuvre
    linear_model: LinearModel  # Its linear model
    places: dict[ColumnKey, int]  # Place of each column
    gram: np.ndarray  # Products, in units of the noise, (k, k)

    @property
    def effects(self) -> set[str]:
        """Return the effects that the manoeuvre excites."""
        return {v.effect for v in self.linear_model.variants}


@dataclass(frozen=True)
class _Posterior:
    """What a hypothesis knows after the samples so far."""

    keys: tuple[ColumnKey, ...]  # Columns of its k coefficients
    mean: np.ndarray  # Their means, (k,)
    covariance: np.ndarray  # Their covariance, (k, k)
    unseen: tuple[str, ...] = ()  # Effects of the hypothesis about which only the prior is known
    dimensions: tuple[FormDimension, ...] = ()  # Dimensions in which it has an unknown function


@dataclass
class _Samples:
    """The linear model of the samples so far, and fits that hypotheses share."""

    linear_model: LinearModel
    null_fit: LinearFit
    best_variants: dict[str, int] = field(default_factory=dict)

    def best_variant(self, effect: str) -> int | None:
        """Return the variant of an effect that fits best; None where the samples show none."""
        if effect not in self.best_variants:
            model = self.linear_model
            numbers = [i for i, v in enumerate(model.variants)
                       if v.effect == effect and not v.limit_start]
            if not numbers:
                return None
            self.best_variants[effect] = max(
                numbers, key=lambda i: model.fit_variants([i], self.null_fit).log_evidence)
        return self.best_variants[effect]


def leading(hypotheses: Sequence[WeightedHypothesis]) -> tuple[WeightedHypothesis, ...]:
    """Return the hypotheses that lead the choice of a manoeuvre, by falling probability."""
    return tuple(h for h in hypotheses
                 if h.probability > _SMALLEST_PROBABILITY)[:_MOST_HYPOTHESES]


def unknown_dimensions(verdict: Verdict | None) -> tuple[FormDimension, ...]:
    """Return the dimensions in which something unknown may act, or the usual ones."""
    present = {d.value: d for d in FormDimension}
    where = tuple(present[d] for d in (verdict.rest_follows if verdict else ()) if d in present)
    return where or (FormDimension.FORCE, FormDimension.DIRECTION, FormDimension.RATE,
                     FormDimension.TIME)


def rank_responses(responses: Sequence[PredictedResponse],
                   hypotheses: Sequence[WeightedHypothesis], model: LinearModel | None,
                   dimensions: Sequence[FormDimension]
                   ) -> tuple[ManoeuvreWorth, ...]:
    """Rank manoeuvres by their expected information per minute."""
    samples = _Samples(model, model.fit_variants([])) if model else None
    leaders = leading(hypotheses)
    posteriors = [_posterior_of(h, samples, leaders, dimensions) for h in leaders]
    total = sum(h.probability for h in leaders)
    probabilities = [h.probability / total for h in leaders]
    worth = [ManoeuvreWorth(r.manoeuvre, expected_information(
        r.gram, probabilities, [_belief(p, r) for p in posteriors], _EVIDENCE_FACTOR))
        for r in responses]
    return tuple(sorted(worth, key=lambda w: -w.per_minute))


def predict(manoeuvre: Experiment, sensor: Sensor, effects: Sequence[str],
            dimensions: Sequence[FormDimension]) -> PredictedResponse:
    """Simulate a manoeuvre with the baseline, and multiply its whitened sensitivities."""
    at_rate = replace(sensor, rate_hz=min(sensor.rate_hz, _RATE_HZ))
    parts = list(simulate_blocks(at_rate, manoeuvre.motion, 0, manoeuvre.begin_s))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    time_s = columns.pop('time_s')
    comparison = at_search_rate(compare(Recording(manoeuvre.name, time_s, columns), at_rate))
    model = build_linear_model([comparison], only=effects)
    fit = model.fit_variants([])
    keys = _keys(model)
    places: dict[ColumnKey, int] = {}
    blocks = []
    for number, channel in enumerate(model.columns):
        functions = model.flexible_bases[0][number]
        scale = float(comparison.sensor.scale_v_per_g[number])
        of_channel = [(keys[c.number], c.values) for c in channel if c.number in keys]
        for dimension in (d for d in dimensions if d in functions):
            of_channel += [(ColumnKey((dimension, number, i), None), scale * _UNKNOWN_G * values)
                           for i, values in enumerate(functions[dimension].T)]
        whitener = model.filters_of(())[number][fit.filter_indices[number]]
        shown = np.array([v for _, v in of_channel]).T
        grams = evidence.whiten_channel(np.zeros(len(shown)), shown, np.arange(shown.shape[1]),
                                        comparison.used, [whitener], by_block=False).total_grams
        for key, _ in of_channel:
            places.setdefault(key, len(places))
        blocks.append((np.array([places[key] for key, _ in of_channel]),
                       grams[0, 1:, 1:] / fit.innovation_variance_v2[number]))
    gram = np.zeros((len(places), len(places)))
    for ids, block in blocks:
        gram[np.ix_(ids, ids)] += block
    return PredictedResponse(manoeuvre, model, places, gram)


def _keys(model: LinearModel) -> dict[int, ColumnKey]:
    """Return the key of each column of a linear model by its number."""
    return {number: ColumnKey((v.effect, tuple(v.shape.items()), v.step), model.names[number])
            for v, ids in zip(model.variants, model.column_ids) if not v.limit_start
            for number in ids}


def _posterior_of(hypothesis: WeightedHypothesis, samples: _Samples | None,
                  others: Sequence[WeightedHypothesis], dimensions: Sequence[FormDimension]
                  ) -> _Posterior:
    """Return what a hypothesis knows; something unknown acts beside the best other one."""
    if UNKNOWN in hypothesis.effects:
        named = next((h for h in others if UNKNOWN not in h.effects), WeightedHypothesis((), 1.0))
        effects, functions = named.effects, tuple(dimensions)
    else:
        effects, functions = hypothesis.effects, ()
    if drifts_among(effects):
        functions = tuple(dict.fromkeys((*functions, FormDimension.TIME)))
    if samples is None:
        return _Posterior((), np.zeros(0), np.zeros((0, 0)), effects, functions)
    numbers = {e: samples.best_variant(e) for e in effects}
    unseen = tuple(e for e, number in numbers.items() if number is None)
    chosen = [number for number in numbers.values() if number is not None]
    model = samples.linear_model
    fit = model.fit_variants(chosen, samples.null_fit) if chosen else samples.null_fit
    keys = _keys(model)
    return _Posterior(tuple(keys[int(i)] for i in fit.column_ids), fit.values, fit.covariance,
                      unseen, functions)


def _belief(posterior: _Posterior, response: PredictedResponse) -> Belief:
    """Return what a hypothesis knows of the columns of a manoeuvre."""
    places = response.places
    count = len(places)
    kept = [i for i, key in enumerate(posterior.keys) if key in places]
    mean = np.zeros(count)
    mean[[places[posterior.keys[i]] for i in kept]] = posterior.mean[kept]
    roots = []
    if kept:
        root = np.zeros((count, len(kept)))
        root[[places[posterior.keys[i]] for i in kept]] = _square_root(
            posterior.covariance[np.ix_(kept, kept)])
        roots.append(root)
    prior_std = _prior_std(posterior, response)
    ids = [place for place in prior_std if prior_std[place] > 0]
    if ids:
        root = np.zeros((count, len(ids)))
        root[ids, range(len(ids))] = [prior_std[i] for i in ids]
        roots.append(root)
    return Belief(mean, np.hstack(roots) if roots else np.zeros((count, 0)))


def _prior_std(posterior: _Posterior, response: PredictedResponse) -> dict[int, float]:
    """Return prior standard deviations by place of what the samples so far do not determine."""
    places, model = response.places, response.linear_model
    keys = _keys(model)
    chosen = []
    for effect in posterior.unseen:
        numbers = [i for i, v in enumerate(model.variants)
                   if v.effect == effect and not v.limit_start]
        # The middle one of the shapes stands for all.
        chosen += [numbers[len(numbers) // 2]] if numbers else []
    prior_std = model.prior(chosen)
    determined = {places[key] for key in posterior.keys if key in places}
    ids = {k for i in chosen for k in model.column_ids[i]} | set(model.nuisance_ids())
    stds = {places[keys[k]]: float(prior_std[k]) for k in ids if keys[k] in places}
    stds |= {place: 1.0 for key, place in places.items()
             if key.name is None and key.variant[0] in posterior.dimensions}
    return {place: std for place, std in stds.items() if place not in determined}


def _square_root(covariance: np.ndarray) -> np.ndarray:
    """Return a square root of a covariance, (k, k), whose units may differ by orders."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    return std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


_OTHER_REFERENCE = 'ros2 run adxl_ros diagnose next.csv --sim next_simulated.csv -o next'
"""Command for another recording beside another reference."""


class ManoeuvreDescription(NamedTuple):
    """How a manoeuvre is made."""

    text: str  # What to do, for people
    trajectory: str  # Name of the trajectory of `simulate`
    robot_text: str  # What to do without a stage, for people
    remounted: bool = False  # Whether the sensor is remounted, turned by 180° about z


MENU = {
    Manoeuvre.SHAKE: ManoeuvreDescription(
        'shake along x from 2 to 40 Hz', 'shaker', 'shake from 2 to 40 Hz'),
    Manoeuvre.SPEEDS: ManoeuvreDescription(
        'turn two planes at two speeds, forth and back, with reversals', 'rich',
        'turn at two speeds, forth and back, with reversals'),
    Manoeuvre.PLANES: ManoeuvreDescription(
        'sweep a second plane', 'tilt_both', 'tilt slowly in all directions'),
    Manoeuvre.REMOUNT: ManoeuvreDescription(
        'remount the sensor turned by 180 deg about z, and sweep again', 'tilt_both',
        'remount the sensor turned by 180 deg about z, and tilt in all directions', True),
    Manoeuvre.HEAT: ManoeuvreDescription(
        'dwell, heat and cool', 'soak', 'rest, heat and cool'),
    Manoeuvre.SUPPLY: ManoeuvreDescription(
        'step the supply at rest', 'soak', 'step the supply at rest'),
}
"""All manoeuvres. An effect names the one that reveals it best in its own file."""


@dataclass(frozen=True)
class MenuManoeuvre:
    """A manoeuvre of the menu."""

    manoeuvre: Manoeuvre  # Its place in the menu
    motion: Motion  # Its motion, which begins at 0 s
    begin_s: float = 0.0  # Time at which it begins, s

    @property
    def name(self) -> str:
        """Return what to do, for people."""
        return MENU[self.manoeuvre].text

    @property
    def minutes(self) -> float:
        """Return the duration, min."""
        return self.motion.duration_s / 60


@dataclass(frozen=True)
class RecordedEvidence:
    """What recordings are compared with, and what they show."""

    sensor: Sensor  # The baseline
    linear_model: LinearModel | None  # Linear model of the recordings; None without any
    seed: int  # Seed of the manoeuvres of the menu

    @property
    def beside_simulator(self) -> bool:
        """Return whether the motion is that of another simulator, without a stage."""
        return self.linear_model is not None and all(
            c.reference is Reference.SIMULATOR for c in self.linear_model.comparisons)


class MenuWorth(NamedTuple):
    """What a manoeuvre of the menu is expected to tell."""

    text: str  # What to do, for people
    minutes: float  # Duration, min
    nats_per_minute: float  # Expected information on the hypotheses, nat/min


@dataclass(frozen=True)
class NextExperiment:
    """What to record next."""

    manoeuvre: str  # What to do, for people
    why: str  # The reason, for people
    command: str  # Command that simulates the manoeuvre, or that diagnoses its recording
    # What it is expected to tell; None where nothing has to be separated
    nats_per_minute: float | None = None
    # All manoeuvres that can be simulated, the best first; empty where nothing has to be separated
    menu: tuple[MenuWorth, ...] = ()
    # Whether the reference has to change, so that nothing can be simulated
    concerns_reference: bool = False
    beside_simulator: bool = False  # Whether another simulator makes its motion


def propose_next_experiment(verdict: Verdict, not_covered: Sequence[str],
                            evidence: RecordedEvidence) -> NextExperiment | None:
    """Propose the manoeuvre that separates most of what is not separated."""
    same = next((group for group in verdict.groups if _give_same_samples(group)), None)
    if same is not None:
        return NextExperiment(
            'another sensor beside the same reference',
            f'because {" and ".join(same)} give the same samples, and what stays is of the '
            'reference', _OTHER_REFERENCE, concerns_reference=True)
    named = [effect_named(effect) for effect in verdict.effects]
    if verdict.status == 'explained' and any(e.diagnosis.smooths_reference for e in named):
        return NextExperiment(
            'the motion with less smoothing of the reference',
            'because it lacks motion that the sensor has', _OTHER_REFERENCE,
            concerns_reference=True)
    if verdict.groups:
        return _separating_experiment(verdict, evidence)
    if verdict.status == 'no_gap' and not not_covered:
        return None
    if verdict.status == 'unknown':
        why = 'to show what the unknown part of the gap depends on'
    elif not_covered:
        why = f'because the recordings have no {", no ".join(not_covered)}'
    else:
        why = 'to confirm the verdict on another recording'
    return _experiment(_revealing_manoeuvre(verdict, bool(not_covered)), why,
                       evidence.beside_simulator)


def _give_same_samples(group: Sequence[str]) -> bool:
    """Determine whether a group has an error of the reference that another effect imitates."""
    return any(effect_named(effect).diagnosis.imitated_by in group for effect in group)


def _separating_experiment(verdict: Verdict, evidence: RecordedEvidence) -> NextExperiment:
    """Rank the whole menu by its expected information; propose the best manoeuvre."""
    hypotheses = leading(verdict.hypotheses)
    effects = sorted({effect for h in hypotheses for effect in h.effects})
    dimensions = unknown_dimensions(verdict)
    responses = []
    for planned in _menu(evidence.seed):
        # At rest the pose is unknown, so that a baseline with effects of the stage has no place.
        with suppress(UserError):
            responses.append(predict(
                planned, _as_mounted(evidence.sensor, planned.manoeuvre), effects, dimensions))
    of_text = {described.text: manoeuvre for manoeuvre, described in MENU.items()}
    ranked = [(worth, of_text[worth.manoeuvre.name]) for worth in rank_responses(
        responses, hypotheses, evidence.linear_model, dimensions)]
    group, has_no_stage = verdict.groups[0], evidence.beside_simulator
    why = f'to separate {", ".join(group[:-1])} and {group[-1]}'
    menu = tuple(MenuWorth(_text(manoeuvre, has_no_stage), float(worth.manoeuvre.minutes),
                           float(worth.per_minute)) for worth, manoeuvre in ranked)
    return replace(_experiment(ranked[0][1], why, has_no_stage), menu=menu,
                   nats_per_minute=menu[0].nats_per_minute)


def _menu(seed: int) -> list[MenuManoeuvre]:
    """Return the manoeuvres of the menu with their motions."""
    return [MenuManoeuvre(manoeuvre, trajectories.TRAJECTORIES[described.trajectory](
        np.random.default_rng(seed))) for manoeuvre, described in MENU.items()]


def _as_mounted(sensor: Sensor, manoeuvre: Manoeuvre) -> Sensor:
    """Return the sensor as it is mounted in a manoeuvre."""
    return _remounted(sensor) if MENU[manoeuvre].remounted else sensor


def _revealing_manoeuvre(verdict: Verdict, lacks_coverage: bool) -> Manoeuvre:
    """Return the manoeuvre that reveals most of the effects of a verdict."""
    revealed_by = [effect_named(e).diagnosis.revealed_by for e in verdict.effects]
    best = max(MENU, key=revealed_by.count)
    if best in revealed_by:
        return best
    return Manoeuvre.SPEEDS if verdict.status == 'unknown' or not lacks_coverage \
        else Manoeuvre.PLANES


def _text(manoeuvre: Manoeuvre, beside_simulator: bool) -> str:
    """Return what to do in a manoeuvre, for people."""
    described = MENU[manoeuvre]
    return described.robot_text if beside_simulator else described.text


def _experiment(manoeuvre: Manoeuvre, why: str, beside_simulator: bool) -> NextExperiment:
    """Describe a manoeuvre with its command."""
    described = MENU[manoeuvre]
    if beside_simulator:
        return NextExperiment(described.robot_text, why, _OTHER_REFERENCE, beside_simulator=True)
    option = ''
    if described.remounted:
        effect = _remounting_effect()
        option = f' --effect {effect.name}:{effect.diagnosis.half_turn}={np.pi:.6f}'
    return NextExperiment(
        described.text, why,
        f'ros2 run adxl_ros simulate {described.trajectory}{option} -o next.csv')


def _remounting_effect() -> Effect:
    """Return the effect that turns the sensor on its stage."""
    return next(e for e in library().values() if e.diagnosis.half_turn)


def _remounted(sensor: Sensor) -> Sensor:
    """Turn the sensor on its stage by half a turn: the encoder's zero changes by π."""
    effect = _remounting_effect()
    turned = with_neutral(sensor, [effect.name])
    values = dict(turned.values[effect.name])
    parameter = effect.diagnosis.half_turn
    values[parameter] = np.asarray(values[parameter]) + np.pi
    return replace(turned, values={**turned.values, effect.name: values})
