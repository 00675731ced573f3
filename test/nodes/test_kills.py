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

"""A sweep that is killed at random moments; 200 times in `make soak`."""

from kills import kill
import pytest


@pytest.mark.kills
def test_no_kill_loses_a_pose_or_breaks_a_file(ros_env, tmp_path):
    """Ten kills at different moments of a sweep, which resumes each time until its end."""
    sweeps = kill(tmp_path, ros_env, 10, 1)
    assert sweeps.lost == [] and sweeps.broken == []
    assert sweeps.poses >= 20 and sweeps.sweeps >= 2, 'too few poses or complete sweeps'
    assert sweeps.moments.keys() - {'poses', 'the mounting is checked', 'the end'}, \
        'no kill while it was fitted or written'
