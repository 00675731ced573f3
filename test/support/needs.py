# SPDX-License-Identifier: Apache-2.0

"""What tests need that a machine may lack, and the end of a run that says so in two lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
import re

_APT = ': apt install '
"""Words between what is missing and the package of Debian and Ubuntu that has it."""


def lack(what: str, apt_package: str = '') -> str:
    """Return the reason for which a test is skipped."""
    return f'needs {what}' + (f'{_APT}{apt_package}' if apt_package else '')


def summary(reasons: Iterable[str]) -> list[str]:
    """Return one line on skipped tests, and one with the command that installs what they need."""
    counts: Counter[str] = Counter()
    packages = set()
    for reason in reasons:
        # pytest's own words for a module that is not installed
        module = re.match(r"could not import '([\w.]+)'", reason)
        what, _, apt_package = (lack(module[1]) if module else reason).partition(_APT)
        counts[what.removeprefix('needs ')] += 1
        packages |= {*apt_package.split()}
    if not counts:
        return []
    lines = [
        f'skipped {counts.total()} tests, which need: '
        + ', '.join(f'{what} ({count})' for what, count in counts.most_common())
    ]
    if packages:
        lines.append(f'to run them: sudo apt install {" ".join(sorted(packages))}')
    return lines
