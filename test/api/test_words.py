# SPDX-License-Identifier: Apache-2.0

"""Texts name arguments to who calls verbs, and options to who calls tools, in one way for all."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
import inspect
from multiprocessing import get_context
import pickle
from pkgutil import iter_modules
import re
import subprocess
import sys

import adxl_ros as adxl
from adxl_ros.wording import option, options_named, pasted, usage
from adxl_ros.workers import open_pool
import numpy as np
import pytest

TIME_S = np.arange(3000) / 100.0
RNG = np.random.default_rng(7)
NOISE = RNG.normal(0, 0.02, (3, len(TIME_S)))
LEVEL = dict(zip(('ax_mps2', 'ay_mps2', 'az_mps2'), np.add(NOISE.T, (0.1, 0.2, 9.8)).T))
STILL = adxl.from_arrays(time_s=TIME_S, **LEVEL)
IN_G = adxl.from_arrays(time_s=TIME_S, **{name: each / 9.80665 for name, each in LEVEL.items()})
BURSTS = adxl.from_arrays(
    time_s=np.repeat(TIME_S[::8], 8) + np.tile(np.arange(8) * 1e-5, len(TIME_S) // 8), **LEVEL
)
X_ONLY = adxl.from_arrays(time_s=TIME_S, x_v=2.5 + NOISE[0])
MOTION = 3 * np.sin(1.3 * TIME_S) * np.sin(0.21 * TIME_S)
SIM = adxl.from_arrays(time_s=TIME_S, **{**LEVEL, 'ax_mps2': MOTION})
LATE = adxl.from_arrays(
    time_s=TIME_S, **{**LEVEL, 'ax_mps2': np.interp(TIME_S - 0.3, TIME_S, MOTION) + NOISE[0]}
)
FOREIGN = {'t_ms': 1e3 * TIME_S} | {f'acc{name[1].upper()}': each for name, each in LEVEL.items()}
OF_VERBS: dict[str, tuple[Callable[[], object], str]] = {
    'apply, unit': (lambda: adxl.apply(IN_G), "unit='g'"),
    'apply, inverse': (lambda: adxl.apply(X_ONLY, inverse='paper'), "inverse='paper'"),
    'apply, no inverse': (lambda: adxl.apply(STILL, inverse='no'), "inverse='no'"),
    'check, unit': (lambda: adxl.check(IN_G), "unit='g'"),
    'check, angles': (lambda: adxl.check(STILL), 'give diagnose(sim=)'),
    'check, bursts': (lambda: adxl.check(BURSTS), 'rate='),
    'check, effects': (lambda: adxl.check(adxl.simulate('tilt_both', rate=25)), 'needs sim='),
    'diagnose, angles': (lambda: adxl.diagnose(SIM), 'or sim= with the specific force'),
    'diagnose, align': (lambda: adxl.diagnose(STILL, align=True), 'align=True: shifts sim='),
    'diagnose, both': (lambda: adxl.diagnose(LATE, sim=SIM, urdf='x'), 'sim= or urdf='),
    'diagnose, late': (lambda: adxl.diagnose(LATE, sim=SIM), 'use align=True'),
    'diagnose, quantity': (lambda: adxl.diagnose(LATE, quantity='no'), "quantity='no'"),
    'diagnose, seed': (lambda: adxl.diagnose(LATE, seed=-1), 'seed=-1'),
    'diagnose, self-check': (lambda: adxl.diagnose(LATE, self_check=-1), 'self_check=-1'),
    'fit, poses': (lambda: adxl.fit(STILL), 'fit(poses=)'),
    'fit, model': (lambda: adxl.fit(STILL, model='physical'), 'leave model= out'),
    'fit, rests': (
        lambda: adxl.fit(STILL, means=True, journal='x'),
        'journal=, poses= and means=',
    ),
    'fit, means': (
        lambda: adxl.fit(adxl.from_arrays(LEVEL, rate=1).rows(0, 5)),
        'fit(means=True)',
    ),
    'from_arrays, rate': (lambda: adxl.from_arrays(rate=-1, **LEVEL), 'rate=-1'),
    'from_arrays, stamps': (
        lambda: adxl.from_arrays(time_s=TIME_S[::-1], **LEVEL),
        'drop_bad_stamps=True',
    ),
    'load': (lambda: adxl.load('no_such_sensor'), 'no_such_sensor'),
    'noise': (lambda: adxl.noise(STILL.rows(0, 60)), 'rests for'),
    'read, unit': (lambda: adxl.read(STILL.to_pandas(), unit='no'), "unit='no'"),
    'read, axes': (lambda: adxl.read(STILL.to_pandas(), axes='x=x,y=x,z=z'), "axes='x=x,y=x,z=z'"),
    'read, counts': (lambda: adxl.read(STILL.to_pandas(), lsb_per_g='a'), "lsb_per_g='a'"),
    'read, columns': (lambda: adxl.read(FOREIGN), "columns='time=t_ms:ms"),
    'simulate, force': (lambda: adxl.simulate('imu'), "simulate('imu', force=RECORDING)"),
    'simulate, rate': (lambda: adxl.simulate('rich', rate=1e9), 'rate=1e+09'),
    'simulate, angles': (lambda: adxl.simulate(STILL), "simulate('imu', force='arrays')"),
    'update': (lambda: adxl.update(STILL, 'no_such_file.yaml'), 'no_such_file.yaml'),
}
"""Calls whose error or result advises, and a word of the advice."""

CALL = re.compile(rf'\b({"|".join(filter(str.islower, adxl.__all__))})\(([^()]*)\)')
"""A call of a verb: its name and its arguments."""

ARGUMENT = re.compile(r"(?<!needs)(?:^|[\s,])([a-z_]+)=(?=$|[A-Z\d'\s;:,]|True)")
"""An argument by its name: no role of a mapping, and not what an effect needs of `diagnose`."""


def texts(value: object) -> Iterator[str]:
    """Yield all texts of an object of JSON but command lines."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, each in value.items():
            if key != 'command':
                yield from texts(each)
    elif isinstance(value, list):
        for each in value:
            yield from texts(each)


def words_of(call: Callable[[], object]) -> str:
    """Return the error of a call, or all that its result says."""
    try:
        result: object = call()
    except adxl.UserError as error:
        return str(error)
    return ' '.join([str(result), *texts(result.to_dict())])  # type: ignore[attr-defined]


@pytest.mark.parametrize('name', OF_VERBS)
def test_a_verb_advises_arguments_and_no_options(name: str) -> None:
    call, word = OF_VERBS[name]
    said = words_of(call)
    assert word in said and ' --' not in said and not said.startswith('--'), said
    # Arguments stand in a call of a verb that takes them, or are of this one.
    alone = CALL.sub('', said)
    calls = [(name.partition(',')[0], alone), *CALL.findall(said)]
    for verb, arguments in calls:
        taken = set(inspect.signature(getattr(adxl, verb)).parameters) | {'overwrite'}
        assert set(ARGUMENT.findall(arguments)) <= taken, said


@pytest.mark.parametrize('name', ['ax_mps2', 'ax_g', 'ax', 'accX'])
def test_arrays_in_g_are_read_as_the_message_says(name: str) -> None:
    arrays = {'time_s': TIME_S} | {
        name.replace('x', axis, 1).replace('X', axis.upper()): each / 9.80665
        for axis, each in zip('xyz', LEVEL.values())
    }
    with pytest.raises(adxl.UserError) as error:
        adxl.noise(adxl.from_arrays(**arrays))
    options = dict(re.findall(r"from_arrays\(\.\.\., (\w+)='(.*?)'\)", str(error.value)))
    assert len(options) == 1
    for recording in (adxl.from_arrays(**arrays, **options), adxl.read(arrays, **options)):
        for column, values in LEVEL.items():
            np.testing.assert_allclose(recording.columns[column], values, rtol=1e-12)


def test_every_verb_is_asked() -> None:
    asked = {name.partition(',')[0] for name in OF_VERBS}
    assert {name for name in adxl.__all__ if name.islower()} == asked


@pytest.mark.parametrize(
    'make, of_tool, of_verb',
    [
        (
            partial(option, 'drop_bad_stamps'),
            '--drop-bad-stamps',
            'read or from_arrays(..., drop_bad_stamps=)',
        ),
        (partial(option, align=True), '--align', 'align=True'),
        (partial(option, sensor='a.yaml'), '--params a.yaml', "sensor='a.yaml'"),
        (partial(option, rate='HZ'), '--rate HZ', 'read or from_arrays(..., rate=HZ)'),
        (
            partial(option, unit='lsb', lsb_per_g=64),
            '--unit lsb --lsb-per-g 64',
            "read or from_arrays(..., unit='lsb', lsb_per_g=64)",
        ),
        (partial(option, quantity='tilt'), '--in tilt', "quantity='tilt'"),
        (partial(option, 'certificate'), '--dcc', 'certificate()'),
        (
            partial(pasted, columns='x=a b:g'),
            "--columns 'x=a b:g'",
            "read or from_arrays(..., columns='x=a b:g')",
        ),
        (partial(usage, 'fit', effects=['bias']), 'fit --effect bias', "fit(effects=['bias'])"),
        (
            partial(usage, 'simulate', 'imu', force='a.csv'),
            'simulate imu --force a.csv',
            "simulate('imu', force='a.csv')",
        ),
    ],
)
def test_options_are_those_of_tools_while_one_runs(
    make: Callable[[], str], of_tool: str, of_verb: str
) -> None:
    assert make() == of_verb
    with options_named():
        assert make() == of_tool
        with options_named():
            assert make() == of_tool
        assert make() == of_tool
    assert '--' not in make()


@pytest.mark.parametrize('is_tool', [False, True])
def test_workers_say_what_their_parent_says(is_tool: bool) -> None:
    with options_named() if is_tool else nullcontext(), open_pool(None, 1) as pool:
        assert pool.submit(option, 'sim').result() == ('--sim' if is_tool else 'sim=')


@pytest.mark.parametrize('name', [name for name in adxl.__all__ if name.islower()])
def test_a_verb_is_pickled_by_its_name(name: str) -> None:
    verb = getattr(adxl, name)
    assert pickle.loads(pickle.dumps(verb)) is verb


def test_a_verb_runs_in_another_process() -> None:
    with get_context('spawn').Pool(1) as pool:
        assert str(pool.apply(adxl.simulate, ('tilt_both',), {'rate': 25})).startswith('tilt_both')


PACKAGES = {module.name for module in iter_modules(adxl.__path__)}


@pytest.mark.parametrize('is_verb_first', [True, False])
def test_a_verb_and_the_package_of_its_name_are_both_there(is_verb_first: bool) -> None:
    assert PACKAGES & set(adxl.__all__) == {'diagnose', 'simulate'}
    verb = 'import adxl_ros as adxl; adxl.simulate.__doc__; from adxl_ros import diagnose'
    imports = 'import adxl_ros.diagnose.verdict as v, adxl_ros.simulate.motion as m'
    check = """
import adxl_ros.diagnose, inspect, pydoc
assert pydoc.plaintext.document(diagnose).startswith('adxl_ros.diagnose(recordings')
assert str(diagnose).startswith('<function diagnose')
assert v is adxl_ros.diagnose.verdict is adxl.diagnose.verdict and m.Motion
assert 'recordings' in inspect.signature(diagnose).parameters
assert diagnose.__doc__.split()[0] == 'Find'
try:
    adxl.diagnose([])
except adxl.UserError as error:
    print(error)
"""
    lines = [verb, imports] if is_verb_first else [imports, verb]
    printed = subprocess.run(
        [sys.executable, '-c', '\n'.join([*lines, check])],
        text=True,
        capture_output=True,
        check=True,
    )
    assert printed.stdout.strip() == 'no recording is given'
