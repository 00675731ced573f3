# SPDX-License-Identifier: Apache-2.0

"""No save of a result replaces what others wrote, without permission."""

from pathlib import Path

import adxl_ros as adxl
import numpy as np
import pytest

TIME_S = np.arange(2000) / 100.0
RNG = np.random.default_rng(3)
RECORDING = adxl.from_arrays(
    time_s=TIME_S,
    **{
        f'a{axis}_mps2': level + RNG.normal(0, 0.02, len(TIME_S))
        for axis, level in zip('xyz', (0.1, 0.2, 9.8))
    },
)
SAVES = {
    'recording': (lambda: RECORDING.save, 'log.csv', 'log.csv'),
    'corrected': (lambda: adxl.apply(RECORDING).save, 'tilt.csv', 'tilt.csv'),
    'noise': (lambda: adxl.noise(RECORDING).save, 'noise.yaml', 'noise.yaml'),
    'curve': (lambda: adxl.noise(RECORDING).report, 'noise', 'noise/allan.png'),
    'check': (lambda: adxl.check(RECORDING).save, 'page', 'page/check.html'),
}
"""Save of each result, the path that it takes, and a file that it writes."""


@pytest.mark.parametrize('kind', SAVES)
def test_a_file_of_others_is_kept_until_its_user_permits(kind: str, tmp_path: Path) -> None:
    make, path, file = SAVES[kind]
    save, users = make(), tmp_path / file
    users.parent.mkdir(exist_ok=True)
    users.write_text('precious')
    with pytest.raises(adxl.UserError, match='overwrite=True'):
        save(tmp_path / path)
    assert users.read_text() == 'precious'
    save(tmp_path / path, overwrite=True)
    assert users.read_bytes() != b'precious'


def test_a_page_of_python_shows_no_command(tmp_path: Path) -> None:
    page = adxl.check(RECORDING).save(tmp_path).read_text()
    assert 'Check of recordings' in page and 'class="command"' not in page


@pytest.mark.parametrize('may_overwrite', [False, True])
@pytest.mark.parametrize('kind', ['recording', 'corrected'])
def test_a_folder_of_others_stays_with_all_that_is_in_it(
    kind: str, may_overwrite: bool, tmp_path: Path
) -> None:
    users = tmp_path / 'project'
    (users / 'src').mkdir(parents=True)
    (users / 'src' / 'main.py').write_text('precious')
    with pytest.raises(adxl.UserError, match='project: is'):
        SAVES[kind][0]()(users, overwrite=may_overwrite)
    assert (users / 'src' / 'main.py').read_text() == 'precious'


def test_an_empty_folder_becomes_the_bag_and_its_own_is_replaced(tmp_path: Path) -> None:
    (tmp_path / 'run').mkdir()
    for may_overwrite in (False, True):
        RECORDING.save(tmp_path / 'run', overwrite=may_overwrite)
    assert len(adxl.read(tmp_path / 'run')) == len(RECORDING)


@pytest.mark.parametrize('name', ['log.npz', 'log.parquet', 'log.db3', 'LOG.CSV', 'log.xlsx'])
@pytest.mark.parametrize('kind', ['recording', 'corrected'])
def test_no_folder_gets_the_name_of_a_file(kind: str, name: str, tmp_path: Path) -> None:
    with pytest.raises(adxl.UserError, match=r'NAME\.csv'):
        SAVES[kind][0]()(tmp_path / name)
    assert not any(tmp_path.iterdir())
