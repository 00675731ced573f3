# SPDX-License-Identifier: Apache-2.0

"""The journal: an acknowledged pose is on disk, and a crash leaves no invalid journal."""

import errno
import json
import os

from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import Journal, read, unfinished
import pytest
from units import pose_record

POSE = pose_record(0)
HEAD = {'serial': 'A1', 'mode': 'stage'}


def test_an_interrupted_calibration_resumes(tmp_path):
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


def test_two_calibrations_of_one_journal_are_refused(tmp_path):
    first = Journal(tmp_path / 'j', HEAD)
    with pytest.raises(UserError, match='another calibration is writing this journal'):
        Journal(tmp_path / 'j', HEAD)
    first.close()
    Journal(tmp_path / 'j', HEAD).close()


@pytest.mark.parametrize(
    'text, words',
    [
        ('', 'empty journal'),
        ('hello\n', 'line 1 is not of a journal'),
        ('{"format": 9}\n', 'format 9'),
        ('[1]\n', 'not an object'),
    ],
)
def test_other_files_are_refused(tmp_path, text, words):
    path = tmp_path / 'j'
    path.write_text(text)
    with pytest.raises(UserError, match=words):
        read(path)


@pytest.mark.parametrize(
    'text, poses',
    [
        (b'%s\n%r\n{"po#e": \xff}\n%r\n', 1),
        (b'%s\n%r\n{"pose": 1, "mean_v": [2.5]}\n', 1),
        (b'a list of mine', 0),
    ],
)
def test_a_damaged_journal_is_replaced_only_on_request(tmp_path, text, poses):
    path, head = tmp_path / 'j', json.dumps({'format': 1, **HEAD}).encode()
    text = text.replace(b'%s', head).replace(b'%r', json.dumps(POSE.to_json()).encode())
    path.write_bytes(text)
    with pytest.raises(
        UserError,
        match=f'is not of a journal .*; {poses} poses before it can be '
        'read; name another journal, or begin again with resume:=anew',
    ):
        Journal(path, HEAD)
    assert path.read_bytes() == text
    accepted, reason = unfinished(path, HEAD)
    assert accepted == poses and 'is not of a journal' in reason
    Journal(path, HEAD, start_over=True).close()
    assert read(path)[:2] == ({'format': 1, **HEAD}, [])
    (kept,) = tmp_path.glob('j.2*')
    assert kept.read_bytes() == text


def test_a_pose_is_synced_before_it_is_acknowledged(tmp_path, monkeypatch):
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


def test_a_new_start_keeps_the_interrupted_journal(tmp_path):
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.append(POSE)
    journal.close()
    assert unfinished(path, HEAD) == (1, '')
    assert unfinished(path, {**HEAD, 'serial': 'B2'}) == (1, 'serial was "A1", is "B2"')
    with pytest.raises(UserError, match='serial was "A1", is "B2"'):
        Journal(path, {**HEAD, 'serial': 'B2'})
    journal = Journal(path, {**HEAD, 'serial': 'B2'}, start_over=True)
    assert journal.entries == []
    journal.close()
    (kept,) = tmp_path.glob('j.2*')
    assert read(kept)[:2] == ({'format': 1, **HEAD}, [POSE])
    assert unfinished(path, HEAD) is None
