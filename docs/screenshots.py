# SPDX-License-Identifier: Apache-2.0

"""Make the pictures of screens and pages in docs/screenshots from real runs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import fcntl
import io
from itertools import groupby
import os
from pathlib import Path
import pty
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time

from PIL import Image
import pyte
from pyte.screens import Char
from rich.console import Console
from rich.style import Style
from rich.text import Text

COLUMNS, LINES = 80, 50
"""Size of the terminal; empty lines at its end are cut off."""
PAGE = {'width': 1280, 'height': 900}
"""Size of the window of the browser, pixels."""
CHROMIUM = next(
    filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), None
)
"""The browser; None for that of `playwright install chromium`."""
LARGEST_BYTES = 300_000
"""Largest size of a picture."""
LONGEST_S = 900.0
"""Longest run of a program, s."""
SPEED = 6.0
"""Sensor time per real time of the guided calibration."""
POSES = 24
"""Accepted poses at which the guided calibration is pictured."""
SWEEP_ARGUMENTS = ('--ros-args', '--log-level', 'error', '-p', 'use_sim_time:=true')
"""Arguments of the nodes of the guided calibration."""


class Terminal:
    """A program in a terminal, whose screen is kept."""

    def __init__(self, command: Sequence[str], folder: Path, lines: int = LINES) -> None:
        self.screen = pyte.Screen(COLUMNS, lines)
        self._stream = pyte.ByteStream(self.screen)
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack('HHHH', lines, COLUMNS, 0, 0))
        self.process = subprocess.Popen(
            command,
            cwd=folder,
            env={**os.environ, 'TERM': 'xterm-256color'},
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        os.close(slave)

    def read_until(self, condition: Callable[[], bool]) -> None:
        """Feed the screen until a condition holds or the program has ended."""
        end_s = time.monotonic() + LONGEST_S
        while not condition():
            if time.monotonic() > end_s:
                raise SystemExit(f'{self.process.args}: not done after {LONGEST_S:g} s')
            try:
                self._stream.feed(os.read(self._master, 65536))
            except OSError:
                break

    def text(self) -> str:
        """Return the text of the screen."""
        return '\n'.join(self.screen.display)

    def close(self) -> None:
        """End the program."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        os.close(self._master)


def style_of(cell: Char) -> Style:
    """Return the style of a cell of the screen."""
    colours = [
        None
        if colour == 'default'
        else f'#{colour}'
        if len(colour) == 6 and set(colour) <= set('0123456789abcdef')
        else colour.replace('brown', 'yellow').replace('bright', 'bright_')
        for colour in (cell.fg, cell.bg)
    ]
    return Style(color=colours[0], bgcolor=colours[1], bold=cell.bold, reverse=cell.reverse)


def draw(terminal: Terminal, title: str, path: Path) -> None:
    """Write the screen of a terminal as SVG."""
    lines = []
    for number in range(terminal.screen.lines):
        row = terminal.screen.buffer[number]
        line = Text()
        cells = [row[column] for column in range(COLUMNS)]
        for style, run_of_cells in groupby(cells, style_of):
            line.append(''.join(cell.data for cell in run_of_cells), style)
        line.rstrip()
        lines.append(line)
    while lines and not lines[-1].plain:
        lines.pop()
    console = Console(
        record=True,
        width=COLUMNS,
        file=io.StringIO(),
        color_system='truecolor',
        force_terminal=True,
    )
    console.print(Text('\n').join(lines), soft_wrap=True)
    console.save_svg(str(path), title=title)
    print(path)


def run(words: Sequence[str], folder: Path, picture: Path | None = None) -> None:
    """Run a program in a terminal to its end, and draw its last screen."""
    terminal = Terminal([str(executable(words[0])), *words[1:]], folder)
    try:
        terminal.read_until(lambda: False)
        if terminal.process.wait():
            raise SystemExit(f'{" ".join(words)} failed:\n{terminal.text()}')
        if picture:
            draw(terminal, f'ros2 run adxl_ros {" ".join(words)}', picture)
    finally:
        terminal.close()


def executable(name: str) -> Path:
    """Return the path of an executable of this package."""
    return Path(__file__).resolve().parents[1] / 'install/adxl_ros/lib/adxl_ros' / name


@contextmanager
def nodes(commands: Sequence[Sequence[str]], folder: Path) -> Iterator[None]:
    """Run nodes until the end of the block."""
    processes = [
        subprocess.Popen(
            [str(executable(command[0])), *command[1:]],
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for command in commands
    ]
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()


def calibration_screen(folder: Path, picture: Path) -> None:
    """Draw the screen of a guided calibration in the middle of a sweep."""
    journal = folder / 'unit.yaml.journal'
    simulated = [
        ['driver', *SWEEP_ARGUMENTS, '-p', f'link.speed:={SPEED}', '-p', 'link.type:=sim'],
        ['stage', *SWEEP_ARGUMENTS],
    ]
    with nodes(simulated, folder):
        terminal = Terminal(
            [
                str(executable('calibration')),
                *SWEEP_ARGUMENTS,
                '-p',
                'autostart:=true',
                '-p',
                'output:=unit.yaml',
                '-p',
                'store:=""',
            ],
            folder,
            30,
        )
        try:
            terminal.read_until(
                lambda: journal.exists() and journal.read_bytes().count(b'\n') > POSES
            )
            draw(terminal, 'ros2 launch adxl_ros calibrate.launch.py', picture)
        finally:
            terminal.close()


def record_fleet(folder: Path) -> None:
    """Simulate four sweeps of each of eight units, one of which drifts; write a manifest."""
    lines = ['url,serial,date']
    for unit in range(8):
        for month in range(4):
            offset_v = 0.02 * (unit * 0.61 % 1 - 0.5) + 0.004 * month * (unit == 2)
            name = f'R{unit:02d}_{month}.csv'
            run(
                [
                    'simulate',
                    'sweep',
                    '--rate',
                    '25',
                    '--effect',
                    f'bias:offset_v={offset_v:.4f}',
                    '--seed',
                    str(10 * unit + month),
                    '-o',
                    name,
                ],
                folder,
            )
            lines.append(f'{name},R{unit:02d},2026-{2 * month + 1:02d}-{unit + 1:02d}')
    (folder / 'manifest.csv').write_text('\n'.join(lines) + '\n')


def page(report: Path, picture: Path) -> None:
    """Write the first screen of a page as a picture."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox'])
        view = browser.new_page(viewport=PAGE)
        view.goto(report.resolve().as_uri())
        view.wait_for_load_state('networkidle')
        view.wait_for_timeout(1000)
        view.screenshot(path=str(picture))
        browser.close()
    if picture.stat().st_size > LARGEST_BYTES:
        Image.open(picture).convert('RGB').quantize(128).save(picture, optimize=True)
    print(picture)


def main() -> None:
    """Make all pictures, or those whose names are given."""
    docs, *names = sys.argv[1:]
    target = Path(docs) / 'screenshots'
    target.mkdir(exist_ok=True)
    target = target.resolve()
    wanted = set(names) or {'demo', 'diagnose', 'calibration', 'fleet'}
    folder = Path(tempfile.mkdtemp())
    try:
        if 'diagnose' in wanted:
            run(
                [
                    'simulate',
                    'rich',
                    '--effect',
                    'lever_arm:z_m=0.03',
                    '--effect',
                    'temperature_bias',
                    '-o',
                    'rich.mcap',
                ],
                folder,
            )
            run(['diagnose', 'rich.mcap', '-o', 'gap'], folder, target / 'diagnose.svg')
            page(folder / 'gap' / 'report.html', target / 'diagnose_page.png')
        if 'calibration' in wanted:
            calibration_screen(folder, target / 'calibration.svg')
        if 'fleet' in wanted:
            record_fleet(folder)
            run(['fleet', 'manifest.csv', '--do', 'check,fit', '-o', 'results'], folder)
            page(folder / 'results' / 'fleet.html', target / 'fleet_page.png')
        if 'demo' in wanted:
            run(['demo'], folder, target / 'demo.svg')
            page(folder / 'demo_output' / 'sweep' / 'report.html', target / 'calibration_page.png')
    finally:
        shutil.rmtree(folder)


if __name__ == '__main__':
    main()
