# SPDX-License-Identifier: Apache-2.0
"""
The diagnosis as one library call, in stages.

They are comparison, checks, linear model, search and held-out figures; the verdict follows from
the figures. What the report adds comes last.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from adxl_ros.diagnose import data_checks, verdict as rule
from adxl_ros.diagnose.comparison import BaselineComparison, LeftOut, Reference
from adxl_ros.diagnose.could_show import could_show, CouldShow
from adxl_ros.diagnose.data_checks import CheckedRecording
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.detection import Detection
from adxl_ros.diagnose.evidence import BLOCKS, sum_by_block
from adxl_ros.diagnose.flexible_functions import flexible_bases
from adxl_ros.diagnose.gap_closure import gap_closure, GapClosure
from adxl_ros.diagnose.held_out import HeldOutFits
from adxl_ros.diagnose.ideal_observer import Surest, surest
from adxl_ros.diagnose.linear_model import (
    build_linear_model,
    LinearModel,
    with_filters,
)
from adxl_ros.diagnose.next_experiment import NextExperiment, propose_next_experiment
from adxl_ros.diagnose.noise_effects import residual_detections
from adxl_ros.diagnose.noise_filters import drifts_among
from adxl_ros.diagnose.noise_floor import estimate_floor, NoiseFloor
from adxl_ros.diagnose.noise_remainders import (
    compare_noise,
    noise_remainders,
    NoiseRemainder,
    NoiseSensors,
)
from adxl_ros.diagnose.remainder import Remainder, reproducible_remainder
from adxl_ros.diagnose.residual_map import not_covered, residual_map, ResidualCell
from adxl_ros.diagnose.sample_faults import residual_shows_spikes
from adxl_ros.diagnose.search import Hypothesis, Search
from adxl_ros.diagnose.verdict import MATERIAL_MG, Verdict
from adxl_ros.diagnose.verdict_sensor import as_printed, named_sensor, with_likely_drift
from adxl_ros.diagnose.weighing import ByDraw, Evidence, HEALTHY, SimulatedAgain
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import check_same_sensor
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor, with_axes, with_neutral
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.motion import Motion
import numpy as np

ShowProgress = Callable[[str, float], None]
"""Called with number and name of the stage, and the fraction of the work that is done."""

_SMALLEST_RANGES = {'temperature_c': 0.5, 'supply_v': 0.02}
"""Range of temperature, °C, and supply, V, below which they do not change. Chosen: noise."""
_FEWEST_RESTING = 200  # Resting samples that show the noise. Chosen: to a tenth of its power


@dataclass(frozen=True)
class Report:
    """A verdict with what a reader needs to believe and to use it."""

    verdict: Verdict  # The verdict with its figures
    closure: GapClosure  # The gap before and after the effects of the verdict
    noise_floor: NoiseFloor  # The noise floor with its source
    # Fitted sets of effects: that of the verdict, then those that explain most
    hypotheses: tuple[Hypothesis, ...]
    detections: tuple[Detection, ...]  # Effects that show in the noise
    noise_remainders: tuple[NoiseRemainder, ...]  # What remains after they are added
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
    # How surely an ideal observer names the effects on the mean; None where nobody asked
    surest: Surest | None = None


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
    limit: bool = False,
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
    limit
        Whether to find how sure an ideal observer could be.

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
    likely = with_likely_drift(search.best, evidence)
    detections = _detections(checked, likely, model.baseline, smallest_mps2)

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
    if verdict.status == 'no_gap':
        status = _status_without_gap(model.comparisons, left_out)
        if status == 'unknown':
            of_status = rule.probability_of(status, verdict.repeated)
            verdict = replace(verdict, probability=of_status)
        verdict = replace(verdict, status=status)
    show_progress('5/5 report', 0.9)
    report = _report(checked, model, search, verdict, detections, floor, evidence, seed)
    observed = surest(model, report.hypotheses[0], verdict.named) if limit else None
    show_progress('5/5 report', 1.0)
    return Diagnosis(
        tuple(model.comparisons),
        tuple(c.comparison for c in checked),
        None,
        replace(report, left_out=left_out, surest=observed),
    )


def _status_without_gap(
    comparisons: Sequence[BaselineComparison], left_out: Sequence[LeftOut]
) -> str:
    """Return what a verdict without a gap may say of recordings."""
    if not any(map(_could_show, comparisons)):
        return 'insufficient'
    # A fault of the sensor is no absence of a gap because its samples were removed.
    hides_a_fault = any(part.effect is not None for part in left_out)
    return 'unknown' if hides_a_fault else 'no_gap'


def _could_show(comparison: BaselineComparison) -> bool:
    """Return whether a sensor moves, or its temperature or supply changes."""
    if comparison.reference is Reference.SIMULATOR:
        return True
    if comparison.joints and not comparison.at_rest.all():
        return True
    return any(
        np.ptp(values) > _SMALLEST_RANGES[name] for name, values in comparison.surroundings.items()
    )


def _evidence(search: Search, floor: NoiseFloor, smallest_mps2: float, seed: int) -> Evidence:
    """Fit all sets of effects to blocks, and predict those that were held out."""
    model = search.model
    comparisons = model.comparisons
    counts = np.sum([sum_by_block(c.used) for c in comparisons], axis=0)
    weights = rule.block_weights(seed)
    robot_mps2 = max(c.robot_error_mps2 for c in comparisons)
    return Evidence(
        candidates=_held_out(search),
        counts=counts,
        weights=weights,
        material_mps2=smallest_mps2,
        reference_mps2=float(max(model.smallest_angle_rad() * G0_MPS2, robot_mps2)),
        errs_in_motion=robot_mps2 > 0,
        fades=any(c.fading_hz is not None for c in comparisons),
        wanders=any(getattr(c.motion.force, 'wanders', False) for c in comparisons),
        floor=ByDraw(floor.power(seed, len(weights) - 1)),
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
    unknown_mps2 = float(np.sqrt(np.mean(noise_mps2**2) + model.lost_motion_mps2**2))
    return max(1e-3 * material_mg * G0_MPS2, rule.MATERIAL_SHARE_OF_NOISE * unknown_mps2)


def _held_out(search: Search) -> dict[frozenset[str], Mapping[str, HeldOutFits]]:
    """Return held-out fits of all sets by the drift of their noise."""
    model = search.model
    beside = with_filters(model, search.best.linearised, model.filters)
    drifts = drifts_among(library())
    if beside.fit(drifts=drifts).log_evidence <= beside.fit().log_evidence:
        drifts = ()

    out: dict[frozenset[str], Mapping[str, HeldOutFits]] = {}
    for effects, hypothesis in search.found.items():
        fits = {d: HeldOutFits(hypothesis.linearised, model, (d,)) for d in drifts}
        out[effects] = {HEALTHY: HeldOutFits(hypothesis.linearised, model), **fits}
    return out


def _left(comparison: BaselineComparison, sensor: Sensor) -> np.ndarray:
    """Return what a sensor leaves, m/s², (n, m); 0 where a sample is not used."""
    residual_mps2 = comparison.residual_v(sensor) / comparison.scale_v_per_mps2
    return np.where(comparison.used[:, None], residual_mps2, 0.0)


def _mean_squares(values: np.ndarray) -> np.ndarray:
    """Return the mean squares over axes of values, (n, m)."""
    return np.mean(values**2, axis=1)


def _vibration_in_motion(comparison: BaselineComparison, left_mps2: np.ndarray) -> np.ndarray:
    """
    Return the squares of vibration that shows only while joints move, (m/s²)², by block.

    It is half the squared change from sample to sample: slow motion hardly counts, nor does noise
    of the sensor, which shows at rest, too.
    """
    paired = comparison.used & np.append(False, comparison.used[:-1])
    rests = comparison.at_rest & paired
    if not comparison.joints or rests.sum() < _FEWEST_RESTING:
        return np.zeros(BLOCKS)
    squares = _mean_squares(np.diff(left_mps2, axis=0, prepend=left_mps2[:1])) / 2
    moves = paired & ~comparison.at_rest
    return sum_by_block(np.where(moves, squares - squares[rests].mean(), 0.0))


def _simulate_again(search: Search, effects: frozenset[str]) -> SimulatedAgain:
    """Simulate a set as it is printed in all recordings, and as it was fitted at their rests."""
    hypothesis = search.found[effects]
    plain = search.found[frozenset()]
    printed = as_printed(hypothesis, with_neutral(search.model.baseline, hypothesis.effects))
    squares, vibration = np.zeros((2, BLOCKS))
    more_at_rest = []
    resting = 0
    for c in search.model.comparisons:
        left_mps2 = _left(c, printed)
        squares += sum_by_block(_mean_squares(left_mps2))
        vibration += _vibration_in_motion(c, left_mps2)
        if c.pose_known:
            fitted_mps2, plain_mps2 = _left(c, hypothesis.sensor), _left(c, plain.sensor)
            more = _mean_squares(fitted_mps2) - _mean_squares(plain_mps2)
            for begin, end in true_runs(c.at_rest & c.used):
                more_at_rest.append(float(np.sum(more[begin:end])))
                resting += end - begin
    return SimulatedAgain(
        squares, np.array(more_at_rest), float(resting), hypothesis.at_bound, vibration
    )


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
        used = comparison.used
        residual_v = comparison.residual_v(best)
        # In motion, a smooth reference lacks knocks that look like spikes.
        regular = used if comparison.fading_hz is None else used | ~comparison.at_rest
        spikes = [
            d
            for d in c.faults.possible_spikes
            if residual_shows_spikes(d, residual_v, regular, comparison.sensor)
        ]
        found = residual_detections(comparison, residual_v, best)
        if found:
            of_baseline = residual_detections(comparison, residual_v, baseline)
            usual = {d.effect for d in of_baseline}
            found = [d for d in found if d.effect in usual]
        detections += [*c.faults.detections, *spikes, *found]
    material = [d for d in detections if d.power_mps2 > smallest_mps2**2]
    return list({d.effect: d for d in sorted(material, key=lambda d: d.power_mps2)}.values())


def _report(
    checked: Sequence[CheckedRecording],
    model: LinearModel,
    search: Search,
    verdict: Verdict,
    detections: Sequence[Detection],
    floor: NoiseFloor,
    evidence: Evidence,
    seed: int,
) -> Report:
    """Add to a verdict the other parts of the report."""
    comparisons = [c.comparison for c in checked]
    best = search.found[verdict.best]
    # Coarse codes are an effect of the verdict, and not of its baseline.
    baseline = checked[0].stated
    fits = evidence.candidates[verdict.best]
    pose_known = any(c.pose_known for c in comparisons)
    sensor = named_sensor(verdict, best, detections, baseline, fits, pose_known)
    lacking = tuple(not_covered(model.comparisons))
    remainders = tuple(noise_remainders(comparisons, best.sensor, sensor, detections, seed))
    ranked = sorted(search.found.values(), key=lambda h: -h.log_evidence)
    before = NoiseSensors(baseline, baseline)
    after = NoiseSensors(best.sensor, sensor)
    left_out = chain(*(c.left_out for c in comparisons))
    removed = sum(part.squares_mps2 for part in left_out if part.effect is not None)
    removed_power = removed / sum(len(c) for c in comparisons)
    return Report(
        verdict=verdict,
        closure=gap_closure(verdict, evidence, floor, remainders, baseline, removed_power),
        noise_floor=floor,
        hypotheses=(best, *(h for h in ranked if h is not best)),
        detections=tuple(detections),
        noise_remainders=remainders,
        noise=tuple(compare_noise(c, before, after, seed) for c in comparisons),
        residual_cells=tuple(residual_map(model.comparisons[0], seed)),
        not_covered=lacking,
        could_show=tuple(could_show(model, comparisons[0], floor.noise_v, verdict.material_mps2)),
        next_experiment=propose_next_experiment(verdict, lacking, baseline, model, seed),
        baseline=baseline,
        sensor=sensor,
        linear_model=model,
    )


def what_shows(
    recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None
) -> list[CouldShow]:
    """Return what recordings can show, before any diagnosis; raise why they cannot be compared."""
    checked = check(recordings, sensor, sim)
    model = build_linear_model([c.search_comparison for c in checked])
    floor = estimate_floor([c.comparison for c in checked])
    return could_show(model, checked[0].comparison, floor.noise_v, material_mps2(model, floor))
