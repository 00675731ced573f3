# SPDX-License-Identifier: Apache-2.0
"""`simulators`: what is wrong with a simulated accelerometer is named with its size."""

from pathlib import Path
import re
import runpy

from adxl_ros.simulate.robot import Robot
from adxl_ros_validation import simulators_command
from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Checked, Simulator
from adxl_ros_validation.simulators.check import check
import numpy as np
from processes import REPO
import pytest

pytest.importorskip('pinocchio')
OMEGA_RADPS = np.array([3.1, 4.3, 5.7])
LATE_STEPS, LEVER_M = 2, np.array([0.02, 0.0, 0.0])


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arm, 'SECONDS', 33.0)


def force(time_s: np.ndarray) -> np.ndarray:
    """Return force, angular rate and acceleration where joints follow sines, (3, n, 3)."""
    phase = np.outer(time_s, OMEGA_RADPS)
    joints = np.array(
        [np.sin(phase), OMEGA_RADPS * np.cos(phase), -(OMEGA_RADPS**2) * np.sin(phase)]
    )
    return Robot(arm.URDF, arm.FRAME).motion(0.6 * joints, None, 9.80665)[:3]


class Right(Simulator):
    """A simulator that makes no error, but for what its heirs put in."""

    library, reads = 'numpy', 'by its formula'

    def __init__(self) -> None:
        self._readings = self.readings(np.arange(-10, 33.1 / arm.STEP_S) * arm.STEP_S)
        self._step = 0

    def readings(self, time_s: np.ndarray) -> np.ndarray:
        return force(time_s)[0]

    def restart(self) -> None:
        self._step = 0

    def step(self) -> None:
        self._step += 1

    def angles(self) -> np.ndarray:
        return 0.6 * np.sin(OMEGA_RADPS * self._step * arm.STEP_S)

    def accelerometer(self) -> np.ndarray:
        return self._readings[self._step + 10]


class Late(Right):
    """Readings come late."""

    def accelerometer(self) -> np.ndarray:
        return self._readings[self._step + 10 - LATE_STEPS]


class Elsewhere(Right):
    """The sensor is not where its frame is."""

    def readings(self, time_s: np.ndarray) -> np.ndarray:
        specific, rate, acceleration = force(time_s)
        outward = np.cross(rate, np.cross(rate, LEVER_M))
        return specific + np.cross(acceleration, LEVER_M) + outward


class WithoutGravity(Right):
    """Gravity has the wrong sign."""

    def readings(self, time_s: np.ndarray) -> np.ndarray:
        return -force(time_s)[0]


class Forgetful(Right):
    """The first reading after a reset is the last one before it."""

    def __init__(self) -> None:
        super().__init__()
        self._last = self._readings[10]

    def accelerometer(self) -> np.ndarray:
        reading, self._last = self._last, super().accelerometer()
        return reading if self._step == 0 else self._last


def checked(kind: type[Simulator], tmp_path: Path) -> Checked:
    return check(kind(), tmp_path / 'run.csv', 1, lambda share: None)


def test_a_delay_is_named_with_its_size(tmp_path: Path) -> None:
    made = checked(Late, tmp_path)
    (named,) = made.named
    assert named.startswith('time_offset: offset 4.0')
    for moved, late_ms in {'attitude': 4, 'acceleration': 4, 'rates': 0}.items():
        assert made.late_ms[moved][0] == pytest.approx(late_ms, abs=0.1)
    assert made.explained > 0.99


def test_a_lever_arm_is_named_with_its_size(tmp_path: Path) -> None:
    made = checked(Elsewhere, tmp_path)
    (named,) = made.named
    assert named.startswith(('lever_arm: x 20.', 'lever_arm: x 19.9'))


def test_a_wrong_sign_of_gravity_is_a_fault(tmp_path: Path) -> None:
    made = checked(WithoutGravity, tmp_path)
    assert made.verdict == 'BAD DATA' and 'sign' in made.named[0]


def test_what_a_reset_leaves_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command names what it cannot import, and keeps what it has."""
    monkeypatch.setattr(arm, 'SECONDS', 31.0)
    (tmp_path / 'mine.py').write_text(
        f'from {__name__} import Forgetful\nclass Mine(Forgetful):\n    reads = "mine"\n'
    )
    (tmp_path / 'lacking.py').write_text('import no_such_simulator\n')
    words = [str(tmp_path), '-o', str(tmp_path / 'out')]
    options = simulators_command.parser().parse_args(words)
    for _ in range(2):
        assert simulators_command.simulators(options) == 0
    page = (tmp_path / 'out' / 'simulators.md').read_text()
    assert 'NO GAP' in page and 'lacking: ModuleNotFoundError' in page
    assert re.search(r'm/s² \| [1-9][\d.]* m?g \| < 0.01 mg', page), page


@pytest.fixture(scope='module')
def after_step(tmp_path_factory: pytest.TempPathFactory) -> Checked:
    """Return what is found in `sensordata` as `mj_step` leaves it."""
    pytest.importorskip('mujoco')
    path = REPO / 'docs' / 'measurements' / 'simulators' / 'in_mujoco.py'
    return checked(runpy.run_path(str(path))['AfterStep'], tmp_path_factory.mktemp('mujoco'))


def test_the_delay_of_mujoco_is_the_largest_cause(after_step: Checked) -> None:
    assert after_step.named[0].startswith('time_offset: offset 2.')


def test_mujoco(after_step: Checked) -> None:
    """What `mj_step` leaves belongs to the step before."""
    assert any(named.startswith('time_offset: offset 2.0') for named in after_step.named)
    step_ms = 1e3 * arm.STEP_S
    # Its rates belong to the middle of a step.
    for moved, late_ms in {
        'attitude': step_ms,
        'acceleration': step_ms,
        'rates': step_ms / 2,
    }.items():
        assert after_step.late_ms[moved][0] == pytest.approx(late_ms, abs=0.05)
