# SPDX-License-Identifier: Apache-2.0

"""keep_calibrated over DDS: after a kill it goes on, adopts, hands over in a ramp, and undoes."""

from dataclasses import replace

from adxl_ros.calibrate.keep.keeper import Keeper
from adxl_ros.files import parameter_file
from adxl_ros.files.sweep_journal import Journal, read
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import to_nominal_mps2
from adxl_ros_validation.kept_robots import calibrated, Kind, Robot
from builtin_interfaces.msg import Time
from graph import Graph, RELIABLE
import numpy as np
from sensor_msgs.msg import Imu, Temperature
from std_srvs.srv import Trigger

UNIT = replace(calibrated(), rate_hz=100.0)
STEP_NS = 10_000_000
SAMPLES = 6200  # Those of 62 s: two windows of a rest
NOISE_MPS2 = 4e-4 * G0_MPS2  # Of a sample, below that of the datasheet
PARAMS = ('--ros-args', '--params-file', 'unit.yaml')
KEEPS = (
    'keep_calibrated',
    *PARAMS,
    *('-p', 'output:=kept', '-p', 'store:=store', '-p', 'ramp_s:=2.0'),
    *RELIABLE,
)
"""The node, whose ramp takes two seconds."""


def decisive():
    """Return the rests before the first adoption, and the one that leads to it."""
    robot = Robot(Kind(lies_down=True, slope=5), np.random.default_rng(3))
    keeper = Keeper(UNIT)
    taken = []
    for day in range(40):
        for rest, _ in robot.rests(day):
            if keeper.add(rest) is not None:
                return taken, rest
            taken.append(rest)
    raise AssertionError('no adoption in 40 days')


def play(graph, rest):
    """Publish the samples of a rest."""
    samples = graph.node.create_publisher(Imu, 'imu/data_raw', 10000)
    readings = graph.node.create_publisher(Temperature, 'temperature', 100)
    # Node and compensation take both topics.
    graph.spin_until(
        lambda: samples.get_subscription_count() == readings.get_subscription_count() == 2,
        20,
        'both subscribers',
    )
    accel_mps2 = to_nominal_mps2(np.array(rest.mean_v), UNIT)
    noise_mps2 = np.random.default_rng(1).normal(0, NOISE_MPS2, (SAMPLES, 3))
    for number, values in enumerate((accel_mps2 + noise_mps2).tolist()):
        sec, nanosec = divmod(rest.start_ns + number * STEP_NS, 10**9)
        message = Imu()
        message.header.stamp = Time(sec=sec, nanosec=nanosec)
        for axis, value in zip('xyz', values):
            setattr(message.linear_acceleration, axis, value)
        if number % 100 == 0:
            reading = Temperature(temperature=rest.temperature_c)
            reading.header.stamp = message.header.stamp
            readings.publish(reading)
            graph.spin(0.02)
        samples.publish(message)


def begin_journal(rests, start, kill, tmp_path):
    """Let a node that is killed begin the journal, and append rests to it."""
    node = start(*KEEPS)
    node.wait_for('keeping K1', 30)
    kill(node.popen.pid)
    node.wait()
    (path,) = (tmp_path / 'kept').rglob('*.jsonl')
    journal = Journal(path, read(path).head)
    for rest in rests:
        journal.append(rest)
    journal.close()


def test_it_goes_on_after_a_kill_adopts_hands_over_and_undoes(start, kill, tmp_path):
    parameter_file.save(tmp_path / 'unit.yaml', UNIT)
    before, last = decisive()
    begin_journal(before, start, kill, tmp_path)
    # It finds no node that was killed before.
    with Graph() as graph:
        start('compensation', *PARAMS)
        node = start(*KEEPS)
        node.wait_for(f'{len(before)} entries in', 30)
        play(graph, last)
        graph.spin_until(lambda: 'adopted: x' in node.output(), 30, 'the adoption')
        (stored,) = (tmp_path / 'store').rglob('*.yaml')
        graph.spin_until(
            lambda: (
                graph.number('keep_calibrated', 'ramp') == 1
                and 'in_use' in graph.value('compensation', 'calibration')
            ),
            20,
            'the end of the ramp',
        )
        assert graph.number('keep_calibrated', 'tilt_90_deg') < 1
        adopted = parameter_file.load(stored)
        assert len(adopted.covariance) and adopted.provenance['kept']
        answer = graph.call(Trigger, 'keep_calibrated/undo', Trigger.Request())
        assert answer.success and 'the calibration before is in use again' in answer.message
        assert not graph.call(Trigger, 'keep_calibrated/undo', Trigger.Request()).success
        graph.spin_until(
            lambda: graph.value('keep_calibrated', 'adopted') == '', 20, 'the end of the adoption'
        )
