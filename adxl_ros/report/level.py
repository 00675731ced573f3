# SPDX-License-Identifier: Apache-2.0

"""The levels of a state and of a line of the log, for people."""

from enum import Enum


class Level(Enum):
    """How well something works; the names are those of diagnostics."""

    OK = 'ok'
    WARN = 'warn'
    ERROR = 'error'
