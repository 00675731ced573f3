# SPDX-License-Identifier: Apache-2.0

"""Faults of devices. After each, the driver must have published the right samples."""

from collections.abc import Callable
from dataclasses import dataclass
import time

from rig import SampleReport, suspend


@dataclass(frozen=True)
class Fault:
    name: str  # Name in the table
    # Function of the rig, the process id of the driver and a duration, s. It returns the monotonic
    # time at which the device works again, ns, or 0 where it was never absent.
    inject: Callable


@dataclass(frozen=True)
class Outcome:
    report: SampleReport  # Samples during the fault and after it
    # Time until samples came again, ms; None where the device was never absent
    recovery_ms: float | None


def byte_fault(kind, rate):
    def inject(rig, pid, duration_s):
        rig.command(f'fault {kind} {rate:g}')
        rig.graph.spin(duration_s)
        rig.command('clear')
        return 0
    return Fault(f'{kind} {rate:g} a byte' if rate else 'wrong baud rate', inject)


def board_fault(name, command):
    return Fault(name, lambda rig, pid, duration_s: rig.command(command))


def stop_driver(rig, pid, duration_s):
    suspend(pid, 3.0, rig.graph)
    return 0


def stop_server(rig, pid, duration_s):
    return suspend(rig.server.popen.pid, 2.0, rig.graph)


def kill_server(rig, pid, duration_s):
    rig.server.kill()
    rig.graph.spin(1.0)
    rig.start()
    return time.monotonic_ns()


SERIAL_FAULTS = (
    *(byte_fault(kind, 1e-3) for kind in ('flip', 'lose', 'insert', 'burst')),
    byte_fault('baud', 0),
    board_fault('100 kB without a delimiter', 'flat 100000'),
    board_fault('200 kB of noise', 'noise 200000'),
    board_fault('137 samples lost by the board', 'drop 137'),
    board_fault('unplugged for 1 s, in a read', 'unplug 1'),
    board_fault('board and clock halted for 1 s', 'halt 1'),
    Fault('reader stopped for 3 s', stop_driver),
)
"""Faults of the serial link after which the board's count shows what is missing."""
RESET = board_fault('reset, away for 0.5 s', 'reset 0.5')
"""After it the board has no count."""
IIO_FAULTS = (
    Fault('iiod: SIGSTOP for 2 s', stop_server),
    Fault('iiod: SIGKILL, back after 1 s', kill_server),
    Fault('iio: reader stopped for 3 s', stop_driver),
)
"""Faults of the IIO link, which has no count."""


def run_fault(fault, rig, pid, duration_s):
    rig.begin_report()
    back_ns = fault.inject(rig, pid, duration_s)
    recovery_ms = rig.recovery_ms(back_ns) if back_ns else None
    rig.wait_for_samples(200, 20, f'samples after: {fault.name}')
    return Outcome(rig.report(), recovery_ms)
