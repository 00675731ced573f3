# SPDX-License-Identifier: Apache-2.0

"""A sweep that is killed at random moments."""

from kills import kill_sweeps


def test_no_kill_loses_a_pose_or_breaks_a_file(ros_env, kill, tmp_path):
    sweeps = kill_sweeps(tmp_path, ros_env, kill, 5, 1)
    assert sweeps.lost == [] and sweeps.broken == []
    assert sweeps.poses >= 10 and sweeps.sweeps >= 1, 'too few poses or complete sweeps'
    assert sweeps.in_fit, 'no kill while it was fitted or written'
