# SPDX-License-Identifier: Apache-2.0
"""A full screen in a terminal: prompt_toolkit draws lines and reads single keys."""

from __future__ import annotations

from collections.abc import Callable
import os
import sys
from typing import TextIO, TYPE_CHECKING

from adxl_ros.errors import UserError
from adxl_ros.nodes.terminal.draw import Line

if TYPE_CHECKING:
    from prompt_toolkit.application import Application
    from prompt_toolkit.formatted_text import StyleAndTextTuples
    from prompt_toolkit.key_binding import KeyPressEvent

_REFRESH_S = 0.2
"""Time between two drawings, s: the node publishes contents five times a second."""


def full_screen(lines: Callable[[int, int], list[Line]], press: Callable[[str], None],
                leave: Callable[[], None]) -> Application[None]:
    """Make the application of a full screen."""
    try:
        from prompt_toolkit.application import Application
        from prompt_toolkit.input import create_input
        from prompt_toolkit.key_binding import KeyBindings
        from prompt_toolkit.layout import FormattedTextControl, Layout, Window
        from prompt_toolkit.output import create_output
    except ImportError:
        raise UserError('the screen needs prompt_toolkit; pip install prompt_toolkit') from None
    stdin, stdout = _terminal()
    output, keys = create_output(stdout), KeyBindings()

    def fragments() -> StyleAndTextTuples:
        rows, columns = output.get_size()
        drawn: StyleAndTextTuples = []
        for line in lines(columns, rows):
            drawn += [*line, ('', '\n')]
        return drawn[:-1]

    def end(event: KeyPressEvent) -> None:
        leave()
        event.app.exit()

    keys.add('<any>')(lambda event: press(event.data.lower()))
    # A key with Alt comes as Escape and the key.
    keys.add('escape', '<any>')(lambda _: None)
    for key in ('q', 'Q', 'c-c'):
        keys.add(key)(end)
    return Application(Layout(Window(FormattedTextControl(fragments, show_cursor=False))),
                       key_bindings=keys, full_screen=True, refresh_interval=_REFRESH_S,
                       input=create_input(stdin), output=output)


def _terminal() -> tuple[TextIO, TextIO]:
    """Return the terminal to read from and to write to."""
    if sys.stdin.isatty() and sys.stdout.isatty():
        return sys.stdin, open(os.dup(sys.stdout.fileno()), 'w', encoding='utf-8')
    try:
        # A launch keeps stdin and stdout to itself.
        return open('/dev/tty', encoding='utf-8'), open('/dev/tty', 'w', encoding='utf-8')
    except OSError:
        raise UserError('the screen needs a terminal; run it in one') from None
