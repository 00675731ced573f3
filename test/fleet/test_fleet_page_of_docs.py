# SPDX-License-Identifier: Apache-2.0
"""The page of the fleet in docs/: its questions are those of the table."""

import re

from made_up_fleet import MadeUpFleet
from processes import REPO
import pytest

TEXT = (REPO / 'docs' / 'howto' / 'fleet.md').read_text(encoding='utf-8')


def test_the_questions_in_sql_have_answers(tmp_path):
    """The SQL of the page runs on a table, where DuckDB is installed."""
    duckdb = pytest.importorskip('duckdb', reason='pip install duckdb')
    (tmp_path / 'results').mkdir()
    MadeUpFleet(refused=0.2).write(tmp_path / 'results')
    blocks = re.findall(r'^```sql\n(.*?)^```', TEXT, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 3
    for query in ' '.join(blocks).split(';')[:-1]:
        assert duckdb.sql(query.replace('results/', f'{tmp_path}/results/')).fetchall()
