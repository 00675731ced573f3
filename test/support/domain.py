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

"""A ROS domain that no other run of these tests and no other graph uses."""

from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
import os
from pathlib import Path
import socket
import tempfile

DOMAINS = range(1, 102)  # 0 is everybody's; above 101 lie ports that the system hands out
BY_UDP = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET', 'FASTRTPS_DEFAULT_PROFILES_FILE':
          str(Path(__file__).with_name('udp_of_this_host.xml'))}
"""
Variables for the processes of tests that kill one of them. Fast DDS's shared memory that a process
is killed in stays locked for others, and where rmw_fastrtps keeps to LOCALHOST it takes shared
memory in any case; the profile keeps them to this host, too.
"""


def domain_in_use(domain: int) -> bool:
    """Say whether somebody has the port to which a domain's participants announce themselves."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', 7400 + 250 * domain))
        except OSError:
            return True
    return False


@contextmanager
def own_domain() -> Iterator[int]:
    """Give the number of a domain that is ours as long as the context lasts."""
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
