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

"""Measure the live nodes and the reading of recordings, beside a bare baseline."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from adxl_ros.calibrate import pose_extraction
from adxl_ros.calibrate.fits import paper_regression
from adxl_ros.errors import UserError
from adxl_ros.files import cdr, parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.files.stream_unit import recorded_unit
from adxl_ros.links.support import wire_format
from adxl_ros.nodes.demo import end
from adxl_ros.simulate.simulator import simulate
from adxl_ros.simulate.trajectories import sweep
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import Imu

_RATE_HZ = 1000.0
_ROWS = 3_000_000


class Listener(Node):
    """Keeps the arrival time and the bytes of each message."""

    def __init__(self, topic: str) -> None:
        super().__init__('listener')
        self.raw: list[bytes] = []
        self.arrived_ns: list[int] = []
        self.create_subscription(Imu, topic, self._on_message,
                                 QoSProfile(depth=1000,
                                            reliability=qos_profile_sensor_data.reliability),
                                 raw=True)

    def _on_message(self, raw: bytes) -> None:
        self.arrived_ns.append(time.time_ns())
        self.raw.append(raw)


class BarePublisher(Node):
    """The least that publishes Imu at 1 kHz: a timer and one message."""

    def __init__(self) -> None:
        super().__init__('bare_publisher')
        self._message = Imu()
        self._publisher = self.create_publisher(Imu, 'bare', 10)
        self.create_timer(1 / _RATE_HZ, self._publish)

    def _publish(self) -> None:
        self._message.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(self._message)


class BareRelay(Node):
    """The least that passes Imu on."""

    def __init__(self) -> None:
        super().__init__('bare_relay')
        publisher = self.create_publisher(Imu, 'relayed', 10)
        self.create_subscription(Imu, 'bare', publisher.publish, qos_profile_sensor_data)


_BARE = {'publisher': BarePublisher, 'relay': BareRelay}


def main() -> int:
    """Run the benchmark; returns the exit status."""
    parse = argparse.ArgumentParser(prog='bench', description=__doc__)
    parse.add_argument('--seconds', type=float, default=20.0, help='of each live measurement')
    parse.add_argument('--iiod', metavar='FILE', help="the tests' IIOD, for the link iio")
    parse.add_argument('--bare', choices=list(_BARE), help=argparse.SUPPRESS)
    parse.add_argument('--read', metavar='PORT', help=argparse.SUPPRESS)
    options = parse.parse_args()
    if options.bare:
        return _bare(_BARE[options.bare])
    if options.read:
        return _bare_reader(options.read)
    os.environ.setdefault('ROS_DOMAIN_ID', str(60 + os.getpid() % 40))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    try:
        print(f'{"1 kHz for " + format(options.seconds, "g") + " s":36} {"rate Hz":>8} '
              f'{"missing":>8} {"p50 ms":>7} {"p99 ms":>7}   CPU of a core')
        bare = [[sys.executable, sys.argv[0], '--bare', kind] for kind in _BARE]
        node = [str(Path(sys.argv[0]).with_name(name)) for name in ('driver', 'compensation')]
        _live('bare publisher', 'bare', bare[:1], options.seconds)
        _live('bare publisher and relay', 'relayed', bare, options.seconds)
        _live('driver', 'imu/data_raw', [[node[0]]], options.seconds)
        _live('driver and compensation', 'imu/data', [[node[0]], [node[1]]], options.seconds)
        _links(node[0], options.iiod, options.seconds)
        _decoding()
        _reading()
    except UserError as error:
        print(f'bench: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _bare(make: type[Node]) -> int:
    rclpy.init()
    executor = SingleThreadedExecutor()
    executor.add_node(make())
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
    return 0


def _bare_reader(port: str) -> int:
    """Read what a board sends, and do nothing with it."""
    with open(port, 'rb', buffering=0) as file, suppress(KeyboardInterrupt, OSError):
        while file.read(65536):
            pass
    return 0


def _links(driver: str, iiod: str | None, seconds: float) -> None:
    """Print the rows of the links: the driver on a board, and on an IIOD, beside a bare reader."""
    with tempfile.TemporaryDirectory() as folder:
        port = str(Path(folder, 'board'))
        simulate = str(Path(sys.argv[0]).with_name('simulate'))
        with _running([[simulate, 'soak', '--port', port]]):
            _until(Path(port).exists, 'the board')
            _bare_reading(port, seconds)
            _live('driver, serial, 2 axes and 2 more', 'imu/data_raw', [[
                driver, '--ros-args', '-p', 'link.type:=serial', '-p', f'link.port:={port}', '-p',
                'link.channels:=x,y,supply,temperature']], seconds)
    if iiod is None:
        return
    with subprocess.Popen([sys.executable, iiod], stdout=subprocess.PIPE, text=True) as server:
        try:
            uri = f'ip:127.0.0.1:{server.stdout.readline().strip()}'
            _live('driver, iio, 2 axes and supply', 'imu/data_raw', [[
                driver, '--ros-args', '-p', 'link.type:=iio', '-p', f'link.uri:={uri}']], seconds)
        except UserError as error:
            print(f'{"driver, iio":36} {error}: is libiio 0.x installed?')
        finally:
            server.kill()


def _bare_reading(port: str, seconds: float) -> None:
    with _running([[sys.executable, sys.argv[0], '--read', port]]) as (reader,):
        time.sleep(2.0)
        before = _cpu_s(reader.pid)
        time.sleep(seconds)
        load = 100 * (_cpu_s(reader.pid) - before) / seconds
    print(f'{"bare reader, decodes nothing":36} {"":8} {"":8} {"":7} {"":7}   {load:.1f} %',
          flush=True)


def _until(condition: Callable[[], bool], what: str) -> None:
    end_s = time.monotonic() + 20
    while not condition():
        if time.monotonic() > end_s:
            raise UserError(f'{what} does not begin')
        time.sleep(0.05)


def _decoding() -> None:
    """Print how many frames of the serial link are decoded in a second."""
    encoder = wire_format.Encoder(wire_format.BoardInfo(_RATE_HZ, 16, 3, 5.0, 'bench'))
    codes = np.random.default_rng(0).integers(1, 65535, (10, 3))
    stream = b''.join(encoder.sample_frame(10_000 * k, 10 * k, codes) for k in range(20_000))
    splitter = wire_format.Splitter()
    began = time.perf_counter()
    count = sum(isinstance(wire_format.decode(raw), wire_format.SampleFrame)
                for i in range(0, len(stream), 4096)
                for raw in splitter.split(stream[i:i + 4096]))
    print(f'\n{"frames decoded a second":36} {count / (time.perf_counter() - began):8.0f}')


def _live(label: str, topic: str, commands: Sequence[Sequence[str]], seconds: float) -> None:
    """Print one row: rate, missing samples, age on arrival, CPU of each process."""
    with _running(commands) as processes:
        rclpy.init(args=[])
        listener = Listener(topic)
        executor = SingleThreadedExecutor()
        executor.add_node(listener)
        try:
            _hear(executor, listener, 50, 20.0)
            _hear(executor, listener, 10 ** 9, 2.0)
            listener.raw.clear()
            listener.arrived_ns.clear()
            before = [_cpu_s(p.pid) for p in processes]
            began = time.monotonic()
            _hear(executor, listener, 10 ** 9, seconds)
            lasted = time.monotonic() - began
            after = [_cpu_s(p.pid) for p in processes]
        finally:
            listener.destroy_node()
            rclpy.try_shutdown()
    stamps = np.concatenate([table.stamp_ns() for table in cdr.tables(listener.raw, cdr.imu)])
    age_ms = (np.array(listener.arrived_ns) - stamps) * 1e-6
    steps = np.rint(np.diff(np.sort(stamps)) * 1e-9 * _RATE_HZ)
    # A bare timer's stamps wander, so that only steps of two periods and more are a loss.
    missing = int(np.sum(np.maximum(steps - 1, 0)))
    p50, p99 = np.percentile(age_ms, [50, 99])
    load = ' + '.join(f'{100 * (b - a) / lasted:.1f} %' for a, b in zip(before, after))
    print(f'{label:36} {len(stamps) / lasted:8.1f} {missing:8d} {p50:7.2f} {p99:7.2f}   {load}',
          flush=True)


def _hear(executor: SingleThreadedExecutor, listener: Listener, count: int,
          seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end and len(listener.raw) < count:
        executor.spin_once(timeout_sec=0.1)
    if not listener.raw:
        raise UserError(f'no messages for {seconds:g} s')


@contextmanager
def _running(commands: Sequence[Sequence[str]]) -> Iterator[list[subprocess.Popen]]:
    processes = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in commands]
    try:
        yield processes
    finally:
        end(processes)


def _cpu_s(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _reading() -> None:
    """Print how long 3 million rows take to read, and the physical fit of a sweep."""
    sensor = parameter_file.load(parameter_file.nominal_path())
    columns = simulate(sensor, sweep(np.random.default_rng(0)), 0)
    count = len(columns['time_s'])
    whole = {name: np.resize(values, _ROWS) for name, values in columns.items()}
    time_s = np.arange(_ROWS) / sensor.rate_hz
    whole.pop('time_s')
    made = Recording('bench', time_s, whole, sensor_info(sensor))
    print(f'\n{"reading":36} {"rows":>8} {"s":>8}')
    with tempfile.TemporaryDirectory() as folder:
        for name in ('made.csv', 'made_bag'):
            path = Path(folder) / name
            recording.write(path, made, sensor)
            began = time.perf_counter()
            read = recording.read(path)
            print(f'{name:36} {len(read):8d} {time.perf_counter() - began:8.1f}', flush=True)
    once = Recording('bench', time_s[:count], {k: v[:count] for k, v in whole.items()},
                     sensor_info(sensor))
    began = time.perf_counter()
    poses = pose_extraction.extract_poses(once, recorded_unit(sensor, once))
    print(f'{"rests of a sweep":36} {count:8d} {time.perf_counter() - began:8.2f}')
    began = time.perf_counter()
    paper_regression.fit(sensor, poses)
    print(f'{"physical fit":36} {len(poses):8d} {time.perf_counter() - began:8.2f}')
