# SPDX-License-Identifier: Apache-2.0

"""A ROS domain that no other run of these tests and no other graph uses."""

from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
import os
from pathlib import Path
import socket
import tempfile

DOMAINS = range(1, 102)
"""Domains of tests: 0 is the default, and above 101 lie the ephemeral ports of the system."""
BY_UDP = {
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
    'FASTRTPS_DEFAULT_PROFILES_FILE': str(Path(__file__).with_name('udp_of_this_host.xml')),
}
"""
Variables for tests with the fixture `kill`. The shared memory of Fast DDS stays locked after a
kill, and rmw_fastrtps always uses it with LOCALHOST. The profile limits the processes to this
host.
"""


PARTICIPANTS = 32
"""How many participants of a domain on this host are looked for."""


def domain_in_use(domain: int) -> bool:
    """
    Return whether a participant of a domain lives on this host.

    A node that a test has run in its own process lives on until Python collects it, and its
    subscriptions and publishers would take part in the next test of the domain. The ports of a
    participant follow from its number (RTPS 2.5, section 9.6.2.3).
    """
    for participant in range(PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', 7400 + 250 * domain + 10 + 2 * participant))
            except OSError:
                return True
    return False


@contextmanager
def own_domain() -> Iterator[int]:
    """Give a domain that no other test uses as long as the context lasts."""
    locks = Path(tempfile.gettempdir())
    for domain in DOMAINS:
        with open(locks / f'adxl_ros_{os.getuid()}_domain_{domain}.lock', 'w') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if not domain_in_use(domain):
                yield domain
                return
    raise RuntimeError('every ROS domain from 1 to 101 is in use')
