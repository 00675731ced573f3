# SPDX-License-Identifier: Apache-2.0

"""Nodes within one process: a failed activation leaves nothing open; what counts as silence."""

from collections.abc import Iterator
import os
import pty
import time
from types import SimpleNamespace

from adxl_ros.errors import UserError
from adxl_ros.links import serial as serial_link
from adxl_ros.links.support import base
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import driver as driver_node, topics
from adxl_ros.nodes.driver import Driver
from processes import wait_until
import pytest
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import Imu
import serial


@pytest.fixture
def port() -> Iterator[str]:
    board, device = pty.openpty()
    name = os.ttyname(device)
    os.close(device)
    yield name
    os.close(board)


class HalfOpen:
    """A serial link with an open port, which cannot state what it measures."""

    def __init__(self, link: serial_link.SerialLink, failure: Exception | None) -> None:
        self._link, self._failure = link, failure
        while not link.read(0).until_ns or link.status().statistics['connections'] == 0:
            pass

    def __getattr__(self, name: str) -> object:
        if name == 'references' and self._failure is not None:
            raise self._failure
        return getattr(self._link, name)


@pytest.fixture
def make_driver(
    ros_env: dict[str, str], port: str, monkeypatch: pytest.MonkeyPatch
) -> Iterator[SimpleNamespace]:
    """Give a driver on the port, and the failure of its next activation."""
    setting = SimpleNamespace(failure=None)

    def open_link(sensor: Sensor, settings: serial_link.Settings) -> HalfOpen:
        return HalfOpen(serial_link.open_link(sensor, settings), setting.failure)

    monkeypatch.setattr(
        driver_node,
        'link_module',
        lambda _: SimpleNamespace(Settings=serial_link.Settings, open_link=open_link),
    )
    rclpy.init(
        args=[
            '--ros-args',
            '-p',
            'link.type:=serial',
            '-p',
            f'link.port:={port}',
            '-p',
            'autostart:=false',
        ]
    )
    setting.driver = Driver()
    yield setting
    setting.driver.close()
    setting.driver.destroy_node()
    rclpy.try_shutdown()


def is_free(port: str) -> bool:
    try:
        serial.Serial(port, exclusive=True).close()
    except serial.SerialException:
        return False
    return True


@pytest.mark.parametrize(
    ('failure', 'result'),
    [
        (UserError('no such channel'), TransitionCallbackReturn.FAILURE),
        (RuntimeError('broken'), TransitionCallbackReturn.ERROR),
    ],
)
def test_a_failed_activation_leaves_no_link_open(
    make_driver: SimpleNamespace, port: str, failure: Exception, result: object
) -> None:
    driver = make_driver.driver
    assert driver.trigger_configure() == TransitionCallbackReturn.SUCCESS
    make_driver.failure = failure
    assert driver.trigger_activate() == result
    assert is_free(port)
    # After a failure the activation can be repeated, after an error from the beginning.
    make_driver.failure = None
    if result == TransitionCallbackReturn.ERROR:
        assert driver.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert driver.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert not is_free(port)
    wait_until(lambda: driver.count_publishers('imu/data_raw') == 1, 5, 'one publisher')
    assert driver.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert is_free(port)
    assert driver.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    wait_until(lambda: driver.count_publishers('imu/data_raw') == 0, 5, 'no publisher')


def test_the_time_in_which_a_node_was_held_up_is_no_silence(
    ros_env: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rclpy.init(args=[])
    node = rclpy.create_node('listener')
    inbox = topics.Inbox(node, Imu, 'imu/data_raw', 10)
    publisher = node.create_publisher(Imu, 'imu/data_raw', 10)

    def received() -> list[bytes]:
        publisher.publish(Imu())
        return inbox.take()

    wait_until(received, 10, 'a sample')
    late_s = time.monotonic() + 60
    monkeypatch.setattr(base, 'time', SimpleNamespace(monotonic=lambda: late_s))
    while inbox.take():
        pass
    assert inbox.silence() == ''
    for _ in range(3):
        late_s += 1
        inbox.take()
    assert 'nothing on /imu/data_raw for ' in inbox.silence()
    node.destroy_node()
    rclpy.shutdown()
