# SPDX-License-Identifier: Apache-2.0

"""
The task of a worker: from the address of a recording to one row.

The recording is staged, its unit and calibration are looked up, and the tasks run one after the
other. A task that refuses leaves its reason. What a recording does not hold is skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
import json
import os
from pathlib import Path
import resource
import shlex
import sys
from time import monotonic
import traceback
from typing import Any, NamedTuple, TYPE_CHECKING

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import recorded_unit, Recording, unit_of
from adxl_ros.files.stream_info import NO_UNIT
from adxl_ros.files.tables import NoNumbers
from adxl_ros.fleet.inputs import begin_of, is_manifest, Source
from adxl_ros.fleet.recipe import age_days, code_version, key_of, ParameterText, Recipe
from adxl_ros.fleet.row import empty_row, finite, Row
from adxl_ros.fleet.staging import stage, Staged, temporary_folder
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.package_version import package_version
from adxl_ros.signals.allan_deviation import longest_rest
from adxl_ros.signals.axis_noise import recording_noise
from adxl_ros.signals.findings import BLOCK_ROWS, check_recording, Findings
from adxl_ros.signals.recorded_sensor import load_sensor, measure_unstated
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.diagnosis import Diagnosis

_BOOTSTRAP_DRAWS = 400
"""Number of draws of an interval. Chosen: the 5 % quantile has 20 draws below it."""
_PAGES = ('explained', 'partly', 'inseparable', 'unknown')
"""Statuses of a diagnosis that get a page. Chosen: it has 2 MB, and without a gap shows little."""
_RESET_PEAK = '5'
"""Command of Linux that sets the largest memory of a process to the present one."""


class Result(NamedTuple):
    """What a task leaves."""

    row: Row  # The row; without results where `is_known` holds
    files: dict[str, bytes]  # Files of the recording, by name
    stamp: str  # Stamp of the recording that was read
    digest: str  # See `Recipe.digest`
    is_known: bool = False  # Whether there is a row with this key


class TaskCrashed(Exception):
    """A task raised what it should not; the result has what is known nevertheless."""

    @property
    def result(self) -> Result:
        """Return what the task leaves."""
        return self.args[1]

    def __str__(self) -> str:
        """Return the reason."""
        return str(self.args[0])


class WrongCode(UserError):
    """The worker has another version of the package than the client."""


def make_row(recipe: Recipe, earlier: frozenset[str], source: Source, is_again: bool) -> Result:
    """Make the row of a recording; see the module."""
    if recipe.code != code_version():
        raise WrongCode(f'worker {_worker()}: has another version of adxl_ros '
                        f'({code_version()[:12]}, the client has {recipe.code[:12]}); install the '
                        'same on all')
    begin_s = monotonic()
    _reset_peak()
    try:
        if source.fault:
            raise UserError(f'{source.url}: {source.fault}')
        with temporary_folder() as folder:
            result = _in_folder(recipe, source, frozenset() if is_again else earlier, folder)
    except UserError as error:
        result = refused(recipe, source, one_line(error).removeprefix(f'{source.url}: '))
    except TaskCrashed as error:
        _finish(error.result.row, begin_s)
        raise
    return _finish_result(result, begin_s)


def refused(recipe: Recipe, source: Source, reason: str, outcome: str = 'refused') -> Result:
    """Return the row of a recording whose content is not known."""
    parameters = recipe.parameters_of(source.serial, source.date, source.params)
    digest = recipe.digest(parameters, source.serial)
    row = _identity(recipe, source, None, source.serial, (source.date, 'manifest'), parameters)
    row |= {'key': key_of(f'{source.url} {source.stamp}', digest), 'outcome': outcome,
            'refusal': reason, 'refused_by': 'stage'}
    return Result(row, {}, source.stamp, digest)


def _in_folder(recipe: Recipe, source: Source, earlier: frozenset[str], folder: Path) -> Result:
    """Stage a recording, and run the tasks on it."""
    (folder / 'recording').mkdir()
    staged = stage(source, folder / 'recording')
    first, fault = _first_block(staged.path, recipe)
    recorded = first.stream_info.serial if first else NO_UNIT
    is_other = bool(source.serial) and recorded not in (NO_UNIT, '', source.serial)
    serial = source.serial or recorded
    date = _date(source, first)
    parameters = recipe.parameters_of(serial, date[0], source.params)
    digest = recipe.digest(parameters, source.serial)
    # Which of both units it is of is not known.
    row = _identity(recipe, source, staged, '' if is_other else serial, date, parameters)
    row['key'] = key_of(staged.content, digest)
    if row['key'] in earlier:
        return Result(row, {}, source.stamp, digest, is_known=True)
    job = _Job(recipe, source, staged, parameters, digest, folder, row)
    if fault:
        job.refuse('read', 'is a manifest; name it itself, not its folder'
                   if is_manifest(staged.path) else job.plain(fault))
    elif is_other:
        job.refuse('read', f'states the serial {recorded}, but the manifest says {source.serial}')
    else:
        job.run()
    return Result(job.row, job.files, source.stamp, digest)


def _first_block(path: Path, recipe: Recipe) -> tuple[Recording | None, str]:
    """Return the first sample of a recording with what it states, or why it cannot be read."""
    try:
        blocks = recording.blocks(path, 1, replace(recipe.reading, drop_bad_stamps=True))
        try:
            return next(blocks, None), ''
        finally:
            blocks.close()
    except NoNumbers as error:
        return None, f'{one_line(error)}; a manifest needs a column url'
    except UserError as error:
        return None, one_line(error)


def _date(source: Source, first: Recording | None) -> tuple[str, str]:
    """Return the begin of a recording, ISO 8601 in UTC, and where it is from."""
    if source.date:
        return source.date, 'manifest'
    if first is not None and (begin := begin_of(first))[0]:
        return begin
    return source.modified, 'file'


def _identity(recipe: Recipe, source: Source, staged: Staged | None, serial: str,
              date: tuple[str, str], parameters: ParameterText) -> Row:
    """Return the columns that do not depend on the tasks."""
    age = age_days(parameters, date[0])
    return {**empty_row(), 'url': source.url, 'hash': staged and staged.content,
            'size_bytes': staged.size_bytes if staged else source.size_bytes,
            'serial': serial if serial not in ('', NO_UNIT) else None,
            'date': date[0] or None, 'date_source': date[1] if date[0] else None,
            'tasks': list(recipe.tasks), 'calibration_id': parameters.calibration_id or None,
            'calibration_age_days': finite(age),
            'validity': None if parameters.calibration_id else 'not calibrated',
            'version': package_version(), 'code': recipe.code}


@dataclass
class _Job:
    """The tasks on one staged recording."""

    recipe: Recipe
    source: Source
    staged: Staged
    parameters: ParameterText
    digest: str
    folder: Path
    row: Row
    files: dict[str, bytes] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    results: int = 0
    _read: Recording | None = None

    def run(self) -> None:
        """Run the tasks. One that does not fit the recording is skipped, unless all are."""
        findings = check_recording(str(self.staged.path), self._params(), replace(
            self.recipe.reading, drop_bad_stamps=True))
        _put_check(self.row, findings)
        self.row['faults'] = [self.plain(fault) for fault in findings.faults]
        if findings.contents is None:
            self.refuse('check', self.plain(findings.faults[0]))
            return
        _put_validity(self.row, self._params(), findings)
        reasons = {ability.tool: self.plain(ability.reason) for ability in findings.abilities
                   if not ability.is_able}
        self.results += self.recipe.tasks == ('check',)
        steps: dict[str, Callable[[], None]] = {
            'noise': self._noise, 'fit': self._fit, 'diagnose': self._diagnose}
        for name in self.recipe.tasks:
            if name in reasons:
                self.skipped[name] = reasons[name]
            elif name in steps:
                self._attempt(name, steps[name])
        if not self.results:
            # Many recordings have no noise; what the others need says more.
            for name, reason in reversed(self.skipped.items()):
                self.refuse(name, reason)
        self.row['skipped'] = [f'{name}: {reason}' for name, reason in self.skipped.items()]
        if self.row['outcome'] is None:
            self.row['outcome'] = 'done'

    def _attempt(self, name: str, step: Callable[[], None]) -> None:
        """Run a task, and note its refusal."""
        try:
            step()
            self.results += 1
        except UserError as error:
            reason = self.plain(one_line(error))
            if name == 'noise':
                # Whether a rest is long enough shows only here.
                self.skipped[name] = reason
            else:
                self.refuse(name, reason)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            reason = f'{type(error).__name__}: {one_line(error)} ({Path(place.filename).name}:' \
                     f'{place.lineno})'
            self.refuse(name, self.plain(reason), 'crashed')
            raise TaskCrashed(reason, Result(
                self.row, self.files, self.source.stamp, self.digest)) from None

    def refuse(self, name: str, reason: str, outcome: str = 'refused') -> None:
        """Note why a task has no result; the first reason counts."""
        if self.row['refusal'] is None:
            self.row |= {'outcome': outcome, 'refusal': reason, 'refused_by': name}

    def plain(self, text: str) -> str:
        """Return a text with the names of the files in place of the paths of the copies."""
        name = self.staged.path.name
        text = text.replace(str(self.staged.path), name).replace(
            str(self.folder / self.parameters.name), self.parameters.name)
        return text.removeprefix(f'{name}: ')

    def _params(self) -> str | None:
        """Return the parameter file as a file of this machine; None for the nominal sensor."""
        if not self.parameters.text:
            return None
        path = self.folder / self.parameters.name
        if not path.exists():
            path.write_text(self.parameters.text, encoding='utf-8')
        return str(path)

    def _recording(self) -> Recording:
        """Return the whole recording."""
        if self._read is None:
            read = recording.read(self.staged.path, self.recipe.reading)
            # Reports name the recording, and not its copy.
            self._read = replace(read, path=self.source.url)
        return self._read

    def _noise(self) -> None:
        """Find the noise of the longest rest."""
        path = self.staged.path
        units: list[Sensor] = []

        def blocks() -> Iterator[Recording]:
            return recording.blocks(path, BLOCK_ROWS, self.recipe.reading)

        def sensor_of(block: Recording) -> Sensor:
            if not units:
                units.append(unit_of(load_sensor(self._params(), block), block.stream_info,
                                     block.axes))
            return units[0]

        rest = longest_rest(blocks, sensor_of)
        result = recording_noise(str(path), rest, units[0].axes, lambda done: None)
        for noise in result.axes:
            for letter, unit, estimate in zip('nbk', ('mps2_per_rthz', 'mps2', 'mps2_per_rts'),
                                              noise.estimates):
                self.row |= {
                    f'noise_{letter}_{noise.axis}_{unit}':
                        finite(estimate.value) if estimate.is_seen else None,
                    f'noise_{letter}_low_{noise.axis}_{unit}': finite(estimate.low),
                    f'noise_{letter}_high_{noise.axis}_{unit}': finite(estimate.high)}

    def _fit(self) -> None:
        """Fit a calibration to the recording alone."""
        # A worker imports what its tasks need, and the client none of it.
        from adxl_ros.calibrate import calibration, pose_extraction
        read = self._recording()
        sensor, _ = measure_unstated(load_sensor(self._params(), read), read)
        unit = recorded_unit(sensor, read)
        poses = pose_extraction.extract_poses(read, unit, None)
        recorded = calibration.RecordedPoses(
            Path(self.source.url).name, poses, pose_extraction.estimate_filters(read, unit, poses))
        result = calibration.calibrate(unit, [recorded], None, (), self.staged.content)
        fitted = result.fitted
        stds = dict(zip(fitted.covariance_names, np.sqrt(np.diag(fitted.covariance)).tolist()))
        _put_axes(self.row, 'zero_g', 'v', fitted, fitted.zero_g_v,
                  [stds.get(Coefficient('bias', 'offset_v', axis)) for axis in fitted.axes])
        _put_axes(self.row, 'scale', 'v_per_g', fitted, fitted.scale_v_per_g,
                  [stds.get(Coefficient('scale_factor', 'offset_v_per_g', axis))
                   for axis in fitted.axes])
        self.row |= {'fit_model': fitted.model, 'fit_poses': len(result.inliers)}
        values = get(fitted, fitted.covariance_names)
        self.row['coefficients'] += [
            _coefficient(name, value, stds[name], 'fit')
            for name, value in zip(fitted.covariance_names, values)]
        self.files['unit.yaml'] = parameter_file.as_text(
            fitted, result.report_lines).encode('utf-8')

    def _diagnose(self) -> None:
        """Compare the recording with its simulation."""
        from adxl_ros.diagnose import page
        from adxl_ros.diagnose.diagnosis import diagnose
        from adxl_ros.diagnose.report import as_json
        read = self._recording()
        sensor, _ = measure_unstated(load_sensor(self._params(), read), read)
        diagnosis = diagnose([read], sensor)
        report = as_json(diagnosis)
        _put_verdict(self.row, diagnosis, report)
        self.files['report.json'] = json.dumps(report, indent=1, allow_nan=False).encode()
        parameters = '' if diagnosis.report is None else \
            parameter_file.as_text(diagnosis.report.sensor, [report['summary']])
        if parameters:
            self.files['params.yaml'] = parameters.encode('utf-8')
        if report['verdict']['status'] in _PAGES:
            params = ['--params', self.parameters.name] if self.parameters.text else []
            again = ['ros2', 'run', 'adxl_ros', 'diagnose', self.source.url, *params, '-o', 'gap']
            self.files['report.html'] = page.page(diagnosis, page.Run(
                self.source.url, self.parameters.name, [], parameters, shlex.join(again)
            )).encode('utf-8')


def _coefficient(name: Coefficient, value: float, std: float | None, source: str
                 ) -> dict[str, Any]:
    """Return one estimate as the table has it."""
    return {'name': str(name), 'unit': parameter_of(name).unit, 'value': finite(value),
            'std': finite(std), 'source': source}


def _put_axes(row: Row, name: str, unit: str, sensor: Sensor, values: np.ndarray,
              stds: Sequence[float | None]) -> None:
    """Put a quantity of each axis and its standard deviations into a row."""
    for axis, value, std in zip(sensor.axes, values, stds):
        row[f'{name}_{axis}_{unit}'] = finite(value)
        row[f'{name}_std_{axis}_{unit}'] = finite(std)


def _put_check(row: Row, findings: Findings) -> None:
    """Put the check of a recording into its row."""
    row['is_sound'] = findings.is_sound
    contents = findings.contents
    if contents is None:
        return
    low, high = contents.reference_ranges.get('temperature_c', (None, None))
    row |= {'axes': ''.join(axis.name.lstrip('a')[0] for axis in contents.axes),
            'duration_s': finite(contents.span_s), 'samples': contents.samples,
            'rate_hz': finite(contents.rate_hz), 'jitter_s': finite(contents.jitter_s),
            'missing': contents.missing, 'longest_gap_s': finite(contents.longest_gap_s),
            'temperature_c': finite(contents.reference_means.get('temperature_c')),
            'temperature_low_c': finite(low), 'temperature_high_c': finite(high)}


def _put_validity(row: Row, params: str | None, findings: Findings) -> None:
    """State whether the calibration is valid for the recording."""
    if params is None or not row['calibration_id']:
        return
    envelope = parameter_file.load(params, may_measure=True).envelope
    age, ranges = row['calibration_age_days'], findings.contents.reference_ranges \
        if findings.contents else {}
    if age is not None and age < 0:
        row['validity'] = 'younger than the recording'
    elif envelope.temperature_c is None or 'temperature_c' not in ranges:
        row['validity'] = 'valid, temperature not known'
    else:
        beyond = float(np.max(envelope.beyond_k(np.array(ranges['temperature_c']))))
        row['validity'] = f'outside: temperature by {beyond:.3g} K' if beyond > 0 else 'valid'


def _put_verdict(row: Row, diagnosis: Diagnosis, report: dict[str, Any]) -> None:
    """Put a diagnosis into a row."""
    verdict, gap = report['verdict'], report['gap']
    row |= {'status': verdict['status'], 'effects': verdict['effects'],
            'groups': verdict['groups'], 'data_fault': verdict['data_fault'],
            'probability': finite(verdict['probability'])}
    if gap is None or diagnosis.report is None:
        return
    before, after = gap['before_ci'], gap['after_ci']
    row |= {'gap_before_mps2': gap['before'], 'gap_before_low_mps2': finite(before[0]),
            'gap_before_high_mps2': finite(before[1]), 'gap_after_mps2': gap['after'],
            'gap_after_low_mps2': finite(after[0]), 'gap_after_high_mps2': finite(after[1]),
            'gap_floor_mps2': gap['floor'], 'gap_floor_source': gap['floor_source'],
            'gap_closed': gap['closed']}
    if gap['floor_ci'] is not None:
        row |= {'gap_floor_low_mps2': gap['floor_ci'][0],
                'gap_floor_high_mps2': gap['floor_ci'][1]}
    if gap['closed'] is not None:
        row |= {'gap_closed_low': gap['closed_ci'][0], 'gap_closed_high': gap['closed_ci'][1]}
    best = diagnosis.report.verdict.best
    values = get(best.sensor, best.names)
    row['coefficients'] += [
        _coefficient(name, value, std, 'diagnose')
        for name, value, std, is_open in zip(best.names, values, best.std, best.undetermined)
        if not is_open]


def _reset_peak() -> None:
    """Begin to measure the largest memory of this process."""
    try:
        Path('/proc/self/clear_refs').write_text(_RESET_PEAK, encoding='ascii')
    except OSError:
        return


def _peak_mb() -> float:
    """Return the largest memory of this process, MB."""
    try:
        lines = Path('/proc/self/status').read_text(encoding='ascii').splitlines()
        return int(next(line for line in lines if line.startswith('VmHWM')).split()[1]) / 1024
    except (OSError, StopIteration):
        unit = 2 ** 20 if sys.platform == 'darwin' else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _worker() -> str:
    """Return host and process."""
    return f'{os.uname().nodename}:{os.getpid()}'


def _finish(row: Row, begin_s: float) -> None:
    """Put the run time, memory and worker into a row."""
    row |= {name: finite(value) for name, value in row.items() if isinstance(value, float)}
    row |= {'seconds': round(monotonic() - begin_s, 6), 'memory_mb': round(_peak_mb(), 3),
            'worker': _worker()}


def _finish_result(result: Result, begin_s: float) -> Result:
    """Return a result with run time, memory and worker."""
    _finish(result.row, begin_s)
    return result
