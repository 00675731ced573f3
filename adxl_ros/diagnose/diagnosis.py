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
The diagnosis as one library call, in stages.

The stages are comparison, checks, linear model, search and decision. What the report adds follows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from adxl_ros.diagnose import data_checks, decision, gap_closure, noise_detectors
from adxl_ros.diagnose.baseline_comparison import BaselineComparison, Reference
from adxl_ros.diagnose.data_checks import CheckedRecording, DataFault
from adxl_ros.diagnose.decision import Findings, Verdict
from adxl_ros.diagnose.decision_settings import DecisionSettings
from adxl_ros.diagnose.determination import at_baseline, not_determined, NotDetermined
from adxl_ros.diagnose.drift_checks import walk_log_bayes_factor
from adxl_ros.diagnose.effect_sizes import contribution, size_hypothesis, SizedHypothesis
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.diagnose.gap_closure import GapClosure, HeldOutResidual
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, residual_channels
from adxl_ros.diagnose.input_checks import compare_checked
from adxl_ros.diagnose.linear_model import build_linear_model, LinearModel
from adxl_ros.diagnose.model_search import refit, search
from adxl_ros.diagnose.next_experiment import (
    NextExperiment,
    propose_next_experiment,
    RecordedEvidence,
)
from adxl_ros.diagnose.noise_comparison import compare_noise, NoiseComparison
from adxl_ros.diagnose.noise_detectors import Detection, NoiseSamples, UNKNOWN
from adxl_ros.diagnose.noise_floor import NoiseFloor
from adxl_ros.diagnose.noise_remainder import (
    floor_without,
    noise_remainders,
    NoiseRemainder,
)
from adxl_ros.diagnose.noise_whitening import drifts_among
from adxl_ros.diagnose.posterior import hidden_odds, posterior, WeighedHypothesis
from adxl_ros.diagnose.progress_plan import (
    BASIS_WORK,
    CHECKS,
    LIBRARY,
    PROBABILITIES,
    ProgressPlan,
    REPORT,
    SET_WORK,
    ShowProgress,
)
from adxl_ros.diagnose.residual_map import (
    not_covered,
    residual_map,
    ResidualCell,
    SMALLEST_WARMING_C,
)
from adxl_ros.diagnose.single_effect_tests import single_effect_tests, SingleEffectTest
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_unit import check_unit
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.diagnosis_hints import StraightLine
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.simulate.motion import Motion
import numpy as np

_SMALLEST_SUPPLY_CHANGE_V = 0.02
"""Range of the supply, V, below which it does not change. Chosen: twice the ripple of a
regulator."""


@dataclass(frozen=True)
class Diagnosis:
    """
    Everything that a diagnosis found.

    Attributes
    ----------
    data_fault
        Fault of a recording; then everything else is empty.
    comparisons
        The recordings at the rate of the search, beside the baseline.
    full_rate
        The same recordings at their full rate.
    noise_floor
        The noise floor.
    verdict
        The verdict.
    hypotheses
        Material hypotheses, the most probable first.
    detections
        Noise-like effects that show.
    noise_remainders
        What remains of the noise-like effects after they are added to the simulation.
    gap_closure
        How far the best hypothesis closes the gap. Its floor is without noise-like effects.
    residual_cells
        Map of the residual of the first recording.
    not_covered
        What the recordings do not cover, for people.
    next_experiment
        What to record next.
    contributions_mps2
        Rms that each effect of the best hypothesis contributes, m/s².
    not_determined
        Parameters of the effects of the hypotheses that the recordings do not determine.
    single_effect_tests
        Tests of each effect alone.
    lost_motion_mps2
        Rms of motion that a smooth reference lacks, m/s², which nothing simulates.
    noise_before, noise_after
        Recorded noise relative to simulated noise, recording by recording: with the baseline, and
        with the baseline and the effects that were found.
    sensor
        The baseline with the effects of the verdict, ready for `simulate`.
    linear_model
        The linear model of the recordings.

    """

    data_fault: DataFault | None
    comparisons: list[BaselineComparison]
    full_rate: tuple[BaselineComparison, ...] = ()
    noise_floor: NoiseFloor | None = None
    verdict: Verdict | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    detections: tuple[Detection, ...] = ()
    noise_remainders: tuple[NoiseRemainder, ...] = ()
    gap_closure: GapClosure | None = None
    residual_cells: tuple[ResidualCell, ...] = ()
    not_covered: tuple[str, ...] = ()
    next_experiment: NextExperiment | None = None
    contributions_mps2: dict[str, float] = field(default_factory=dict)
    not_determined: NotDetermined = field(default_factory=dict)
    single_effect_tests: dict[str, SingleEffectTest] = field(default_factory=dict)
    lost_motion_mps2: float = 0.0
    noise_before: tuple[NoiseComparison, ...] = ()
    noise_after: tuple[NoiseComparison, ...] = ()
    sensor: Sensor | None = None
    linear_model: LinearModel | None = None


SETTINGS = DecisionSettings()
"""Settings of the decision."""


def diagnose(recordings: Sequence[Recording], sensor: Sensor, sim: Motion | None = None,
             seed: int = 0, show_progress: ShowProgress = lambda stage, fraction: None,
             align: bool = False) -> Diagnosis:
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

    Returns
    -------
    Diagnosis
        The verdict with its evidence, or a fault of a recording.

    Raises
    ------
    UserError
        A recording is of another unit, or its reference cannot be followed.

    """
    if not sensor.effects:
        sensor = with_axes(sensor, recordings[0].axes)
    plan = ProgressPlan(show_progress)
    plan.show(CHECKS, 0.0)
    compared: list[BaselineComparison] = []
    for recording in recordings:
        check_unit(recording.stream_info, recording.axes, sensor)
        comparison = compare_checked(recording, sensor, sim, align)
        if isinstance(comparison, DataFault):
            return Diagnosis(comparison, [])
        compared.append(comparison)
    short = data_checks.find_length_fault(compared)
    if short is not None:
        return Diagnosis(short, compared)
    checked: list[CheckedRecording] = []
    for comparison in compared:
        result = data_checks.check_recording(comparison)
        if isinstance(result, DataFault):
            return Diagnosis(result, [comparison])
        checked.append(result)
    linear_model = build_linear_model([c.search_comparison for c in checked],
                                      plan.within(LIBRARY))
    searched = search(linear_model, SETTINGS, plan)
    plan.expect(PROBABILITIES, BASIS_WORK + SET_WORK * len(searched.hypotheses))
    explanation = _explain(checked, linear_model, searched.hypotheses, sensor, seed,
                           plan.within(PROBABILITIES))
    plan.show(REPORT, 0.0)
    verdict = _decide(linear_model, explanation,
                      hidden_odds(linear_model, searched.single_gains, SETTINGS))
    diagnosis = _with_report(checked, linear_model, explanation, verdict, sensor, seed)
    plan.show(REPORT, 1.0)
    return replace(diagnosis, full_rate=tuple(c.comparison for c in checked))


@dataclass(frozen=True)
class _Explanation:
    """
    The hypotheses that hold on held-out blocks, and the noise beside the best of them.

    Attributes
    ----------
    noise_floor
        The noise floor.
    noise_mps2
        Rms of the noise without the steps of the encoder, m/s².
    weighed
        Sets of effects that hold, with and without something unknown, the most probable first.
    closure
        Gap closure of the best hypothesis.
    detections
        Noise-like effects that show.
    noise_remainders
        What remains of the noise-like effects.
    sensor
        The baseline with the best hypothesis and the detections.
    noise_before, noise_after
        Recorded noise relative to simulated noise, with the baseline and with `sensor`.
    lost_motion_mps2
        Rms of motion that a smooth reference lacks, m/s²; 0 unless the best hypothesis has one.

    """

    noise_floor: NoiseFloor
    noise_mps2: float
    weighed: list[WeighedHypothesis]
    closure: GapClosure
    detections: list[Detection]
    noise_remainders: list[NoiseRemainder]
    sensor: Sensor
    noise_before: tuple[NoiseComparison, ...]
    noise_after: tuple[NoiseComparison, ...]
    lost_motion_mps2: float


def _explain(checked: Sequence[CheckedRecording], linear_model: LinearModel,
             hypotheses: Sequence[Hypothesis], sensor: Sensor, seed: int,
             show_share: Callable[[float], None]) -> _Explanation:
    """Keep the material hypotheses that hold on held-out blocks, and find noise-like effects."""
    comparisons = [c.comparison for c in checked]
    floor = gap_closure.estimate_noise_floor(comparisons)
    scale_v_per_mps2 = linear_model.comparisons[0].scale_v_per_mps2
    noise_mps2 = float(np.sqrt(np.mean((floor.noise_v / scale_v_per_mps2) ** 2)))
    weighed = posterior(linear_model, _sized(linear_model, hypotheses, noise_mps2), SETTINGS)
    show_share(0.7)
    baseline_residual = gap_closure.held_out_residual(linear_model, comparisons, (),
                                                      linear_model.baseline)
    confirmed, closure = _confirmed(linear_model, comparisons, weighed, baseline_residual,
                                    floor.rms_mps2, seed)
    confirmed = _at_baseline(linear_model, confirmed)
    best = _best(confirmed)
    detections = _detections(checked, best)
    named_sensor = _with_detections(best, detections, sensor)
    return _Explanation(
        floor, noise_mps2, confirmed, closure, detections,
        noise_remainders(comparisons, best.sensor, named_sensor, detections, best.effects, seed),
        named_sensor,
        _noise_comparisons(comparisons, sensor, sensor, seed),
        _noise_comparisons(comparisons, best.sensor, named_sensor, seed),
        _lost_motion_mps2(comparisons, best))


def _lost_motion_mps2(comparisons: Sequence[BaselineComparison], best: Hypothesis) -> float:
    """Return the rms of motion that a smooth reference lacks, m/s²."""
    if not any(effect_named(e).diagnosis.smooths_reference for e in best.effects):
        return 0.0
    return float(np.sqrt(np.average(
        [gap_closure.lost_motion_mps2(c, best.sensor) ** 2 for c in comparisons],
        weights=[c.used.sum() for c in comparisons])))


def _at_baseline(linear_model: LinearModel, weighed: Sequence[WeighedHypothesis]
                 ) -> list[WeighedHypothesis]:
    """Return the sets; sizes of the best one that are not determined are those of the baseline."""
    best = next(w for w in weighed if w.unknown is None)
    return [replace(w, hypothesis=at_baseline(linear_model, w.hypothesis)) if w is best else w
            for w in weighed]


def _sized(linear_model: LinearModel, hypotheses: Sequence[Hypothesis], noise_mps2: float
           ) -> list[SizedHypothesis]:
    """Size hypotheses; fit the material effects of probable ones, too, and all exact ones."""
    sized = [size_hypothesis(linear_model, h, noise_mps2, SETTINGS) for h in hypotheses]
    present = {frozenset(h.effects) for h in hypotheses}
    lowest = hypotheses[0].log_evidence - SETTINGS.smallest_deficit
    for s in list(sized):
        exact = all(effect_named(e).exact for e in s.material)
        if s.material in present or not (exact or s.hypothesis.log_evidence >= lowest):
            continue
        present.add(s.material)
        refitted = refit(linear_model, s.hypothesis, sorted(s.material))
        if refitted is not None:
            sized.append(size_hypothesis(linear_model, refitted, noise_mps2, SETTINGS))
    return sized


def _best(weighed: Sequence[WeighedHypothesis]) -> Hypothesis:
    """Return the most probable hypothesis without anything unknown."""
    return next(w.hypothesis for w in weighed if w.unknown is None)


def _decide(linear_model: LinearModel, explanation: _Explanation, hidden: Mapping[str, float]
            ) -> Verdict:
    """Gather the findings beside the best hypothesis, and decide."""
    best, closure = _best(explanation.weighed), explanation.closure
    simulated_noise_mps2 = float(np.sqrt(np.mean(
        [n.simulated_std_mps2 ** 2 for n in explanation.noise_after])))
    walk = walk_log_bayes_factor(list(residual_channels(linear_model, best))) \
        if drifts_among(best.effects) else 0.0
    verdict = decision.decide(Findings(
        weighed=explanation.weighed,
        hidden_odds=hidden,
        walk_log_bayes_factor=walk,
        detections=explanation.detections,
        noise_mps2=explanation.noise_mps2,
        explained_mps2=closure.explained_mps2,
        unexplained_mps2=gap_closure.unexplained_mps2(
            linear_model, best, closure, simulated_noise_mps2, explanation.lost_motion_mps2),
        lost_motion_mps2=explanation.lost_motion_mps2,
        code_step_mps2=max(map(_rounding_std_mps2, linear_model.comparisons))), SETTINGS)
    if verdict.status == 'no_gap' and not any(map(_could_show, linear_model.comparisons)):
        return replace(verdict, status='insufficient')
    if any(c.reference_fades for c in linear_model.comparisons):
        return decision.without_fast_effects(verdict)
    return verdict


def _rounding_std_mps2(comparison: BaselineComparison) -> float:
    """Return the standard deviation of the ADC's rounding on its coarsest axis, m/s²."""
    return float(comparison.sensor.lsb_v / np.min(comparison.scale_v_per_mps2)) / 12 ** 0.5


def _with_report(checked: Sequence[CheckedRecording], linear_model: LinearModel,
                 explanation: _Explanation, verdict: Verdict, sensor: Sensor, seed: int
                 ) -> Diagnosis:
    """Add to a verdict the other parts of the report."""
    comparisons, best = linear_model.comparisons, verdict.best
    floor, lacking = explanation.noise_floor, not_covered(comparisons)
    contributions_mps2 = {
        effect: contribution(linear_model, best, effect).rms_mps2 for effect in best.effects}
    named = verdict.status not in ('no_gap', 'unknown', 'insufficient')
    hypotheses = tuple(w.hypothesis for w in explanation.weighed if w.unknown is None)
    return Diagnosis(
        data_fault=None,
        comparisons=comparisons,
        noise_floor=floor,
        verdict=verdict,
        hypotheses=hypotheses,
        detections=tuple(explanation.detections),
        noise_remainders=tuple(explanation.noise_remainders),
        gap_closure=_without_noise_effects(explanation, sensor, seed),
        residual_cells=tuple(residual_map(comparisons[0], checked[0].comparison,
                                          floor.rms_mps2, seed)),
        not_covered=tuple(lacking),
        next_experiment=propose_next_experiment(verdict, lacking, RecordedEvidence(
            sensor, linear_model, SETTINGS.evidence_factor, seed)),
        contributions_mps2=contributions_mps2,
        not_determined=not_determined(linear_model, hypotheses),
        single_effect_tests=single_effect_tests(linear_model, seed),
        lost_motion_mps2=explanation.lost_motion_mps2,
        noise_before=explanation.noise_before,
        noise_after=explanation.noise_after,
        sensor=explanation.sensor if named else sensor,
        linear_model=linear_model)


def _without_noise_effects(explanation: _Explanation, sensor: Sensor, seed: int) -> GapClosure:
    """
    Return the gap closure with the noise floor that the noise-like effects are above.

    The steps of the encoder count as far as the residual has them: where its angles are smoothed,
    the residual is smaller than noise and steps together.
    """
    at_rate = replace(sensor, rate_hz=explanation.sensor.rate_hz)
    stated = noise.sample_std_v(at_rate) / (at_rate.scale_v_per_g / G0_MPS2)
    stated_mps2 = float(np.sqrt(np.mean(stated ** 2)))

    def floor_mps2(measured_mps2: float, after_mps2: float) -> float:
        return floor_without(min(measured_mps2, after_mps2), explanation.noise_remainders,
                             stated_mps2)

    floor, closure = explanation.noise_floor, explanation.closure
    middle_mps2 = floor_mps2(floor.rms_mps2, closure.after_mps2)
    draws_mps2 = floor.draws_mps2(seed)
    if draws_mps2 is None:
        return closure.at_floor(middle_mps2, None, seed)
    low_mps2, high_mps2 = np.quantile(
        list(map(floor_mps2, draws_mps2, closure.after_draws_mps2(seed))), [0.05, 0.95])
    return closure.at_floor(middle_mps2, (min(float(low_mps2), middle_mps2),
                                          max(float(high_mps2), middle_mps2)), seed)


def _confirmed(linear_model: LinearModel, comparisons: Sequence[BaselineComparison],
               weighed: Sequence[WeighedHypothesis], baseline_residual: HeldOutResidual,
               floor_mps2: float, seed: int) -> tuple[list[WeighedHypothesis], GapClosure]:
    """
    Remove the most probable hypotheses until the first one holds on held-out blocks.

    A hypothesis holds if it makes the held-out samples more probable and their residual not
    larger. Effects that nuisance parameters absorb need not make the samples more probable. A
    hypothesis with a drift must predict more than the same effects without it, because a drift
    also follows what the form of these effects lacks.
    """
    closures: dict[frozenset[str], GapClosure] = {}

    def closure_of(hypothesis: Hypothesis) -> GapClosure:
        effects = frozenset(hypothesis.effects)
        if effects not in closures:
            closures[effects] = gap_closure.gap_closure(
                linear_model, comparisons, hypothesis, baseline_residual, floor_mps2, seed)
        return closures[effects]

    def holds(best: Hypothesis, others: Sequence[Hypothesis]) -> bool:
        closure = closure_of(best)
        absorbed = all(effect_named(e).diagnosis.absorbed for e in best.effects)
        # Motion that the reference lacks makes most of the squares, so that they say nothing.
        harm = closure.harm and not any(c.reference_fades for c in comparisons)
        if harm or not (closure.log_likelihood_gain > 0 or absorbed):
            return False
        without_drift = frozenset(best.effects) - frozenset(drifts_among(best.effects))
        steady = [h for h in others if 0 < len(h.effects) < len(best.effects)
                  and frozenset(h.effects) == without_drift]
        return all(closure.log_likelihood_gain - closure_of(h).log_likelihood_gain
                   >= SETTINGS.worth_fitting for h in steady)

    refuted: set[frozenset[str]] = set()
    library_sets = [w for w in weighed if w.unknown is None]
    hypotheses = [w.hypothesis for w in library_sets]
    first = 0
    while library_sets[first].effects and not holds(hypotheses[first], hypotheses[first + 1:]):
        refuted.add(library_sets[first].effects)
        first += 1
    kept = [w for w in weighed if w.effects not in refuted or w.unknown is not None]
    log_weights = np.array([w.log_weight for w in kept])
    # Beside a refuted set, the others may have no probability in floating point.
    probabilities = np.exp(log_weights - np.logaddexp.reduce(log_weights))
    return ([replace(w, probability=float(p)) for w, p in zip(kept, probabilities)],
            closure_of(hypotheses[first]))


def _detections(checked: Sequence[CheckedRecording], best: Hypothesis) -> list[Detection]:
    """
    Return the noise-like effects of the recordings and of the residual, the strongest of each.

    Spikes count only where the residual of the best hypothesis shows them, too.
    """
    detections = [d for c in checked for d in c.detections]
    for c in checked:
        comparison, used = c.comparison, c.comparison.used
        sensor = replace(best.sensor, rate_hz=comparison.sensor.rate_hz)
        residual_v = comparison.residual_v(best.sensor)
        spikes = c.possible_spikes
        # In motion, a smooth reference lacks knocks that look like spikes.
        regular = used | ~comparison.at_rest if comparison.reference_fades else used
        if spikes is not None and noise_detectors.residual_shows_spikes(spikes, residual_v,
                                                                        regular, sensor):
            detections.append(spikes)
        detections += noise_detectors.residual_detections(NoiseSamples(
            time_s=comparison.time_s, residual_v=bridged(residual_v, used),
            simulated_v=comparison.simulated_noise_v(sensor, 0),
            at_rest=comparison.at_rest & used, used=used), sensor)
    ranked = sorted(detections, key=lambda d: d.log_bayes_factor)
    return list({d.effect: d for d in ranked}.values())


def _noise_comparisons(comparisons: Sequence[BaselineComparison], mean_sensor: Sensor,
                       noise_sensor: Sensor, seed: int) -> tuple[NoiseComparison, ...]:
    """Compare the residual after one sensor's mean output with the noise of another sensor."""
    return tuple(compare_noise(bridged(c.residual_v(mean_sensor), c.used),
                               bridged(c.simulated_noise_v(noise_sensor, seed), c.used),
                               c.sensor.rate_hz, c.scale_v_per_mps2) for c in comparisons)


def _could_show(comparison: BaselineComparison) -> bool:
    """Determine whether the sensor moves, or its temperature or supply changes."""
    if comparison.reference is Reference.SIMULATOR:
        return True
    if comparison.reference is Reference.STAGE and not comparison.at_rest.all():
        return True
    motion, time_s = comparison.motion, comparison.time_s
    warms = motion.temperature_c is not None \
        and np.ptp(motion.temperature_c(time_s)) > SMALLEST_WARMING_C
    supply_changes = motion.supply_v is not None \
        and np.ptp(motion.supply_v(time_s)) > _SMALLEST_SUPPLY_CHANGE_V
    return bool(warms or supply_changes)


def _with_detections(best: Hypothesis, detections: Sequence[Detection], baseline: Sensor
                     ) -> Sensor:
    """
    Return the sensor of a hypothesis with the noise-like effects, at the baseline's rate.

    Nuisance parameters that are not effects of the hypothesis have these values:

    - Filter and latency stay those of the parameter file.
    - Zero-g and scale factor are fitted if the hypothesis has an effect on the mean, otherwise
      those of the file.
    - A zero-g that drifts stays that of the file, because it does not predict the next recording.
    """
    has_mean_effect = any(effect_named(effect).acts_on is ActsOn.MEAN for effect in best.effects)
    drifts = bool(drifts_among(best.effects))

    def stays_as_filed(effect: str) -> bool:
        hints = effect_named(effect).diagnosis
        if effect in best.effects:
            return False
        if has_mean_effect:
            return drifts and hints.straight_line is StraightLine.ZERO_G
        return hints.nuisance

    effects = [e for e in best.sensor.effects
               if e in (*baseline.effects, *best.effects)
               or (effect_named(e).diagnosis.straight_line and not stays_as_filed(e))]
    values = {name: (baseline if stays_as_filed(name) else best.sensor).values[name]
              for name in effects}
    for detection in detections:
        if detection.effect != UNKNOWN:
            if detection.effect not in effects:
                effects.append(detection.effect)
            values[detection.effect] = detection.values
    kept = [i for i, name in enumerate(baseline.covariance_names)
            if name.effect in effects]
    return replace(best.sensor, effects=tuple(effects), values=values, rate_hz=baseline.rate_hz,
                   adc_bits=baseline.adc_bits,
                   covariance=baseline.covariance[np.ix_(kept, kept)],
                   covariance_names=tuple(baseline.covariance_names[i] for i in kept))
