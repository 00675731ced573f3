# SPDX-License-Identifier: Apache-2.0
"""`blind` on small checks, with diagnoses that cheat or name no effect."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
import json
import shutil
import sys

from adxl_ros.workers import open_pool, Pool
from adxl_ros_validation.blind import (
    diagnosis_runs,
    faults,
    grading,
    ideal_observer,
    motion,
    report,
    scores,
    simulator,
    trials,
)
from adxl_ros_validation.blind.trials import Label, plans
import numpy as np
import pytest

pytestmark = pytest.mark.long

SEED, TRIALS, SECONDS = 5, 20, (20.0, 24.0)
# A diagnosis as a script: `answer(recording, parameters)` returns status and hypotheses.
SCRIPT = """
import json, os, sys
from pathlib import Path
{body}
recording, parameters, out = sys.argv[1], sys.argv[3], Path(sys.argv[5])
status, hypotheses = answer(Path(recording), Path(parameters))
best = max(hypotheses, key=lambda hypothesis: hypothesis[1])
out.mkdir()
(out / 'report.json').write_text(json.dumps({{
    'verdict': {{'status': status, 'effects': [] if 'unknown' in best[0] else best[0],
                'groups': [], 'probability': best[1]}},
    'hypotheses': [{{'effects': e, 'probability': p}} for e, p in hypotheses],
    'gap': {{'closed': None, 'before': 0.01}}, 'candidates': []}}))
"""
NOTHING = "def answer(recording, parameters): return 'no_gap', [[[], 0.9], [['bias'], 0.1]]"
# Searches labels near its files, in its arguments and environment, and in a given folder.
CHEAT = """
def answer(recording, parameters):
    places = [Path.cwd(), *Path.cwd().resolve().parents[:-2], Path({folder!r})]
    places += [Path(word).resolve().parent for word in sys.argv[1:]]
    places += [Path(word) for value in os.environ.values() for word in value.split(':')
               if 'label' in word or 'blind' in word]
    for place in places:
        for path in place.rglob('*label*'):
            for file in ([path] if path.is_file() else path.rglob('*')):
                try:
                    rows = json.loads(file.read_bytes())['labels']
                except (OSError, ValueError, KeyError, TypeError):
                    continue
                for row in rows:
                    if row['name'] == recording.stem and row['effects']:
                        return 'explained', [[row['effects'], 1.0]]
    return 'no_gap', [[[], 1.0]]
"""


def short_plans(seed, count):
    return plans(seed, count, SECONDS)


@contextmanager
def show(stage):
    yield lambda fraction: None


def scored(folder, body, pool):
    path = folder.parent / 'diagnosis.py'
    path.write_text(SCRIPT.format(body=body))
    real = diagnosis_runs.executable
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            diagnosis_runs,
            'executable',
            lambda name: [sys.executable, str(path)] if name == 'diagnose' else real(name),
        )
        return diagnosis_runs.score(folder, pool, show)


class Threads(Pool, ThreadPoolExecutor):
    """Threads, which see what a test replaces."""

    slots = 2


@pytest.fixture(scope='module')
def pool():
    with Threads(2) as pool:
        yield pool


@pytest.fixture(scope='module')
def committed_check(tmp_path_factory):
    folder = tmp_path_factory.mktemp('check') / 'blind'
    with open_pool(None) as pool:
        trials.seal(folder, short_plans, trials.draw_trial, SEED, TRIALS, pool, show)
    return folder


@pytest.fixture(scope='module')
def null_check(committed_check, tmp_path_factory, pool):
    """Score a diagnosis that names no effect, once for all tests that use it."""
    folder = tmp_path_factory.mktemp('nothing')
    shutil.copytree(committed_check, folder / 'blind')
    return folder / 'blind', scored(folder / 'blind', NOTHING, pool)


def copied(committed_check, null_check, folder):
    """Copy the committed check with its held-out simulations, which the tests do not change."""
    shutil.copytree(committed_check, folder / 'blind')
    shutil.copytree(null_check[0] / 'labels' / 'held', folder / 'blind' / 'labels' / 'held')
    return folder / 'blind'


def test_only_the_label_file_contains_labels(committed_check):
    names = sorted(path.name for path in (committed_check / 'recordings').iterdir())
    count = TRIALS + 2
    assert names == sorted(
        f'r{i:04d}.{suffix}' for i in range(count) for suffix in ('csv', 'yaml')
    )
    assert {path.stat().st_mtime for path in (committed_check / 'recordings').iterdir()} == {0}
    effects = [
        name.encode()
        for name in faults.KINDS
        if name not in ('bias', 'gravity', 'scale_factor', 'supply')
    ]
    assert [path.name for path in (committed_check / 'labels').iterdir()] == ['labels.json']
    for path in committed_check.rglob('*'):
        if path.name == 'labels.json':
            continue
        data = path.read_bytes() if path.is_file() else b''
        assert [name for name in effects if name in data] == [], path
        assert b'"seed"' not in data, path


def test_scores_of_a_diagnosis_without_effects(null_check):
    made = null_check[1]
    assert made['scores']['false_alarms']['value'] == 0
    for score in ('top_1', 'set_recall', 'unknown_recall_all', 'harm'):
        assert made['scores'][score]['value'] == 0
    assert made['scores']['closed']['value'] == 0
    assert not made['leaks']
    groups = [row['group'] for row in made['rows']]
    assert [groups.count(name) for name in ('none', 'pair', 'outside', 'single', 'zero')] == [
        5,
        4,
        4,
        7,
        2,
    ]


def test_a_diagnosis_cannot_reach_the_labels(committed_check, null_check, tmp_path, pool):
    folder = copied(committed_check, null_check, tmp_path)
    blindfolded = scored(folder, CHEAT.format(folder='.'), pool)
    assert not any(row['named'] for row in blindfolded['rows'])
    # The same diagnosis names the labels if it has the folder.
    shutil.rmtree(folder / 'reports')
    opened = scored(folder, CHEAT.format(folder=str(folder)), pool)
    assert all(
        sorted(row['named']) == sorted(row['effects'])
        for row in opened['rows']
        if row['group'] != 'zero'
    )


def test_a_failed_diagnosis_is_counted(monkeypatch):
    monkeypatch.setattr(
        diagnosis_runs,
        'executable',
        lambda name: [sys.executable, '-c', 'import sys; sys.exit("no such thing")'],
    )
    result = diagnosis_runs.diagnose('r0', b'time_s,x_v\n', b'')[1]
    given = grading.answer(result)
    assert (given.status, given.gap, result['error']) == ('failed', False, 'no such thing')
    for given in ({}, {'verdict': None}, {'verdict': {'status': 'explained'}}, []):
        assert grading.answer({'report': given, 'seconds': 1.0}).status == 'failed'


def padded(label, recording):
    """Make a recording longer if its label has an effect, even at strength zero."""
    return '# ' + 'x' * 5000 + '\n' + recording if label.effects else recording


PADDED = """
def answer(recording, parameters):
    found = recording.read_text().startswith('#')
    return ('explained', [[['bias'], 1.0]]) if found else ('no_gap', [[[], 1.0]])
"""


def test_a_generator_that_leaks_labels_is_detected(null_check, tmp_path, pool):
    """The length of the recordings reveals which trials have an effect."""
    folder, labels = tmp_path / 'blind', trials.committed_labels(null_check[0])[1]
    recordings = null_check[0] / 'recordings'

    def leaking(plan):
        label = next(label for label in labels if label.name == plan.name)
        text, parameters = (
            (recordings / f'{plan.name}.{suffix}').read_text() for suffix in ('csv', 'yaml')
        )
        return trials.Drawn(label, padded(label, text), parameters)

    trials.seal(folder, short_plans, leaking, SEED, TRIALS, pool, show)
    shutil.copytree(null_check[0] / 'labels' / 'held', folder / 'labels' / 'held')
    made = scored(folder, PADDED, pool)
    assert made['controls']['metadata_only']['leaks'] and made['leaks']
    said = report.of_simulated(made)
    assert 'LEAKS' in ''.join(said.screen()) and 'LEAKS' in said.markdown()


def drawn_labels():
    """Return labels of the usual mix, without their recordings."""
    common = {'manoeuvre': 'rich', 'axes': 'xyz', 'floor_mps2': 0.01}
    rows = []
    for plan in plans(1, 60):
        faults = [
            {
                'effect': name,
                'size': 1.0,
                'shape': {'w': [0.0] * 6, 'hertz': 9.0},
                'strength_mps2': 0.01 * (i + 1),
                'power': 1.0,
                'told': 1.0,
                'inseparable': [],
            }
            for i, name in enumerate(plan.effects)
        ]
        rows.append(
            Label(
                plan.name,
                plan.group,
                plan.effects,
                plan.seed,
                plan.seconds,
                **common,
                faults=faults,
                flexible=1.0,
            )
        )
    return rows


def answered(label, wrong=False):
    """Return the right answer, or an answer with effects that the trial does not have."""
    effects = frozenset({'bias', 'gravity'}) if wrong else grading.truth(label)
    status = 'no_gap' if not effects else 'unknown' if 'unknown' in effects else 'explained'
    return grading.Answer(
        status, effects, (), 0.95, ((effects, 0.95), (frozenset({'x'}), 0.05)), {}, 1.0
    )


def test_perfect_and_wrong_answers():
    labels = drawn_labels()
    right = scores.scores([scores.Trial(label, answered(label), None) for label in labels])
    for name in ('top_1', 'set_recall', 'unknown_recall', 'verdict_right'):
        assert right[name]['value'] == 1
    assert right['false_alarms']['value'] == right['harm']['value'] == 0
    assert right['calibration_error']['value'] == pytest.approx(0.05)
    assert right['brier']['value'] == pytest.approx(2 * 0.05**2)
    assert right['pairs']['whole']['value'] == 1
    assert 'NO' not in [row['met'] for row in scores.bars(right)]
    wrong = scores.scores([scores.Trial(label, answered(label, True), None) for label in labels])
    assert wrong['false_alarms']['value'] == 1 and wrong['top_1']['value'] == 0
    assert {row['name'] for row in scores.bars(wrong) if row['met'] != 'NO'} == {
        'harm',
        'coverage',
        'closed_by_oracle',
        'limit_held',
    }


@pytest.mark.parametrize('name', faults.KINDS)
def test_every_fault_changes_a_recording(name):
    """The change grows with the size."""
    scene = simulator.Scene(
        simulator.draw_unit(np.random.default_rng(0)),
        motion.draw(np.random.default_rng(2), (60.0, 62.0), 125.0, 'rich'),
        1,
    )
    kind = faults.KINDS[name]
    shape = kind.draw(np.random.default_rng(1), scene.unit)

    def size(times):
        return ideal_observer.rms(
            scene.response([simulator.Fault(kind, times * kind.start, shape)], True)
        )

    assert 0 < size(1.0) < size(2.0) < np.inf


def test_the_command_commits_and_scores(run_tool, tmp_path, monkeypatch):
    monkeypatch.setattr(trials, 'plans', partial(plans, seconds=(40.0, 42.0)))
    sealed = run_tool('blind', '--seal', 'dir', '--trials', 1, '--seed', 156)
    assert sealed.returncode == 0, sealed.stderr
    digest = json.loads((tmp_path / 'dir' / 'seal.json').read_text())['sha256_of_salt_and_labels']
    assert digest in sealed.stdout
    assert not list((tmp_path / 'dir').glob('blind.*'))
    opened = run_tool('blind', '--open', 'dir')
    assert opened.returncode == 0, opened.stderr
    made = json.loads((tmp_path / 'dir' / 'blind.json').read_text())
    assert (made['hash'], made['seed'], made['trials'], made['cases']) == (digest, 156, 1, 2)
    assert made['failed'] == {}
    for name in ('blind.html', 'blind.md'):
        assert digest in (tmp_path / 'dir' / name).read_text()


@pytest.mark.parametrize(
    'words, status, says',
    [
        (['--trials', 3], 2, 'required'),
        (['-o', 'a', '--open', 'b'], 2, 'not allowed'),
        (['--trials', 0, '-o', 'a'], 1, 'at least 1'),
        (['--open', 'none'], 1, '--seal none'),
        (['-o', 'a', '--real', 'x'], 1, 'x: no such folder'),
    ],
)
def test_wrong_usage(run_tool, tmp_path, words, status, says):
    failed = run_tool('blind', *words)
    assert failed.returncode == status and says in failed.stderr
    assert 'Traceback' not in failed.stderr
