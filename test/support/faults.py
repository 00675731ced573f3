# SPDX-License-Identifier: Apache-2.0

"""
Faults of devices. After each, the driver must have published the right samples.

A fault is a function of the rig and the process id of the driver. It returns the monotonic time at
which the device works again, ns, or 0 where it was never absent.
"""

import time

from rig import suspend


def byte_fault(kind, rate=1e-3):
    def inject(rig, pid):
        rig.command(f'fault {kind} {rate:g}')
        rig.graph.spin(0.7)
        rig.command('clear')
        return 0

    return inject


def board_fault(command):
    return lambda rig, pid: rig.command(command)


def stop_driver(rig, pid):
    suspend(pid, 3.0, rig.graph)
    return 0


def stop_server(rig, pid):
    return suspend(rig.server.popen.pid, 2.0, rig.graph)


def kill_server(rig, pid):
    rig.server.kill()
    rig.graph.spin(1.0)
    rig.start()
    return time.monotonic_ns()


SERIAL_FAULTS = {
    **{
        f'{kind} a thousandth of the bytes': byte_fault(kind)
        for kind in ('flip', 'lose', 'insert', 'burst')
    },
    'wrong baud rate': byte_fault('baud', 0),
    '100 kB without a delimiter': board_fault('flat 100000'),
    '200 kB of noise': board_fault('noise 200000'),
    '137 samples lost by the board': board_fault('drop 137'),
    'unplugged for 1 s, in a read': board_fault('unplug 1'),
    'board and clock halted for 1 s': board_fault('halt 1'),
    'reader stopped for 3 s': stop_driver,
}
"""Faults of the serial link, after which the board's count shows what is missing."""
RESET = board_fault('reset 0.5')
"""The board is away for half a second; after it the board has no count."""
IIO_FAULTS = {
    'SIGSTOP of iiod for 2 s': stop_server,
    'SIGKILL of iiod, back after 1 s': kill_server,
    'reader stopped for 3 s': stop_driver,
}
"""Faults of the IIO link, which has no count."""


def run_fault(inject, rig, pid, name):
    """Return the report of the samples since before a fault; fail where they do not come back."""
    rig.begin_report()
    back_ns = inject(rig, pid)
    if back_ns:
        rig.wait_for_recovery(back_ns, name)
    rig.wait_for_samples(200, 20, f'samples after: {name}')
    return rig.report()
