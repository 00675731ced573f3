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

"""Run the main job: a simulated sweep, and a real recording, through the live graph."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from adxl_ros.errors import UserError
from adxl_ros.files import params
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.common import nominal_path
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

_SPEED = 12.0
_SILENT_S = 60.0
_UNATTENDED = ('-p', 'autostart:=true', '-p', 'screen:=false')
_LOSSLESS = ('-p', 'qos_overrides./imu/data_raw.subscription.reliability:=reliable')
"""At many times real time a best-effort subscriber loses samples on a busy machine."""
_DRAWN = {'bias': 0.5, 'scale_factor': 0.5, 'misalignment': 0.7, 'cross_axis': 0.7,
          'cross_axis_z': 1.0, 'scale_factor_z': 0.7}
"""Effects of the demonstrated unit, in multiples of their typical scale."""


class Watcher(Node):
    """Reads the diagnostics of the nodes that the demonstration runs, and calls ~/finish."""

    def __init__(self) -> None:
        super().__init__('demo')
        self.said: dict[str, dict[str, str]] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._finish = self.create_client(Trigger, 'calibration/finish')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.said[status.name] = {'message': status.message,
                                      **{pair.key: pair.value for pair in status.values}}

    def of(self, node: str) -> dict[str, str]:
        """Return the newest diagnostics of a node."""
        return next((values for name, values in self.said.items() if name.startswith(node)), {})

    def watch(self, seconds: float) -> None:
        """Listen for so long."""
        self._executor.spin_once(timeout_sec=seconds)

    def finish(self) -> str:
        """Ask the calibration to fit what it has; returns its answer."""
        future = self._finish.call_async(Trigger.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=60.0)
        if not future.done():
            raise UserError('calibration/finish: no answer for 60 s')
        return future.result().message


def main() -> int:
    """Run the demonstration; returns the exit status."""
    parse = argparse.ArgumentParser(prog='demo', description=__doc__)
    parse.add_argument('-o', dest='output', metavar='DIR', default='demo_output', type=Path)
    parse.add_argument('--real', metavar='CSV', type=Path,
                       help='a three-axis recording turned by hand, calibrated too')
    parse.add_argument('--speed', type=float, default=_SPEED,
                       help=f'sensor time per real time (default {_SPEED:g})')
    options = parse.parse_args()
    # A graph of its own: the demonstration must not move a robot that shares the network.
    os.environ.setdefault('ROS_DOMAIN_ID', str(60 + os.getpid() % 40))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    try:
        options.output.mkdir(parents=True, exist_ok=True)
        lines = _simulated(options.output, options.speed)
        if options.real is not None:
            lines += _real(options.output, options.real)
    except UserError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'demo: {options.output}: {error.strerror}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    print('\n' + '\n'.join(lines))
    return 0


def _simulated(folder: Path, speed: float) -> list[str]:
    """Sweep a simulated ADXL203 whose coefficients are drawn at datasheet spread."""
    unit, nominal = folder / 'simulated_unit.yaml', folder / 'nominal.yaml'
    sensor = replace(params.load(nominal_path()), serial='demo')
    params.save(nominal, sensor)
    params.save(unit, _drawn(sensor), ['The truth of the simulated unit.'])
    output = folder / 'adxl203_demo.yaml'
    print(f'A simulated ADXL203 on a simulated two-axis stage, {speed:g} times real time:')
    clock = ['-p', 'use_sim_time:=true']
    _fresh(output)
    with _graph() as (start, watcher):
        start('driver', unit, '-p', f'link.speed:={speed}', *clock)
        start('stage', nominal, *clock)
        start('calibration', nominal, *clock, *_LOSSLESS, *_UNATTENDED, '-p',
              f'output:={output}', '-p', f'report:={folder / "sweep"}', '-p',
              f'store:={folder / "calibrations"}')
        _wait(watcher, lambda: output.exists())
    return ['Simulated ADXL203, poses that the fit has not seen:', *_verdict(output),
            f'Coefficients: {output}; report: {folder / "sweep" / "report.html"}']


def _real(folder: Path, recording: Path) -> list[str]:
    """Calibrate a recorded sensor against gravity, replayed through the graph."""
    output = folder / f'{recording.stem}.yaml'
    print(f'{recording.name}, a real sensor turned by hand, 20 times real time:')
    clock = ['-p', 'use_sim_time:=true']
    _fresh(output)
    with _graph() as (start, watcher):
        start('calibration', nominal_path(), *clock, *_LOSSLESS, *_UNATTENDED, '-p',
              'mode:=gravity', '-p', f'output:={output}', '-p',
              f'report:={folder / recording.stem}', '-p', f'store:={folder / "calibrations"}')
        start('driver', nominal_path(), '-p', 'link.type:=replay', '-p',
              f'link.recording:={recording}', '-p', 'link.speed:=20.0', *clock)
        _wait(watcher, lambda: watcher.of('driver').get('link_state') == 'ended')
        answer = watcher.finish()
    if not output.exists():
        raise UserError(f'{recording}: {answer}')
    return ['', f'{recording.stem}, a real sensor:', *_verdict(output),
            f'Coefficients: {output}; report: {folder / recording.stem / "report.html"}']


def _drawn(sensor: Sensor) -> Sensor:
    rng = np.random.default_rng(203)
    values = {name: {p.name: np.array([
        spread * p.scale * rng.choice((-1, 1)) * rng.uniform(0.5, 1.5) if a in p.axes else 0.0
        for a in sensor.axes]) for p in effect_named(name).parameters}
        for name, spread in _DRAWN.items()}
    return replace(sensor, effects=tuple(_DRAWN), values=values)


def _verdict(path: Path) -> list[str]:
    """Return the verdict that stands in the head of a parameter file, after the coefficients."""
    head = [line[2:] for line in path.read_text(encoding='utf-8').splitlines()
            if line.startswith('#')]
    return head[head.index('') + 1:]


def _fresh(output: Path) -> None:
    """Remove what an earlier demonstration left, so that this one's result can be told."""
    for path in (output, output.with_name(f'{output.name}.journal')):
        path.unlink(missing_ok=True)


@contextmanager
def _graph() -> Iterator[tuple]:
    """Yield a function that starts nodes, and a watcher; end them all at the end."""
    processes: list[subprocess.Popen] = []

    def start(name: str, parameters: Path, *arguments: str) -> None:
        command = [str(Path(sys.argv[0]).with_name(name)), '--ros-args', '--log-level', 'warn',
                   '--params-file', str(parameters), *arguments]
        processes.append(subprocess.Popen(command))

    rclpy.init(args=[])
    watcher = Watcher()
    try:
        yield start, watcher
    finally:
        watcher.destroy_node()
        rclpy.try_shutdown()
        end(processes)


def end(processes: Sequence[subprocess.Popen]) -> None:
    """Interrupt processes, and kill those that do not end within 10 s."""
    for process in processes:
        process.send_signal(signal.SIGINT)
    for process in processes:
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()


def _wait(watcher: Watcher, finished: object) -> None:
    """Show the calibration's progress until it has finished; raises when it falls silent."""
    shown, tenth, heard = '', '', time.monotonic()
    while not finished():
        watcher.watch(0.2)
        said = watcher.of('calibration')
        text = f'  pose {said.get("pose", "-")}: {said.get("message", "starting")}'
        if text != shown:
            heard = time.monotonic()
            if sys.stdout.isatty():
                print(f'\r{text[:98]:98}', end='', flush=True)
            elif said.get('pose', '')[:-1] != tenth:
                print(text, flush=True)
        shown, tenth = text, said.get('pose', '')[:-1]
        if time.monotonic() - heard > _SILENT_S:
            raise UserError(f'no progress for {_SILENT_S:g} s; the calibration said: {text}')
    if sys.stdout.isatty():
        print()
