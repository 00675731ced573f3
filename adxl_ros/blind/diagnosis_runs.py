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

"""The diagnosis of every recording, each in a process that gets this recording only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial
import hashlib
from importlib.metadata import PackageNotFoundError, version
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.jobs.run import for_each
from adxl_ros.jobs.whole_files import make_folder, write

_ENVIRONMENT = ('PATH', 'LD_LIBRARY_PATH', 'PYTHONPATH', 'AMENT_PREFIX_PATH', 'VIRTUAL_ENV',
                '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'ROS_DISTRO', 'LANG', 'SYSTEMROOT')
"""Variables that ROS 2 and Python need. None contains the folder of the check."""
_TIMEOUT_S = 1200.0
"""Longest time of one diagnosis, s; chosen."""
Result = dict[str, Any]
"""What a diagnosis left: `report`, `parameters`, `seconds`, `status` and `error`."""


def executable(name: str) -> list[str]:
    """Return the command line of an executable of the package."""
    return [sys.executable, '-c',
            f'import sys; from adxl_ros.tools.{name} import main; sys.exit(main())']


def call(command: Sequence[str], folder: Path) -> tuple[int, str]:
    """
    Run a command in a folder, with an environment that names no other folder of the user.

    Parameters
    ----------
    command
        The command line.
    folder
        Its working directory and home.

    Returns
    -------
    tuple
        Exit status, and the last line of stderr.

    """
    environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
    # Each process uses one core: linear algebra must not use the others.
    environment |= {'HOME': str(folder), 'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1',
                    'MPLCONFIGDIR': str(folder)}
    with subprocess.Popen(command, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                          stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                          start_new_session=True) as process:
        try:
            error = process.communicate(timeout=_TIMEOUT_S)[1]
            return process.returncode, (error.strip().splitlines() or [''])[-1]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return 1, f'not finished after {_TIMEOUT_S:.0f} s'
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise


def diagnose(name: str, recording: bytes, parameters: bytes,
             command: Sequence[str] | None) -> tuple[str, Result]:
    """
    Diagnose a recording in a folder that has the recording and its parameter file only.

    Parameters
    ----------
    name
        Neutral name of both files.
    recording, parameters
        Content of the files.
    command
        What to run; None for `diagnose` of the package.

    Returns
    -------
    tuple
        The name and the result; `report` and `parameters` are None where they were not written.

    """
    with tempfile.TemporaryDirectory(prefix='diagnose_') as temporary:
        folder = Path(temporary)
        csv, yaml, out = folder / f'{name}.csv', folder / f'{name}.yaml', folder / 'out'
        for path, data in ((csv, recording), (yaml, parameters)):
            path.write_bytes(data)
            os.utime(path, (0, 0))
        arguments = [*(command or executable('diagnose')), csv.name, '--params', yaml.name,
                     '-o', out.name, '--json', '--seed', '0']
        start = time.monotonic()
        status, error = call(arguments, folder)
        seconds = time.monotonic() - start
        report, params = out / 'report.json', out / 'params.yaml'
        try:
            content = json.loads(report.read_bytes())
        except (OSError, ValueError) as problem:
            content, error = None, error or f'no report: {problem}'
        return name, {'report': content, 'seconds': seconds, 'status': status, 'error': error,
                      'parameters': params.read_text() if params.exists() else None}


def diagnose_all(folder: Path, command: Sequence[str] | None, pool: Executor,
                 show: Callable[[float], None]) -> dict[str, Result]:
    """
    Diagnose all recordings of a folder that have no report yet.

    Parameters
    ----------
    folder
        Has `recordings`; gets `reports`.
    command
        The diagnosis; None for that of the package.
    pool
        Works in parallel.
    show
        Receives the fraction that is finished.

    Returns
    -------
    dict
        All results by name.

    Raises
    ------
    UserError
        Earlier results are of another version of the diagnosis.

    """
    reports, code = make_folder(folder / 'reports'), code_version(command)
    stamp = reports / 'version.txt'
    if stamp.exists() and stamp.read_text() != code:
        raise UserError(f'{stamp}: earlier reports are of another version of the diagnosis '
                        f'({stamp.read_text()[:12]}, now {code[:12]}); draw a new check '
                        'into another folder')
    write(stamp, code.encode())
    names = sorted(path.stem for path in (folder / 'recordings').glob('*.csv'))
    todo = [name for name in names if not (reports / f'{name}.json').exists()]

    def job(name: str) -> tuple:
        source = folder / 'recordings' / name
        return (name, source.with_suffix('.csv').read_bytes(),
                source.with_suffix('.yaml').read_bytes(), command)

    def keep(name: str, result: Result) -> None:
        write(reports / f'{name}.json', json.dumps(result).encode())

    for_each(pool, diagnose, [partial(job, name) for name in todo], keep, show,
             len(names) - len(todo))
    if code_version(command) != code:
        raise UserError('the code of the diagnosis changed while it ran; draw a new check into '
                        'another folder, and do not change the package meanwhile')
    return {name: json.loads((reports / f'{name}.json').read_bytes()) for name in names}


def code_version(command: Sequence[str] | None) -> str:
    """Hash the code of the diagnosis: the package without this check, or the command's files."""
    hashed = hashlib.sha256()
    if command is None:
        root = Path(__file__).parents[1]
        files = [path for path in sorted(root.rglob('*.py'))
                 if path.relative_to(root).parts[0] != 'blind'
                 and path.name not in ('blind.py', 'blind_forest.py')]
    else:
        files = [Path(word) for word in command[1:] if Path(word).is_file()]
        hashed.update(repr(list(command)).encode())
    for path in files:
        hashed.update(path.name.encode() + path.read_bytes())
    return hashed.hexdigest()


def package_version() -> str:
    """Return the version of this package; 'unknown' when it runs from its source."""
    try:
        return version('adxl_ros')
    except PackageNotFoundError:
        return 'unknown'
