# SPDX-License-Identifier: Apache-2.0

"""The self-test over DDS: an emulated board, its driver killed in the middle, and another one."""

from contextlib import suppress
import os

from adxl_ros.files import parameter_file
from adxl_ros.links.support.wire_format import (
    decode,
    IN_SELF_TEST,
    SampleFrame,
    Splitter,
    WireError,
)
from graph import accel, Graph
import numpy as np
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from units import nominal

UNIT = nominal(
    serial='T5',
    self_test_lower_g=(0.45, 0.45),
    self_test_upper_g=(1.1, 1.1),
    rate_hz=500.0,
    rc_capacitance_f=0.05 / 32e3,  # A slow filter, so that there is time for the kill
)
LONGEST_US = 1.51e6  # Half a second, and 20 time constants until the output is as before
STEP_MPS2 = 4.0  # A step of the self-test is larger, noise is not


def driver(start):
    options = ('link.type:=serial', 'link.port:=board', 'link.channels:=x,y,supply,temperature')
    words = [word for option in options for word in ('-p', option)]
    return start('driver', '--ros-args', '--params-file', 'unit.yaml', *words)


def frames_until_unmarked(port, count):
    """Read a board until some of its frames in a row are not marked; return its frames."""
    fd, splitter, frames = os.open(port, os.O_RDONLY | os.O_NOCTTY), Splitter(), []
    try:
        while len(frames) < count or any(is_marked(frame) for frame in frames[-count:]):
            for raw in splitter.split(os.read(fd, 4096)):
                with suppress(WireError):
                    frames.append(decode(raw))
            frames = [frame for frame in frames if isinstance(frame, SampleFrame)]
    finally:
        os.close(fd)
    return frames


def is_marked(frame):
    return bool(frame.flags & IN_SELF_TEST)


def test_a_driver_that_is_killed_leaves_no_self_test_behind(start, kill, tmp_path):
    parameter_file.save(tmp_path / 'unit.yaml', UNIT)
    start('simulate', 'soak', '--params', 'unit.yaml', '--port', 'board').wait_for('sending', 30)
    first = driver(start)
    with Graph() as graph:
        raw = graph.listen(Imu, 'imu/data_raw')
        graph.spin_until(lambda: len(raw) > 100, 30, 'samples')
        client = graph.node.create_client(Trigger, 'driver/self_test')
        graph.spin_until(client.service_is_ready, 20, 'the service')
        client.call_async(Trigger.Request())
        graph.spin_until(
            lambda: graph.has_reported('driver', 'withheld during'), 20, 'the self-test'
        )
        kill(first.popen.pid)
        first.wait()
    frames = frames_until_unmarked(tmp_path / 'board', 200)
    marked_us = [frame.time_us for frame in frames if is_marked(frame)]
    assert marked_us, 'the kill came before the end of the self-test'
    assert marked_us[-1] - frames[0].time_us < LONGEST_US, 'it ends by itself'
    rest = frames[-1].codes[-1, 0]
    changed = [frame for frame in frames if (np.abs(frame.codes[:, 0] - rest * 1.0) > 1000).any()]
    assert changed and all(is_marked(frame) for frame in changed)
    with Graph() as graph:
        raw = graph.listen(Imu, 'imu/data_raw')
        driver(start)
        graph.spin_until(lambda: len(raw) > 100, 30, 'samples of the second driver')
        answer = graph.call(Trigger, 'driver/self_test', Trigger.Request())
        assert answer.success and answer.message.startswith('PASS x +0.7'), answer.message
        count = len(raw)
        graph.spin_until(lambda: len(raw) > count + 100, 20, 'samples after it')
        assert graph.number('driver', 'withheld') > 0
        values = np.array([accel(message)[:2] for message in raw])
    assert np.abs(values - np.median(values, axis=0)).max() < STEP_MPS2
