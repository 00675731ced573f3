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
"""The page of the fleet in docs/: its columns and questions are those of the table."""

import re

from adxl_ros.fleet.row import COLUMNS
from made_up_fleet import MadeUpFleet
from processes import REPO
import pytest

TEXT = (REPO / 'docs' / 'fleet.md').read_text(encoding='utf-8')


def test_every_column_is_described():
    described = set(re.findall(r'^\| `(\w+)` \|', TEXT, re.MULTILINE))
    names = {re.sub(r'_[yz](?=_)', '_x', column.name) for column in COLUMNS}
    assert names <= described


def test_the_questions_in_sql_have_answers(tmp_path):
    """The SQL of the page runs on a table, where DuckDB is installed."""
    duckdb = pytest.importorskip('duckdb', reason='pip install duckdb')
    (tmp_path / 'results').mkdir()
    MadeUpFleet(refused=0.2).write(tmp_path / 'results')
    blocks = re.findall(r'^```sql\n(.*?)^```', TEXT, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 3
    for query in ' '.join(blocks).split(';')[:-1]:
        assert duckdb.sql(query.replace('results/', f'{tmp_path}/results/')).fetchall()
