# SPDX-License-Identifier: Apache-2.0

"""The map finds where a residual lies, and reports cells by chance in one of twenty maps."""

from dataclasses import replace

from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.flexible_functions import flexible_bases
from adxl_ros.diagnose.residual_map import not_covered, residual_map
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import FormDimension
from adxl_ros.model.kinematics import gravity_slopes
from gaps import simulated, turning, unit, warm
import numpy as np
import pytest


@pytest.fixture(scope='module')
def healthy():
    """Return a recording of a healthy unit with its simulation."""
    sensor = unit()
    return compare(simulated(sensor, motion=warm(turning())), sensor)


def with_residual(comparison, added_mps2):
    """Return a comparison whose residual is white noise of 1 mg plus given values, m/s²."""
    sensor = comparison.sensor
    noise_mps2 = np.random.default_rng(7).normal(0, 1e-3 * G0_MPS2, comparison.volts.shape)
    residual_v = (noise_mps2 + added_mps2) * comparison.scale_v_per_mps2
    return replace(comparison, volts=comparison.simulated_v(sensor) + residual_v)


def test_a_residual_that_follows_the_force_is_found_there(healthy):
    """Two per cent of the force on x: the mean is lowest where x points down, highest up."""
    force_x_g = healthy.reference_force_g()[0]
    added = np.zeros_like(healthy.volts)
    added[:, 0] = 0.02 * force_x_g
    cells = residual_map(with_residual(healthy, added), seed=1)
    means = {cell.low: cell.mean_mps2 for cell in cells if cell.dimension == 'force_x_g'}
    assert len(means) >= 2
    assert means[max(means)] > 0.005 > -0.005 > means[min(means)]
    assert {cell.axis for cell in cells} == {'x'}
    assert [cell.share for cell in cells] == sorted((c.share for c in cells), reverse=True)


def test_noise_alone_has_no_cell(healthy):
    assert residual_map(with_residual(healthy, 0.0), seed=1) == []


def test_what_a_recording_does_not_vary_is_named(healthy):
    assert not_covered([healthy]) == ['other supplies']


def test_flexible_functions_have_an_rms_of_one_about_zero(healthy):
    """A random combination with coefficients of standard deviation 1 has an rms of 1."""
    for basis in flexible_bases(healthy, healthy.simulated_v(healthy.sensor)):
        for functions in basis.values():
            used = functions[healthy.used]
            assert used.mean(axis=0) == pytest.approx(0.0, abs=1e-9)
            assert (used**2).mean(axis=0).sum() == pytest.approx(1.0)


def test_play_that_closes_gradually_is_an_error_of_form_of_backlash(healthy):
    """Dahl's friction: the joint is behind by half the play times a memory of its direction."""
    angles_rad = healthy.joint_values()
    play_rad = 0.004
    memory = [0.0]
    for step_rad in np.diff(angles_rad[1]):
        forgotten = 1 - np.exp(-abs(step_rad) / play_rad)
        memory.append(memory[-1] + (np.sign(step_rad) - memory[-1]) * forgotten)
    behind = gravity_slopes(*angles_rad)[1] * np.array(memory)
    bases = flexible_bases(healthy, healthy.simulated_v(healthy.sensor))
    for change, basis in zip(behind, bases):
        functions = basis[FormDimension.DIRECTION]
        left = change - functions @ np.linalg.lstsq(functions, change - change.mean())[0]
        assert left.std() < 0.2 * change.std()
