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

Of five kills two come within the first two seconds, one while all poses are fitted, one while a
file is written, and one when the sweep has ended.
"""

from contextlib import suppress
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import time

from adxl_ros.files import parameter_file, sweep_journal
from graph import RELIABLE
import numpy as np
from processes import executable
from units import drawn, nominal

SIM = ('-p', 'use_sim_time:=true')
SWEEP = ('-p', 'autostart:=true', '-p', 'sweep.planes_rad:=[1.5707963267948966]',
         '-p', 'sweep.step_rad:=1.5707963267948966', '-p', 'sweep.dwell_s:=0.5', '-p',
         'sweep.check_poses:=2', '-p', 'output:=unit.yaml', '-p', 'store:=store', '-p',
         'report:=report', *RELIABLE)
_LONGEST_S = 90.0
_POSES_S, _FIT_S, _WRITE_S = 2.0, 1.0, 0.005
_MOMENTS = ('poses', 'fit', 'poses', 'write', 'end')
_FILES = ('unit.yaml.previous', 'unit.yaml', 'store', 'report.html', 'calibration.png')


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
        What went wrong: acknowledged poses or an earlier calibration that were gone or changed,
        files that were not whole.
    moments
        Kills by what the node was doing.

    """

    def __init__(self, folder, env, seed):
        self.folder, self.env = Path(folder), env
        self.rng = np.random.default_rng(seed)
        self.kills = self.sweeps = self.poses = 0
        self.lost, self.broken, self.moments = [], [], {}
        base = nominal(serial='K1', rate_hz=200.0)
        parameter_file.save(self.folder / 'truth.yaml', drawn(np.random.default_rng(3), base))
        parameter_file.save(self.folder / 'bare.yaml', base)
        self._known, self._written, self._stored, self._left = {}, '', set(), set()
        self._others = [self._start('driver', 'truth.yaml', '-p', 'link.speed:=10.0'),
                        self._start('stage', 'bare.yaml', '-p', 'slew_rate_rad_s:=6.0')]

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
        """Let the node go on with the sweep until a moment or the end, kill it, and look."""
        moment = _MOMENTS[self.kills % len(_MOMENTS)]
        after_s = self.rng.uniform() * {'poses': _POSES_S, 'fit': _FIT_S, 'write': _WRITE_S,
                                        'end': 0.0}[moment]
        file = self.rng.choice(_FILES)
        node = self._start('calibration', 'bare.yaml', *SWEEP)
        began, log = time.monotonic(), self.folder / 'calibration.log'
        try:
            while not self._come(moment, file, log.read_text(errors='replace')) \
                    and time.monotonic() - began < _LONGEST_S:
                time.sleep(0.005 if moment != 'write' else 0.001)
            time.sleep(after_s)
        finally:
            os.kill(node.pid, signal.SIGKILL)
            node.wait()
        self.kills += 1
        self._look(log.read_text(errors='replace'))

    def _come(self, moment, file, said):
        """Tell whether a moment has come, or the end."""
        return 'wrote unit.yaml' in said or {
            'poses': 'calibrating' in said, 'fit': 'fitting' in said, 'end': False,
            'write': 'fitting' in said and file in map(_file, self._unfinished())}[moment]

    def _unfinished(self):
        """Return the hidden folders in which files are written."""
        while True:
            # One that is finished while it is looked into is none any more.
            with suppress(FileNotFoundError):
                return {path for pattern in ('.unit*.part', '*/.*.part', 'store/K1/.*.part')
                        for path in self.folder.glob(pattern)}

    def _look(self, said):
        acknowledged = [int(n) - 1 for n in re.findall(r'pose (\d+) is on disk', said)]
        self.poses += len(acknowledged)
        left = self._unfinished()
        moment = (
            'start' if 'calibrating' not in said else
            'the end' if 'wrote' in said else
            f'a file is written ({_file(min(left))})' if left else
            'the fit, or between files' if 'fitting' in said else
            'the mounting is checked' if not acknowledged and self._known else 'poses')
        self.moments[moment] = self.moments.get(moment, 0) + 1
        if moment == 'start':
            self.broken.append(f'kill {self.kills}: it did not begin: {said[-300:]}')
            return
        if self._left & left:
            self.broken.append(f'kill {self.kills}: not cleared: {self._left & left}')
        self._left = left
        try:
            self._look_at_poses(acknowledged)
            self._look_at_files()
        except Exception as error:
            self.broken.append(f'kill {self.kills}: {error}')

    def _look_at_poses(self, acknowledged):
        _, entries = sweep_journal.read(self.folder / 'unit.yaml.journal')
        kept = {entry.pose: json.dumps(entry.to_json())
                for entry in sweep_journal.accepted_poses(entries)}
        gone = [n for n in {*self._known, *acknowledged} if n not in kept]
        changed = [n for n in self._known if n in kept and kept[n] != self._known[n]]
        if gone or changed:
            self.lost.append(f'kill {self.kills}: gone {gone}, changed {changed}')
        self._known = kept
        if any(isinstance(entry, sweep_journal.Fitted) and entry.done for entry in entries):
            self.sweeps += 1
            self._known = {}
            if _data(self.folder / 'unit.yaml') not in map(_data, self._in_store()):
                self.lost.append(f'kill {self.kills}: the sweep has ended without a copy')

    def _look_at_files(self):
        """Load all that is there; the calibration before the newest is kept, as the store is."""
        now = _data(self.folder / 'unit.yaml')
        before = _data(self.folder / 'unit.yaml.previous')
        if now != self._written and before != self._written:
            self.lost.append(f'kill {self.kills}: the calibration before is not kept')
        stored = self._in_store()
        for path in stored:
            parameter_file.load(path)
        page = self.folder / 'report' / 'report.html'
        if page.exists() and '</html>' not in page.read_text()[-20:]:
            self.broken.append(f'kill {self.kills}: {page} is cut')
        if self._stored - stored:
            self.lost.append(f'kill {self.kills}: gone from the store: {self._stored - stored}')
        self._written, self._stored = now, stored

    def _in_store(self):
        return set((self.folder / 'store' / 'K1').glob('*.yaml'))


def _data(path):
    """Return the hash of the poses behind a parameter file; '' where there is none."""
    return parameter_file.load(path).provenance['data_sha256'] if path.exists() else ''


def _file(left):
    """Name what was written in a hidden folder."""
    return 'store' if 'K1' in left.parts else left.name.removesuffix('.part')[1:-9]


def kill(folder, env, kills, seed):
    """Kill so often; returns the `Sweeps`."""
    sweeps = Sweeps(folder, env, seed)
    try:
        while sweeps.kills < kills:
            sweeps.kill_once()
    finally:
        sweeps.end()
    return sweeps
