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

"""Answers of methods to compare a diagnosis with: those of the competition, and simple ones."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.blind import grading
from adxl_ros.blind.diagnostic_utility import COMPONENTS
from adxl_ros.blind.grading import Answer, UNKNOWN
from adxl_ros.blind.trials import Label
import numpy as np


def answers(labels: Sequence[Label]) -> dict[str, list[Answer]]:
    """
    Return the answers of all reference methods.

    `Null` never names an effect, `Random` names one at random, and `Worst` names all together.
    They are the references of the diagnosis competition (github.com/jdekleer/dxc26synth,
    RandomDiagnoser.py).
    Guessing draws from the mix of the check. The others choose by the smallest residual or by the
    smallest BIC for white noise, with the responses of the check's own world.

    Parameters
    ----------
    labels
        Labels of the trials.

    Returns
    -------
    dict
        Answers in the order of the labels, by the name of the method.

    """
    rng = np.random.default_rng(0)
    effects: dict[str, list[frozenset[str]]] = {
        'BIC, white noise': [frozenset(filter(None, [label.plain['bic']])) for label in labels],
        'smallest RMSE': [frozenset({label.plain['rmse']}) for label in labels],
        'guess by the mix': [grading.truth(labels[i]) for i in rng.permutation(len(labels))],
        'Null': [frozenset()] * len(labels),
        'Random': [frozenset({str(name)}) for name in rng.choice(COMPONENTS, len(labels))],
        'Worst': [frozenset(COMPONENTS)] * len(labels),
    }
    return {name: [certain(row) for row in rows] for name, rows in effects.items()}


def certain(effects: frozenset[str]) -> Answer:
    """Return an answer that names effects for certain."""
    status = 'no_gap' if not effects else 'unknown' if UNKNOWN in effects else 'explained'
    return Answer(status, effects, (), 1.0, ((effects, 1.0),), {}, 0.0)
