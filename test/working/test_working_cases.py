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
"""Working cases: what a label states is in the files, and the scores count what they say."""

from dataclasses import replace
import json

from adxl_ros.blind.grading import Answer
from adxl_ros.files import parameter_file, recording
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import with_axes
from adxl_ros.simulate.motion import Knots, Motion
from adxl_ros.simulate.trajectories import Steps
from adxl_ros.working import cases, scene, scores
from adxl_ros.working.fault import Fault
import numpy as np
import pytest

SECONDS = (30.0, 40.0)


@pytest.fixture(scope='module')
def still_scene():
    """Return a unit without noise on a stage that moves for six seconds."""
    nominal = with_axes(parameter_file.load(parameter_file.nominal_path()), 'xyz')
    zeros = {'bias': {'offset_v': np.zeros(3)}, 'scale_factor': {'offset_v_per_g': np.zeros(3)}}
    sensor = replace(nominal, rate_hz=100.0, effects=('bias', 'scale_factor'), values=zeros,
                     rc_capacitance_f=0.1e-6)
    shaken = scene.Burst(1.0, 4.0, 10.0, 3.0 / 62.8 ** 2)
    motion = Motion(6.0, Knots([0, 2, 4, 6], [0.4, 1.5, 0.9, 2.2]),
                    Knots([0, 1, 3, 5, 6], [0, 2, -1.0, 1, 0]), shaken,
                    Steps(25.0, ((1.0, 35.0),), 2.0), Steps(5.0, ((2.0, 4.8),), 0.5))
    return scene.Scene(sensor, sensor, motion, 'rich', 3)


@pytest.mark.parametrize('kind', [*cases.LISTED.values(), *cases.UNLISTED.values()],
                         ids=lambda kind: kind.name)
def test_every_kind_changes_the_samples_and_leaves_the_library_as_it_was(kind, still_scene):
    """Each kind has a visible size, in its own form and in that of the library."""
    names = set(library())
    assert (kind.name in names) == kind.listed
    plain = scene.samples(still_scene, [])
    shape = {**kind.draw(np.random.default_rng(1), 3), 'rate_hz': 3.0}
    for form in ('other', 'library') if kind.parameters else ('other',):
        fault = Fault(kind, min(3 * kind.start, kind.largest), {**shape, 'form': form})
        changed = scene.samples(still_scene, [fault])
        assert np.all(np.isfinite(changed))
        assert np.sqrt(np.mean((changed - plain) ** 2)) > 1e-4
    assert set(library()) == names


def test_a_calibration_takes_up_a_part_of_an_offset_of_the_stage(still_scene):
    """A cosine of beta in place of a cosine at another angle leaves less than before."""
    fault = Fault(cases.LISTED['stage_offset'], 5e-3, {'w': [0.0, 1.0]})
    stated = scene.calibrated(still_scene, [fault])
    assert np.abs(stated.zero_g_v - still_scene.stated.zero_g_v).max() < 1e-3
    assert np.abs(stated.scale_v_per_g / still_scene.stated.scale_v_per_g - 1).max() < 1e-2
    fault = Fault(cases.LISTED['quadratic'], 5e-3, {'w': [1.0, 0.0, 0.0], 'form': 'library'})
    stated = scene.calibrated(still_scene, [fault])
    assert stated.zero_g_v[0] - still_scene.stated.zero_g_v[0] > 1e-3
    np.testing.assert_allclose(stated.zero_g_v[1:], still_scene.stated.zero_g_v[1:], atol=1e-5)


def test_a_case_is_written_and_drawn_again_to_the_bit(tmp_path):
    """A label has the strength that was drawn, and its files can be read."""
    number = next(n for n in range(50) if cases.planned(
        np.random.default_rng([cases.SEED, 3, n]), 3, n)[0] == 'single')
    label = cases.write(tmp_path / 'a', 3, number, SECONDS)
    again = cases.write(tmp_path / 'b', 3, number, SECONDS)
    assert label == again
    files = [tmp_path / part / label.name / f'{label.name}.csv' for part in 'ab']
    assert files[0].read_bytes() == files[1].read_bytes()
    assert cases.read(files[0].with_suffix('.json')) == label
    sensor = parameter_file.load(files[0].with_suffix('.yaml'))
    made = recording.read(files[0])
    assert sensor.rate_hz == label.rate_hz
    assert len(made) == round(label.seconds * label.rate_hz)
    assert json.loads(files[0].with_suffix('.json').read_text())['faults'][0]['strength_mg'] > 0


def graded(group, effects, answer, *, outside=False, visibility=1e6, strength_mg=3.0):
    """Return a case with an answer."""
    faults = [{'kind': name, 'strength_mg': strength_mg, 'visibility': visibility,
               'calibrated': False, 'shape': {}}
              for name in (*effects, *(['beat'] if outside else []))]
    return scores.Graded(cases.Label('w', group, tuple(effects), outside, 100.0, 60.0, 'xy',
                                     'rich', 1e-3, 0.01, 3.0, faults), answer)


def said(status, certain=(), groups=(), probability=0.65):
    """Return an answer."""
    return Answer(status, frozenset(certain), tuple(map(frozenset, groups)), probability,
                  ((frozenset(certain), probability),), {}, 1.0)


def test_exact_in_the_set_and_hidden():
    """A group counts for the set only; an effect that cannot be seen may be missing."""
    exact = graded('single', ['supply'], said('explained', ['supply']))
    assert exact.exact and exact.contained and exact.right
    group = graded('single', ['supply'], said('inseparable', [], [('supply', 'warm_up')]))
    assert not group.exact and group.contained and group.right
    wrong = graded('single', ['supply'], said('explained', ['warm_up']))
    assert not (wrong.exact or wrong.contained or wrong.right)
    missed = graded('single', ['supply'], said('no_gap'))
    assert not (missed.exact or missed.contained or missed.right)
    hidden = graded('single', ['supply'], said('no_gap'), visibility=1.0)
    assert hidden.exact and hidden.contained and hidden.right
    unknown = graded('outside', [], said('unknown', ['unknown']), outside=True)
    assert unknown.exact
    alarm = graded('none', [], said('explained', ['supply']))
    assert not (alarm.exact or alarm.contained or alarm.right)


def test_table_states_shares_and_bins():
    """Of two verdicts of 65 % one is right, which is a bin of its own."""
    rows = [graded('single', ['supply'], said('explained', ['supply'])),
            graded('single', ['supply'], said('explained', ['warm_up'])),
            graded('none', [], said('no_gap', probability=0.97))]
    text = scores.table(rows)
    assert ' 50 % ' in text.split('60- 70 %')[1].splitlines()[0]
    assert '100 % ' in text.split('90-100 %')[1].splitlines()[0]
    assert text.splitlines()[1].split()[:2] == ['none', '100']
    assert 'supply 3.00 mg: explained 0.65 warm_up' in text
