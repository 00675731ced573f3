# SPDX-License-Identifier: Apache-2.0

"""The reporter of diagnostics: once a second, and at once when a level changes."""

from collections.abc import Iterator
import threading

from adxl_ros.nodes.diagnostics import DiagnosticsReporter, Level, Status
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph import Graph
import pytest


class Reported:
    """A reporter on the node of a graph, the status of its task, and what it has published."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.status = Status(Level.OK, 'fine', '17', {'rate_hz': 0.1, 'text': 'a'})
        self.arrays: list[DiagnosticArray] = graph.listen(DiagnosticArray, '/diagnostics')
        self.reporter = DiagnosticsReporter(graph.node, {'task': lambda: self.status})

    def wait(self, count: int, timeout_s: float = 5.0) -> DiagnosticStatus:
        """Wait for a number of reports; return the newest status."""
        self.graph.spin_until(lambda: len(self.arrays) >= count, timeout_s, f'{count} reports')
        return self.arrays[-1].status[0]


@pytest.fixture
def reporter_rig(ros_env: dict[str, str]) -> Iterator[Reported]:
    with Graph() as graph:
        yield Reported(graph)


def test_a_task_is_published_once_a_second(reporter_rig: Reported) -> None:
    reporter_rig.wait(3)

    def spans_s():
        """Return the times over two periods; a busy machine may hold the reporter up."""
        stamps_s = [array.header.stamp.sec + 1e-9 * array.header.stamp.nanosec
                    for array in reporter_rig.arrays]
        return [last - first for first, last in zip(stamps_s, stamps_s[2:])]
    reporter_rig.graph.spin_until(lambda: abs(spans_s()[-1] - 2.0) < 0.5, 5, 'two seconds')
    status = reporter_rig.arrays[-1].status[0]
    assert (status.name, status.level) == ('tester: task', DiagnosticStatus.OK)
    assert (status.message, status.hardware_id) == ('fine', '17')
    assert {pair.key: pair.value for pair in status.values} == {'rate_hz': '0.1', 'text': 'a'}


def test_a_change_of_level_is_reported_at_once_from_any_thread(reporter_rig: Reported) -> None:
    reporter_rig.wait(1)
    # Without its timer it reports only what is new.
    reporter_rig.reporter._timer.cancel()
    reporter_rig.reporter.notice('task', Level.OK)
    reporter_rig.graph.spin(0.3)
    assert len(reporter_rig.arrays) == 1
    reporter_rig.status = Status(Level.ERROR, 'now wrong', '17', {})
    thread = threading.Thread(target=reporter_rig.reporter.notice, args=('task', Level.ERROR))
    thread.start()
    assert reporter_rig.wait(2).message == 'now wrong'
    thread.join()
    assert reporter_rig.wait(3).message == 'now wrong', 'a second later again'
