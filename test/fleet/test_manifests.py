# SPDX-License-Identifier: Apache-2.0

"""Manifests: the recordings that they list, and what they state of them."""

import os

from adxl_ros.files.column_mapping import AS_IT_IS
from adxl_ros.fleet.inputs import find_sources
from adxl_ros.fleet.row import make_recipe
from adxl_ros.fleet.task import make_row
from fleets import recording_text
import pytest

pytest.importorskip('fsspec', reason='fsspec is not installed')


def write(path, *lines):
    path.write_text('\n'.join([*lines, '']), encoding='utf-8')
    return str(path)


def rows_of(*inputs):
    """Return the rows of the recordings of a command line by name, after a check."""
    recipe = make_recipe(('check',), None, (), None, AS_IT_IS)
    rows = [make_row(recipe, frozenset(), source, False).row for source in find_sources(inputs)]
    return {row['url'].rpartition('/')[2]: row for row in rows}


def test_a_serial_number_that_contradicts_the_recording_is_refused(tmp_path):
    """A recording that states no unit has that of the manifest, and the other way round."""
    serials = {'other': 'S2', 'same': 'S3', 'silent': 'nominal', 'open': 'S4', 'unsaid': 'S5'}
    for name, serial in serials.items():
        write(tmp_path / f'{name}.csv', *recording_text(serial, '2026-10-01', 1).splitlines())
    rows = rows_of(
        write(
            tmp_path / 'list.csv',
            'url,serial',
            'other.csv,WRONG',
            'same.csv,S3',
            'silent.csv,S6',
            'open.csv,',
            'unsaid.csv,nominal',
        )
    )
    other = rows.pop('other.csv')
    assert (other['outcome'], other['refused_by'], other['serial']) == ('refused', 'read', None)
    assert other['refusal'] == 'states the serial S2, but the manifest says WRONG'
    assert {name: row['serial'] for name, row in rows.items()} == {
        'same.csv': 'S3',
        'silent.csv': 'S6',
        'open.csv': 'S4',
        'unsaid.csv': 'S5',
    }
    assert {row['outcome'] for row in rows.values()} == {'done'}


def test_a_name_that_is_not_utf_8_is_refused_by_its_name(tmp_path):
    name = os.fsdecode(os.fsencode(tmp_path) + b'/b\xe9.csv')
    write(tmp_path / 'a.csv', *recording_text('S1', '2026-10-01', 1).splitlines())
    with open(name, 'w', encoding='utf-8') as file:
        file.write(recording_text('S2', '2026-10-01', 1))
    for inputs in ([str(tmp_path)], [str(tmp_path / 'a.csv'), name]):
        rows = rows_of(*inputs)
        assert rows['a.csv']['refusal'] is None
        assert rows['b\\udce9.csv']['refusal'] == 'its name is not UTF-8; rename it'


def test_hidden_folders_are_not_searched(tmp_path, monkeypatch):
    """One that is named, or lies above the searched folder, is searched."""
    monkeypatch.chdir(tmp_path)
    names = (
        'day/a.csv',
        'day/.ipynb_checkpoints/a-checkpoint.csv',
        'day/.old/bag/metadata.yaml',
        'day/.old/bag/0.mcap',
        'bag/metadata.yaml',
        'bag/.hidden',
        'day/sub/.x/b.csv',
        '.top/c.csv',
    )
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write(tmp_path / name, 'time_s,x_v')

    def found(name):
        return [source.url.removeprefix(f'{tmp_path}/') for source in find_sources([name])]

    assert found('day') == found('day/*') == found('day/**/*.csv') == ['day/a.csv']
    assert found('.top') == found('.top/*') == found('.t*/*.csv') == ['.top/c.csv']
    assert found('day/.old') == ['day/.old/bag']
    # A bag is read as a whole.
    assert find_sources(['bag'])[0].size_bytes == 2 * len('time_s,x_v\n')
