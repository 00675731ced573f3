# SPDX-License-Identifier: Apache-2.0

"""A session from its poses to its file, without ROS."""

from dataclasses import replace

from adxl_ros.calibrate.guided.screen_contents import CaptureSettings, StageMode
from adxl_ros.calibrate.guided.session import GravityError, Session, SessionSettings
from adxl_ros.errors import UserError
from adxl_ros.files import atomic_write, sweep_journal
from adxl_ros.model import signal_chain
from adxl_ros.model.kinematics import specific_force
import numpy as np
import pytest
from units import drawn, nominal, pose_record

UNIT = nominal(serial='S1')
TRUTH = drawn(np.random.default_rng(3), UNIT)


@pytest.fixture
def begin(tmp_path):
    """Give a function that begins or resumes a calibration of 20 poses and 2 check poses."""
    begun = []

    def begin(start_over=False, **changes):
        if begun:
            begun[-1].journal.close()
        capture = CaptureSettings(1.0, 0.0035, 20.0, StageMode.MANUAL)
        settings = replace(
            SessionSettings(
                'stage',
                'full',
                (np.pi / 4, np.pi / 2),
                np.pi / 2,
                float(np.radians(0.1)),
                2,
                capture,
                tmp_path / 'unit.yaml',
                tmp_path / 'journal',
                '',
                '',
            ),
            **changes,
        )
        begun.append(Session(UNIT, settings, start_over))
        return begun[-1]

    yield begin
    begun[-1].journal.close()


def take(session, count, off_v=0.0):
    for _ in range(count):
        guide = session.guide
        target, index = guide.course.target, guide.course.index
        volts = (
            np.column_stack(
                signal_chain.static_response(TRUTH)(
                    specific_force(
                        np.array([target.alpha_rad]), np.array([target.beta_rad]), 9.80665
                    )
                )
            )[0]
            + off_v
        )
        entry = pose_record(
            index,
            alpha_rad=target.alpha_rad,
            beta_rad=target.beta_rad,
            check=target.check,
            start_ns=2 * index,
            stop_ns=2 * index + 1,
            mean_v=tuple(volts.tolist()),
            std_v=(5e-5, 5e-5),
        )
        session.journal.append(entry)
        guide.take(entry)


def poses_on_disk(session):
    return [
        e.pose for e in sweep_journal.accepted_poses(sweep_journal.read(session.journal.path)[1])
    ]


def test_a_pose_to_be_repeated_is_neither_fitted_nor_resumed(begin):
    session = begin()
    take(session, 2)
    take(session, 1, 0.3)
    assert session.guide.redo(session.journal.append) == 'pose 3 will be taken again'
    assert poses_on_disk(session) == [0, 1]
    assert [e.pose for e in session.guide.poses_to_fit()] == [0, 1]
    session = begin()
    assert session.resumed == 2 and poses_on_disk(session) == [0, 1]


def test_a_repeated_finish_keeps_the_previous_calibration(begin, tmp_path, monkeypatch):
    """If the journal does not accept `done`, an equal fit does not replace the file."""
    (tmp_path / 'unit.yaml').write_text('the one before\n')
    session = begin(store=str(tmp_path / 'store'))
    take(session, 12)
    with monkeypatch.context() as patch:
        patch.setattr(session.journal, 'append', _full)
        result = session.finish()
        copy = result.keep(session.settings.store)
        with pytest.raises(UserError, match='unit.yaml is written, but .*make room'):
            session.end()
    again = session.finish()
    assert again.keep(session.settings.store) == copy and copy.startswith('kept as')
    assert (tmp_path / 'unit.yaml.previous').read_text() == 'the one before\n'
    first = (tmp_path / 'unit.yaml').read_text()
    take(session, 1)
    session.finish().keep(session.settings.store)
    assert (tmp_path / 'unit.yaml.previous').read_text() == first
    assert len(list((tmp_path / 'store' / 'S1').iterdir())) == 2


def _full(_):
    raise UserError('journal: cannot write the journal: the disk is full; make room and try again')


def test_incomplete_files_of_a_killed_process_are_removed(begin, tmp_path):
    for name in ('unit.yaml', 'unit.yaml.previous', 'journal.previous'):
        (tmp_path / f'.{name}.abcd1234.part').mkdir()
        (tmp_path / f'.{name}.abcd1234.part' / name).write_text('half')
    for inner in ('report/.report.html', 'store/S1/.S1-2026.yaml'):
        (tmp_path / f'{inner}.abcd1234.part').mkdir(parents=True)
    (tmp_path / '.unit.yaml.mine').mkdir()
    with atomic_write.atomic_path(tmp_path / 'unit.yaml') as fresh:
        begin(report=str(tmp_path / 'report'), store=str(tmp_path / 'store'))
        fresh.write_text('whole')
        assert len(list(tmp_path.rglob('.*.part'))) == 1
    assert (tmp_path / 'unit.yaml').read_text() == 'whole'
    assert {p.name for p in tmp_path.glob('.*')} == {'.unit.yaml.mine'}


@pytest.mark.parametrize('count', [1, 2, 3, 5, 8])
def test_few_poses_are_fitted_or_refused(begin, count):
    session = begin()
    take(session, count)
    session.guide.course.skipped.update(range(count, 20))
    session.guide.go(session.guide.course.index)
    try:
        assert session.finish().fitted.provenance['poses'] == f'{count}'
    except UserError as error:
        assert str(error)


@pytest.mark.parametrize('mode', ['stage', 'gravity'])
def test_a_calibration_resumes_only_with_equal_values_and_settings(begin, mode):
    settings, unit = replace(begin().settings, mode=mode), nominal('xyz')
    changed = [
        (settings, replace(unit, **{name: np.asarray(getattr(unit, name)) * 2}))
        for name in (
            'noise_density_g_per_rthz',
            'rc_capacitance_f',
            'adc_vref_v',
            'range_g',
            'local_gravity_mps2',
            'stage_resolution_rad',
        )
    ]
    names = ['temperature_span_c'] + ['tolerance_rad', 'near_rad'] * (mode == 'stage')
    changed += [
        (replace(settings, capture=replace(settings.capture, **{name: 0.1})), unit)
        for name in names
    ]
    before = settings.head(unit)
    for other, sensor in changed:
        assert len([key for key, value in other.head(sensor).items() if value != before[key]]) == 1


def gravity_session(begin, monkeypatch, factor):
    """Begin a calibration by hand whose first two rests have readings times a factor."""
    unit = nominal('xyz', serial='S1')
    monkeypatch.setattr('test_session.UNIT', unit)
    session = begin(mode='gravity')
    rests = iter(
        [
            pose_record(
                i,
                start_ns=2 * i,
                stop_ns=2 * i + 1,
                std_v=(5e-5,) * 3,
                mean_v=tuple((unit.nominal_zero_g_v + factor * np.array(up)).tolist()),
            )
            for i, up in enumerate(([0, 0, 1.0], [0, 1.0, 0]))
        ]
    )
    monkeypatch.setattr(session.guide, 'accept', lambda: next(rests, None))
    return session


@pytest.mark.parametrize(
    ('factor', 'reason'),
    [(1 / 9.80665, 'as values in g'), (1000.0, 'mm/s²'), (0.0, 'gravity is missing')],
)
def test_the_first_rest_in_another_unit_ends_the_calibration(begin, monkeypatch, factor, reason):
    session = gravity_session(begin, monkeypatch, factor)
    with pytest.raises(GravityError, match=reason):
        list(session.take_poses())
    assert poses_on_disk(session) == []


def test_a_scale_that_is_wrong_by_less_is_a_doubt(begin, monkeypatch):
    assert gravity_session(begin, monkeypatch, 1.0).doubt == ''
    session = gravity_session(begin, monkeypatch, 0.6)
    assert len(list(session.take_poses())) == 2
    assert '5.88 m/s²' in session.doubt
