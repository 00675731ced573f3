# SPDX-License-Identifier: Apache-2.0

"""The table of a fleet: its types and units, and what docs/howto/fleet.md asks of it."""

from datetime import datetime, timezone
import re

from adxl_ros.fleet.row import arrow_schema, as_table, COLUMNS, empty_row
from made_up_fleet import MadeUpFleet
from processes import REPO
import pytest

TEXT = (REPO / 'docs' / 'howto' / 'fleet.md').read_text(encoding='utf-8')


def test_a_row_keeps_every_type():
    pytest.importorskip('pyarrow')
    row = {
        **empty_row(),
        'url': 's3://bucket/a.csv',
        'date': '2026-11-01T10:00:00+01:00',
        'is_sound': True,
        'samples': 3,
        'faults': ['one'],
        'groups': [['a', 'b']],
        'noise_n_x_mps2_per_rthz': 1e-3,
    }
    back = as_table([row, empty_row()]).to_pylist()
    assert back[0] == {**row, 'date': datetime(2026, 11, 1, 9, tzinfo=timezone.utc)}
    assert back[1] == empty_row()


def test_names_are_unique_and_units_stand_in_the_schema():
    pytest.importorskip('pyarrow')
    names = [column.name for column in COLUMNS]
    assert len(set(names)) == len(names)
    assert arrow_schema().field('gap_before_mps2').metadata[b'unit'].decode() == 'm/s²'


def test_the_questions_in_sql_have_answers(tmp_path):
    """The SQL of the page runs on a table, where DuckDB is installed."""
    duckdb = pytest.importorskip('duckdb', reason='pip install duckdb')
    (tmp_path / 'results').mkdir()
    MadeUpFleet(refused=0.2).write(tmp_path / 'results')
    blocks = re.findall(r'^```sql\n(.*?)^```', TEXT, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 3
    for query in ' '.join(blocks).split(';')[:-1]:
        assert duckdb.sql(query.replace('results/', f'{tmp_path}/results/')).fetchall()
