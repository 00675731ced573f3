# SPDX-License-Identifier: Apache-2.0

"""
The task of a worker: from the address of a recording to one row.

The recording is staged, its sensor and calibration are looked up, and the tasks run one after the
other. A task that refuses leaves its reason. What a recording does not hold is skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timedelta
from functools import cached_property
import os
from pathlib import Path
from resource import getrusage, RUSAGE_SELF
import shutil
import tempfile
from time import monotonic, time
from typing import Any, NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.calibration_store import sha256
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.files.surroundings import assumed
from adxl_ros.files.tables import BLOCK_ROWS
from adxl_ros.fleet import inputs
from adxl_ros.fleet.inputs import begin_of, Date, FoundRecording
from adxl_ros.fleet.row import (
    empty_row,
    finite,
    NOISE,
    ParameterText,
    Recipe,
    Row,
    sha256_of,
)
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import code_version, package_version
from adxl_ros.signals.findings import check_recording, Findings
from adxl_ros.wording import options_named
import numpy as np

_SPARE_MB = 64  # Space that stays free, MB. Chosen: a task writes some MB
_LEFT_S = 86400.0
"""Age from which a temporary folder is that of a killed worker, s. Chosen: no task takes a day."""
_PAGES = ('explained', 'partly', 'inseparable', 'unknown')
"""Statuses of a diagnosis that get a page. Chosen: it has 2 MB, and without a gap shows little."""


class StagingError(Exception):
    """A recording could not be copied; it may be possible later, or on another machine."""


class Staged(NamedTuple):
    """The copy of a recording."""

    path: Path  # The file or folder
    content: str  # SHA-256 of the content
    size_bytes: int  # Its size


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield an empty folder; those that killed workers left behind a day ago are removed."""
    root = Path(tempfile.gettempdir(), f'adxl_ros_fleet_{os.getuid()}')
    try:
        root.mkdir(mode=0o700, exist_ok=True)
        for left in root.iterdir():
            if time() - left.stat().st_mtime > _LEFT_S:
                shutil.rmtree(left, ignore_errors=True)
        folder = tempfile.TemporaryDirectory(dir=root, ignore_cleanup_errors=True)
    except OSError as error:
        raise StagingError(f'{root}: no temporary folder: {error.strerror}') from None
    with folder as name:
        yield Path(name)


def stage(source: FoundRecording, folder: Path) -> Staged:
    """Copy a recording into a folder."""
    url = source.url
    try:
        fs, path = inputs.file_system(source.address or url)
    except UserError as reason:
        raise StagingError(one_line(reason)) from None
    before = inputs.look_up(fs, path)
    if before.fault:
        error = UserError if before.fault == inputs.NO_FILE else StagingError
        raise error(f'{url}: {before.fault}')
    size_mb = (before.size_bytes or 0) / 1e6
    free_mb = shutil.disk_usage(folder).free / 1e6
    if size_mb + _SPARE_MB > free_mb:
        raise StagingError(
            f'{url}: needs {size_mb:.3g} MB beside {_SPARE_MB} MB that stay free, '
            f'but {tempfile.gettempdir()} has {free_mb:.3g} MB free; set TMPDIR '
            'to a larger disk'
        )
    target = folder / inputs.file_name(path)
    try:
        # A web server answers `isdir` with the whole file.
        is_folder = fs.info(path)['type'] == 'directory'
        for name in fs.find(path) if is_folder else [path]:
            copy = target / name.removeprefix(path).lstrip('/') if is_folder else target
            if folder not in copy.parents or '..' in copy.parts:
                raise UserError(f'{url}: {name!r} leads outside of its folder')
            copy.parent.mkdir(parents=True, exist_ok=True)
            fs.get_file(name, str(copy))
    except UserError:
        raise
    except Exception as problem:
        # A connection that broke is not used again.
        fs.clear_instance_cache()
        raise StagingError(f'{url}: {inputs.fault_of(problem)}') from None
    fs.invalidate_cache()
    after = inputs.look_up(fs, path)
    size_bytes = sum(
        copy.stat().st_size for copy in [target, *target.rglob('*')] if copy.is_file()
    )
    has_changed = (after.stamp, after.size_bytes) != (before.stamp, before.size_bytes)
    if has_changed or before.size_bytes not in (None, size_bytes):
        raise StagingError(f'{url}: changed while it was read; is it still being written?')
    return Staged(target, sha256([target]), size_bytes)


class TaskResult(NamedTuple):
    """What a task leaves."""

    row: Row  # The row; without results where `is_known` holds
    files: dict[str, bytes]  # Files of the recording, by name
    stamp: str  # Stamp of the recording that was read
    digest: str  # See `Recipe.digest`
    is_known: bool = False  # Whether there is a row with this key


@options_named()
def make_row(
    recipe: Recipe, earlier: frozenset[str], source: FoundRecording, is_again: bool
) -> TaskResult:
    """Make the row of a recording; one with an `earlier` key is only made where `is_again`."""
    worker = f'{os.uname().nodename}:{os.getpid()}'
    if recipe.code != code_version():
        raise UserError(
            f'worker {worker}: has another version of adxl_ros '
            f'({code_version()[:12]}, the client has {recipe.code[:12]}); install the '
            'same on all'
        )
    begin_s = monotonic()
    try:
        if source.fault:
            raise UserError(f'{source.url}: {source.fault}')
        with temporary_folder() as folder:
            (folder / 'recording').mkdir()
            staged = stage(source, folder / 'recording')
            result = _of_staged(recipe, source, frozenset() if is_again else earlier, staged)
    except UserError as error:
        result = refused(recipe, source, one_line(error))
    row = result.row
    row |= {name: finite(value) for name, value in row.items() if isinstance(value, float)}
    row |= {
        'seconds': round(monotonic() - begin_s, 6),
        'worker': worker,
        'memory_mb': getrusage(RUSAGE_SELF).ru_maxrss / 1024,
    }
    return result


def refused(
    recipe: Recipe, source: FoundRecording, reason: str, outcome: str = 'refused'
) -> TaskResult:
    """Return the row of a recording whose content is not known."""
    parameters = recipe.parameters_of(source.serial, source.date, source.params)
    digest = recipe.digest(parameters, source.serial)
    row = _identity(recipe, source, None, source.serial, Date(source.date, 'manifest'), parameters)
    row |= {
        'key': sha256_of(f'{source.url} {source.stamp}', digest),
        'outcome': outcome,
        'refusal': reason.removeprefix(f'{source.url}: '),
        'refused_by': 'stage',
    }
    return TaskResult(row, {}, source.stamp, digest)


def _of_staged(
    recipe: Recipe, source: FoundRecording, earlier: frozenset[str], staged: Staged
) -> TaskResult:
    """Run the tasks on a copy, unless there is a row of this content by this recipe."""
    first = None
    fault = ''
    try:
        first = next(
            recording.blocks(staged.path, 1, replace(recipe.reading, drop_bad_stamps=True)), None
        )
    except UserError as error:
        fault = one_line(error)
    recorded = first.stream_info.serial if first else NO_SERIAL
    is_other = bool(source.serial) and recorded not in (NO_SERIAL, '', source.serial)
    serial = source.serial or recorded
    date = Date(source.date, 'manifest')
    if not date.text and first:
        date = begin_of(first)
    if not date.text:
        date = Date(source.modified, 'file')
    parameters = recipe.parameters_of(serial, date.text, source.params)
    digest = recipe.digest(parameters, source.serial)
    # Which of both sensors it is of is not known.
    row = _identity(recipe, source, staged, '' if is_other else serial, date, parameters)
    row['key'] = sha256_of(staged.content, digest)
    if row['key'] in earlier:
        return TaskResult(row, {}, source.stamp, digest, is_known=True)
    job = _Job(recipe, source, staged, parameters, row)
    if fault:
        job.refuse('read', job.plain(fault))
    elif is_other:
        job.refuse('read', f'states the serial {recorded}, but the manifest says {source.serial}')
    else:
        job.run()
    return TaskResult(job.row, job.files, source.stamp, digest)


def _identity(
    recipe: Recipe,
    source: FoundRecording,
    staged: Staged | None,
    serial: str,
    date: Date,
    parameters: ParameterText,
) -> Row:
    """Return the columns that do not depend on the tasks."""
    age_days = None
    if date.text and parameters.date:
        age = datetime.fromisoformat(date.text) - datetime.fromisoformat(parameters.date)
        age_days = age / timedelta(days=1)
    return {
        **empty_row(),
        'url': source.url,
        'hash': staged and staged.content,
        'size_bytes': staged.size_bytes if staged else source.size_bytes,
        'serial': serial if serial not in ('', NO_SERIAL) else None,
        'date': date.text or None,
        'date_source': date.source if date.text else None,
        'tasks': list(recipe.tasks),
        'calibration_id': parameters.calibration_id or None,
        'calibration_age_days': age_days,
        'validity': None if parameters.calibration_id else 'not calibrated',
        'version': package_version(),
        'code': recipe.code,
    }


class _Job:
    """The tasks on one staged recording."""

    def __init__(
        self,
        recipe: Recipe,
        source: FoundRecording,
        staged: Staged,
        parameters: ParameterText,
        row: Row,
    ) -> None:
        self._recipe = recipe
        self._source = source
        self._staged = staged
        self._parameters = parameters
        self._params: str | None = None  # Path of the parameter file; None: the nominal sensor
        if parameters.text:
            path = staged.path.parents[1] / parameters.name
            path.write_text(parameters.text, encoding='utf-8')
            self._params = str(path)
        self.row = row
        self.files: dict[str, bytes] = {}

    def run(self) -> None:
        """Run the tasks. One that does not fit the recording is skipped, unless all are."""
        findings = check_recording(
            str(self._staged.path),
            self._params,
            replace(self._recipe.reading, drop_bad_stamps=True),
        )
        self._put_check(findings)
        if findings.contents is None:
            self.refuse('check', self.plain(findings.faults[0]))
            return
        fault = findings.contents.gravity.fault
        if fault is not None and fault.is_clear:
            # No figure from such readings counts, so that no task begins.
            self.row |= {'status': 'bad_data', 'data_fault': fault.data_fault}
            self.refuse('check', fault.text)
            return
        tasks = self._recipe.tasks
        skipped = {
            ability.tool: self.plain(ability.reason)
            for ability in findings.abilities
            if not ability.is_able and ability.tool in tasks
        }
        has_result = tasks == ('check',)
        for name, step in (
            ('noise', self._noise),
            ('fit', self._fit),
            ('diagnose', self._diagnose),
        ):
            if name not in tasks or name in skipped:
                continue
            try:
                step()
                has_result = True
            except UserError as error:
                reason = self.plain(one_line(error))
                if name == 'noise':
                    # Whether a rest is long enough shows only here.
                    skipped[name] = reason
                else:
                    self.refuse(name, reason)
            except Exception as error:
                self.refuse(
                    name, self.plain(f'{type(error).__name__}: {one_line(error)}'), 'crashed'
                )
        # Many recordings have no noise; what the others need says more.
        order = [name for name in tasks if name in skipped]
        if order and not has_result:
            self.refuse(order[-1], skipped[order[-1]])
        self.row['skipped'] = [f'{name}: {skipped[name]}' for name in order]
        self.row['outcome'] = self.row['outcome'] or 'done'

    def refuse(self, name: str, reason: str, outcome: str = 'refused') -> None:
        """Note why a task has no result; the first reason counts, or a crash."""
        if self.row['refusal'] is None or outcome == 'crashed':
            self.row |= {'outcome': outcome, 'refusal': reason, 'refused_by': name}

    def plain(self, text: str) -> str:
        """Return a text with the names of the files in place of the paths of the copies."""
        name = self._staged.path.name
        text = text.replace(str(self._staged.path), name)
        text = text.replace(self._params, self._parameters.name) if self._params else text
        return text.removeprefix(f'{name}: ')

    def _put_check(self, findings: Findings) -> None:
        """Put the check of a recording into its row, and whether its calibration is valid."""
        row = self.row
        contents = findings.contents
        row |= {'is_sound': findings.is_sound, 'faults': [*map(self.plain, findings.faults)]}
        if contents is None:
            return
        low, high = contents.reference_ranges.get('temperature_c', (None, None))
        row |= {
            'axes': ''.join(axis.name.lstrip('a')[0] for axis in contents.axes),
            'duration_s': contents.span_s,
            'samples': contents.samples,
            'rate_hz': contents.rate_hz,
            'jitter_s': contents.jitter_s,
            'missing': contents.missing,
            'longest_gap_s': contents.longest_gap_s,
            'temperature_c': contents.reference_means.get('temperature_c'),
            'temperature_low_c': low,
            'temperature_high_c': high,
        }
        if self._params is None or not row['calibration_id']:
            return
        envelope = parameter_file.load(self._params, may_measure=True).envelope
        if row['calibration_age_days'] is not None and row['calibration_age_days'] < 0:
            row['validity'] = 'younger than the recording'
        elif envelope.temperature_c is None or low is None:
            row['validity'] = 'valid, temperature not known'
        else:
            beyond = float(np.max(envelope.beyond_k(np.array([low, high]))))
            row['validity'] = f'outside: temperature by {beyond:.3g} K' if beyond > 0 else 'valid'

    @cached_property
    def _recording(self) -> Recording:
        """Return the whole recording; reports name it, and not its copy."""
        return replace(
            recording.read(self._staged.path, self._recipe.reading), path=self._source.url
        )

    def _put_assumed(self, sensor: Sensor) -> None:
        """Add what a task assumes of the surroundings that effects of a sensor follow."""
        new = assumed(self._recording, sensor.effects)
        self.row['assumed'] = list(dict.fromkeys([*self.row['assumed'], *new]))

    def _noise(self) -> None:
        """Find the noise of the longest rest."""
        from adxl_ros.api.noise import noise  # the client needs none

        found = noise(
            lambda: recording.blocks(self._staged.path, BLOCK_ROWS, self._recipe.reading),
            self._params,
        )
        for of_axis in found.axes:
            for (letter, _, unit, _), estimate in zip(NOISE, of_axis.estimates):
                values = (
                    estimate.value if estimate.is_seen else None,
                    estimate.low,
                    estimate.high,
                )
                self.row |= {
                    f'noise_{letter}{end}_{of_axis.axis}_{unit}': value
                    for end, value in zip(('', '_low', '_high'), values)
                }

    def _fit(self) -> None:
        """Fit a calibration to the recording alone."""
        from adxl_ros.api.calibration import fit  # the client needs none

        found = fit(self._recording, self._params, data_sha256=self._staged.content)
        fitted = found.sensor
        self._put_assumed(fitted)
        std_of = dict(zip(fitted.covariance_names, stds(fitted.covariance).tolist()))
        for name, unit_name, coefficient, values in (
            ('zero_g', 'v', ('bias', 'offset_v'), fitted.zero_g_v),
            ('scale', 'v_per_g', ('scale_factor', 'offset_v_per_g'), fitted.scale_v_per_g),
        ):
            for axis, value in zip(fitted.axes, values):
                self.row |= {
                    f'{name}_{axis}_{unit_name}': float(value),
                    f'{name}_std_{axis}_{unit_name}': std_of.get(Coefficient(*coefficient, axis)),
                }
        self.row |= {'fit_model': fitted.model, 'fit_poses': found.poses}
        self.files['unit.yaml'] = parameter_file.as_text(fitted, found.result.report_lines).encode(
            'utf-8'
        )

    def _diagnose(self) -> None:
        """Compare the recording with its simulation."""
        from adxl_ros.api.gap import diagnose  # the client needs none

        found = diagnose(self._recording, self._params)
        # The report names the file, and not the copy of the task.
        params = self._parameters.name if self._params else ''
        found = replace(found, compared=found.compared.with_params(params))
        self._put_assumed(found.sensor)
        self._put_verdict(found.to_dict())
        self.files |= {
            name: text.encode()
            for name, text in found.documents('gap', has_page=found.verdict in _PAGES).items()
        }

    def _put_verdict(self, report: dict[str, Any]) -> None:
        """Put a diagnosis into the row."""
        gap = report['gap']
        self.row |= {
            name: report['verdict'][name]
            for name in ('status', 'effects', 'groups', 'data_fault', 'probability')
        }
        if gap is None:
            return
        self.row['gap_floor_source'] = gap['floor_source']
        for name, unit in (
            ('before', '_mps2'),
            ('after', '_mps2'),
            ('floor', '_mps2'),
            ('closed', ''),
        ):
            interval = (gap[name] is not None and gap[f'{name}_ci']) or (None, None)
            self.row |= {
                f'gap_{name}{end}{unit}': value
                for end, value in zip(('', '_low', '_high'), (gap[name], *interval))
            }
