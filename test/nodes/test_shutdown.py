"""How nodes end: Ctrl-C reaches them twice under a launch, from the terminal and from it."""

import signal
import time

from graph import Graph
import pytest


@pytest.mark.parametrize('name', ['driver', 'stage', 'calibration', 'compensation'])
def test_interrupted_twice_a_node_ends_cleanly(start, name):
    """The second signal, whenever it comes, changes neither the status nor the output."""
    with Graph() as graph:
        node = start(name)
        graph.spin_until(lambda: name in graph.diagnostics, 30, 'up')
    node.popen.send_signal(signal.SIGINT)
    # Signals repeat until the process has ended.
    while node.popen.poll() is None:
        node.popen.send_signal(signal.SIGINT)
        time.sleep(0.002)
    assert node.wait() == 0
    assert 'Traceback' not in node.output()
