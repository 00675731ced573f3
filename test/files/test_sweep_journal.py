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

"""The journal: on disk before it is acknowledged, whole after any crash."""

import errno
import json
import os

from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import (
    accepted_poses,
    Fitted,
    Journal,
    PoseDropped,
    PoseRecord,
    PoseSkipped,
    read,
    skipped_poses,
    unfinished,
)
from adxl_ros.tools import fit
import numpy as np
import pytest
from units import pose_record

POSE = pose_record(0)
HEAD = {'serial': 'A1', 'mode': 'stage'}


def test_an_interrupted_calibration_resumes(tmp_path):
    """Entries that were appended come back, and a line that a crash cut does not."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.append(pose_record(1))
    journal.close()
    with open(path, 'ab') as file:
        file.write(b'{"pose": 2, "mea')
    journal = Journal(path, HEAD)
    assert journal.entries == [POSE, pose_record(1)]
    journal.append(pose_record(2))
    journal.close()
    assert [entry.pose for entry in read(path)[1]] == [0, 1, 2]


def test_another_unit_is_refused_and_says_what_changed(tmp_path):
    """A journal of another unit is not continued."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.close()
    with pytest.raises(UserError, match='serial was "A1", is "B2"'):
        Journal(path, {**HEAD, 'serial': 'B2'})
    assert len(read(path)[1]) == 1


def test_two_at_once_are_refused(tmp_path):
    """The second calibration of one journal is told so."""
    first = Journal(tmp_path / 'j', HEAD)
    with pytest.raises(UserError, match='another calibration is writing this journal'):
        Journal(tmp_path / 'j', HEAD)
    first.close()
    Journal(tmp_path / 'j', HEAD).close()


def test_a_finished_one_is_kept_beside_the_new(tmp_path):
    """After a finished calibration a new one begins, and the old journal is kept."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.append(Fitted(None, True))
    journal.close()
    journal = Journal(path, {**HEAD, 'serial': 'B2'})
    assert journal.entries == []
    journal.close()
    assert read(tmp_path / 'j.previous').entries[0] == POSE


@pytest.mark.parametrize('text, words', [
    ('', 'empty journal'), ('hello\n', ':1: not a journal'), ('{"format": 9}\n', 'format 9'),
    ('[1]\n', 'not an object')])
def test_what_is_no_journal(tmp_path, text, words):
    """Files that are no journal are refused by their line."""
    path = tmp_path / 'j'
    path.write_text(text)
    with pytest.raises(UserError, match=words):
        read(path)


@pytest.mark.parametrize('text, poses', [
    (b'%s\n%r\n{"po#e": \xff}\n%r\n', 1), (b'%s\n%r\n{"pose": 1, "mean_v": [2.5]}\n', 1),
    (b'a list of mine', 0)])
def test_a_damaged_one_is_said_and_begun_anew_only_if_told(tmp_path, text, poses):
    """Nothing is cut from it, and it is no dead end."""
    path, head = tmp_path / 'j', json.dumps({'format': 1, **HEAD}).encode()
    text = text.replace(b'%s', head).replace(b'%r', json.dumps(POSE.to_json()).encode())
    path.write_bytes(text)
    with pytest.raises(UserError, match=f'not a journal: .*; {poses} poses before it can be read; '
                       'name another journal, or begin anew with resume:=anew'):
        Journal(path, HEAD)
    assert path.read_bytes() == text
    found, why = unfinished(path, HEAD)
    assert found == poses and 'is not of a journal' in why
    Journal(path, HEAD, start_over=True).close()
    assert read(path) == ({'format': 1, **HEAD}, [])
    kept, = tmp_path.glob('j.2*')
    assert kept.read_bytes() == text


def test_a_head_that_a_crash_cut_is_written_anew(tmp_path):
    """It held no pose: nothing to ask about."""
    for text in (b'{"form', bytes(40)):
        (tmp_path / 'j').write_bytes(text)
        Journal(tmp_path / 'j', HEAD).close()
        assert read(tmp_path / 'j')[0]['serial'] == 'A1'


def test_unwritable(tmp_path):
    """A journal in a folder that is not there is refused."""
    with pytest.raises(UserError, match='cannot write the journal'):
        Journal(tmp_path / 'none' / 'j', HEAD)


def test_a_pose_taken_again_replaces_the_first():
    """`redo` appends the pose anew."""
    first, other, again = pose_record(0), pose_record(1), pose_record(0, samples=3)
    entries = [first, other, again, Fitted(None, True)]
    assert accepted_poses(entries) == [again, other]


def test_lines_of_every_version_are_read(tmp_path):
    """Keys and their order are those of all journals; a rest by hand has no angles."""
    taken = {'pose': 1, 'alpha_rad': 0.5, 'beta_rad': 0.25, 'alpha_setting': 0, 'beta_setting': 1,
             'check': False, 'start_ns': 1, 'stop_ns': 2, 'samples': 5, 'mean_v': [2.5, 2.6],
             'std_v': [0.1, 0.2], 'temperature_c': 23.0}
    by_hand = {key: taken[key] for key in ('pose', 'start_ns', 'stop_ns', 'samples', 'mean_v',
                                           'std_v')}
    earlier = {key: value for key, value in taken.items() if not key.endswith('_setting')}
    lines = [taken, by_hand, earlier, {'drop': 1}, {'skip': 3, 'drop': 3},
             {'mounting': 'not checked'}, {'rests': [taken, by_hand], 'done': False}]
    path = tmp_path / 'j'
    path.write_text(''.join(f'{json.dumps(line)}\n' for line in (
        {'format': 1, **HEAD}, *lines, {'note': 'of another version'}, {'done': True})))
    entries = read(path).entries
    assert [json.dumps(e.to_json()) for e in entries] == [json.dumps(e) for e in (
        *lines, {'done': True})]
    assert entries[0].beta_setting == 1 and entries[2].beta_setting is None
    assert np.isnan(entries[1].alpha_rad) and entries[1] == PoseRecord.from_json(by_hand)


def test_a_pose_is_synced_before_it_is_acknowledged(tmp_path, monkeypatch):
    """What a power cut after `append` leaves is what fsync was called for, the entry in it."""
    path, synced = tmp_path / 'j', []
    journal = Journal(path, HEAD)
    sync = os.fsync
    monkeypatch.setattr(os, 'fsync', lambda fd: (synced.append(path.read_bytes()), sync(fd)))
    journal.append(POSE)
    assert json.loads(synced[-1].splitlines()[-1]) == json.loads(json.dumps(POSE.to_json()))
    monkeypatch.setattr(os, 'fsync', _no_room)
    with pytest.raises(UserError, match='No space left on device; make room'):
        journal.append(pose_record(1))
    assert read(path)[1] == [POSE]


def _no_room(_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_one_that_was_fitted_early_goes_on_and_is_in_nobodys_way(tmp_path):
    """With poses left open it is offered again; to another unit it is a finished one."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.append(Fitted((), False))
    journal.close()
    assert unfinished(path, HEAD) == (1, '')
    other = {**HEAD, 'serial': 'B2'}
    assert unfinished(path, other) is None
    journal = Journal(path, HEAD)
    assert accepted_poses(journal.entries) == [POSE]
    journal.close()
    journal = Journal(path, other)
    assert journal.entries == []
    journal.close()
    kept, = tmp_path.glob('j.2*')
    assert accepted_poses(read(kept)[1]) == [POSE]


def test_fit_takes_the_rests_that_were_fitted_unless_the_sweep_went_on(tmp_path):
    """`fit --journal` has all poses that the sweep ended with."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.append(Fitted((pose_record(0, samples=7),), False))
    assert fit._records(path) == [pose_record(0, samples=7)]
    journal.append(pose_record(1))
    journal.close()
    assert fit._records(path) == [POSE, pose_record(1)]


def test_anew_keeps_the_interrupted_one(tmp_path):
    """Poses of an interrupted calibration are put aside, not away."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.close()
    assert unfinished(path, HEAD) == (1, '')
    assert unfinished(path, {**HEAD, 'serial': 'B2'}) == (1, 'serial was "A1", is "B2"')
    journal = Journal(path, {**HEAD, 'serial': 'B2'}, start_over=True)
    assert journal.entries == []
    journal.close()
    kept, = tmp_path.glob('j.2*')
    assert read(kept) == ({'format': 1, **HEAD}, [POSE])
    assert unfinished(path, HEAD) is None


def test_poses_that_were_dropped_or_left_out():
    """A rest that is forgotten counts no more; a pose that is left out is known as such."""
    entries = [POSE, pose_record(1), PoseDropped(1), PoseSkipped(4), pose_record(2),
               PoseSkipped(5), PoseDropped(5)]
    assert accepted_poses(entries) == [POSE, pose_record(2)]
    assert skipped_poses(entries) == {4}, 'what is taken again after all is not left out'


def test_what_a_power_cut_leaves_at_the_end_is_no_pose(tmp_path):
    """A file system may have given the file its length, but not yet its bytes."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.close()
    with open(path, 'ab') as file:
        file.write(bytes(200))
    journal = Journal(path, HEAD)
    assert journal.entries == [POSE]
    journal.append(pose_record(1))
    journal.close()
    assert read(path)[1] == [POSE, pose_record(1)]
