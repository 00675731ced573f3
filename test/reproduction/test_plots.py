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

"""The figures of the paper, as they are drawn."""

from adxl_ros.files.plot_file import pyplot
from adxl_ros.reproduction import plots
from adxl_ros.reproduction.misalignment import DirectionSearch, SEARCH_RAD
import numpy as np
import pytest


def test_the_legend_states_the_angles_at_which_the_lines_stand(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plots, 'write_plot', lambda figure, path: drawn.append(figure))
    search = DirectionSearch(*np.radians([0.7, 1.0, 0.8, 0.6]), SEARCH_RAD, np.cos(SEARCH_RAD))
    plots.draw_misalignment(tmp_path / 'misalignment.png', search)
    _, *lines = drawn[0].axes[0].get_lines()
    assert len(lines) == 4
    for line in lines:
        stated_deg = float(line.get_label().rsplit(':', 1)[1].strip().rstrip('°'))
        assert stated_deg == pytest.approx(line.get_xdata()[0], abs=0.005)
    pyplot().close(drawn[0])
