# SPDX-License-Identifier: Apache-2.0

"""Diagnosis of the front door: where recordings differ from their simulation, and why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.api.compared import Compared, PARAMETERS
from adxl_ros.api.recordings import (
    each_recording,
    one_recording,
    read_ideal,
    RecordingInput,
    RobotInput,
)
from adxl_ros.api.result import (
    as_json,
    FirstScreen,
    no_progress,
    Progress,
    Result,
)
from adxl_ros.api.sensors import sensor_of, SensorInput
from adxl_ros.diagnose import diagnosis as core, report as words
from adxl_ros.diagnose.could_show import CouldShow
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.gap_in_unit import gap_in, GapInUnit, quantity as quantity_named
from adxl_ros.diagnose.ideal_observer import Surest
from adxl_ros.diagnose.report_json import as_json as diagnosis_json, candidates, named_effects
from adxl_ros.diagnose.screen import screen_lines
from adxl_ros.diagnose.self_check import diagnose_again
from adxl_ros.diagnose.verdict import MATERIAL_MG
from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import own_folder, write_text
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.files.surroundings import assumed
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import option
from adxl_ros.report.arguments import require_least, require_path, require_whole
from adxl_ros.report.figures import AFTER_COLOUR, axes_for, BEFORE_COLOUR, QUIET_COLOUR
from adxl_ros.report.quantities import Interval, mg
from adxl_ros.report.screen import NextStep
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.recorded_motion import motion_from_force

PAGE = 'report.html'  # File of the page of a diagnosis
REPORT = 'report.json'  # File of the figures
_NO_VERDICT = ('bad_data', 'insufficient')
"""Outcomes without a verdict: a fault of a recording, or too little in it."""


class FoundParameter(NamedTuple):
    """The size of an effect, or what shapes it."""

    value: float | list[float] | None  # In `unit`; a list by axis; None if not determined
    low: float | None  # Low end of the 90 % interval, in `unit`; None without one
    high: float | None  # High end of the same
    unit: str  # Unit of the parameter file


class FoundEffect(NamedTuple):
    """An effect that the simulator lacks."""

    name: str  # Name in the library of effects
    probability: float  # Probability that the sensor has it, 0 to 1
    share: float | None  # Share of the squared gap that it closes, 0 to 1; None for noise
    parameters: Mapping[str, FoundParameter]  # By name, such as 'offset_v.x'
    rivals: tuple[str, ...]  # Effects that the recordings do not separate from it
    cause: str  # What causes it, and what to do


class GapFigures(NamedTuple):
    """The figures from which the verdict follows; intervals hold 90 %."""

    before_mps2: Interval  # Recording minus simulation, rms, m/s²
    after_mps2: Interval  # The same with the effects, on parts that were not fitted, m/s²
    floor_mps2: Interval  # Noise, which no simulation predicts, rms, m/s²
    closed: Interval  # (before² − after²) / (before² − floor²), a share; NaN without a gap
    upper_limit_mps2: float  # A gap of any kind above it would have shown, m/s²
    material_mps2: float  # Smaller amplitudes are no gap, rms, m/s²
    reference_mps2: float  # Error of the reference that returns with each pose, rms, m/s²


@dataclass(frozen=True, repr=False, eq=False)
class Gap(Result):
    """
    The gap between recordings and their simulation.

    `print` shows the screen of the tool `diagnose`, a notebook the top of its page.

    Attributes
    ----------
    verdict
        no_gap, explained, partly, inseparable or unknown; without a verdict insufficient or
        bad_data.
    probability
        How often such verdicts were right in the working cases, 0 to 1; a `fault` is certain, 1.
    surest
        How sure of the effects an ideal observer could be; None unless `limit` asks for it, and
        without effects on the mean.
    effects
        Effects of the verdict, those with the largest share of the gap first.
    figures
        The figures from which the verdict follows; None after `fault`.
    could_show
        Smallest size of each effect that would have shown, in the unit of its parameter.
    sensor
        What the simulator shall model: the given sensor with the effects that were found.
    fault
        Why a recording cannot be compared; '' where it can.
    summary
        Verdict and figures in a few sentences.
    notes : tuple of str
        What was corrected or left out.
    in_unit
        The gap in the unit that `quantity` names; None where none was asked for.
    remarks
        What was assumed of temperature, supply and power-on; and the prior, and the result of the
        self-check, where they were asked for.
    compared
        What was compared with what.
    diagnosis
        All steps between the recordings and the verdict.

    """

    verdict: str
    probability: float
    surest: Surest | None
    effects: tuple[FoundEffect, ...]
    figures: GapFigures | None
    could_show: tuple[CouldShow, ...]
    sensor: Sensor
    fault: str
    summary: str
    notes: tuple[str, ...]
    in_unit: GapInUnit | None
    remarks: tuple[str, ...]
    compared: Compared
    diagnosis: Diagnosis

    @property
    def fault_name(self) -> str:
        """Return the name of the fault, one of docs/reference/report_json.md; '' for none."""
        return self._report['verdict']['data_fault'] or ''

    @property
    def has_verdict(self) -> bool:
        """Return whether the recordings allow a verdict."""
        return self.verdict not in _NO_VERDICT

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        lines = screen_lines(self.diagnosis, self.compared.subject)
        for remark in self.remarks:
            lines += ['', f' {remark}']
        if self.in_unit:
            lines += ['', f' in      {self.in_unit.text}']
        return lines

    @property
    def first_screen(self) -> FirstScreen:
        """Return the top of the page."""
        from adxl_ros.diagnose.page import COLOURS, TILES

        rows = [] if self.fault else words.figure_rows(self.diagnosis)[:TILES]
        return FirstScreen(
            COLOURS[self.verdict],
            words.badge(self.diagnosis),
            words.headline(self.diagnosis),
            rows,
        )

    @cached_property
    def _report(self) -> dict[str, Any]:
        return diagnosis_json(self.diagnosis)

    def to_dict(self) -> dict[str, Any]:
        """Return report.json; docs/reference/report_json.md has its keys."""
        if self.in_unit is None:
            return self._report
        return self._report | {'gap_in': as_json(self.in_unit._asdict())}

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each parameter of each effect of the verdict."""
        from pandas import DataFrame

        rows = []
        for effect in self.effects:
            rows += [
                (effect.name, name, *parameter, effect.probability, effect.share)
                for name, parameter in effect.parameters.items()
            ]
        return DataFrame(
            rows, columns=['effect', 'parameter', *FoundParameter._fields, 'probability', 'share']
        )

    def plot(self, ax: Any = None) -> Any:
        """Draw gap, gap with the effects, and noise floor, mg, into axes of matplotlib."""
        if self.figures is None:
            raise UserError(f'no figures to draw: {self.fault}')
        ax = axes_for(ax)
        figures = self.figures
        bars = {
            'gap': figures.before_mps2,
            'with the effects': figures.after_mps2,
            'noise floor': figures.floor_mps2,
        }
        ax.barh(
            list(bars),
            [mg(bar.value) for bar in bars.values()],
            color=[BEFORE_COLOUR, AFTER_COLOUR, QUIET_COLOUR],
        )
        ax.invert_yaxis()
        ax.set(xlabel='rms, mg', title=words.badge(self.diagnosis))
        return ax

    def save(
        self, folder: str | os.PathLike, made_by: str = '', *, overwrite: bool = False
    ) -> list[Path]:
        """
        Write report.html, report.json and params.yaml into a folder; return their paths.

        A fault leaves params.yaml out. `made_by` is the command that the page shows, by default
        one that repeats the diagnosis. overwrite: whether files are replaced that this package
        did not write, or that were changed since.
        """
        texts = self.documents(require_path(folder), made_by)
        path = own_folder(folder, texts, overwrite)
        for name, text in texts.items():
            write_text(path / name, text)
        return [path / name for name in (PAGE, PARAMETERS, REPORT) if name in texts]

    def documents(
        self, folder: str | os.PathLike, made_by: str = '', has_page: bool = True
    ) -> dict[str, str]:
        """Return the files that `save` writes, by name."""
        from adxl_ros.diagnose import page

        run = page.Run(
            subject=self.compared.subject,
            parameter_file=self.compared.params_name,
            steps=self.next_steps(folder),
            command=made_by or self.compared.command(folder),
        )
        return page.documents(
            self.diagnosis, self.to_dict(), self.screen, run if has_page else None
        )

    def next_steps(self, folder: str | os.PathLike) -> list[NextStep]:
        """Return what to record, how to diagnose that, and how to simulate what was found."""
        is_closed = self.verdict in ('explained', 'partly')
        return self.compared.next_steps(self.diagnosis, folder, is_closed)


def diagnose(
    recordings: RecordingInput | Iterable[RecordingInput],
    sensor: SensorInput | None = None,
    *,
    sim: RecordingInput | Motion | None = None,
    sim_unit: str = '',
    urdf: str | os.PathLike | None = None,
    frame: str = 'imu_link',
    joints: str = '',
    align: bool = False,
    material: float = MATERIAL_MG,
    prior: str | os.PathLike | None = None,
    quantity: str | None = None,
    self_check: int = 0,
    limit: bool = False,
    seed: int = 0,
    progress: Progress = no_progress,
) -> Gap:
    """
    Find where recordings of one unit differ from their simulation, and which effects cause it.

    Parameters
    ----------
    recordings
        One or more recordings of one unit, each once: a Recording, a DataFrame, or the path of
        one that is read as it is. The motion is that of `alpha_rad` and `beta_rad` of a
        stage, or that of `sim` or `urdf`.
    sensor
        What the simulator models: a Sensor, a `Fit`, a datasheet's name or the path of a
        parameter file. None for the nominal sensor, or any IMU.
    sim
        Ideal specific force of the same motion by another simulator, with `ax_mps2, ay_mps2,
        az_mps2`, m/s², in the frame of the sensor: a Recording, a DataFrame or a path.
    sim_unit
        Unit of the file `sim`: g, mg or mmps2; '' for m/s². `read` has other samples' `unit`.
    urdf
        Path of the robot that carries the sensor; its joints are in the bag of the recording, or
        its columns NAME_rad.
    frame, joints
        Frame of the robot that carries the sensor, and topic of its joints; '' for the only one.
    align
        Whether `sim` is shifted in time where its motion is late or early.
    material
        Amplitude that matters, mg rms, at least 1e-6; smaller effects are no gap. Where a tenth
        of the noise is larger, that is used.
    prior
        Path of the population.yaml of a fleet: prior of zero-g and scale factor.
    quantity
        States the gap in another unit, too: 'tilt' (deg), 'velocity' (m/s after 10 s), or
        'MODULE:FUNCTION'.
    self_check
        Number of recordings that are simulated from the verdict, to see how often it returns.
    limit
        Whether to say how sure an ideal observer could be, who knows the effects and the noise.
    seed
        Seed of the bootstraps.
    progress
        Called with the share of the work that is done, 0 to 1, and the name of the stage.

    Returns
    -------
    Gap
        Verdict, effects with sizes and intervals, figures, and the sensor to simulate with. What
        makes a recording useless is its `fault`, with the verdict bad_data or insufficient.

    Raises
    ------
    UserError
        An argument is wrong, a file cannot be read, or recordings are of several units.

    """
    require_whole('seed', seed)
    require_whole('self_check', self_check)
    require_least('material', material, 1e-6)
    _require_simulator(sim, sim_unit, urdf, align)
    unit = quantity_named(quantity) if quantity else None
    if not (sim is None or isinstance(sim, (Motion, str, os.PathLike))):
        sim = one_recording(sim)
    read = list(each_recording(recordings))
    _require_one_reference(sim, urdf, len(read))
    given = sensor_of(sensor, read[0])
    baseline = given.sensor
    remarks = []
    motion = (
        RobotInput(urdf, frame, joints).path(read[0], baseline).as_motion()
        if urdf
        else _motion(read[0], sim, sim_unit)
    )
    if prior:
        baseline, remark = _with_prior(baseline, prior)
        remarks.append(remark)
    for each in read:
        remarks += [f'assumed: {text}' for text in assumed(each, baseline.effects)]
    diagnosis = core.diagnose(
        read,
        baseline,
        motion,
        seed,
        lambda stage, done: progress(done, stage),
        align,
        material,
        limit,
    )
    in_unit = None
    found = diagnosis.report
    if self_check and found:
        remarks.append(
            diagnose_again(
                diagnosis,
                read,
                motion,
                self_check,
                seed,
                lambda done: progress(done, 'self-check'),
            )
        )
    if unit and found:
        in_unit = gap_in(unit, diagnosis.full_rate, found.baseline, found.sensor, seed)
    simulator = _name_of(sim)
    robot = os.fspath(urdf or '')
    compared = Compared(
        recordings=tuple(each.path for each in read),
        params=given.file,
        params_name=given.file_name,
        sim=simulator,
        sim_unit=sim_unit,
        urdf=robot,
        frame=frame,
        subject=_subject(read, baseline, simulator or robot),
    )
    return _gap(diagnosis, baseline, compared, in_unit, remarks)


def _require_simulator(
    sim: RecordingInput | Motion | None,
    sim_unit: str,
    urdf: str | os.PathLike | None,
    align: bool,
) -> None:
    """Refuse arguments that are about a simulator or a robot, where none is given."""
    has_other = sim is not None or bool(urdf)
    if align and not has_other:
        raise UserError(
            f'{option(align=True)}: shifts {option("sim")} or a robot, and neither is given'
        )
    if sim_unit and not isinstance(sim, (str, os.PathLike)):
        raise UserError(
            f'{option(sim_unit=sim_unit)}: states the unit of a file that {option("sim")} names, '
            'and none is named; samples in memory are given by read or from_arrays(..., unit=...)'
        )


def _require_one_reference(
    sim: RecordingInput | Motion | None, urdf: str | os.PathLike | None, count: int
) -> None:
    """Refuse a simulator and a robot together, and one of them for several recordings."""
    references = sum((sim is not None, bool(urdf)))
    if references > 1 or (references and count > 1):
        raise UserError(
            f'{_name_of(sim) or urdf}: {option("sim")} or {option("urdf")}, one of them, goes '
            f'with one recording, but {count} are given'
        )


def _with_prior(sensor: Sensor, population: str | os.PathLike) -> tuple[Sensor, str]:
    """Return a sensor with the zero-g and scale factor of its fleet, and a remark on them."""
    from adxl_ros.files import calibration_store
    from adxl_ros.model.population import posterior

    informed, line, _ = posterior(sensor, calibration_store.read_population(population))
    return informed, f'prior: {line}'


def _name_of(sim: RecordingInput | Motion | None) -> str:
    """Return the name of another simulator's recording; '' for none."""
    if isinstance(sim, Recording):
        return sim.path
    return os.fspath(sim) if isinstance(sim, (str, os.PathLike)) else ''


def _motion(read: Recording, sim: RecordingInput | Motion | None, unit: str) -> Motion | None:
    """Return the motion of another simulator; None for that of the stage."""
    if sim is None or isinstance(sim, Motion):
        return sim
    return motion_from_force(read_ideal(sim, read.epoch_ns, unit), False)


def _subject(recordings: Sequence[Recording], sensor: Sensor, sim: str) -> str:
    """Return what is compared with what."""
    first = recordings[0]
    count = len(recordings)
    name = Path(first.path).name if count == 1 else f'{count} recordings'
    span_s = sum(read.span_s for read in recordings)
    unit = 'the nominal sensor' if sensor.serial == NO_SERIAL else f'unit {sensor.serial}'
    simulated = f'{Path(sim).name} through the chain of {unit}' if sim else f'simulation of {unit}'
    return (
        f'{name} ({span_s:.0f} s, {first.rate_hz:.4g} Hz, {" ".join(first.axes)})  minus  '
        f'{simulated}'
    )


def _gap(
    diagnosis: Diagnosis,
    baseline: Sensor,
    compared: Compared,
    in_unit: GapInUnit | None,
    remarks: Sequence[str],
) -> Gap:
    """Collect what a user reads of a diagnosis."""
    report = diagnosis.report
    fault = diagnosis.fault
    verdict = fault.status if fault else ''
    probability = 1.0
    effects: tuple[FoundEffect, ...] = ()
    figures = None
    if report is not None:
        verdict = report.verdict.status
        probability = report.verdict.probability
        found = {c['effect']: c for c in candidates(report)}
        effects = tuple(_effect(found[name]) for name in named_effects(report))
        before, after, floor, closed = report.closure
        figures = GapFigures(
            before_mps2=before,
            after_mps2=after,
            floor_mps2=floor,
            closed=closed,
            upper_limit_mps2=report.verdict.upper_limit_mps2,
            material_mps2=report.verdict.material_mps2,
            reference_mps2=report.verdict.reference_mps2,
        )
    return Gap(
        verdict=verdict,
        probability=probability,
        surest=report.surest if report else None,
        effects=effects,
        figures=figures,
        could_show=report.could_show if report else (),
        sensor=report.sensor if report else baseline,
        fault=fault.message if fault else '',
        summary=words.summary(diagnosis),
        notes=tuple(words.notes(diagnosis)),
        in_unit=in_unit,
        remarks=tuple(remarks),
        compared=compared,
        diagnosis=diagnosis,
    )


def _effect(candidate: Mapping[str, Any]) -> FoundEffect:
    """Return an effect of the report, unrounded."""
    parameters = {}
    for name, parameter in candidate['parameters'].items():
        low, high = parameter.get('ci') or (None, None)
        parameters[name] = FoundParameter(
            value=parameter['value'], low=low, high=high, unit=parameter['unit']
        )
    return FoundEffect(
        name=candidate['effect'],
        probability=candidate['probability'],
        share=candidate['share'],
        parameters=parameters,
        rivals=tuple(candidate['inseparable_from']),
        cause=candidate['cause'],
    )
