# SPDX-License-Identifier: Apache-2.0

"""Recording and journal of one sweep number the settings of its joints equally."""

from dataclasses import replace

from adxl_ros.calibrate.poses import extract_poses
import numpy as np


def same_partition(first, second):
    pairs = set(zip(first, second))
    return len(pairs) == len(set(first)) == len(set(second))


def by_rests(read, unit, entries):
    """Find the rests without a journal; return the settings of the poses of a journal."""
    poses = extract_poses(read, unit)
    begin, end = (read.epoch_ns + np.rint(poses.time_s * 1e9).astype(np.int64)).T
    # Without the journal a rest may begin later, and end with the next move.
    overlap_ns = [np.minimum(end, e.stop_ns) - np.maximum(begin, e.start_ns) for e in entries]
    assert min(map(max, overlap_ns)) > 0
    rest = [int(both.argmax()) for both in overlap_ns]
    return poses.alpha_setting[rest], poses.beta_setting[rest]


def check_all_agree(read, unit, entries):
    """Assert that a recording numbers the settings as its journal does."""
    alpha, beta = (np.array([getattr(e, f'{joint}_setting') for e in entries])
                   for joint in ('alpha', 'beta'))
    by_journal = extract_poses(read, unit, entries)
    assert (by_journal.alpha_setting == alpha).all() and (by_journal.beta_setting == beta).all()
    # Records of an earlier version have no numbers of settings.
    bare = [replace(e, alpha_setting=None, beta_setting=None) for e in entries]
    named = extract_poses(read, unit, bare)
    for settings in ((named.alpha_setting, named.beta_setting), by_rests(read, unit, entries)):
        assert same_partition(settings[0].tolist(), alpha.tolist())
        assert same_partition(settings[1].tolist(), beta.tolist())
