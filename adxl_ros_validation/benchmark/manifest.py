# SPDX-License-Identifier: Apache-2.0
"""The manifest: where recordings of others are, what is known of them, and how they are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import adxl_ros as adxl
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import ACCEL, Recording
import numpy as np
import yaml

SHIPPED = Path(__file__).parents[1] / 'benchmark_sources.yaml'
"""The manifest of the package."""
LEVELS = ('A', 'B', 'C')
"""A: a defect is put in; B: a documented one; C: the gap to a better reference."""
GIVEN = 0.75
"""Share of a case that a method gets; the later rest measures what its parameters close."""
_LONGEST_SHIFT_S = 5.0
"""Longest shift between the clocks of a recording and its reference, s; chosen."""


@dataclass(frozen=True)
class Reference:
    """What knows the force of the same motion better."""

    file: str  # Name of its file in the folder
    sha256: str = ''  # Hash of the file; '' where none is stated
    read: Mapping[str, Any] = field(default_factory=dict)  # Arguments of `adxl_ros.read`
    # Whether it is a sensor itself, which is calibrated against gravity first
    calibrate: bool = False
    align: bool = False  # Whether its clock is another one, so that it is shifted in time
    turn: bool = False  # Whether its axes are others, so that it is turned by least squares


@dataclass(frozen=True)
class Source:
    """One public recording."""

    name: str
    file: str  # Name of its file in the folder
    licence: str
    known: str  # What is known of it
    levels: str  # Some of `LEVELS`, for example AC
    address: str = ''  # Where the file is
    commit: str = ''  # Version of it
    sha256: str = ''  # Hash of the file; '' where none is stated
    not_known: str = ''
    rate_hz: float = math.nan  # Its sample rate, Hz, for readers of the manifest
    read: Mapping[str, Any] = field(default_factory=dict)  # Arguments of `adxl_ros.read`
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
    recording = adxl.read(
        _found(folder, source.file, source.sha256, source.address), **source.read
    )
    if source.angles_deg:
        angles = {
            name: np.full(len(recording), np.deg2rad(angle))
            for name, angle in zip(('alpha_rad', 'beta_rad'), source.angles_deg)
        }
        recording = replace(recording, columns={**recording.columns, **angles})
    return Loaded(source, recording, _force(source, folder, recording))


def _found(folder: Path, name: str, sha256: str, address: str) -> Path:
    """Return the path of a file that is the one of the manifest."""
    path = folder / name
    if not path.exists():
        raise UserError(f'{path}: no such file; fetch {address or "it"}')
    if sha256 and hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
        raise UserError(f'{path}: is not the file whose SHA-256 the manifest has')
    return path


def _force(source: Source, folder: Path, recording: Recording) -> Recording | None:
    """Return the force by the reference of a source, on the clock of the recording."""
    reference = source.reference
    if reference is None:
        return None
    path = _found(folder, reference.file, reference.sha256, source.address)
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
    singular values of the correlations of all pairs of axes.
    """
    step_s = 1 / recording.rate_hz
    grid_s = np.arange(0.0, min(recording.span_s, force.span_s), step_s)
    most = min(round(_LONGEST_SHIFT_S / step_s), len(grid_s) // 4)
    first, second = (
        np.fft.rfft(_samples(each, grid_s + each.time_s[0]), 2 * len(grid_s))
        for each in (recording, force)
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
