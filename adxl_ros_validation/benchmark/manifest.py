# SPDX-License-Identifier: Apache-2.0
"""The manifest: where recordings of others are, what is known of them, and how they are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import adxl_ros as adxl
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import ACCEL, Recording
from adxl_ros.model.constants import G0_MPS2
import numpy as np
import pandas as pd
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, Slerp
import yaml

SHIPPED = Path(__file__).parents[1] / 'benchmark_sources.yaml'
"""The manifest of the package."""
LEVELS = ('A', 'B', 'C')
"""A: a defect is put in; B: a documented one; C: the gap to a better reference."""
GIVEN = 0.75
"""Share of a case that a method gets; the later rest measures what its parameters close."""
_LONGEST_SHIFT_S = 5.0
"""Longest shift between the clocks of a recording and its reference, s; chosen."""


@dataclass(frozen=True, kw_only=True)
class Fetched:
    """A file that a user fetches."""

    file: str  # Its name in the folder
    address: str = ''  # Where it is, or what it is made of
    convert: str = ''  # Command that makes $FILE of $FETCHED, which is at the address; '' for none
    sha256: str = ''  # Hash of the file; '' where none is stated
    read: Mapping[str, Any] = field(default_factory=dict)  # Arguments of `adxl_ros.read`

    def path_in(self, folder: Path) -> Path:
        """Return the path of the file, which is the one of the manifest."""
        path = folder / self.file
        if not path.exists():
            raise UserError(f'{path}: no such file; fetch {self.address or "it"}{self._then()}')
        if self.sha256 and hashlib.sha256(path.read_bytes()).hexdigest() != self.sha256:
            raise UserError(f'{path}: is not the file whose SHA-256 the manifest has')
        return path

    def _then(self) -> str:
        """Return what is to be done with what was fetched."""
        if not self.convert:
            return ''
        fetched = self.address.rpartition('/')[2]
        command = self.convert.replace('$FETCHED', fetched).replace('$FILE', self.file)
        return f', then run: {command}'


@dataclass(frozen=True, kw_only=True)
class Reference(Fetched):
    """What knows the force of the same motion better."""

    # Whether it is a table of poses with the columns time_s, qx, qy, qz, qw, which turn the body
    # into a frame whose z is up, and x_m, y_m, z_m where its position is known
    poses: bool = False
    smooth_s: float = 0.12  # Span of the polynomials that smooth poses, and differentiate, s
    # Whether it is a sensor itself, which is calibrated against gravity first
    calibrate: bool = False
    align: bool = False  # Whether its clock is another one, so that it is shifted in time
    turn: bool = False  # Whether its axes are others, so that it is turned by least squares


@dataclass(frozen=True, kw_only=True)
class Source(Fetched):
    """One public recording."""

    name: str
    licence: str
    known: str  # What is known of it
    levels: str  # Some of `LEVELS`, for example AC
    not_known: str = ''
    rate_hz: float = math.nan  # Its sample rate, Hz, for readers of the manifest
    angles_deg: Sequence[float] = ()  # Stage angles alpha and beta of a sensor that rests
    reference: Reference | None = None
    # Sets of effects of which each is a right answer of level B
    expected: Sequence[Sequence[str]] = ()


class Loaded(NamedTuple):
    """A source whose files are there."""

    source: Source
    recording: Recording
    force: Recording | None  # Specific force by the reference, in its columns ax_mps2 ...


def load(path: Path) -> list[Source]:
    """Read a manifest."""
    try:
        rows = yaml.safe_load(path.read_text(encoding='utf-8'))['sources']
        sources = [_source(path, number, row) for number, row in enumerate(rows, 1)]
    except FileNotFoundError:
        raise UserError(f'{path}: no such manifest') from None
    except (OSError, UnicodeError, yaml.YAMLError, KeyError, TypeError) as error:
        text = ' '.join(str(error).split())
        raise UserError(
            f'{path}: is no manifest: {text}; it has a list `sources` of mappings, as that of '
            f'the package has: {SHIPPED}'
        ) from None
    names = [source.name for source in sources]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f'{path}: two sources are called {name}; give them different names')
    return sources


def _source(path: Path, number: int, row: Mapping[str, Any]) -> Source:
    """Check an entry of a manifest."""
    where = f'{path}: source {number} ({row.get("name", "without a name")})'
    try:
        given = dict(row)
        if 'reference' in given:
            given['reference'] = Reference(**given['reference'])
        source = Source(**given)
    except TypeError as error:
        raise UserError(f'{where}: {str(error).split("__init__() ")[-1]}') from None
    if not source.levels or not set(source.levels) <= set(LEVELS):
        raise UserError(f'{where}: levels: {source.levels}; write some of A, B and C')
    if 'B' in source.levels and not source.expected:
        raise UserError(f'{where}: is of level B, which needs `expected`, a list of sets')
    if 'C' in source.levels and source.reference is None:
        raise UserError(f'{where}: is of level C, which needs a `reference`')
    return source


def read_all(sources: Sequence[Source], folder: Path) -> tuple[list[Loaded], list[str]]:
    """Read the sources whose files are in a folder; say why others are left out."""
    loaded, left_out = [], []
    for source in sources:
        try:
            loaded.append(_read(source, folder))
        except UserError as error:
            left_out.append(f'{source.name}: {" ".join(str(error).split())}')
    return loaded, left_out


def _read(source: Source, folder: Path) -> Loaded:
    """Read a source and its reference."""
    recording = adxl.read(source.path_in(folder), **source.read)
    if source.angles_deg:
        angles = {
            name: np.full(len(recording), np.deg2rad(angle))
            for name, angle in zip(('alpha_rad', 'beta_rad'), source.angles_deg)
        }
        recording = replace(recording, columns={**recording.columns, **angles})
    force = _force(source, folder, recording)
    if force is not None:
        recording = recording.rows(*np.searchsorted(recording.time_s, force.time_s[[0, -1]]))
    return Loaded(source, recording, force)


def _force(source: Source, folder: Path, recording: Recording) -> Recording | None:
    """Return the force by the reference of a source, on the clock of the recording."""
    reference = source.reference
    if reference is None:
        return None
    path = reference.path_in(folder)
    if reference.poses:
        force = _force_of_poses(path, reference.smooth_s)
    else:
        force = adxl.read(path, **reference.read)
    if reference.calibrate:
        corrected = adxl.apply(force, adxl.fit(force)).to_pandas()
        columns = {name: corrected[name].to_numpy() for name in ACCEL}
        force = replace(force, columns=columns, info={})
    missing = [name for name in ACCEL if name not in force.columns]
    if missing:
        raise UserError(f'{path}: a reference needs three axes in m/s², but has no {missing[0]}')
    if reference.align:
        force = replace(force, time_s=force.time_s + _lag_s(recording, force))
    if reference.turn:
        force = _turned(recording, force)
    start, stop = np.searchsorted(force.time_s, recording.time_s[[0, -1]])
    if stop - start < len(force) // 2:
        raise UserError(f'{path}: covers too little of {recording.path}')
    return force


def _force_of_poses(path: Path, smooth_s: float) -> Recording:
    """Return the specific force of a body by its poses, in its own axes."""
    table = pd.read_csv(path)
    try:
        time_s = table['time_s'].to_numpy()
        turn = Slerp(time_s, Rotation.from_quat(table[['qx', 'qy', 'qz', 'qw']].to_numpy()))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f'{path}: is no table of poses: {error}') from None
    step_s = float(np.median(np.diff(time_s)))
    grid_s = np.arange(time_s[0], time_s[-1], step_s)
    width = max(2 * round(smooth_s / step_s / 2) + 1, 5)
    smooth = partial(savgol_filter, window_length=width, polyorder=3, delta=step_s)
    turns = Rotation.from_matrix(smooth(turn(grid_s).as_matrix(), axis=0))
    force = np.tile([0.0, 0.0, G0_MPS2], (len(grid_s), 1))
    if 'x_m' in table:
        places = [np.interp(grid_s, time_s, table[name]) for name in ('x_m', 'y_m', 'z_m')]
        force += smooth(places, deriv=2).T
    force = turns.inv().apply(force)
    return adxl.from_arrays(time_s=grid_s, **dict(zip(ACCEL, force.T)), name=path.name)


def _samples(recording: Recording, time_s: np.ndarray) -> np.ndarray:
    """Return the output at instants, in its own unit, (m, n)."""
    return np.array(
        [
            np.interp(time_s, recording.time_s, recording.columns[name])
            for name in recording.sensor_columns
        ]
    )


def _lag_s(recording: Recording, force: Recording) -> float:
    """
    Return by what the clock of a reference is behind that of a recording, s.

    The agreement at a lag is the largest that any rotation of the reference gives: the sum of the
    singular values of the correlations of all pairs of axes. The means are left out: that of
    gravity agrees at any lag, and best where the two overlap most.
    """
    step_s = 1 / recording.rate_hz
    grid_s = np.arange(0.0, min(recording.span_s, force.span_s), step_s)
    most = min(round(_LONGEST_SHIFT_S / step_s), len(grid_s) // 4)
    first, second = (
        np.fft.rfft(samples - samples.mean(axis=1, keepdims=True), 2 * len(grid_s))
        for samples in (_samples(each, grid_s + each.time_s[0]) for each in (recording, force))
    )
    pairs = np.roll(np.fft.irfft(first[:, None] * np.conj(second)), most)[..., : 2 * most + 1]
    agreement = np.linalg.svd(np.moveaxis(pairs, -1, 0), compute_uv=False).sum(axis=1)
    best = int(np.clip(np.argmax(agreement), 1, 2 * most - 1))
    left, middle, right = agreement[best - 1 : best + 2]
    # The vertex of the parabola through the three largest values
    part = 0.5 * (left - right) / (left - 2 * middle + right)
    return float((best - most + part) * step_s + recording.time_s[0] - force.time_s[0])


def _turned(recording: Recording, force: Recording) -> Recording:
    """Turn a reference into the frame of a recording, by least squares over what methods get."""
    time_s = recording.time_s[: int(GIVEN * len(recording))]
    left, _, right = np.linalg.svd(_samples(recording, time_s) @ _samples(force, time_s).T)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    columns = dict(zip(ACCEL, turn @ np.array([force.columns[name] for name in ACCEL])))
    return replace(force, columns={**force.columns, **columns})
