# SPDX-License-Identifier: Apache-2.0
"""The forms of the package's effects in a recording, for an observer that knows its noise."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.linear_model import candidates, variants
from adxl_ros.files import parameter_file
from adxl_ros.files.recording import read
from adxl_ros.model.effects.base import Coefficient
from adxl_ros_validation.blind.ideal_observer import IdealObserver
import numpy as np


class LibraryForms(NamedTuple):
    """What the package's effects change in a recording, m/s², (m, n) each."""

    by_effect: dict[str, list[list[np.ndarray]]]  # changes by each coefficient, for each shape
    # those of filter and latency with the standard deviation of a healthy unit, by coefficient
    tolerated: dict[Coefficient, tuple[np.ndarray, float]]


def library_forms(recording: Path) -> LibraryForms:
    """Simulate the library beside a recording, whose parameter file has the same name."""
    compared = compare(read(recording), parameter_file.load(recording.with_suffix('.yaml')))
    output_v, forms = compared.simulated_v(compared.sensor), LibraryForms({}, {})
    none = np.zeros(len(compared))
    for effect in candidates():
        hints = effect.diagnosis
        for variant in variants(compared, effect, output_v):
            changes = list[np.ndarray]()
            forms.by_effect.setdefault(effect.name, []).append(changes)
            for name in variant.names:
                change_v = np.stack([columns.get(name, none) for columns in variant.columns])
                change = change_v / compared.scale_v_per_mps2[:, None]
                changes.append(change)
                if hints.healthy_std is not None and not hints.straight_line:
                    forms.tolerated.setdefault(name, (change, hints.healthy_std))
    return forms


def library_rivals(forms: LibraryForms, observer: IdealObserver) -> dict[str, list[np.ndarray]]:
    """
    Return columns that span the responses of each effect, in sets, (v, k) each.

    What lies between the shapes that are tried is between two neighbours.
    """
    rivals = {}
    for name, shapes in forms.by_effect.items():
        vectors = [[observer.project(change) for change in shape] for shape in shapes]
        neighbours = [*pairwise(vectors)] or [(vectors[0], [])]
        rivals[name] = [observer.span([*a, *b]) for a, b in neighbours]
    return rivals
