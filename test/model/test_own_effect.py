# SPDX-License-Identifier: Apache-2.0

"""The package of the page about effects of other packages works as documented."""

import json
import os
import re
import subprocess
import sys

from adxl_ros.files import parameter_file, recording
import numpy as np
from processes import REPO, run_executable
import pytest
from units import nominal

PAGE = REPO / 'docs' / 'howto' / 'own_effect.md'


@pytest.mark.long
def test_the_documented_package_works(tmp_path, monkeypatch, run_tool):
    pytest.importorskip('plotly')
    blocks = re.findall(r'`([a-z_.]+)`:\n\n```\w+\n(.*?)```', PAGE.read_text(), re.DOTALL)
    assert {name for name, _ in blocks} == {'pyproject.toml', 'crane_effects.py'}
    package = tmp_path / 'package'
    package.mkdir()
    for name, text in blocks:
        (package / name).write_text(text)
        assert len(text.splitlines()) < 45
    site = tmp_path / 'site'
    done = subprocess.run(
        [
            sys.executable,
            '-m',
            'pip',
            'install',
            '--quiet',
            '--no-deps',
            '--no-index',
            '--no-build-isolation',
            '--target',
            str(site),
            '.',
        ],
        cwd=package,
        text=True,
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr
    monkeypatch.setenv('PYTHONPATH', f'{site}{os.pathsep}{os.environ.get("PYTHONPATH", "")}')
    line = re.search(r'simulate (sweep .*) -o', PAGE.read_text())
    assert line
    effect = line[1].split()[2]
    made = run_executable(
        'simulate', 'tilt_alpha', '--rate', '50', '--effect', effect, '-o', 'a.csv', cwd=tmp_path
    )
    assert made.returncode == 0, made.stderr
    run_tool('simulate', 'tilt_alpha', '--rate', '50', '-o', 'b.csv')
    read = [recording.read(tmp_path / name).columns['x_v'] for name in ('a.csv', 'b.csv')]
    # 2 Ohm · 0.7 mA. The growth with the output averages out over a complete turn.
    assert abs(np.mean(read[0] - read[1]) - 1.4e-3) < 2e-5
    path = tmp_path / 'unit.yaml'
    parameter_file.save(path, nominal('xy'))
    text = path.read_text().rstrip() + (
        '\n    effects: [cable_sag]\n    cable_sag:\n'
        '      resistance_ohm: 2.0\n      current_a: 7.0e-4\n'
        '      growth_per_g: [0.05, 0.05]\n'
    )
    path.write_text(text)
    applied = run_executable('apply', 'a.csv', '--params', path, '-o', 'out.csv', cwd=tmp_path)
    assert applied.returncode == 0, applied.stderr
    run_tool('apply', 'b.csv', '-o', 'bare.csv')
    ax = [
        np.genfromtxt(tmp_path / name, delimiter=',', names=True)['ax_mps2']
        for name in ('out.csv', 'bare.csv')
    ]
    assert abs(np.mean(ax[0] - ax[1])) < 2e-4
    # The diagnosis knows it; what grows so little with the output is a zero-g as well.
    run = run_executable(
        'simulate', 'tilt_both', '--rate', '50', '--effect', effect, '-o', 'c.csv', cwd=tmp_path
    )
    assert run.returncode == 0, run.stderr
    run = run_executable('diagnose', 'c.csv', '-o', 'gap', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    report = json.loads((tmp_path / 'gap' / 'report.json').read_text())
    assert report['verdict']['status'] in ('explained', 'inseparable')
    assert 'cable_sag' in [row['effect'] for row in report['could_show']]
