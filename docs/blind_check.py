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

"""Write the tables of a blind check, blind.json, into docs/blind-check-log.md."""

import json
from pathlib import Path
import re
import sys

from adxl_ros.blind import report_html


def main() -> None:
    """Replace the text between the marks of the run."""
    source, run = sys.argv[1:]
    path = Path(__file__).with_name('blind-check-log.md')
    tables = report_html.markdown(json.loads(Path(source).read_text(encoding='utf-8')))
    text, found = re.subn(f'<!-- {run} -->.*<!-- /{run} -->',
                          lambda match: f'<!-- {run} -->\n{tables}\n<!-- /{run} -->',
                          path.read_text(encoding='utf-8'), flags=re.DOTALL)
    if not found:
        sys.exit(f'{path}: has no place for the run {run!r}')
    path.write_text(text, encoding='utf-8')


main()
