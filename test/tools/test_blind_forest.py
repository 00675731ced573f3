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

"""The random forest of the blind check learns effects from simulated recordings."""

from concurrent.futures import ThreadPoolExecutor

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.effects import library
from adxl_ros.simulate import simulator
from adxl_ros.tools import blind_forest
from adxl_ros.tools.effect_option import with_effects
import numpy as np
import pytest

EFFECTS = {'bias': 'bias:offset_v=0.02', 'noise_excess': 'noise_excess:ratio=2'}


def no_progress(fraction):
    """Receive the fraction that is finished."""


def test_features_of_every_effect_are_numbers():
    """Two axes leave the features of the third one empty, and no effect does more."""
    for number in range(0, len(library()), 5):
        _, _, features = blind_forest.training_row(number)
        empty = int(np.sum(np.isnan(features)))
        assert empty <= len(features) / 3 + 3 * len(blind_forest._BAND_EDGES_HZ)
        assert not np.isinf(features).any()


def test_training_is_reproducible():
    first, again = blind_forest.training_row(7), blind_forest.training_row(7)
    assert first[:2] == again[:2] and np.array_equal(first[2], again[2], equal_nan=True)


@pytest.mark.long
def test_strong_effects_are_learned(tmp_path, monkeypatch):
    """A forest of three classes separates a strong bias from excess noise."""
    pytest.importorskip('sklearn', reason='scikit-learn is not installed: pip install '
                                          'scikit-learn')
    monkeypatch.setattr(blind_forest, 'library', lambda: EFFECTS)
    monkeypatch.setattr(blind_forest, 'TRAINING_RECORDINGS', 30)
    monkeypatch.setattr(blind_forest, '_STRENGTH_G', (5e-3, 15e-3))
    monkeypatch.setattr(blind_forest, '_TIMES_TYPICAL', (3.0, 10.0))
    rng = np.random.default_rng(4)
    for name, effect in EFFECTS.items():
        stated = blind_forest._stated(rng)
        sensor = with_effects(stated, [effect])
        columns = simulator.simulate(sensor, blind_forest._motion(rng), 3)
        path = tmp_path / f'{name}.csv'
        recording.write(path, Recording(str(path), columns.pop('time_s'), columns), stated)
        parameter_file.save(path.with_suffix('.yaml'), stated)
    with ThreadPoolExecutor(1) as pool:
        answers = blind_forest.answers(tmp_path, pool, no_progress)
    assert {name: sorted(answer.named) for name, answer in answers.items()} == {
        name: [name] for name in EFFECTS}


def test_votes_become_answers():
    """Nearly equal votes are a group, few votes are unknown."""
    classes = np.array(['', 'a', 'b', 'c'])

    def status(*votes):
        answer = blind_forest._answer(classes, np.array(votes), 0.3)
        return answer.status, sorted(answer.named)

    assert status(0.6, 0.4, 0.0, 0.0) == ('no_gap', [])
    assert status(0.1, 0.8, 0.1, 0.0) == ('explained', ['a'])
    assert status(0.1, 0.4, 0.3, 0.2) == ('inseparable', ['a', 'b', 'c'])
    assert status(0.2, 0.25, 0.25, 0.3 - 1e-6) == ('unknown', ['unknown'])
