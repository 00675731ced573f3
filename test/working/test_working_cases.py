# SPDX-License-Identifier: Apache-2.0
"""Working cases: every fault acts, a case is drawn again to the bit, and scores count right."""

from adxl_ros.model.effects import library
from adxl_ros_validation import working_cases, working_world as world
from adxl_ros_validation.blind import trials
from adxl_ros_validation.blind.ideal_observer import (
    Bracket,
    bracket,
    IdealObserver,
    rms,
    Told,
    told_apart,
)
from adxl_ros_validation.blind.motion import Manoeuvre
from adxl_ros_validation.blind.simulator import Fault, Scene
from adxl_ros_validation.blind.trials import Label
import numpy as np
import pytest
import scipy


@pytest.fixture(scope='module')
def scene():
    """Return a unit in a manoeuvre that has everything that faults need."""
    rng = np.random.default_rng(4)
    unit = next(
        u for u in iter(lambda: world.draw_unit(rng), None) if u.axes == 'xyz' and u.rate_hz == 100
    )
    return Scene(unit, world.draw_motion(rng, unit, {'heat', 'supply', 'shake', 'fast'}), 3)


@pytest.mark.parametrize('name', world.KINDS)
def test_every_fault_changes_a_recording(name, scene):
    kind = world.KINDS[name]
    assert (name in library()) == (name in world.LISTED)
    shape = {**kind.draw(np.random.default_rng(1), scene.unit)}
    sizes = [
        rms(scene.response([Fault(kind, size, shape)], True))
        for size in (kind.start, min(3 * kind.start, kind.largest))
    ]
    assert np.all(np.isfinite(sizes)) and 1e-5 < sizes[0] < sizes[1]


@pytest.mark.parametrize('share', [world.trapezoidal, world.cycloidal])
def test_moves_reach_their_ends_without_a_jump(share):
    script = Manoeuvre(share=share)
    script.rest(1.0)
    script.go(seconds=2.0, beta=1.0, alpha=0.5)
    script.go(seconds=1.0, beta=-0.5)
    t = np.arange(0, 5, 1e-3)
    joints = script.joints(t)
    assert joints['beta'][[500, 3000, 4500]] == pytest.approx([0.0, 1.0, -0.5])
    assert joints['alpha'][[500, 3500]] == pytest.approx([np.pi / 2, 0.5])
    assert np.abs(np.diff(joints['beta'])).max() < 4e-3


def row(group, effects, status, named=(), probability=0.65, groups=()):
    """Return a case with a report; its effects have 0.03 m/s²."""
    faults = [{'effect': name, 'strength_mps2': 0.03, 'power': 1.0} for name in effects]
    report = {
        'verdict': {
            'status': status,
            'effects': list(named),
            'probability': probability,
            'groups': [list(names) for names in groups],
        },
        'hypotheses': [{'effects': list(named), 'probability': probability}],
        'gap': {},
        'candidates': [],
    }
    return working_cases.Row(
        Label('w', group, tuple(effects), (1, 2), (9.0, 9.0), 'mixed', 'xy', 0.01, faults),
        {'report': report, 'seconds': 2.0, 'cpu_s': 1.0, 'error': ''},
        frozenset({'flicker'}),
        False,
    )


@pytest.mark.parametrize(
    'given, right, in_set',
    [
        (row('single', ['supply'], 'explained', ['supply']), True, True),
        (row('single', ['supply'], 'explained', ['supply', 'flicker']), True, True),
        (row('single', ['supply'], 'inseparable', [], groups=[['supply', 'bias']]), False, True),
        (row('single', ['supply'], 'explained', ['bias']), False, False),
        (row('single', ['supply'], 'no_gap'), False, False),
        (row('outside', ['beat'], 'unknown'), True, True),
        (row('outside', ['beat'], 'partly', ['bias']), True, True),
        (row('none', [], 'explained', ['supply']), False, False),
        (row('none', [], 'explained', ['flicker']), True, True),
    ],
)
def test_exact_and_in_the_set(given, right, in_set):
    assert (working_cases.right(given), working_cases.in_set(given)) == (right, in_set)


def test_the_bounds_of_an_ideal_observer() -> None:
    """Two hypotheses at a distance of 2 are confused with Φ(-1); far rivals do not matter."""
    single = bracket([2.0])
    assert single.low == pytest.approx(single.high) == pytest.approx(0.8413, abs=1e-4)
    several = bracket([2.0, 2.0, 1e2])
    assert several.low == pytest.approx(1 - 2 * 0.1587, abs=1e-3)
    assert several.high == pytest.approx(0.8413, abs=1e-4)
    assert bracket([0.0] * 5) == (0.0, 0.5)


def test_another_form_of_the_truth_is_as_sure_as_it_is_nearer_than_its_rival(scene) -> None:
    """Forms that leave r₀ and rⱼ of the truth are told by (rⱼ² - r₀²) / |rⱼ - r₀|."""
    observer = IdealObserver(scene, {})
    fault = Fault(world.KINDS['bias'], 1.0, {})
    rng = np.random.default_rng(2)
    truth, other, noise = rng.normal(size=(3, *observer.force.shape))
    own, rival = (truth + share * part for share, part in ((0.1, other), (0.5, noise)))
    library = {
        'bias': [observer.span([observer.project(own)])],
        'gravity': [observer.span([observer.project(rival)])],
    }
    change = 3 * truth / np.linalg.norm(observer.project(truth))
    told = told_apart(observer, [fault], [change], library)
    vector = observer.project(change)
    left = [vector - c @ (c.T @ vector) for c in (library['bias'][0], library['gravity'][0])]
    squares = [float(part @ part) for part in left]
    apart = np.linalg.norm(left[1] - left[0])
    expected = scipy.stats.norm.cdf((squares[1] - squares[0]) / apart / 2)
    assert told.exactly.high == pytest.approx(expected)
    assert told.in_set.high > told.exactly.high
    # The truth's own form leaves nothing: half the distance of the rival.
    exact = told_apart(
        observer,
        [fault],
        [change],
        {**library, 'bias': [observer.span([observer.project(truth)])]},
    )
    assert exact.exactly.high == pytest.approx(scipy.stats.norm.cdf(squares[1] ** 0.5 / 2))


@pytest.mark.long
def test_the_limits_of_a_case(tmp_path) -> None:
    """A latency that a healthy unit may have is hardly told from others, but is seen."""
    case = working_cases.draw(7351, 8)
    assert case.label.effects == ('time_offset',)
    trials.save(tmp_path, case.label.name, (case.recording, case.parameters))
    by_world, by_library = working_cases.limits(case, tmp_path)
    assert max(by_world.exactly.high, by_library.exactly.high) < 0.6
    assert by_world.in_set.low > 0.99 > by_library.in_set.low > 0.8


def test_limits_stand_below_their_score():
    told = Told(Bracket(0.7, 0.8), Bracket(0.9, 1.0))
    seen = row('single', ['supply'], 'explained', ['supply'])
    cases = [
        working_cases.Observed('single', seen, working_cases.Limits(told, told)),
        working_cases.Observed('single', None, working_cases.Limits(told, told)),
    ]
    lines = working_cases.table(cases).splitlines()
    exactly = next(i for i, line in enumerate(lines) if line.startswith('single effect, exactly'))
    assert '100 %' in lines[exactly] and 'n = 1' in lines[exactly]
    assert lines[exactly + 1].endswith('forms of the world      70 to 80 %, n = 2')
