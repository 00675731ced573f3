# SPDX-License-Identifier: Apache-2.0

"""No tool replaces a file of others in silence."""

import pytest

COMMANDS = {
    'simulate': (['simulate', 'tumble', '--rate', '20', '-o', 'out.csv'], 'out.csv'),
    'apply': (['apply', 'sweep.csv', '-o', 'out.csv'], 'out.csv'),
    'fit': (['fit', 'sweep.csv', '--store', '', '-o', 'out.yaml'], 'out.yaml'),
    'noise': (['noise', 'sweep.csv', '--report', 'noise'], 'noise/allan.png'),
    'export': (['export', 'params.yaml', '--to', 'mujoco', '-o', 'out.xml'], 'out.xml'),
    'check': (['check', 'sweep.csv', '--report', 'page'], 'page/check.html'),
    'diagnose': (['diagnose', 'sweep.csv', '-o', 'gap'], 'gap/report.json'),
    'fleet': (['fleet', 'sweep.csv', '-o', 'fleet'], 'fleet/fleet.html'),
}
"""Command and one of its files by tool."""


@pytest.mark.parametrize('tool', COMMANDS)
def test_a_file_of_others_is_kept(run_tool, tmp_path, tool) -> None:
    command, output = COMMANDS[tool]
    (tmp_path / output).parent.mkdir(exist_ok=True)
    (tmp_path / output).write_text('precious')
    done = run_tool(*command)
    assert done.returncode == 1, done.stdout
    assert f'{output}: is there already' in done.stderr and '--overwrite' in done.stderr
    assert (tmp_path / output).read_text() == 'precious'


def test_the_option_replaces_it_and_an_own_file_needs_none(run_tool, tmp_path) -> None:
    (tmp_path / 'out.csv').write_text('precious')
    command = COMMANDS['simulate'][0]
    assert run_tool(*command, '--overwrite').returncode == 0
    assert run_tool(*command).returncode == 0
