# SPDX-License-Identifier: Apache-2.0
"""
What to record next.

Each hypothesis has a posterior of its coefficients by the samples so far. A manoeuvre is simulated
with the baseline and goes through the same comparison as a recording, with the steps of the
encoder. Its sensitivities to the library then predict the response of each hypothesis. The
manoeuvre with the largest expected information per minute is proposed.

All hypotheses predict y = J·θ + e with white noise e of variance 1. They differ in what they know
of θ: mean m and covariance S. Only the products G = Jᵀ·J matter, so that the number of samples
does not.

The mutual information between hypothesis and data has no closed form. Pairwise Bhattacharyya
distances bound it from below (Kolchinsky and Tracey 2017, Entropy 19, 361, equation 10).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import cache
from itertools import chain, combinations, count
from pathlib import Path
from typing import NamedTuple

from adxl_ros.diagnose import comparison as beside, linear_model as linear
from adxl_ros.diagnose.comparison import Reference
from adxl_ros.diagnose.evidence import LinearFit
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.verdict import UNKNOWN, Verdict, WeightedHypothesis
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Concern, Manoeuvre
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import Sensor, with_neutral, with_values
from adxl_ros.process import command
from adxl_ros.report.quantities import listed
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
import numpy as np

_RATE_HZ = 62.5
"""Sample rate of the simulated manoeuvres, Hz. Chosen: run time; a stage moves far slower."""
_SMALLEST_PROBABILITY = 1e-3
"""Probability of a hypothesis that leads the choice. Chosen: the others together are far below the
5 % that remain at the end."""
_MOST_HYPOTHESES = 40  # Largest number of such hypotheses. Chosen: run time
_EVIDENCE_FACTOR = 0.3
"""Factor of the information, because no model of a sensor is exact (Miller and Dunson 2019)."""


class KnownCoefficients(NamedTuple):
    """What a hypothesis knows of k coefficients."""

    mean: np.ndarray  # Mean, (k,)
    covariance: np.ndarray  # Covariance, (k, k)


def expected_information(
    gram: np.ndarray,
    probabilities: Sequence[float],
    beliefs: Sequence[KnownCoefficients],
    factor: float = 1.0,
) -> float:
    """
    Return a lower bound of the information that an experiment gives on the hypothesis, nat.

    gram: products of the sensitivities, in units of the noise, (k, k).
    """
    weights = np.asarray(probabilities, float)
    size = np.max([np.abs(b.mean) + stds(b.covariance) for b in beliefs], axis=0)
    kept = np.flatnonzero(size)
    values, vectors = np.linalg.eigh(gram[np.ix_(kept, kept)] * np.outer(size[kept], size[kept]))
    # A root of G, because all sensitivities with the same products respond alike.
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T / size[kept]
    means = [root @ b.mean[kept] for b in beliefs]
    covariances = [
        np.eye(len(kept)) + root @ b.covariance[np.ix_(kept, kept)] @ root.T for b in beliefs
    ]
    log_dets = np.linalg.slogdet(covariances)[1]
    overlap = np.eye(len(weights))
    for i, j in combinations(range(len(weights)), 2):
        both = (covariances[i] + covariances[j]) / 2
        difference = means[i] - means[j]
        distance = (
            difference @ np.linalg.solve(both, difference) / 8
            + np.linalg.slogdet(both)[1] / 2
            - (log_dets[i] + log_dets[j]) / 4
        )
        overlap[i, j] = overlap[j, i] = np.exp(-max(factor * distance, 0.0))
    positive = weights > 0
    return max(float(-weights[positive] @ np.log((overlap @ weights)[positive])), 0.0)


class ManoeuvreWorth(NamedTuple):
    """What a manoeuvre is expected to tell."""

    name: str  # Name of a `Manoeuvre`, or one that the investigation plans
    minutes: float  # Duration, min
    information: float  # Expected decrease of the entropy of the hypotheses, nat

    @property
    def per_minute(self) -> float:
        """Return the expected information per minute, nat/min."""
        return self.information / self.minutes


class PredictedResponse(NamedTuple):
    """The sensitivities of one manoeuvre."""

    name: str
    minutes: float  # Duration, min
    linear_model: LinearModel  # Its variants are those that the manoeuvre excites
    places: dict[tuple, int]  # Number of each column by its key


def leading(hypotheses: Sequence[WeightedHypothesis]) -> tuple[WeightedHypothesis, ...]:
    """Return the known hypotheses that lead the choice of a manoeuvre, the most probable first."""
    return tuple(
        h for h in hypotheses if h.probability > _SMALLEST_PROBABILITY and UNKNOWN not in h.effects
    )[:_MOST_HYPOTHESES]


def predict(
    name: str, motion: Motion, begin_s: float, sensor: Sensor, effects: Sequence[str]
) -> PredictedResponse:
    """
    Simulate a manoeuvre with the baseline, and multiply its whitened sensitivities.

    begin_s: time of its motion at which it begins, s.
    """
    at_rate = sensor.computed_at(min(sensor.rate_hz, _RATE_HZ))
    columns = simulate(at_rate, motion, 0, begin_s)
    recording = Recording(name, columns.pop('time_s'), columns)
    comparison = beside.at_search_rate(beside.compare(recording, at_rate))
    model = linear.build_linear_model([comparison], only=effects)
    places = {key: number for number, key in _keys(model).items()}
    return PredictedResponse(name, motion.duration_s / 60, model, places)


def _keys(model: LinearModel) -> dict[int, tuple]:
    """Return variant and coefficient of each column of a linear model by its number."""
    keys: dict[int, tuple] = {}
    for variant, ids in zip(model.variants, model.column_ids):
        if not variant.limit_start:
            keys |= {number: (variant.key, model.names[number]) for number in ids}
    return keys


class _SoFar(NamedTuple):
    """What the samples so far say of hypotheses."""

    effects: frozenset[str]  # Effects whose parameters they could show
    keys: dict[int, tuple]  # Variant and coefficient of each fitted column by its number
    fits: list[LinearFit | None]  # Fit of each hypothesis; None before there are samples

    @classmethod
    def of(cls, hypotheses: Sequence[WeightedHypothesis], model: LinearModel | None) -> _SoFar:
        """Fit hypotheses to the samples of a model, each effect by the variant that fits best."""
        if model is None:
            return cls(frozenset(), {}, [None] * len(hypotheses))

        def log_evidence(variant: int) -> float:
            return model.fit_variants([variant], model.null_fit).log_evidence

        best: dict[str, int] = {}
        for effect in set(chain.from_iterable(h.effects for h in hypotheses)):
            numbers = _variants_of(model, effect)
            if numbers:
                best[effect] = max(numbers, key=log_evidence)
        fits: list[LinearFit | None] = []
        for hypothesis in hypotheses:
            chosen = [best[e] for e in hypothesis.effects if e in best]
            fits.append(model.fit_variants(chosen, model.null_fit))
        return cls(frozenset(best), _keys(model), fits)


def rank_responses(
    responses: Sequence[PredictedResponse],
    hypotheses: Sequence[WeightedHypothesis],
    model: LinearModel | None,
) -> tuple[ManoeuvreWorth, ...]:
    """Rank manoeuvres by their expected information per minute."""
    leaders = leading(hypotheses)
    so_far = _SoFar.of(leaders, model)
    total = sum(h.probability for h in leaders)
    probabilities = [h.probability / total for h in leaders]
    worth = []
    for response in responses:
        beliefs = [
            _belief(response, so_far.keys, fit, {*h.effects} - so_far.effects)
            for h, fit in zip(leaders, so_far.fits)
        ]
        information = expected_information(
            response.linear_model.information, probabilities, beliefs, _EVIDENCE_FACTOR
        )
        worth.append(ManoeuvreWorth(response.name, response.minutes, information))
    return tuple(sorted(worth, key=lambda w: -w.per_minute))


def _variants_of(model: LinearModel, effect: str) -> list[int]:
    """Return the numbers of the variants of an effect."""
    return [i for i, v in enumerate(model.variants) if v.effect == effect and not v.limit_start]


def _belief(
    response: PredictedResponse,
    fitted_keys: dict[int, tuple],
    fit: LinearFit | None,
    unseen: Collection[str],
) -> KnownCoefficients:
    """
    Return what a hypothesis knows of the columns of a manoeuvre.

    fit: what the samples so far say of columns with some keys, None before there are samples. Of
    `unseen` effects only the prior is known.
    """
    places = response.places
    model = response.linear_model
    # The middle one of the shapes of an effect stands for all.
    chosen = [
        numbers[len(numbers) // 2] for effect in unseen if (numbers := _variants_of(model, effect))
    ]
    known = [*model.nuisance_ids, *chain.from_iterable(model.column_ids[i] for i in chosen)]
    mean = np.zeros(len(model.names))
    variance = np.zeros(len(model.names))
    variance[known] = model.prior(chosen)[known] ** 2
    covariance = np.diag(variance)
    if fit is not None:
        columns = [fitted_keys[int(k)] for k in fit.column_ids]
        kept = [i for i, key in enumerate(columns) if key in places]
        at = [places[columns[i]] for i in kept]
        mean[at] = fit.values[kept]
        covariance[at] = 0.0
        covariance[np.ix_(at, at)] = fit.covariance[np.ix_(kept, kept)]
    return KnownCoefficients(mean, covariance)


class ManoeuvreDescription(NamedTuple):
    """How a manoeuvre is made."""

    text: str  # What to do, for people
    trajectory: str  # Name of the trajectory of `simulate`
    remounted: bool = False  # Whether the sensor is remounted, turned by 180° about z


MENU = {
    Manoeuvre.SHAKE: ManoeuvreDescription('shake along x from 2 to 40 Hz', 'shaker'),
    Manoeuvre.SPEEDS: ManoeuvreDescription(
        'turn two planes at two speeds, forth and back, with reversals', 'rich'
    ),
    Manoeuvre.PLANES: ManoeuvreDescription(
        'sweep a second plane, or tilt in all directions', 'tilt_both'
    ),
    Manoeuvre.REMOUNT: ManoeuvreDescription(
        'remount the sensor turned by 180 deg about z, and sweep again', 'tilt_both', True
    ),
    Manoeuvre.HEAT: ManoeuvreDescription('dwell, heat and cool', 'soak'),
    Manoeuvre.SUPPLY: ManoeuvreDescription('step the supply at rest', 'soak'),
}
"""All manoeuvres. An effect names the one that reveals it best in its own file."""


class NextExperiment(NamedTuple):
    """What to record next."""

    manoeuvre: str  # What to do, for people
    why: str  # The reason, for people
    command: str  # Command that simulates the manoeuvre, or that diagnoses its recording
    # All manoeuvres that can be simulated, the best first; empty where nothing has to be separated
    menu: tuple[ManoeuvreWorth, ...] = ()
    # Whether the reference has to change, so that nothing can be simulated
    concerns_reference: bool = False
    beside_simulator: bool = False  # Whether another simulator makes its motion
    stem: str = 'next'  # Name of its recording, without the extension, that no input has


def propose_next_experiment(
    verdict: Verdict,
    not_covered: Sequence[str],
    sensor: Sensor,
    model: LinearModel | None,
    seed: int,
) -> NextExperiment | None:
    """
    Propose the manoeuvre that separates most of what is not separated.

    sensor: the baseline; model: linear model of the recordings, or None.
    """
    comparisons = model.comparisons if model else []
    stem = _free_stem([c.name for c in comparisons])
    if any(effect_named(e).concern is Concern.REFERENCE for e in verdict.named):
        return NextExperiment(
            'the motion beside another reference, or one with less smoothing',
            'because the error may be of the reference',
            _beside_other_reference(stem),
            concerns_reference=True,
            stem=stem,
        )
    references = {c.reference for c in comparisons}
    beside_simulator = references == {Reference.SIMULATOR}
    if verdict.status == 'no_gap' and not not_covered:
        return None
    ranked: tuple[ManoeuvreWorth, ...] = ()
    usual = Manoeuvre.SPEEDS
    why = 'to confirm the verdict on another recording'
    if verdict.groups:
        ranked = _ranked_menu(verdict, sensor, model, seed)
        why = f'to separate {listed(verdict.groups[0], "and")}'
    elif verdict.status == 'unknown':
        why = 'to show what the unknown part of the gap depends on'
    elif not_covered:
        usual = Manoeuvre.PLANES
        why = f'because the recordings have no {", no ".join(not_covered)}'
    if ranked:
        manoeuvre = Manoeuvre[ranked[0].name]
    else:
        revealed_by = [effect_named(e).diagnosis.revealed_by for e in verdict.named]
        manoeuvre = next(filter(None, revealed_by), usual)
    return _experiment(manoeuvre, why, beside_simulator, stem)._replace(menu=ranked)


def _free_stem(recordings: Sequence[str]) -> str:
    """Return the name of another recording, without its extension, that no input has."""
    taken = {Path(name).stem for name in recordings}
    names = chain(['next'], (f'next_{number}' for number in count(2)))
    return next(name for name in names if name not in taken)


def _ranked_menu(
    verdict: Verdict, sensor: Sensor, model: LinearModel | None, seed: int
) -> tuple[ManoeuvreWorth, ...]:
    """Rank the menu by its expected information, without what the baseline cannot follow."""
    of_leading = (h.effects for h in leading(verdict.hypotheses))
    effects = sorted({*chain.from_iterable(of_leading)})

    @cache
    def predicted(trajectory: str, remounted: bool) -> PredictedResponse:
        motion = trajectories.TRAJECTORIES[trajectory](np.random.default_rng(seed))
        mounted = _remounted(sensor) if remounted else sensor
        return predict(trajectory, motion, 0.0, mounted, effects)

    responses = []
    for manoeuvre, described in MENU.items():
        # No trajectory moves a robot, and a soak has no pose for effects of the stage.
        with suppress(UserError):
            response = predicted(described.trajectory, described.remounted)
            responses.append(response._replace(name=manoeuvre.name))
    return rank_responses(responses, verdict.hypotheses, model)


def _experiment(
    manoeuvre: Manoeuvre, why: str, beside_simulator: bool, stem: str
) -> NextExperiment:
    """Describe a manoeuvre with its command."""
    described = MENU[manoeuvre]
    if beside_simulator:
        line = _beside_other_reference(stem)
    else:
        turned = f' --effect {":".join(_half_turn())}={np.pi:.6f}' if described.remounted else ''
        line = command('simulate', f'{described.trajectory}{turned} -o {stem}.csv')
    return NextExperiment(described.text, why, line, beside_simulator=beside_simulator, stem=stem)


def _beside_other_reference(stem: str) -> str:
    """Return the command for another recording beside another reference."""
    return command('diagnose', f'{stem}.csv --sim {stem}_simulated.csv -o {stem}')


def _half_turn() -> tuple[str, str]:
    """Return effect and parameter, an angle, that turn the sensor on its stage."""
    return next((e.name, hint) for e in library().values() if (hint := e.diagnosis.half_turn))


def _remounted(sensor: Sensor) -> Sensor:
    """Turn the sensor on its stage by half a turn: the encoder's zero changes by π."""
    name, parameter = _half_turn()
    turned = with_neutral(sensor, [name])
    return with_values(turned, name, {parameter: turned.values[name][parameter] + np.pi})
