# SPDX-License-Identifier: Apache-2.0
"""
The diagnosis as one library call, in stages.

They are comparison, checks, linear model, search and held-out figures; the verdict follows from
the figures. What the report adds comes last.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

from adxl_ros.diagnose import data_checks, next_experiment, noise_effects, verdict as rule
from adxl_ros.diagnose.comparison import BaselineComparison, LeftOut, Reference, with_values
from adxl_ros.diagnose.data_checks import CheckedRecording, DataFault
from adxl_ros.diagnose.evidence import (
    BLOCKS,
    drifts_among,
    estimate_floor,
    NoiseFloor,
    sum_by_block,
)
from adxl_ros.diagnose.flexible_functions import flexible_bases
from adxl_ros.diagnose.held_out import HeldOutFits
from adxl_ros.diagnose.linear_model import build_linear_model, filters_for, LinearModel
from adxl_ros.diagnose.next_experiment import CouldShow, NextExperiment
from adxl_ros.diagnose.noise_effects import compare_noise, Detection, NoiseRemainder
from adxl_ros.diagnose.remainder import Remainder, reproducible_remainder
from adxl_ros.diagnose.residual_map import not_covered, residual_map, ResidualCell
from adxl_ros.diagnose.search import Hypothesis, Search, with_filters
from adxl_ros.diagnose.verdict import HEALTHY, MATERIAL_MG, Verdict
from adxl_ros.files.recording_columns import check_same_sensor, Recording
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.sensor import get, parameter_of, put, Sensor, with_axes, with_neutral
from adxl_ros.report.quantities import Interval
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
import numpy as np

ShowProgress = Callable[[str, float], None]
"""Called with number and name of the stage, and the fraction of the work that is done."""

_DRIFT_LIMIT = 5.0
"""Expected mean square of a random walk about its mean, divided by the one in a recording, that
one walk in 20 exceeds. Derived from the random walk."""
_SMALLEST_RANGES = {'temperature_c': 0.5, 'supply_v': 0.02}
"""Range of temperature, °C, and supply, V, below which they do not change. Chosen: noise."""


class GapClosure(NamedTuple):
    """The gap before and after the effects of the verdict, held out, and the noise floor."""

    before: Interval  # Rms of recording minus simulation over samples and axes, m/s²
    after: Interval  # The same with the effects, m/s²
    floor: Interval  # Noise floor, m/s²; its interval is NaN where it is not measured
    closed: Interval  # (before² − after²)/(before² − floor²); NaN without a gap


@dataclass(frozen=True)
class Report:
    """A verdict with what a reader needs to believe and to use it."""

    verdict: Verdict  # The verdict with its figures
    closure: GapClosure  # The gap before and after the effects of the verdict
    noise_floor: NoiseFloor  # The noise floor with its source
    # Fitted sets of effects: that of the verdict, then those that explain most
    hypotheses: tuple[Hypothesis, ...]
    # detections, noise_remainders: Effects that show in the noise, and what remains after they are
    # added
    detections: tuple[Detection, ...]
    noise_remainders: tuple[NoiseRemainder, ...]
    # Recorded noise relative to simulated noise by recording, before and with what was found
    noise: tuple[dict[str, Any], ...]
    residual_cells: tuple[ResidualCell, ...]  # Map of the residual of the first recording
    not_covered: tuple[str, ...]  # What the recordings do not cover, for people
    # Smallest size of each effect that these recordings would have shown
    could_show: tuple[CouldShow, ...]
    next_experiment: NextExperiment | None  # What to record next
    baseline: Sensor  # The baseline
    sensor: Sensor  # The baseline with the effects whose closing is stated, ready for `simulate`
    linear_model: LinearModel  # The linear model of the recordings
    # What was not compared and is larger than what is material, by reason; without the samples of
    # effects that the verdict names
    left_out: tuple[LeftOut, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """What a diagnosis found: a report, or the fault of a recording that makes one impossible."""

    # The recordings beside the baseline, at the rate of the search
    comparisons: tuple[BaselineComparison, ...]
    # The same at their full rate; empty after a fault
    full_rate: tuple[BaselineComparison, ...] = ()
    fault: DataFault | None = None  # Fault of a recording
    report: Report | None = None  # The report where there is no fault


def diagnose(
    recordings: Sequence[Recording],
    sensor: Sensor,
    sim: Motion | None = None,
    seed: int = 0,
    show_progress: ShowProgress = lambda stage, fraction: None,
    align: bool = False,
    material_mg: float = MATERIAL_MG,
) -> Diagnosis:
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
    show_progress('1/5 checks', 0.0)
    try:
        checked = check(recordings, sensor, sim, align)
    except DataFault as fault:
        return Diagnosis(fault.comparisons, fault=fault)
    compared = [c.search_comparison for c in checked]
    model = build_linear_model(
        compared, lambda share: show_progress('2/5 library of effects', 0.1 + 0.2 * share)
    )
    search = Search(model)
    search.run(lambda share: show_progress('3/5 effects', 0.3 + 0.5 * share))
    show_progress('4/5 held-out figures', 0.8)
    floor = estimate_floor([c.comparison for c in checked])
    smallest_mps2 = material_mps2(model, floor, material_mg)
    evidence = _evidence(search, floor, smallest_mps2, seed)
    detections = _detections(
        checked, _with_likely_drift(search.best, evidence), model.baseline, smallest_mps2
    )

    def remainder_of(effects: frozenset[str], drift: str) -> Remainder:
        bases = chain(*map(flexible_bases, compared, model.baseline_v))
        return reproducible_remainder(evidence.candidates[effects][drift], bases)

    verdict = rule.decide(
        evidence,
        remainder_of,
        [rule.NoiseCause(d.effect, d.power_mps2, d.is_left_out) for d in detections],
        lambda effects: _simulate_again(search, effects),
    )
    left_out = _material_left_out(checked, verdict)
    if verdict.status == 'no_gap' and not any(map(_could_show, model.comparisons)):
        verdict = replace(verdict, status='insufficient')
    elif verdict.status == 'no_gap' and any(part.effect is not None for part in left_out):
        # A fault of the sensor is no absence of a gap because its samples were removed.
        verdict = replace(verdict, status='unknown')
    show_progress('5/5 report', 0.9)
    report = _report(checked, model, search, verdict, detections, floor, evidence, seed)
    show_progress('5/5 report', 1.0)
    return Diagnosis(
        tuple(model.comparisons),
        tuple(c.comparison for c in checked),
        None,
        replace(report, left_out=left_out),
    )


def _could_show(comparison: BaselineComparison) -> bool:
    """Return whether a sensor moves, or its temperature or supply changes."""
    if comparison.reference is Reference.SIMULATOR:
        return True
    if comparison.joints and not comparison.at_rest.all():
        return True
    return any(
        np.ptp(values) > _SMALLEST_RANGES[name] for name, values in comparison.surroundings.items()
    )


def _evidence(search: Search, floor: NoiseFloor, smallest_mps2: float, seed: int) -> rule.Evidence:
    """Fit all sets of effects to blocks, and predict those that were held out."""
    model = search.model
    comparisons = search.model.comparisons
    counts = np.sum([sum_by_block(c.used) for c in comparisons], axis=0)
    robot_mps2 = max(c.robot_error_mps2 for c in comparisons)
    return rule.Evidence(
        candidates=_held_out(search, floor, max(counts.sum(), 1.0)),
        counts=counts,
        weights=rule.block_weights(seed),
        material_mps2=smallest_mps2,
        reference_mps2=max(model.smallest_angle_rad() * G0_MPS2, robot_mps2),
        errs_in_motion=robot_mps2 > 0,
        fades=any(c.fading_hz is not None for c in comparisons),
        wanders=any(getattr(c.motion.force, 'wanders', False) for c in comparisons),
        floor_mps2=np.inf if floor.source == 'assumed' else floor.rms_mps2,
        sizeless={effects: h.sizeless for effects, h in search.found.items()},
    )


def _material_left_out(
    checked: Sequence[CheckedRecording], verdict: Verdict
) -> tuple[LeftOut, ...]:
    """Return what was left out and is material, but for what the verdict names or explains."""
    parts = []
    for comparison in (c.comparison for c in checked):
        for part in comparison.left_out:
            # Knocks look like lone samples, and a reference that is smoother lacks them.
            is_knock = bool(part.effect) and comparison.fading_hz is not None
            is_material = part.squares_mps2 > verdict.material_mps2**2 * len(comparison)
            if is_material and not is_knock and part.effect not in verdict.named:
                parts.append(part)
    return tuple(parts)


def check(
    recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None, align: bool = False
) -> list[CheckedRecording]:
    """Put recordings beside their simulation; raise DataFault for the first fault."""
    if not sensor.effects:
        sensor = with_axes(sensor, recordings[0].axes)
    doubts: list[list[str]] = []
    for recording in recordings:
        check_same_sensor(recording.stream_info, recording.axes, sensor)
        follows_stage = sim is None and {'alpha_rad', 'beta_rad'} <= {*recording.columns}
        # The angles of a stage show the unit of each axis, its sign, and which axis it is.
        doubts.append([] if follows_stage else data_checks.check_gravity(recording, sensor, sim))
    compared: list[BaselineComparison] = []
    try:
        for recording, of_samples in zip(recordings, doubts):
            comparison = data_checks.compare_checked(recording, sensor, sim, align)
            compared.append(replace(comparison, notes=(*of_samples, *comparison.notes)))
        checked = [data_checks.check_recording(comparison) for comparison in compared]
        data_checks.check_length(compared)
        return checked
    except DataFault as fault:
        # The notes of all recordings say what was corrected or left out before.
        of_fault = [c for c in fault.comparisons if not any(c is other for other in compared)]
        raise replace(fault, comparisons=(*compared, *of_fault)) from None


def material_mps2(
    model: LinearModel, floor: NoiseFloor, material_mg: float = MATERIAL_MG
) -> float:
    """Return the material amplitude: the stated one, or a share of the noise."""
    noise_mps2 = floor.noise_v / model.comparisons[0].scale_v_per_mps2
    return max(
        1e-3 * material_mg * G0_MPS2,
        rule.MATERIAL_SHARE_OF_NOISE
        * float(np.sqrt(np.mean(noise_mps2**2) + model.lost_motion_mps2**2)),
    )


class _FitsByDrift(Mapping[str, HeldOutFits]):
    """Held-out fits of a set by the drift of its noise; those with a drift once they are asked."""

    def __init__(
        self,
        healthy: HeldOutFits,
        drifts: Sequence[str],
        with_drift: Callable[[str], HeldOutFits | None],
    ) -> None:
        self._drifts = drifts
        self._with_drift = with_drift
        self._known: dict[str, HeldOutFits | None] = {HEALTHY: healthy}

    def __getitem__(self, drift: str) -> HeldOutFits:
        if drift not in self._known:
            self._known[drift] = self._with_drift(drift) if drift in self._drifts else None
        fits = self._known[drift]
        if fits is None:
            raise KeyError(drift)
        return fits

    def __iter__(self) -> Iterator[str]:
        return (drift for drift in (HEALTHY, *self._drifts) if drift in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _held_out(
    search: Search, floor: NoiseFloor, count: float
) -> dict[frozenset[str], Mapping[str, HeldOutFits]]:
    """Return held-out fits of all sets by the drift of their noise."""
    best = search.best
    model = search.model
    beside = with_filters(model, best.linearised, model.filters)
    drifts = drifts_among(library())
    if beside.fit(drifts=drifts).log_evidence <= beside.fit().log_evidence:
        drifts = ()

    def with_drift(healthy: HeldOutFits, drift: str) -> HeldOutFits | None:
        left = healthy.figures.squares.sum() / count - floor.rms_mps2**2
        filters = filters_for(model.filters, (*model.baseline.effects, drift))
        fits = HeldOutFits(with_filters(model, healthy.linearised, filters), model, (drift,))
        # A drift that should be far larger than what is left is none.
        return fits if fits.drift_mps2**2 <= _DRIFT_LIMIT * max(left, 0.0) else None

    out: dict[frozenset[str], Mapping[str, HeldOutFits]] = {}
    for effects, hypothesis in search.found.items():
        healthy = HeldOutFits(hypothesis.linearised, model)
        out[effects] = _FitsByDrift(healthy, drifts, partial(with_drift, healthy))
    return out


def _left_mps2(comparison: BaselineComparison, sensor: Sensor) -> np.ndarray:
    """Return the squares that a sensor leaves of used samples, mean over axes, (m/s²)², (n,)."""
    residual_mps2 = comparison.residual_v(sensor) / comparison.scale_v_per_mps2
    return np.mean(residual_mps2**2, axis=1) * comparison.used


def _simulate_again(search: Search, effects: frozenset[str]) -> rule.SimulatedAgain:
    """Simulate a set as it is printed in all recordings, and as it was fitted at their rests."""
    hypothesis = search.found[effects]
    model = search.model
    printed = _as_printed(hypothesis, with_neutral(model.baseline, hypothesis.effects))
    squares = np.zeros(BLOCKS)
    more_at_rest = []
    resting = 0
    for c in model.comparisons:
        left = _left_mps2(c, printed)
        left[~c.used] = 0.0
        squares += sum_by_block(left)
        if c.pose_known:
            more = _left_mps2(c, hypothesis.sensor)
            more -= _left_mps2(c, search.found[frozenset()].sensor)
            for begin, end in true_runs(c.at_rest & c.used):
                more_at_rest.append(float(np.sum(more[begin:end])))
                resting += end - begin
    return rule.SimulatedAgain(
        squares, np.array(more_at_rest), float(resting), hypothesis.at_bound
    )


def _as_printed(hypothesis: Hypothesis, sensor: Sensor) -> Sensor:
    """
    Give a sensor, which has the effects of a hypothesis, their fitted values.

    A size that these recordings do not determine would be a guess in others.
    """
    hidden = [
        name
        for name, is_open in zip(hypothesis.names, hypothesis.undetermined)
        if is_open and parameter_of(name).is_size
    ]
    fitted = {e: hypothesis.sensor.values[e] for e in hypothesis.effects}
    return put(replace(sensor, values={**sensor.values, **fitted}), hidden, get(sensor, hidden))


def _with_likely_drift(best: Hypothesis, evidence: rule.Evidence) -> Sensor:
    """Return the sensor of a set, with the drift that its noise needs most, if any."""
    effects = frozenset(best.effects)
    sensor = best.sensor
    fits = evidence.candidates[effects]
    nats = {d: evidence.figure(evidence.drift_nats(effects, d)) for d in fits if d != HEALTHY}
    likely = max(nats, key=lambda drift: nats[drift].value, default=HEALTHY)
    if likely == HEALTHY or not nats[likely].predicts:
        return sensor
    return _with_drift(sensor, likely, fits[likely])


def _with_drift(sensor: Sensor, drift: str, fits: HeldOutFits) -> Sensor:
    """Return a sensor with the drift that the noise of fits has."""
    densities = fits.drift_densities()[: len(sensor.axes)]
    name = effect_named(drift).parameters[0].name
    return with_values(with_neutral(sensor, [drift]), drift, {name: densities})


def _detections(
    checked: Sequence[CheckedRecording], best: Sensor, baseline: Sensor, smallest_mps2: float
) -> list[Detection]:
    """
    Return the material noise-like effects of recordings and residual, the strongest of each.

    Spikes count only where the residual of the best set shows them, too, and excess noise only
    where it exceeds that of the baseline, too: a filter also changes the noise. `best` is the
    sensor of the best set, whose drift is no excess noise.
    """
    detections: list[Detection] = []
    for c in checked:
        comparison = c.comparison
        used = c.comparison.used
        residual_v = comparison.residual_v(best)
        # In motion, a smooth reference lacks knocks that look like spikes.
        regular = used if comparison.fading_hz is None else used | ~comparison.at_rest
        spikes = [
            d
            for d in c.possible_spikes
            if noise_effects.residual_shows_spikes(d, residual_v, regular, comparison.sensor)
        ]
        found = noise_effects.residual_detections(comparison, residual_v, best)
        if found:
            of_baseline = noise_effects.residual_detections(comparison, residual_v, baseline)
            usual = {d.effect for d in of_baseline}
            found = [d for d in found if d.effect in usual]
        detections += [*c.detections, *spikes, *found]
    material = [d for d in detections if d.power_mps2 > smallest_mps2**2]
    return list({d.effect: d for d in sorted(material, key=lambda d: d.power_mps2)}.values())


def _named_sensor(
    verdict: Verdict,
    best: Hypothesis,
    detections: Sequence[Detection],
    baseline: Sensor,
    fits: Mapping[str, HeldOutFits],
    pose_known: bool,
) -> Sensor:
    """
    Return the baseline with exactly the effects whose closing the verdict states.

    Zero-g and scale factor that the file holds, or that changed beside the effects by a material
    amount, have their fitted values. Without a known pose these are those of its median output,
    and stay those of the file, as filter and latency do.
    """
    if not verdict.closes:
        return baseline
    fitted = best.sensor
    sensor = with_neutral(baseline, best.effects)
    from_file = with_neutral(baseline, fitted.effects)
    smallest_v = verdict.material_mps2 / G0_MPS2 * baseline.scale_v_per_g.min()

    def has_changed(effect: str) -> bool:
        before = from_file.values[effect]
        changes_v = [value - before[name] for name, value in fitted.values[effect].items()]
        return any(np.abs(change_v).max() > smallest_v for change_v in changes_v)

    if best.effects:
        straight = [
            e
            for e in fitted.effects
            if pose_known
            and e not in best.effects
            and effect_named(e).diagnosis.straight_line
            and (e in baseline.effects or has_changed(e))
        ]
        sensor = with_neutral(sensor, straight)
        sensor = _as_printed(
            best,
            replace(sensor, values={**sensor.values, **{e: fitted.values[e] for e in straight}}),
        )
    for detection in detections:
        sensor = detection.added_to(sensor)
    for drift in [e for e in drifts_among(library()) if e in verdict.named][:1]:
        sensor = _with_drift(sensor, drift, fits[drift])
    kept = [i for i, name in enumerate(baseline.covariance_names) if name.effect in sensor.effects]
    return replace(
        sensor,
        covariance=baseline.covariance[np.ix_(kept, kept)],
        covariance_names=tuple(baseline.covariance_names[i] for i in kept),
    )


def _closure(
    verdict: Verdict,
    evidence: rule.Evidence,
    floor: NoiseFloor,
    remainders: Sequence[NoiseRemainder],
    sensor: Sensor,
    removed_power: float,
    seed: int,
) -> GapClosure:
    """
    Return the gap before and after the best set, above the floor without noise-like effects.

    removed_power: mean square, (m/s²)², of samples that the sensor did not measure.
    """
    best = verdict.best if verdict.closes else frozenset[str]()

    def left(effects: frozenset[str]) -> np.ndarray:
        """Return the power that a set leaves, (m/s²)², by draw."""
        squares = evidence.candidates[effects][HEALTHY].figures.squares
        # A difference of squares may fall below 0 by rounding.
        return np.maximum(evidence.mean(squares), 0.0) + removed_power

    before = left(frozenset())
    after = left(best)
    stated = noise.sample_std_v(sensor) / (sensor.scale_v_per_g / G0_MPS2)
    stated_mps2 = rms(stated)
    draws = floor.draws_mps2(seed, len(before) - 1)
    floors = np.full(len(before), floor.rms_mps2)
    if draws is not None:
        floors[1:] = draws
    lowest = np.array(
        [
            noise_effects.floor_without(f, remainders, stated_mps2)
            for f in np.minimum(floors, np.sqrt(after))
        ]
    )
    with np.errstate(all='ignore'):
        closed = (before - after) / np.where(before > lowest**2, before - lowest**2, np.nan)
    if draws is None:
        lowest[1:] = np.nan
    return GapClosure(
        *map(_interval, (np.sqrt(before), np.sqrt(after), lowest, np.clip(closed, -1.0, 1.0)))
    )


def _interval(draws: np.ndarray) -> Interval:
    """Return the first value with the 90 % interval of the others."""
    finite = draws[1:][np.isfinite(draws[1:])]
    low, high = np.quantile(finite, [0.05, 0.95]) if len(finite) else (np.nan, np.nan)
    return Interval(float(draws[0]), float(low), float(high))


def _report(
    checked: Sequence[CheckedRecording],
    model: LinearModel,
    search: Search,
    verdict: Verdict,
    detections: Sequence[Detection],
    floor: NoiseFloor,
    evidence: rule.Evidence,
    seed: int,
) -> Report:
    """Add to a verdict the other parts of the report."""
    comparisons = [c.comparison for c in checked]
    best = search.found[verdict.best]
    # Coarse codes are an effect of the verdict, and not of its baseline.
    baseline = checked[0].stated
    fits = evidence.candidates[verdict.best]
    pose_known = any(c.pose_known for c in comparisons)
    sensor = _named_sensor(verdict, best, detections, baseline, fits, pose_known)
    lacking = tuple(not_covered(model.comparisons))
    remainders = tuple(
        noise_effects.noise_remainders(comparisons, best.sensor, sensor, detections, seed)
    )
    ranked = sorted(search.found.values(), key=lambda h: -h.log_evidence)
    sensors = {'before': (baseline, baseline), 'after': (best.sensor, sensor)}
    left_out = chain(*(c.left_out for c in comparisons))
    removed = sum(part.squares_mps2 for part in left_out if part.effect is not None)
    removed_power = removed / sum(len(c) for c in comparisons)
    return Report(
        verdict=verdict,
        closure=_closure(verdict, evidence, floor, remainders, baseline, removed_power, seed),
        noise_floor=floor,
        hypotheses=(best, *(h for h in ranked if h is not best)),
        detections=tuple(detections),
        noise_remainders=remainders,
        noise=tuple(compare_noise(c, sensors, seed) for c in comparisons),
        residual_cells=tuple(residual_map(model.comparisons[0], seed)),
        not_covered=lacking,
        could_show=tuple(
            next_experiment.could_show(model, comparisons[0], floor.noise_v, verdict.material_mps2)
        ),
        next_experiment=next_experiment.propose_next_experiment(
            verdict, lacking, baseline, model, seed
        ),
        baseline=baseline,
        sensor=sensor,
        linear_model=model,
    )


def what_shows(
    recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None
) -> list[CouldShow] | DataFault:
    """Return what recordings can show, before any diagnosis; or why they cannot be compared."""
    try:
        checked = check(recordings, sensor, sim)
    except DataFault as fault:
        return fault
    model = build_linear_model([c.search_comparison for c in checked])
    floor = estimate_floor([c.comparison for c in checked])
    return next_experiment.could_show(
        model, checked[0].comparison, floor.noise_v, material_mps2(model, floor)
    )


def self_check(
    diagnosis: Diagnosis,
    recordings: list[Recording],
    sim: Motion | None,
    count: int,
    seed: int,
    show: Callable[[float], None] = lambda done: None,
) -> str:
    """
    Diagnose recordings that are simulated from a verdict; say how often the verdict comes back.

    This is posterior simulation-based calibration (Säilynoja, Schmitt, Bürkner and Vehtari 2025,
    arXiv 2502.03279): the sensor of the verdict records the same motion, with noise and with the
    steps of the encoder, and the same baseline is compared with it.
    """
    report = diagnosis.report
    assert report is not None
    named = report.verdict.effects, report.verdict.groups
    same = 0
    inside = []
    for i in range(count):
        drawn = []
        for k, (c, recording) in enumerate(zip(diagnosis.full_rate, recordings)):
            sensor = replace(report.sensor, rate_hz=recording.rate_hz)
            columns = simulate(
                sensor, c.motion, seed + 1 + i * len(recordings) + k, like=recording
            )
            drawn.append(replace(recording, time_s=columns.pop('time_s'), columns=columns))
        again = diagnose(drawn, report.baseline, sim, seed).report
        if again is not None:
            same += (again.verdict.effects, again.verdict.groups) == named
            fitted = again.hypotheses[0]
            places = [
                j
                for j, name in enumerate(fitted.names)
                if report.verdict.closes
                and name.effect in report.verdict.best
                and not fitted.undetermined[j]
            ]
            names = [fitted.names[j] for j in places]
            inside += list(
                np.abs(get(fitted.sensor, names) - get(report.sensor, names))
                <= Z_90 * fitted.std[places]
            )
        show((i + 1) / count)
    sizes = (
        f', {sum(inside)} of {len(inside)} intervals held the size (90 % expected)'
        if inside
        else ''
    )
    return f'self-check: {same} of {count} simulated recordings had the same verdict{sizes}'
