# SPDX-License-Identifier: Apache-2.0
"""The figures of the paper, as they are drawn."""

from adxl_ros.files.plot_file import pyplot
from adxl_ros_validation import reproduction_report
from adxl_ros_validation.experiments import DirectionSearch, SEARCH_RAD
import numpy as np
import pytest


def test_the_legend_states_the_angles_at_which_the_lines_stand(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(reproduction_report, 'write_plot',
                        lambda figure, path: drawn.append(figure))
    search = DirectionSearch(*np.radians([0.7, 1.0, 0.8, 0.6]), SEARCH_RAD, np.cos(SEARCH_RAD))
    reproduction_report.draw_misalignment(tmp_path / 'misalignment.png', search)
    _, *lines = drawn[0].axes[0].get_lines()
    assert len(lines) == 4
    for line in lines:
        stated_deg = float(line.get_label().rsplit(':', 1)[1].strip().rstrip('°'))
        assert stated_deg == pytest.approx(line.get_xdata()[0], abs=0.005)
    pyplot().close(drawn[0])
