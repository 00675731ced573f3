# SPDX-License-Identifier: Apache-2.0

"""The journal: an acknowledged pose is on disk, and a crash leaves no invalid journal."""

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
    """Appended entries are read again, except for a line that a crash has cut."""
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


def test_another_unit_is_refused_with_the_difference(tmp_path):
    """A journal of another unit is not continued."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.close()
    with pytest.raises(UserError, match='serial was "A1", is "B2"'):
        Journal(path, {**HEAD, 'serial': 'B2'})
    assert len(read(path)[1]) == 1


def test_two_calibrations_of_one_journal_are_refused(tmp_path):
    """The second calibration is refused."""
    first = Journal(tmp_path / 'j', HEAD)
    with pytest.raises(UserError, match='another calibration is writing this journal'):
        Journal(tmp_path / 'j', HEAD)
    first.close()
    Journal(tmp_path / 'j', HEAD).close()


def test_a_finished_journal_is_kept_beside_the_new_one(tmp_path):
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
def test_other_files_are_refused(tmp_path, text, words):
    """The message names the line of the fault."""
    path = tmp_path / 'j'
    path.write_text(text)
    with pytest.raises(UserError, match=words):
        read(path)


@pytest.mark.parametrize('text, poses', [
    (b'%s\n%r\n{"po#e": \xff}\n%r\n', 1), (b'%s\n%r\n{"pose": 1, "mean_v": [2.5]}\n', 1),
    (b'a list of mine', 0)])
def test_a_damaged_journal_is_replaced_only_on_request(tmp_path, text, poses):
    """The file is not changed, and a start with `resume:=anew` keeps a copy of it."""
    path, head = tmp_path / 'j', json.dumps({'format': 1, **HEAD}).encode()
    text = text.replace(b'%s', head).replace(b'%r', json.dumps(POSE.to_json()).encode())
    path.write_bytes(text)
    with pytest.raises(UserError, match=f'not a journal: .*; {poses} poses before it can be read; '
                       'name another journal, or begin again with resume:=anew'):
        Journal(path, HEAD)
    assert path.read_bytes() == text
    accepted, reason = unfinished(path, HEAD)
    assert accepted == poses and 'is not of a journal' in reason
    Journal(path, HEAD, start_over=True).close()
    assert read(path) == ({'format': 1, **HEAD}, [])
    kept, = tmp_path.glob('j.2*')
    assert kept.read_bytes() == text


def test_an_incomplete_head_is_written_again(tmp_path):
    """Without a pose there is no question to the operator."""
    for text in (b'{"form', bytes(40)):
        (tmp_path / 'j').write_bytes(text)
        Journal(tmp_path / 'j', HEAD).close()
        assert read(tmp_path / 'j')[0]['serial'] == 'A1'


def test_a_journal_in_a_missing_folder_is_refused(tmp_path):
    """The message names the missing folder."""
    with pytest.raises(UserError, match='cannot write the journal'):
        Journal(tmp_path / 'none' / 'j', HEAD)


def test_a_repeated_pose_replaces_the_first():
    """`redo` appends the pose again."""
    first, other, again = pose_record(0), pose_record(1), pose_record(0, samples=3)
    entries = [first, other, again, Fitted(None, True)]
    assert accepted_poses(entries) == [again, other]


def test_lines_of_every_version_are_read(tmp_path):
    """Keys and their order are those of all journals; a rest by hand has no angles."""
    record = {'pose': 1, 'alpha_rad': 0.5, 'beta_rad': 0.25, 'alpha_setting': 0, 'beta_setting': 1,
              'check': False, 'start_ns': 1, 'stop_ns': 2, 'samples': 5, 'mean_v': [2.5, 2.6],
              'std_v': [0.1, 0.2], 'temperature_c': 23.0}
    by_hand = {key: record[key] for key in ('pose', 'start_ns', 'stop_ns', 'samples', 'mean_v',
                                            'std_v')}
    earlier = {key: value for key, value in record.items() if not key.endswith('_setting')}
    lines = [record, by_hand, earlier, {'drop': 1}, {'skip': 3, 'drop': 3},
             {'mounting': 'not checked'}, {'rests': [record, by_hand], 'done': False}]
    path = tmp_path / 'j'
    path.write_text(''.join(f'{json.dumps(line)}\n' for line in (
        {'format': 1, **HEAD}, *lines, {'note': 'of another version'}, {'done': True})))
    entries = read(path).entries
    assert [json.dumps(e.to_json()) for e in entries] == [json.dumps(e) for e in (
        *lines, {'done': True})]
    assert entries[0].beta_setting == 1 and entries[2].beta_setting is None
    assert np.isnan(entries[1].alpha_rad) and entries[1] == PoseRecord.from_json(by_hand)


def test_a_pose_is_synced_before_it_is_acknowledged(tmp_path, monkeypatch):
    """The file contains the entry when `append` calls fsync."""
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


def test_an_early_fit_can_continue_and_does_not_block_another_unit(tmp_path):
    """With open poses the calibration can resume. For another unit the journal is finished."""
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


def test_fit_uses_the_fitted_rests_unless_the_sweep_has_continued(tmp_path):
    """`fit --journal` uses all poses of the end of the sweep."""
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.append(Fitted((pose_record(0, samples=7),), False))
    assert fit._records(path) == [pose_record(0, samples=7)]
    journal.append(pose_record(1))
    journal.close()
    assert fit._records(path) == [POSE, pose_record(1)]


def test_a_new_start_keeps_the_interrupted_journal(tmp_path):
    """The poses of an interrupted calibration are kept in another file."""
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


def test_dropped_and_skipped_poses():
    """A dropped pose does not count, and a skipped pose is listed."""
    entries = [POSE, pose_record(1), PoseDropped(1), PoseSkipped(4), pose_record(2),
               PoseSkipped(5), PoseDropped(5)]
    assert accepted_poses(entries) == [POSE, pose_record(2)]
    assert skipped_poses(entries) == {4}, 'a pose that is taken after all is not skipped'


def test_zero_bytes_after_a_power_cut_are_ignored(tmp_path):
    """A file system may have stored the length of the file before its bytes."""
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
