# SPDX-License-Identifier: Apache-2.0
"""Write a blind check, blind.json, into docs/maintain/blind_check.md and the log of all runs."""

import json
from pathlib import Path
import re
import sys

from adxl_ros_validation.blind import report

DOCS = Path(__file__).resolve().parent


def main() -> None:
    """Replace the result, and the tables of the run in the log; a new run comes last there."""
    source, run = sys.argv[1:]
    made = json.loads(Path(source).read_text(encoding='utf-8'))
    log = DOCS / 'measurements' / 'blind_check_log.txt'
    if f'<!-- {run} -->' not in log.read_text(encoding='utf-8'):
        with log.open('a', encoding='utf-8') as stream:
            stream.write(f'\n## {run.capitalize()} run\n\n<!-- {run} -->\n<!-- /{run} -->\n')
    check = report.of_simulated(made)
    replace(log, run, check.markdown())
    # The page has the score, its figure, its bar and whether it is met; the log has the rest.
    narrow = [
        re.sub(r'^((\|[^|]*){4}).*', r'\1|', line)
        for line in check.markdown(['Result']).replace('### Result\n\n', '').splitlines()
    ]
    replace(DOCS / 'maintain' / 'blind_check.md', 'result', '\n'.join(narrow))


def replace(path: Path, mark: str, text: str) -> None:
    """Replace the text between two marks of a page."""
    page = path.read_text(encoding='utf-8')
    page, count = re.subn(
        f'<!-- {mark} -->.*<!-- /{mark} -->',
        lambda match: f'<!-- {mark} -->\n{text}\n<!-- /{mark} -->',
        page,
        flags=re.DOTALL,
    )
    if not count:
        sys.exit(f'{path}: has no place for {mark!r}')
    path.write_text(page, encoding='utf-8')


if __name__ == '__main__':
    main()
