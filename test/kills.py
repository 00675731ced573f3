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

"""
A sweep that is killed again and again, at random moments: no accepted pose is lost.

    make soak ARGS='--minutes 0'     200 kills, a table for docs/guided.md
"""

import json
import os
from pathlib import Path
import re
import signal
import subprocess
import time

from adxl_ros.files import journal, params
from conftest import executable
import numpy as np
from units import drawn, nominal

SIM = ('-p', 'use_sim_time:=true')
SWEEP = ('-p', 'autostart:=true', '-p', 'sweep.planes_rad:=[0.785, 1.5707963267948966, 2.356]',
         '-p', 'sweep.step_rad:=0.7853981633974483', '-p', 'sweep.dwell_s:=0.5', '-p',
         'sweep.check_poses:=4', '-p', 'output:=unit.yaml', '-p',
         'qos_overrides./imu/data_raw.subscription.reliability:=reliable')
_LONGEST_S = 60.0


class Sweeps:
    """
    Runs the calibration node on a simulated stage, kills it, and looks at what it left.

    Attributes
    ----------
    kills, sweeps
        How often it was killed, and how many sweeps came to their end in spite of it.
    poses
        Poses that were acknowledged.
    lost, broken
        What went wrong: acknowledged poses that were gone or changed, files that were not whole.
    moments
        Kills by what the node was doing.

    """

    def __init__(self, folder, env, seed):
        # A process that is killed within Fast DDS's shared memory leaves it locked for others.
        self.folder, self.env = Path(folder), {**env, 'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'}
        self.rng = np.random.default_rng(seed)
        self.kills = self.sweeps = self.poses = 0
        self.lost, self.broken, self.moments = [], [], {}
        base = nominal(serial='K1')
        params.save(self.folder / 'truth.yaml', drawn(np.random.default_rng(3), base))
        params.save(self.folder / 'bare.yaml', base)
        self._known = {}
        self._others = [self._start('driver', 'truth.yaml', '-p', 'link.speed:=10.0'),
                        self._start('stage', 'bare.yaml', '-p', 'slew_rate_rad_s:=3.0')]

    def _start(self, name, file, *more):
        with open(self.folder / f'{name}.log', 'wb') as log:
            return subprocess.Popen(
                [executable(name), '--ros-args', '--params-file', self.folder / file, *SIM, *more],
                env=self.env, cwd=self.folder, stdin=subprocess.DEVNULL, stdout=log,
                stderr=subprocess.STDOUT)

    def end(self):
        """End what is still running."""
        for process in self._others:
            process.send_signal(signal.SIGINT)
        for process in self._others:
            process.wait(20)

    def kill_once(self):
        """Let the node go on with the sweep for a random time, kill it, and look."""
        node = self._start('calibration', 'bare.yaml', *SWEEP)
        began, log = time.monotonic(), self.folder / 'calibration.log'
        after_s, since = self.rng.uniform(0.0, 2.0), None
        try:
            while time.monotonic() - began < _LONGEST_S:
                text = log.read_text(errors='replace')
                if since is None and 'calibrating' in text:
                    since = time.monotonic()
                if 'wrote unit.yaml' in text or (
                        since is not None and time.monotonic() - since > after_s):
                    break
                time.sleep(0.005)
        finally:
            os.kill(node.pid, signal.SIGKILL)
            node.wait()
        self.kills += 1
        self._look(log.read_text(errors='replace'), since is not None)

    def _look(self, said, begun):
        path = self.folder / 'unit.yaml.journal'
        acknowledged = [int(n) - 1 for n in re.findall(r'pose (\d+) is on disk', said)]
        self.poses += len(acknowledged)
        moment = 'start' if not begun else 'the end' if 'wrote' in said else (
            'the mounting is checked' if not acknowledged and self._known else 'poses')
        self.moments[moment] = self.moments.get(moment, 0) + 1
        if not begun:
            self.broken.append(f'kill {self.kills}: it did not begin: {said[-300:]}')
            return
        try:
            _, entries = journal.read(path)
            if (self.folder / 'unit.yaml').exists():
                params.load(self.folder / 'unit.yaml')
        except Exception as error:
            self.broken.append(f'kill {self.kills}: {error}')
            return
        left = [p.name for p in self.folder.iterdir() if p.name.startswith('.unit')]
        kept = {entry['pose']: json.dumps(entry) for entry in journal.accepted_poses(entries)}
        gone = [n for n in {*self._known, *acknowledged} if n not in kept]
        changed = [n for n in self._known if n in kept and kept[n] != self._known[n]]
        if gone or changed:
            self.lost.append(f'kill {self.kills}: gone {gone}, changed {changed}')
        self._known = kept
        if any('done' in entry for entry in entries):
            self.sweeps += 1
            self._known = {}
        for name in left:
            # What a kill within a write leaves is beside the file and never read; tidy up.
            subprocess.run(['rm', '-r', self.folder / name], check=True)


def kill(folder, env, kills, seed):
    """Kill so often; returns the `Sweeps`."""
    sweeps = Sweeps(folder, env, seed)
    try:
        while sweeps.kills < kills:
            sweeps.kill_once()
    finally:
        sweeps.end()
    return sweeps
