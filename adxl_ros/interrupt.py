# SPDX-License-Identifier: Apache-2.0

"""Ctrl-C while the executable of a node loads its modules."""

from pathlib import Path
import signal
import sys

_EXECUTABLES = ('driver', 'stage', 'calibration', 'compensation', 'investigate',
                'monitor', 'screen')
"""Executables that set a handler of their own once they have loaded."""


def end_silently_while_loading() -> None:
    """
    Let SIGINT end the executable of a node without a traceback of its imports.

    Programs that import the package, such as `ros2 launch`, keep their handler.
    """
    path = Path(sys.argv[0])
    is_node = path.name in _EXECUTABLES and path.parent.parts[-2:] == ('lib', 'adxl_ros')
    if is_node and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
