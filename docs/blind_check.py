# SPDX-License-Identifier: Apache-2.0
"""Write a blind check, blind.json, into docs/blind-check.md and docs/blind-check-log.md."""

import json
from pathlib import Path
import re
import sys

from adxl_ros_validation.blind import report_html


def main() -> None:
    """Replace the result, and the tables of the run in the log; a new run comes last there."""
    source, run = sys.argv[1:]
    made = json.loads(Path(source).read_text(encoding='utf-8'))
    log = Path(__file__).with_name('blind-check-log.md')
    if f'<!-- {run} -->' not in log.read_text(encoding='utf-8'):
        with log.open('a', encoding='utf-8') as stream:
            stream.write(f'\n## {run.capitalize()} run\n\n<!-- {run} -->\n<!-- /{run} -->\n')
    replace(log, run, report_html.markdown(made))
    replace(log.with_name('blind-check.md'), 'result', report_html.markdown_result(made))


def replace(path: Path, mark: str, text: str) -> None:
    """Replace the text between two marks of a page."""
    page = path.read_text(encoding='utf-8')
    page, count = re.subn(f'<!-- {mark} -->.*<!-- /{mark} -->',
                          lambda match: f'<!-- {mark} -->\n{text}\n<!-- /{mark} -->',
                          page, flags=re.DOTALL)
    if not count:
        sys.exit(f'{path}: has no place for {mark!r}')
    path.write_text(page, encoding='utf-8')


main()
