# SPDX-License-Identifier: Apache-2.0

"""Files and directories that appear as a whole, and whose writer is known."""

import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
from threading import Event, Thread

from adxl_ros.errors import UserError
from adxl_ros.files import atomic_write
from adxl_ros.files.atomic_write import atomic_path, free_name, is_own, write_text
import pytest


def write_folder(path: Path, text: str) -> None:
    with atomic_path(path) as fresh:
        fresh.mkdir()
        (fresh / 'bag_0.mcap').write_text(text)


def test_a_folder_is_there_at_every_moment_of_its_replacement(tmp_path: Path) -> None:
    """A reader that looks all the time sees the old or the new folder, never none."""
    path, ended, seen = tmp_path / 'bag', Event(), set()
    write_folder(path, '0')

    def look() -> None:
        while not ended.is_set():
            seen.add(path.is_dir())

    reader = Thread(target=look)
    reader.start()
    for number in range(1, 200):
        write_folder(path, str(number))
    ended.set()
    reader.join()
    assert seen == {True}
    assert (path / 'bag_0.mcap').read_text() == '199'
    assert os.listdir(tmp_path) == ['bag']


def test_without_an_exchange_a_folder_is_replaced_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(atomic_write.ctypes, 'CDLL', lambda *_, **__: object())
    for text in ('old', 'new'):
        write_folder(tmp_path / 'bag', text)
    assert (tmp_path / 'bag' / 'bag_0.mcap').read_text() == 'new'
    assert os.listdir(tmp_path) == ['bag']


def test_a_kill_while_a_folder_is_written_leaves_the_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / 'bag'
    write_folder(path, 'old')
    code = (
        'import sys, time\nfrom pathlib import Path\n'
        'from adxl_ros.files.atomic_write import atomic_path\n'
        'with atomic_path(sys.argv[1]) as fresh:\n    fresh.mkdir()\n'
        '    print("begun", flush=True)\n    time.sleep(60)\n'
    )
    with subprocess.Popen(
        [sys.executable, '-c', code, str(path)], stdout=subprocess.PIPE
    ) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == b'begun\n'
        writer.send_signal(signal.SIGKILL)
    assert (path / 'bag_0.mcap').read_text() == 'old'


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Give a folder on a file system that keeps extended attributes."""
    write_text(tmp_path / 'probe', '')
    if not is_own(tmp_path / 'probe'):
        pytest.skip('no extended attributes here')
    return tmp_path


def test_only_what_was_written_here_and_left_as_it_was_is_own(kept: Path) -> None:
    write_text(kept / 'made.csv', 'a')
    write_folder(kept / 'bag', 'a')
    write_folder(kept / 'bag', 'b')
    assert is_own(kept / 'made.csv') and is_own(kept / 'bag')
    (kept / 'users.csv').write_text('a')
    shutil.copyfile(kept / 'made.csv', kept / 'copy.csv')
    with open(kept / 'made.csv', 'a') as file:
        file.write('edited')
    (kept / 'bag' / 'further').write_text('')
    for name in ('users.csv', 'copy.csv', 'made.csv', 'bag', 'absent'):
        assert not is_own(kept / name), name


def test_a_free_name_is_that_of_no_file(tmp_path: Path) -> None:
    assert free_name(tmp_path / 'sim.csv') == tmp_path / 'sim.csv'
    for name in ('sim.csv', 'sim_2.csv'):
        (tmp_path / name).write_text('')
    assert free_name(tmp_path / 'sim.csv') == tmp_path / 'sim_3.csv'


def test_a_folder_of_others_is_never_replaced(tmp_path: Path) -> None:
    users = tmp_path / 'home'
    users.mkdir()
    write_folder(users, 'into an empty one')
    assert (users / 'bag_0.mcap').exists()
    (users / 'thesis.tex').write_text('precious')
    with pytest.raises(UserError, match=r'thesis\.tex'):
        write_folder(users, 'a bag')
    assert (users / 'thesis.tex').read_text() == 'precious'
    assert os.listdir(tmp_path) == ['home']
