"""How nodes end: Ctrl-C reaches them twice under a launch, from the terminal and from it."""

from pathlib import Path
import signal
import time

from graph import Graph
from processes import wait_until
import pytest


def test_interrupted_twice_a_node_ends_cleanly(start):
    """The second signal, whenever it comes, changes neither the status nor the output."""
    names = 'driver', 'stage', 'calibration', 'compensation', 'monitor'
    with Graph() as graph:
        nodes = [start(name) for name in names]
        graph.spin_until(lambda: set(names) <= set(graph.diagnostics), 40, 'up')
    for node in nodes:
        node.popen.send_signal(signal.SIGINT)
        # Signals repeat until the process has ended.
        while node.popen.poll() is None:
            node.popen.send_signal(signal.SIGINT)
            time.sleep(0.002)
        assert node.wait() == 0
        assert 'Traceback' not in node.output()


@pytest.mark.parametrize(
    'name, library',
    [
        ('driver', '_multiarray_umath'),
        ('driver', '_rclpy_pybind11'),
        *((name, 'libfastrtps') for name in ('driver', 'compensation', 'monitor')),
    ],
)
def test_interrupted_while_it_starts_a_node_prints_no_traceback(start, name, library):
    """The signal comes while a node loads numpy, loads rclpy, or makes its first topics."""
    node = start(name)
    memory = Path(f'/proc/{node.popen.pid}/maps')
    wait_until(lambda: library in memory.read_text(), 20, f'{library} in {name}')
    node.popen.send_signal(signal.SIGINT)
    assert node.wait() in (0, -signal.SIGINT)
    assert 'Traceback' not in node.output()
