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
A long recording through `apply` in bounded memory: `make long ARGS='--hours 8'`.

Writes a recording of three axes at 1 kHz, applies a parameter file to it, and prints rows, time
and the largest memory of each step. Then it interrupts the same run half-way.
"""

import argparse
from datetime import date
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
import numpy as np
from units import drawn, nominal

ROWS = 100_000
RATE_HZ = 1000.0


def write(path: Path, hours: float) -> int:
    """Write a simulated recording; return its rows."""
    sensor = nominal('xyz')
    rng = np.random.default_rng(0)
    rows = round(hours * 3600 * RATE_HZ)
    block = {f'{a}_v': np.rint((v + rng.normal(size=ROWS) * 5e-4) / sensor.lsb_v) * sensor.lsb_v
             for a, v in zip('xyz', (2.6, 2.4, 3.49))}
    with recording.writer(path, sensor) as out:
        for begin in range(0, rows, ROWS):
            count = min(ROWS, rows - begin)
            time_s = (begin + np.arange(count)) / RATE_HZ
            out(Recording(str(path), time_s, {k: v[:count] for k, v in block.items()},
                          sensor_info(sensor)))
    return rows


def main() -> None:
    """Run and print the table."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--hours', type=float, default=8.0)
    parse.add_argument('--folder', type=Path, default=None, help='for some 8 GB')
    options = parse.parse_args()
    # A background job of a shell ignores SIGINT, and its processes would inherit this.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        unit = Path(folder) / 'unit.yaml'
        parameter_file.save(unit, drawn(np.random.default_rng(1), nominal('xyz')))
        print(f'{date.today()}, {options.hours:g} h of three axes at 1 kHz, seed 0\n')
        print('| recording | rows | written in, s | applied in, s | greatest memory, MB |')
        print('|---|---|---|---|---|', flush=True)
        for name in ('long.csv', 'long.mcap'):
            path, out = Path(folder) / name, Path(folder) / 'out.csv'
            began = time.monotonic()
            rows = write(path, options.hours)
            written = time.monotonic() - began
            began = time.monotonic()
            command = ['apply', str(path), '--params', str(unit), '-o', str(out)]
            done = subprocess.run([sys.executable, '-c', MEASURE, *command], text=True,
                                  check=True, capture_output=True).stdout
            took = time.monotonic() - began
            print(f'| {name} | {rows} | {written:.0f} | {took:.0f} | {int(done) / 1e3:.0f} |',
                  flush=True)
            out.unlink()
            again = subprocess.Popen(['apply', *command[1:]])
            time.sleep(took / 2)
            again.send_signal(signal.SIGINT)
            again.wait()
            remaining = [p.name for p in Path(folder).iterdir()
                         if p.name not in (name, 'unit.yaml')]
            assert again.returncode == 130 and not remaining, (again.returncode, remaining)
            path.unlink()
        print('\nInterrupted half-way, neither left a file.')


MEASURE = ('import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True); '
           'print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)')

if __name__ == '__main__':
    main()
