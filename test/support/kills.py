# SPDX-License-Identifier: Apache-2.0

"""
A sweep that is killed repeatedly, at random moments: no accepted pose is lost.

Of five kills, two come within the first two seconds and one during the fit. One comes while a file
is written, and one when the sweep has ended.
"""

from contextlib import suppress
import json
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
SWEEP = (
    '-p',
    'autostart:=true',
    '-p',
    'sweep.planes_deg:=[90.0]',
    '-p',
    'sweep.step_deg:=90.0',
    '-p',
    'sweep.dwell_s:=0.5',
    '-p',
    'sweep.check_poses:=2',
    '-p',
    'output:=unit.yaml',
    '-p',
    'store:=store',
    '-p',
    'report:=report',
    *RELIABLE,
)
_TIMEOUT_S = 90.0
"""Longest wait for the moment of a kill, s."""
_DELAYS_S = {'poses': 2.0, 'fit': 1.0, 'write': 0.005, 'end': 0.0}
"""Longest random delay of a kill after its moment, s."""
_MOMENTS = ('poses', 'fit', 'poses', 'write', 'end')
"""Moments of the kills, in turn."""


class Sweeps:
    """
    Runs the calibration node on a simulated stage, kills it, and checks its files.

    kills: number of kills, `in_fit` of them while it fitted or wrote; sweeps: number of sweeps
    that came to their end; poses: acknowledged poses; lost: poses and calibrations that are
    missing or changed; broken: incomplete files, and other failures.
    """

    def __init__(self, folder, env, kill, seed):
        self.folder, self.env, self._kill = Path(folder), env, kill
        self.rng = np.random.default_rng(seed)
        self.kills = self.sweeps = self.poses = self.in_fit = 0
        self.lost, self.broken = [], []
        base = nominal(serial='K1', rate_hz=200.0)
        parameter_file.save(self.folder / 'truth.yaml', drawn(np.random.default_rng(3), base))
        parameter_file.save(self.folder / 'bare.yaml', base)
        self._kept_poses, self._written = {}, ''
        self._stored, self._unfinished_before = set(), set()
        self._others = [
            self._start('driver', 'truth.yaml', '-p', 'link.type:=sim', '-p', 'link.speed:=10.0'),
            self._start('stage', 'bare.yaml', '-p', 'slew_rate_rad_s:=6.0'),
        ]

    def _start(self, name, file, *arguments):
        with open(self.folder / f'{name}.log', 'wb') as log:
            return subprocess.Popen(
                [
                    executable(name),
                    '--ros-args',
                    '--params-file',
                    self.folder / file,
                    *SIM,
                    *arguments,
                ],
                env=self.env,
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def end(self):
        for process in self._others:
            process.send_signal(signal.SIGINT)
        for process in self._others:
            process.wait(100)

    def kill_once(self):
        """Run the sweep until a moment or the end, kill the node, and check its files."""
        moment = _MOMENTS[self.kills % len(_MOMENTS)]
        delay_s = self.rng.uniform() * _DELAYS_S[moment]
        node = self._start('calibration', 'bare.yaml', *SWEEP)
        began_s, log = time.monotonic(), self.folder / 'calibration.log'
        try:
            while (
                not self._has_come(moment, log.read_text(errors='replace'))
                and time.monotonic() - began_s < _TIMEOUT_S
            ):
                time.sleep(0.005 if moment != 'write' else 0.001)
            time.sleep(delay_s)
        finally:
            self._kill(node.pid)
            node.wait()
        self.kills += 1
        self._check(log.read_text(errors='replace'))

    def _has_come(self, moment, output):
        """Return whether a moment, or the end of the sweep, has come."""
        if 'wrote unit.yaml' in output:
            return True
        if moment == 'poses':
            return 'calibrating' in output
        if moment == 'fit':
            return 'fitting' in output
        return moment == 'write' and 'fitting' in output and bool(self._unfinished())

    def _unfinished(self):
        while True:
            # A folder may be finished while the search looks into it.
            with suppress(FileNotFoundError):
                return {
                    path
                    for pattern in ('.unit*.part', '*/.*.part', 'store/K1/.*.part')
                    for path in self.folder.glob(pattern)
                }

    def _check(self, output):
        acknowledged = [int(n) - 1 for n in re.findall(r'pose (\d+) is on disk', output)]
        self.poses += len(acknowledged)
        unfinished = self._unfinished()
        if 'calibrating' not in output:
            self.broken.append(f'kill {self.kills}: it did not begin: {output[-300:]}')
            return
        if 'fitting' in output and 'wrote' not in output:
            self.in_fit += 1
        if self._unfinished_before & unfinished:
            self.broken.append(
                f'kill {self.kills}: not cleared: {self._unfinished_before & unfinished}'
            )
        self._unfinished_before = unfinished
        try:
            self._check_poses(acknowledged)
            self._check_files()
        except Exception as error:
            self.broken.append(f'kill {self.kills}: {error}')

    def _check_poses(self, acknowledged):
        entries = sweep_journal.read(self.folder / 'unit.yaml.journal').entries
        kept = {
            entry.pose: json.dumps(entry.to_json())
            for entry in sweep_journal.accepted_poses(entries)
        }
        missing = [n for n in {*self._kept_poses, *acknowledged} if n not in kept]
        changed = [n for n in self._kept_poses if n in kept and kept[n] != self._kept_poses[n]]
        if missing or changed:
            self.lost.append(f'kill {self.kills}: missing {missing}, changed {changed}')
        self._kept_poses = kept
        if any(isinstance(entry, sweep_journal.Fitted) and entry.done for entry in entries):
            self.sweeps += 1
            self._kept_poses = {}
            if _data(self.folder / 'unit.yaml') not in map(_data, self._in_store()):
                self.lost.append(f'kill {self.kills}: the sweep has ended without a copy')

    def _check_files(self):
        """Load all files; the previous calibration and the calibration store must be kept."""
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
    """Return the hash of the poses of a parameter file; '' without a file."""
    return parameter_file.load(path).provenance['data_sha256'] if path.exists() else ''


def kill_sweeps(folder, env, kill, kills, seed):
    """Kill a sweep a number of times by a function of its process id; return the `Sweeps`."""
    sweeps = Sweeps(folder, env, kill, seed)
    try:
        while sweeps.kills < kills:
            sweeps.kill_once()
    finally:
        sweeps.end()
    return sweeps
