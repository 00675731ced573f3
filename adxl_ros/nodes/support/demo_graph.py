# SPDX-License-Identifier: Apache-2.0

"""The graph of the demonstration: its nodes, each in a process, and what they report."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
import subprocess
import time

from adxl_ros.errors import UserError
from adxl_ros.nodes.support.processes import executable, stop
from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

FIT_S = 600.0
"""Longest time of a fit, s; chosen: far above the seconds that a fit takes."""
_POLL_S = 0.2
"""Time between two looks at the progress, s."""
_SILENT_S = 60.0
"""Longest time without progress while poses are taken, s; chosen: a pose takes 1 s."""


class Watcher(Node):
    """Reads the diagnostics of the nodes that the demonstration runs, and calls ~/finish."""

    def __init__(self) -> None:
        super().__init__('demo')
        # Newest message and values, by the name of the diagnostic status
        self.reports: dict[str, dict[str, str]] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._finish = self.create_client(Trigger, 'calibration/finish')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.reports[status.name] = {'message': status.message, **values}

    def report_of(self, node: str) -> dict[str, str]:
        """Return the newest diagnostics of a node."""
        return next((values for name, values in self.reports.items() if name.startswith(node)), {})

    def watch(self, seconds: float) -> None:
        """Listen for some time, s."""
        self._executor.spin_once(timeout_sec=seconds)

    def finish(self) -> str:
        """Let the calibration fit what it has; return its answer."""
        future = self._finish.call_async(Trigger.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=FIT_S)
        answer = future.result() if future.done() else None
        if answer is None:
            raise UserError(f'calibration/finish: no answer for {FIT_S:g} s')
        return answer.message


class DemoGraph:
    """The nodes that the demonstration runs, each in a process of its own."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._processes: dict[str, subprocess.Popen] = {}
        self.watcher = Watcher()  # Receives what they report

    def start(self, name: str, params_file: Path, *arguments: str) -> None:
        """Start a node."""
        command = [executable(name), '--ros-args', '--log-level', 'warn', '--params-file',
                   str(params_file), *arguments]
        with self._log.open('ab') as log:
            self._processes[name] = subprocess.Popen(command, stdout=log, stderr=log)

    def close(self) -> None:
        """End the nodes."""
        stop(list(self._processes.values()))
        self._processes.clear()

    def wait(self, finished: Callable[[], bool], progress: Callable[[], object],
             silent_s: float = _SILENT_S) -> None:
        """Wait until a condition holds."""
        newest: object = None
        changed_s = time.monotonic()
        while not finished():
            self.watcher.watch(_POLL_S)
            message = self._check_nodes()
            news = (progress(), message)
            if news != newest:
                newest, changed_s = news, time.monotonic()
            if time.monotonic() - changed_s > silent_s:
                raise UserError(f'no progress for {silent_s:g} s; the calibration reported: '
                                f'{message or "nothing"}; see {self._log}')

    def _check_nodes(self) -> str:
        """Return what the calibration reports; refuse a node that has ended or a failed fit."""
        message = self.watcher.report_of('calibration').get('message', '')
        ended = [name for name, process in self._processes.items() if process.poll() is not None]
        if ended:
            raise UserError(f'the node {ended[0]} has ended; see {self._log}')
        if message.startswith('cannot finish'):
            raise UserError(f'{message}; see {self._log}')
        return message


@contextmanager
def open_graph(log: Path) -> Iterator[DemoGraph]:
    """Yield a graph without nodes, and end the nodes that were started in it."""
    log.unlink(missing_ok=True)
    rclpy.init(args=[])
    graph = DemoGraph(log)
    try:
        yield graph
    finally:
        graph.watcher.destroy_node()
        rclpy.try_shutdown()
        graph.close()
