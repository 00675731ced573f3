# SPDX-License-Identifier: Apache-2.0
"""
The diagnosis as one library call, in stages.

They are comparison, checks, linear model, search and held-out figures; the verdict follows from
the figures. What the report adds comes last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

from adxl_ros.diagnose import data_checks, noise_effects, noise_model
from adxl_ros.diagnose.comparison import BaselineComparison, Reference
from adxl_ros.diagnose.data_checks import CheckedRecording, compare_checked, DataFault
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.diagnose.held_out import (
    block_weights,
    drift_densities,
    drift_mps2,
    HeldOutFits,
    pose_shares,
    reproducible_rest,
    used_counts,
)
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, linearise
from adxl_ros.diagnose.linear_model import build_linear_model, LinearModel
from adxl_ros.diagnose.next_experiment import (
    NextExperiment,
    propose_next_experiment,
    RecordedEvidence,
)
from adxl_ros.diagnose.noise_effects import (
    compare_noise,
    Detection,
    floor_without,
    noise_remainders,
    NoiseComparison,
    NoiseRemainder,
    NoiseSamples,
    UNKNOWN,
)
from adxl_ros.diagnose.noise_model import drift_effects, NoiseFloor
from adxl_ros.diagnose.residual_map import not_covered, residual_map, ResidualCell
from adxl_ros.diagnose.search import Search
from adxl_ros.diagnose.verdict import (
    Candidate,
    decide,
    Evidence,
    HEALTHY,
    MATERIAL_MG,
    MATERIAL_SHARE_OF_NOISE,
    Verdict,
)
from adxl_ros.diagnose.visibility import could_show, CouldShow, noise_could_show
from adxl_ros.files.recording_columns import check_unit, Recording
from adxl_ros.model import noise
from adxl_ros.model.coefficients import get, parameter_of, put, with_neutral
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.simulate.motion import Motion
import numpy as np

ShowProgress = Callable[[str, float], None]
"""Called with number and name of the stage, and the fraction of the work that is done."""

_STAGES = {'checks': 0.1, 'library of effects': 0.3, 'effects': 0.8, 'held-out figures': 0.9,
           'report': 1.0}
"""Stages, and the fraction of the usual run time after each. Measured at 250 Hz."""
_DRIFT_LIMIT = 5.0
"""Expected mean square of a random walk about its mean, divided by the one in a recording, that
one walk in 20 exceeds. Derived from the random walk."""
_REPEATED, _RIGHT = (0.0, 0.5, 0.8, 0.95, 1.0), (0.2, 0.4, 0.6, 0.75, 0.9)
"""Shares of the draws that repeat a verdict, and how often such verdicts were right. Rounded from
40 working cases (seed 901): of those that all draws repeat, 21 of 25."""
_SMALLEST_RANGES = {'temperature_c': 0.5, 'supply_v': 0.02}
"""Range of temperature, °C, and supply, V, below which they do not change. Chosen: noise."""


class GapClosure(NamedTuple):
    """The gap before and after the effects of the verdict, held out, and the noise floor."""

    # before_mps2, after_mps2: Rms of recording minus simulation over samples and axes, m/s²
    before_mps2: float
    # before_ci, after_ci: Their 90 % intervals
    before_ci: tuple[float, float]
    after_mps2: float
    after_ci: tuple[float, float]
    floor_mps2: float  # Noise floor, m/s²
    floor_ci: tuple[float, float] | None  # Its 90 % interval; None where it is not measured
    closed: float  # (before² − after²)/(before² − floor²); NaN without a gap
    closed_ci: tuple[float, float]  # Its 90 % interval


@dataclass(frozen=True)
class Report:
    """A verdict with what a reader needs to believe and to use it."""

    verdict: Verdict  # The verdict with its figures
    closure: GapClosure  # The gap before and after the effects of the verdict
    noise_floor: NoiseFloor  # The noise floor with its source
    hypotheses: tuple[Hypothesis, ...]  # Fitted sets of effects, those that explain most first
    # detections, noise_remainders: Effects that show in the noise, and what remains after they are
    # added
    detections: tuple[Detection, ...]
    noise_remainders: tuple[NoiseRemainder, ...]
    # noise_before, noise_after: Recorded noise relative to simulated noise by recording, before
    # and with what was found
    noise_before: tuple[NoiseComparison, ...]
    noise_after: tuple[NoiseComparison, ...]
    residual_cells: tuple[ResidualCell, ...]  # Map of the residual of the first recording
    not_covered: tuple[str, ...]  # What the recordings do not cover, for people
    # Smallest size of each effect that these recordings would have shown
    could_show: tuple[CouldShow, ...]
    next_experiment: NextExperiment | None  # What to record next
    lost_motion_mps2: float  # Rms of motion that a smooth reference lacks, m/s²
    baseline: Sensor  # The baseline
    sensor: Sensor  # The baseline with the effects whose closing is stated, ready for `simulate`
    linear_model: LinearModel  # The linear model of the recordings


@dataclass(frozen=True)
class Diagnosis:
    """What a diagnosis found: a report, or the fault of a recording that makes one impossible."""

    # The recordings beside the baseline, at the rate of the search
    comparisons: tuple[BaselineComparison, ...]
    # The same at their full rate; empty after a fault
    full_rate: tuple[BaselineComparison, ...] = ()
    fault: DataFault | None = None  # Fault of a recording
    report: Report | None = None  # The report where there is no fault


def diagnose(recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None,
             seed: int = 0, show_progress: ShowProgress = lambda stage, fraction: None,
             align: bool = False, material_mg: float = MATERIAL_MG) -> Diagnosis:
    """
    Compare recordings of one unit with the simulator, and find which effects it lacks.

    Parameters
    ----------
    recordings
        Whole recordings of one unit.
    sensor
        The baseline: datasheet values and modelled effects.
    sim
        Specific force by another simulator, in place of the stage.
    seed
        Seed of bootstraps and of simulated noise.
    show_progress
        Called with the name of the stage and the fraction that is done, 0 to 1.
    align
        Whether `sim` is shifted in time where its motion is late or early.
    material_mg
        Amplitude that a user would act on, mg rms.

    Returns
    -------
    Diagnosis
        The report, or the fault of a recording.

    Raises
    ------
    UserError
        A recording is of another unit, or its reference cannot be followed.

    """
    show = _stages(show_progress)
    show('checks', 0.0)
    checked = check(recordings, sensor, sim, align)
    if isinstance(checked, Diagnosis):
        return checked
    model = build_linear_model([c.search_comparison for c in checked],
                               lambda share: show('library of effects', share))
    search = Search(model)
    search.run(lambda share: show('effects', share))
    show('held-out figures', 0.0)
    floor = noise_model.estimate([c.comparison for c in checked])
    fits = _held_out(model, search, floor)
    evidence = Evidence(
        {effects: candidate for effects, (candidate, _) in fits.items()}, used_counts(model),
        block_weights(seed), material_mps2(model, floor, material_mg),
        model.smallest_angle_rad() * G0_MPS2,
        model.lost_motion_mps2, np.inf if floor.source == 'assumed' else floor.rms_mps2)
    detections = _detections(checked, search.best, model.baseline)
    verdict = decide(
        evidence, cache(lambda effects, drift: reproducible_rest(fits[effects][1][drift], model)),
        [d.effect for d in detections if d.effect != UNKNOWN],
        lambda share: float(np.interp(share, _REPEATED, _RIGHT)))
    show('report', 0.0)
    if verdict.status == 'no_gap' and not any(map(_could_show, model.comparisons)):
        verdict = replace(verdict, status='insufficient')
    best = frozenset(verdict.best.effects)
    named = _named_sensor(verdict, detections, model.baseline, checked[0].comparison.sensor,
                          fits[best][1])
    report = _report(checked, model, search, verdict, detections, floor, evidence, named, seed)
    show('report', 1.0)
    return Diagnosis(tuple(model.comparisons), tuple(c.comparison for c in checked), None, report)


def _stages(show_progress: ShowProgress) -> ShowProgress:
    """Return a function that shows a stage with its number and the fraction of all work."""
    names = list(_STAGES)

    def show(stage: str, share: float) -> None:
        number = names.index(stage)
        before = _STAGES[names[number - 1]] if number else 0.0
        show_progress(f'{number + 1}/{len(names)} {stage}',
                      before + share * (_STAGES[stage] - before))

    return show


def check(recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None,
          align: bool = False) -> list[CheckedRecording] | Diagnosis:
    """Put recordings beside their simulation; return the diagnosis of the first fault instead."""
    if not sensor.effects:
        sensor = with_axes(sensor, recordings[0].axes)
    compared: list[BaselineComparison] = []
    for recording in recordings:
        check_unit(recording.stream_info, recording.axes, sensor)
        comparison = compare_checked(recording, sensor, sim, align)
        if isinstance(comparison, DataFault):
            return Diagnosis((), (), comparison)
        compared.append(comparison)
    short = data_checks.find_length_fault(compared)
    if short is not None:
        return Diagnosis(tuple(compared), (), short)
    checked: list[CheckedRecording] = []
    for comparison in compared:
        result = data_checks.check_recording(comparison)
        if isinstance(result, DataFault):
            return Diagnosis((comparison,), (), result)
        checked.append(result)
    return checked


def material_mps2(model: LinearModel, floor: NoiseFloor, material_mg: float = MATERIAL_MG
                  ) -> float:
    """Return the material amplitude: the stated one, or a share of the noise."""
    scale = model.comparisons[0].scale_v_per_mps2
    noise_mps2 = np.sqrt(np.mean((floor.noise_v / scale) ** 2) + model.lost_motion_mps2 ** 2)
    return max(1e-3 * material_mg * G0_MPS2, MATERIAL_SHARE_OF_NOISE * float(noise_mps2))


def _held_out(model: LinearModel, search: Search, floor: NoiseFloor
              ) -> dict[frozenset[str], tuple[Candidate, dict[str, HeldOutFits]]]:
    """Return the held-out figures of all sets, with the drifts that their noise may have."""
    best = search.best
    beside = linearise(model, best.effects, best.sensor, model.filters)
    drifts = drift_effects() if beside.fit(drifts=drift_effects()).log_evidence \
        > beside.fit().log_evidence else ()
    count = max(used_counts(model).sum(), 1.0)
    out = {}
    for effects, hypothesis in search.found.items():
        fits = {HEALTHY: HeldOutFits(hypothesis.linearised)}
        sizes = {HEALTHY: 0.0}
        left = fits[HEALTHY].figures.squares.sum() / count - floor.rms_mps2 ** 2
        linearised = linearise(model, hypothesis.effects, hypothesis.sensor, model.filters) \
            if drifts else hypothesis.linearised
        for drift in drifts:
            beside_drift = HeldOutFits(linearised, (drift,))
            size = drift_mps2(beside_drift, model)
            # A drift that should be far larger than what is left is none.
            if size ** 2 <= _DRIFT_LIMIT * max(left, 0.0):
                fits[drift], sizes[drift] = beside_drift, size
        out[effects] = (Candidate(hypothesis, {d: f.figures for d, f in fits.items()}, sizes,
                                  pose_shares(hypothesis, model)), fits)
    return out


def _detections(checked: Sequence[CheckedRecording], best: Hypothesis, baseline: Sensor
                ) -> list[Detection]:
    """
    Return the noise-like effects of the recordings and of the residual, the strongest of each.

    Spikes count only where the residual of the best set shows them, too, and excess noise only
    where it exceeds that of the baseline, too: a filter also changes the noise.
    """
    detections = [d for c in checked for d in c.detections]
    for c in checked:
        comparison, used = c.comparison, c.comparison.used
        sensor = replace(best.sensor, rate_hz=comparison.sensor.rate_hz)
        residual_v = comparison.residual_v(best.sensor)
        spikes = c.possible_spikes
        # In motion, a smooth reference lacks knocks that look like spikes.
        regular = used | ~comparison.at_rest if comparison.reference_fades else used
        if spikes is not None and noise_effects.residual_shows_spikes(spikes, residual_v,
                                                                      regular, sensor):
            detections.append(spikes)
        by_sensor = [noise_effects.residual_detections(NoiseSamples(
            time_s=comparison.time_s, residual_v=bridged(residual_v, used),
            simulated_v=comparison.simulated_noise_v(s, 0),
            at_rest=comparison.at_rest & used, used=used), s)
            for s in (sensor, replace(baseline, rate_hz=comparison.sensor.rate_hz))]
        of_baseline = {d.effect for d in by_sensor[1]}
        detections += [d for d in by_sensor[0] if d.effect in of_baseline]
    ranked = sorted(detections, key=lambda d: d.log_bayes_factor)
    return list({d.effect: d for d in ranked}.values())


def _could_show(comparison: BaselineComparison) -> bool:
    """Determine whether the sensor moves, or its temperature or supply changes."""
    if comparison.reference is Reference.SIMULATOR or (
            comparison.reference is Reference.STAGE and not comparison.at_rest.all()):
        return True
    paths = {name: getattr(comparison.motion, name) for name in _SMALLEST_RANGES}
    return any(path is not None and np.ptp(path(comparison.time_s)) > _SMALLEST_RANGES[name]
               for name, path in paths.items())


def _named_sensor(verdict: Verdict, detections: Sequence[Detection], searched: Sensor,
                  baseline: Sensor, fits: dict[str, HeldOutFits]) -> Sensor:
    """
    Return the baseline with exactly the effects whose closing the verdict states.

    Zero-g and scale factor that the file holds, or that changed beside the effects by a material
    amount, have their fitted values. Filter and latency stay those of the file.
    """
    if verdict.status in ('no_gap', 'insufficient', 'unknown'):
        return baseline
    best, drifts = verdict.best, [e for e in drift_effects()
                                  if e in (*verdict.effects, *sum(verdict.groups, ()))]
    sensor = with_neutral(baseline, best.effects)
    if best.effects:
        straight = [e for e in best.sensor.effects if effect_named(e).diagnosis.straight_line
                    and e not in best.effects
                    and (e in baseline.effects or _changed(best.sensor, searched, e, verdict))]
        sensor = with_neutral(sensor, straight)
        from_file = sensor
        sensor = replace(sensor, values={**sensor.values, **{
            e: best.sensor.values[e] for e in (*best.effects, *straight)}})
        # A size that these recordings do not determine would be a guess in others.
        hidden = [name for name, is_open in zip(best.names, best.undetermined)
                  if is_open and parameter_of(name).is_size]
        sensor = put(sensor, hidden, get(from_file, hidden))
    in_noise = {d.effect: d.values for d in detections if d.effect != UNKNOWN}
    in_noise |= {drift: {effect_named(drift).parameters[0].name: drift_densities(
        fits[drift], sensor)} for drift in drifts[:1]}
    for effect, values in in_noise.items():
        sensor = with_neutral(sensor, [effect])
        sensor = replace(sensor, values={
            **sensor.values, effect: {**sensor.values[effect], **values}})
    kept = [i for i, name in enumerate(baseline.covariance_names) if name.effect in sensor.effects]
    return replace(sensor, covariance=baseline.covariance[np.ix_(kept, kept)],
                   covariance_names=tuple(baseline.covariance_names[i] for i in kept))


def _changed(fitted: Sensor, baseline: Sensor, effect: str, verdict: Verdict) -> bool:
    """Determine whether a zero-g or scale factor changed by a material amount."""
    from_file = with_neutral(baseline, [effect])
    change = max(np.abs(np.asarray(fitted.values[effect][p.name])
                        - np.asarray(from_file.values[effect][p.name])).max()
                 for p in effect_named(effect).parameters)
    return bool(change / baseline.scale_v_per_g.min() * G0_MPS2 > verdict.material_mps2)


def _closure(verdict: Verdict, evidence: Evidence, floor: NoiseFloor,
             remainders: Sequence[NoiseRemainder], sensor: Sensor, seed: int) -> GapClosure:
    """Return the gap before and after the best set, above the floor without noise-like effects."""
    best = frozenset(verdict.best.effects) if verdict.status not in (
        'no_gap', 'insufficient', 'unknown') else frozenset()
    before, after = (evidence.mean(evidence.candidates[e].figures[HEALTHY].squares)
                     for e in (frozenset[str](), best))
    stated = noise.sample_std_v(sensor) / (sensor.scale_v_per_g / G0_MPS2)
    stated_mps2 = float(np.sqrt(np.mean(stated ** 2)))
    draws = floor.draws_mps2(seed, len(before) - 1)
    floors = np.concatenate([[floor.rms_mps2], np.full(len(before) - 1, floor.rms_mps2)
                             if draws is None else draws])
    lowest = np.array([floor_without(min(f, np.sqrt(a)), remainders, stated_mps2)
                       for f, a in zip(floors, after)])
    with np.errstate(all='ignore'):
        closed = (before - after) / np.where(before > lowest ** 2, before - lowest ** 2, np.nan)
    closed = np.clip(closed, -1.0, 1.0)
    return GapClosure(
        float(np.sqrt(before[0])), _interval(np.sqrt(before)), float(np.sqrt(after[0])),
        _interval(np.sqrt(after)), float(lowest[0]), None if draws is None else _interval(lowest),
        float(closed[0]), _interval(closed))


def _interval(draws: np.ndarray) -> tuple[float, float]:
    """Return the 90 % interval of draws after the first, which is the value."""
    finite = draws[1:][np.isfinite(draws[1:])]
    low, high = np.quantile(finite, [0.05, 0.95]) if len(finite) else (np.nan, np.nan)
    return float(low), float(high)


def _report(checked: Sequence[CheckedRecording], model: LinearModel, search: Search,
            verdict: Verdict, detections: Sequence[Detection], floor: NoiseFloor,
            evidence: Evidence, sensor: Sensor, seed: int) -> Report:
    """Add to a verdict the other parts of the report."""
    comparisons = [c.comparison for c in checked]
    baseline, lacking = comparisons[0].sensor, tuple(not_covered(model.comparisons))
    remainders = tuple(noise_remainders(comparisons, verdict.best.sensor, sensor, detections,
                                        seed))
    ranked = sorted(search.found.values(), key=lambda h: -h.log_evidence)
    return Report(
        verdict, _closure(verdict, evidence, floor, remainders, baseline, seed), floor,
        (verdict.best, *(h for h in ranked if h is not verdict.best)), tuple(detections),
        remainders, _noise_comparisons(comparisons, baseline, baseline, seed),
        _noise_comparisons(comparisons, verdict.best.sensor, sensor, seed),
        tuple(residual_map(model.comparisons[0], comparisons[0], floor.rms_mps2, seed)), lacking,
        tuple(shown(model, comparisons, floor, verdict.material_mps2)),
        propose_next_experiment(verdict, lacking, RecordedEvidence(baseline, model, seed)),
        model.lost_motion_mps2, baseline, sensor, model)


def shown(model: LinearModel, comparisons: Sequence[BaselineComparison], floor: NoiseFloor,
          material: float) -> list[CouldShow]:
    """Return the smallest size of each effect that recordings show, by the mean or the noise."""
    return sorted([*could_show(model, material),
                   *noise_could_show(comparisons[0], floor.noise_v, material)],
                  key=lambda row: (row.effect, row.parameter, row.axis))


def what_shows(recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None
               ) -> list[CouldShow] | DataFault:
    """Return what recordings can show, before any diagnosis; or why they cannot be compared."""
    checked = check(recordings, sensor, sim)
    if isinstance(checked, Diagnosis):
        assert checked.fault is not None
        return checked.fault
    model = build_linear_model([c.search_comparison for c in checked])
    comparisons = [c.comparison for c in checked]
    floor = noise_model.estimate(comparisons)
    return shown(model, comparisons, floor, material_mps2(model, floor))


def _noise_comparisons(comparisons: Sequence[BaselineComparison], mean_sensor: Sensor,
                       noise_sensor: Sensor, seed: int) -> tuple[NoiseComparison, ...]:
    """Compare the residual after one sensor's mean output with the noise of another sensor."""
    return tuple(compare_noise(bridged(c.residual_v(mean_sensor), c.used),
                               bridged(c.simulated_noise_v(noise_sensor, seed), c.used),
                               c.sensor.rate_hz, c.scale_v_per_mps2) for c in comparisons)
