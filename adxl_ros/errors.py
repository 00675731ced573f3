# SPDX-License-Identifier: Apache-2.0

"""The one exception that reaches a user, and words that its messages share."""

import shlex
import sys


class UserError(Exception):
    """
    An error that the user can correct, with a message of one line.

    The message names the file, line and column, or the topic, the wrong value, and what to do.
    Tools print it and exit with status 1. Nodes log it and show it in diagnostics.
    """

    def __init__(self, message: str = '', paste: str = '') -> None:
        """Take the message."""
        super().__init__(f'{message} {paste}' if paste else message)
        # End of the message that is for a command line, quoted for a shell; empty for none
        self.paste = paste


def install_hint(*requirements: str) -> str:
    """
    Return the command that installs Python packages, for the running Python.

    Ubuntu 24.04 refuses `pip install` outside of a virtual environment (PEP 668).
    """
    options = '' if sys.prefix != sys.base_prefix else '--user --break-system-packages '
    return f'python3 -m pip install {options}{shlex.join(requirements)}'


def one_line(error: BaseException) -> str:
    """Return the text of an error in one line."""
    return ' '.join(str(error).split())
