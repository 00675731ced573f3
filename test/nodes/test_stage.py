# SPDX-License-Identifier: Apache-2.0

"""The stage over DDS, alone and in lockstep with the driver's simulated sensor."""

from adxl_ros.model.kinematics import specific_force
from graph import Graph, imu_table, stamp_ns
import numpy as np
import pytest
from sensor_msgs.msg import Imu, JointState

ROS = '--ros-args'
SIM_TIME = (ROS, '-p', 'use_sim_time:=true')
QUICK = (
    '-p',
    'slew_rate_rad_s:=2.0',
    '-p',
    'qos_overrides./stage/true_joint_states.publisher.depth:=10000',
)
STEP = np.radians(5 / 60)
IDEAL = (
    '-p',
    'sensor.noise_density_g_per_rthz:=[0.0,0.0,0.0]',
    '-p',
    'sensor.axes:=xyz',
    '-p',
    'sensor.nominal_zero_g_v:=[2.5,2.5,2.5]',
    '-p',
    'sensor.nominal_scale_v_per_g:=[1.0,1.0,1.0]',
    '-p',
    'sensor.rc_capacitance_f:=0.0',
    '-p',
    'sensor.adc_bits:=0',
)


class Commander(Graph):
    """A client that commands the stage and keeps its joint states."""

    def __enter__(self):
        super().__enter__()
        self.states = self.listen(JointState, 'stage/joint_states')
        self.true = self.listen(JointState, 'stage/true_joint_states')
        self.command = self.node.create_publisher(JointState, 'stage/command', 10)
        return self

    def go(self, **joints):
        """Command until the stage has arrived, because the first commands may be lost."""

        def arrived():
            self.command.publish(JointState(name=list(joints), position=list(joints.values())))
            self.spin(0.2)
            last = dict(zip(self.states[-1].name, self.states[-1].position)) if self.states else {}
            return (
                last
                and np.abs(self.states[-1].velocity).max() < 1e-4
                and all(abs(last[j] - angle) <= STEP / 2 + 1e-9 for j, angle in joints.items())
            )

        self.spin_until(arrived, 60, 'arrival')


def test_the_stage_reaches_its_command_and_publishes_its_encoder(start):
    start('stage', ROS, '-p', 'slew_rate_rad_s:=1.0', '-p', 'beta_rad:=0.2')
    with Commander() as graph:
        graph.spin_until(lambda: graph.states, 20, 'joint states')
        assert list(graph.states[0].name) == ['alpha', 'beta', 'shift']
        assert graph.states[0].position[1] == pytest.approx(0.2, abs=STEP / 2)
        graph.go(alpha=0.5, beta=-0.3)
        graph.spin(0.3)
        now = graph.node.get_clock().now().nanoseconds
    stamps = np.array([stamp_ns(m) for m in graph.states])
    assert (np.diff(stamps) == 10_000_000).all()
    assert stamps[-1] <= now
    positions = np.array([m.position for m in graph.states])
    steps = positions[:, :2] / STEP
    assert np.abs(steps - np.rint(steps)).max() < 1e-6
    assert max(np.abs(m.velocity).max() for m in graph.states) == pytest.approx(1, rel=0.01)
    true = {stamp_ns(m): m.position for m in graph.true}
    assert max(true) > stamps[-1], 'the true motion is known ahead'
    error_rad = np.array([true[s][:2] - p[:2] for s, p in zip(stamps, positions) if s in true])
    assert 1e-6 < np.abs(error_rad).max() <= STEP / 2 + 1e-9


@pytest.mark.parametrize('speed', [1.0, 5.0])
def test_the_simulated_sensor_senses_the_true_angles(start, speed):
    clock = SIM_TIME if speed != 1 else (ROS,)
    start('stage', *clock, *QUICK)
    start('driver', *clock, '-p', 'link.type:=sim', '-p', f'link.speed:={speed}', *IDEAL)
    with Commander() as graph:
        samples = graph.listen(Imu, 'imu/data_raw', raw=True)
        graph.spin_until(
            lambda: graph.reports('driver', 'on the stage') and graph.true, 20, 'driver and stage'
        )
        # The driver uses the stage from its first message on, not from its discovery.
        graph.spin_until(lambda: len(samples) > 500 and len(graph.true) > 50, 20, 'a while')
        del samples[:]
        graph.go(alpha=0.8, beta=-0.5)
        graph.go(alpha=1.5, beta=0.7)
        arrival_ns = stamp_ns(graph.states[-1])
        graph.spin_until(
            lambda: imu_table(samples[-1:])[0][0] >= arrival_ns, 20, 'the samples of the arrival'
        )
        assert graph.value('driver', 'missing') == '0'
    stamps, measured = imu_table(samples)
    assert (np.diff(stamps) == 1_000_000).all()
    true = {stamp_ns(m): m.position for m in graph.true}
    rows = [k for k, stamp in enumerate(stamps) if stamp in true]
    assert len(rows) == pytest.approx((stamps >= min(true)).sum() / 10, abs=2)
    alpha, beta, _ = np.array([true[stamps[k]] for k in rows]).T
    assert np.ptp(alpha) > 1.4
    assert np.ptp(beta) > 1.1
    expected = np.column_stack(specific_force(alpha, beta, 9.80665))
    assert np.abs(measured[rows] - expected).max() < 1e-9
