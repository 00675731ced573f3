# SPDX-License-Identifier: Apache-2.0
"""
What recordings could show, and what to record next.

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
from itertools import chain, combinations, count
from pathlib import Path
from typing import NamedTuple

from adxl_ros.diagnose import comparison as beside, linear_model as linear, noise_effects
from adxl_ros.diagnose.comparison import BaselineComparison, Reference, with_values
from adxl_ros.diagnose.evidence import expected_drift_g, left_beside, LinearFit
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.verdict import UNKNOWN, Verdict, WeightedHypothesis
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Coefficient, Concern, Detector, Manoeuvre
from adxl_ros.model.sensor import parameter_of, Sensor, with_neutral
from adxl_ros.process import command
from adxl_ros.report.quantities import listed
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
import numpy as np

_SHOWN_STDS = 4.0  # Size of a coefficient, in standard deviations, that shows: it gains 8 nats
_RATE_HZ = 62.5
"""Sample rate of the simulated manoeuvres, Hz. Chosen: run time; a stage moves far slower."""
_SMALLEST_PROBABILITY = 1e-3
"""Probability of a hypothesis that leads the choice. Chosen: the others together are far below the
5 % that remain at the end."""
_MOST_HYPOTHESES = 40  # Largest number of such hypotheses. Chosen: run time
_EVIDENCE_FACTOR = 0.3
"""Factor of the information, because no model of a sensor is exact (Miller and Dunson 2019)."""


class CouldShow(NamedTuple):
    """Smallest size of one parameter of an effect that recordings would have shown."""

    name: Coefficient  # The coefficient
    smallest: float  # The size, in `unit`; infinite where nothing of it reaches the output
    # Share of the effect's signal that zero-g, scale factor and latency cannot imitate
    share: float = 1.0

    @property
    def unit(self) -> str:
        """Return the unit of the size, that of the parameter."""
        return parameter_of(self.name).unit

    @property
    def shows(self) -> bool:
        """Return whether the smallest size is one that the parameter can have."""
        p = parameter_of(self.name)
        return bool(self.smallest <= p.upper - p.neutral)


def could_show(
    model: LinearModel, comparison: BaselineComparison, noise_v: np.ndarray, material_mps2: float
) -> list[CouldShow]:
    """
    Return the smallest sizes by effect: material ones, that exceed their uncertainty.

    Nuisance parameters are free, within their tolerance. An effect with several shapes has the
    size of the shape that shows best. The sizes of effects on the noise are those of one
    recording at its full rate; `noise_v` is its noise, V, (m,).
    """
    rows = [
        *_noise_could_show(comparison, noise_v, material_mps2),
        *_mean_could_show(model, material_mps2),
    ]
    seen = {row.name.effect for row in rows}
    limited = {variant.effect for variant in model.variants if variant.limit_start}
    for effect in linear.candidates():
        if effect.name not in seen | limited:
            name = Coefficient(effect.name, effect.parameters[0].name)
            rows.append(CouldShow(name, np.inf, 0.0))
    # The last coefficient of each effect shows best, by smallest over typical size.
    rows.sort(
        key=lambda row: (row.smallest / parameter_of(row.name).scale, row.name), reverse=True
    )
    best = {row.name.effect: row for row in rows}
    return [best[effect] for effect in sorted(best)]


class _Information(NamedTuple):
    """What recordings tell of the coefficients of all columns, (columns,) each."""

    alone: np.ndarray  # Inverse variance where nothing else is free, 1/unit²
    marginal: np.ndarray  # Inverse variance beside the nuisance parameters, 1/unit²
    power_mps2: np.ndarray  # Mean square over samples and axes, (m/s²)²/unit²


def _information(model: LinearModel) -> _Information:
    """Return what the recordings of a linear model tell."""
    squares_mps2 = np.zeros(len(model.names))
    samples = 0
    for columns, (comparison, axis) in zip(model.columns, model.places):
        scale = float(comparison.scale_v_per_mps2[axis])
        for k, column_v in columns.items():
            squares_mps2[k] += float(np.sum(column_v[comparison.used] ** 2)) / scale**2
        samples += int(comparison.used.sum())
    gram = model.information
    marginal = left_beside(gram, model.nuisance_ids, model.prior(()))
    return _Information(np.diag(gram), marginal, squares_mps2 / max(samples, 1))


def _mean_could_show(model: LinearModel, material_mps2: float) -> list[CouldShow]:
    """Return the smallest sizes of effects that show in the mean of the output."""
    known = _information(model)
    rows = []
    for variant, ids in zip(model.variants, model.column_ids):
        hints = effect_named(variant.effect).diagnosis
        hides_in_pose = bool(hints.straight_line) and not model.pose_known
        if variant.limit_start or hides_in_pose:
            continue
        for k in ids:
            information = known.alone[k] if hints.nuisance else known.marginal[k]
            share = float(np.clip(information / max(known.alone[k], 1e-300), 0.0, 1.0))
            power_mps2 = known.power_mps2[k] * share
            size = np.inf
            if information > 0 and power_mps2 > 0:
                certain = _SHOWN_STDS * information**-0.5
                size = max(certain, material_mps2 * power_mps2**-0.5)
            if hints.nuisance:
                size = np.hypot(size, 3 * model.tolerance(model.names[k]))
            rows.append(CouldShow(model.names[k], float(size), share))
    return rows


def _noise_could_show(
    comparison: BaselineComparison, noise_v: np.ndarray, material_mps2: float
) -> list[CouldShow]:
    """Return the smallest sizes of effects that show in the noise of one recording."""
    sensor = comparison.sensor
    count = len(comparison)
    level_v = float(noise_v.max())
    rate_hz = sensor.rate_hz
    line_v = max(
        level_v * np.sqrt(8 * (noise_effects.LINE_LOG_EXCESS + np.log(count)) / count),
        np.sqrt(2) * material_mps2 * float(comparison.scale_v_per_mps2.max()),
    )
    sizes = {
        Detector.NOISE_LEVEL: ('ratio', noise_effects.NOISE_EXCESS - 1),
        Detector.MAINS_LINE: ('amplitude_v', line_v),
        Detector.ISOLATED_SAMPLES: (
            'amplitude_v',
            noise_effects.SPIKE_STDS * max(level_v, noise.electronics(sensor).lsb_v.max()),
        ),
        Detector.REPEATED_SAMPLES: (
            'duration_s',
            noise_effects.shortest_repeat(comparison.volts, len(sensor.axes)) / rate_hz,
        ),
        Detector.COARSE_CODES: ('lost_bits', float(np.log2(noise_effects.COARSE_STEPS))),
    }
    rows = []
    for effect in library().values():
        hints = effect.diagnosis
        if hints.drift is not None:
            unit_g = expected_drift_g(effect.name, 1.0, comparison)
            density = max(material_mps2 / G0_MPS2 / unit_g, hints.healthy_density)
            rows.append(CouldShow(Coefficient(effect.name, effect.parameters[0].name), density))
        elif hints.detector in sizes:
            parameter, size = sizes[hints.detector]
            rows.append(CouldShow(Coefficient(effect.name, parameter), float(size)))
    return rows


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
    size = np.max([np.abs(b.mean) + np.sqrt(np.diag(b.covariance)) for b in beliefs], axis=0)
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

    name: str
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


def rank_responses(
    responses: Sequence[PredictedResponse],
    hypotheses: Sequence[WeightedHypothesis],
    model: LinearModel | None,
) -> tuple[ManoeuvreWorth, ...]:
    """Rank manoeuvres by their expected information per minute."""
    leaders = leading(hypotheses)
    seen = dict[str, int]()
    keys = dict[int, tuple]()
    fits = list[LinearFit | None]([None] * len(leaders))
    if model is not None:

        def log_evidence(variant: int) -> float:
            return model.fit_variants([variant], model.null_fit).log_evidence

        # The variant of each effect that fits the samples best.
        for effect in set(chain(*(h.effects for h in leaders))):
            numbers = _variants_of(model, effect)
            if numbers:
                seen[effect] = max(numbers, key=log_evidence)
        keys = _keys(model)
        for i, hypothesis in enumerate(leaders):
            chosen = [seen[e] for e in hypothesis.effects if e in seen]
            fits[i] = model.fit_variants(chosen, model.null_fit)
    total = sum(h.probability for h in leaders)
    probabilities = [h.probability / total for h in leaders]
    worth = []
    for response in responses:
        beliefs = [
            _belief(response, keys, fit, {*h.effects} - {*seen}) for h, fit in zip(leaders, fits)
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
    known = [*model.nuisance_ids, *chain(*(model.column_ids[i] for i in chosen))]
    mean, variance = np.zeros((2, len(model.names)))
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
    no_stage = model is not None and all(
        c.reference is Reference.SIMULATOR for c in model.comparisons
    )
    stem = _free_stem([c.name for c in model.comparisons] if model else ())
    if any(effect_named(e).concern is Concern.REFERENCE for e in verdict.named):
        return NextExperiment(
            'the motion beside another reference, or one with less smoothing',
            'because the error may be of the reference',
            _beside_other_reference(stem),
            concerns_reference=True,
            stem=stem,
        )
    if verdict.groups:
        ranked = _ranked_menu(verdict, sensor, model, seed)
        group = verdict.groups[0]
        best = ranked[0].name
        why = f'to separate {listed(group, "and")}'
        return _experiment(
            next(m for m, d in MENU.items() if d.text == best), why, no_stage, stem
        )._replace(menu=ranked)
    if verdict.status == 'no_gap' and not not_covered:
        return None
    why = 'to confirm the verdict on another recording'
    if verdict.status == 'unknown':
        why = 'to show what the unknown part of the gap depends on'
    elif not_covered:
        why = f'because the recordings have no {", no ".join(not_covered)}'
    revealed_by = [effect_named(e).diagnosis.revealed_by for e in verdict.effects]
    usual = (
        Manoeuvre.SPEEDS if verdict.status == 'unknown' or not not_covered else Manoeuvre.PLANES
    )
    return _experiment(next(filter(None, revealed_by), usual), why, no_stage, stem)


def _free_stem(recordings: Sequence[str]) -> str:
    """Return the name of another recording, without its extension, that no input has."""
    taken = {Path(name).stem for name in recordings}
    return next(
        stem
        for number in count(1)
        if (stem := 'next' if number == 1 else f'next_{number}') not in taken
    )


def _ranked_menu(
    verdict: Verdict, sensor: Sensor, model: LinearModel | None, seed: int
) -> tuple[ManoeuvreWorth, ...]:
    """Rank the whole menu by its expected information."""
    effects = sorted({*chain(*(h.effects for h in leading(verdict.hypotheses)))})
    responses = []
    for described in MENU.values():
        motion = trajectories.TRAJECTORIES[described.trajectory](np.random.default_rng(seed))
        # At rest the pose is unknown, so that a baseline with effects of the stage has no place.
        with suppress(UserError):
            responses.append(
                predict(
                    described.text,
                    motion,
                    0.0,
                    _remounted(sensor) if described.remounted else sensor,
                    effects,
                )
            )
    return rank_responses(responses, verdict.hypotheses, model)


def _experiment(manoeuvre: Manoeuvre, why: str, no_stage: bool, stem: str) -> NextExperiment:
    """Describe a manoeuvre with its command."""
    described = MENU[manoeuvre]
    option = ''
    if no_stage:
        return NextExperiment(
            described.text, why, _beside_other_reference(stem), beside_simulator=True, stem=stem
        )
    if described.remounted:
        option = f' --effect {":".join(_half_turn())}={np.pi:.6f}'
    return NextExperiment(
        described.text,
        why,
        command('simulate', f'{described.trajectory}{option} -o {stem}.csv'),
        stem=stem,
    )


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
