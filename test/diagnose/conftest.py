# SPDX-License-Identifier: Apache-2.0

"""A diagnosis that several modules share."""

from processes import run_executable
import pytest


@pytest.fixture
def two_effects(made_once):
    """Return a folder with a recording of two effects, its diagnosis, and one of swapped axes."""
    return made_once('two_effects', diagnose_two_effects)


def diagnose_two_effects(folder):
    def call(name, *arguments, status=0):
        done = run_executable(name, *arguments, cwd=folder)
        assert done.returncode == status, done.stderr
        return done.stdout

    call(
        'simulate',
        'rich',
        '--rate',
        '62.5',
        '--effect',
        'lever_arm:x_m=0.03,y_m=0.02',
        '--effect',
        'temperature_bias:per_k=4e-4',
        '-o',
        'run.csv',
    )
    screen = call('diagnose', 'run.csv', '-o', 'gap', '--self-check', '1', '--limit')
    (folder / 'screen.txt').write_text(screen)
    text = (folder / 'run.csv').read_text()
    swapped = text.replace(',x_v,y_v,', ',y_v,x_v,')
    assert swapped != text
    (folder / 'swapped.csv').write_text(swapped)
    call('diagnose', 'swapped.csv', '-o', 'fault', status=1)
