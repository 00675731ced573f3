# SPDX-License-Identifier: Apache-2.0

"""
Write docs/reference from the package: tools, nodes, effects, files and the library.

    make reference                     every page
    docs/reference.py FOLDER           the same into another folder, for the test that compares
"""

from collections.abc import Iterable, Iterator
import dataclasses
import enum
from functools import cache
import html
import importlib
from importlib.metadata import entry_points
import inspect
import json
import math
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
import textwrap
from typing import Any

import adxl_ros
from adxl_ros.diagnose.data_faults import DATA_FAULTS
from adxl_ros.files import parameter_file
from adxl_ros.files.column_mapping import UNITS
from adxl_ros.fleet.row import COLUMNS
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
from adxl_ros_validation.blind import scores

DOCS = Path(__file__).resolve().parent
MADE = '<!-- Made by `make reference`: change the package, not this page. -->'
TOOLS = sorted(
    {
        point.name
        for point in entry_points(group='console_scripts')
        if point.module.startswith(('adxl_ros.tools.', 'adxl_ros_validation.'))
    }
    - {'bench'}
)
NODES = (
    'driver',
    'compensation',
    'calibration',
    'keep_calibrated',
    'stage',
    'monitor',
    'investigate',
    'screen',
)
PICTURED = {
    'stuck': '`rate_hz` = 1, `duration_s` = 0.2',
    'saturation': '`limit_g` = 0.9',
    'clock_skew': '`ratio` = 0.001',
    'mount_resonance': '`frequency_hz` = 25',
}
"""Values of parameters in the pictures, where the typical one would not show."""
SERVED = 'compensation, calibration, keep_calibrated, monitor, investigate'
TOPICS = [
    (
        'imu/data_raw',
        'sensor_msgs/Imu',
        'samples by the nominal conversion, m/s²; an absent axis has variance 1e6',
        'driver',
        SERVED,
    ),
    (
        'imu/data',
        'sensor_msgs/Imu',
        'corrected specific force, m/s², and orientation, with covariance',
        'compensation',
        'you',
    ),
    (
        'tilt',
        'geometry_msgs/Vector3Stamped',
        'roll, pitch, inclination, rad: three angles, which tf2 must not turn',
        'compensation',
        'you',
    ),
    (
        'imu/linear_acceleration_free',
        'geometry_msgs/Vector3Stamped',
        'without gravity, m/s²; only with `free_acceleration`',
        'compensation',
        'you',
    ),
    (
        'sensor_info',
        'diagnostic_msgs/DiagnosticStatus',
        'serial, axes, nominal zero-g and scale factor, rate, format; latched',
        'driver',
        SERVED,
    ),
    (
        'temperature',
        'sensor_msgs/Temperature',
        'temperature of the sensor, °C, where the link measures it',
        'driver',
        SERVED,
    ),
    (
        'supply',
        'sensor_msgs/BatteryState',
        'supply voltage, V, where the link measures it',
        'driver',
        SERVED,
    ),
    (
        'stage/command',
        'sensor_msgs/JointState',
        'where the stage shall go: names alpha and beta, rad, with the largest speed',
        'calibration, investigate',
        'calibration, stage, investigate',
    ),
    (
        'stage/joint_states',
        'sensor_msgs/JointState',
        'what the encoders show: alpha, beta, rad, and shift, m',
        'stage, driver',
        'calibration, monitor, investigate',
    ),
    (
        'stage/true_joint_states',
        'sensor_msgs/JointState',
        'true position of the simulated stage, for the simulated sensor',
        'stage',
        'driver',
    ),
    (
        'calibration/next_pose',
        'diagnostic_msgs/DiagnosticStatus',
        'the next pose in words and numbers; latched',
        'calibration',
        'you',
    ),
    (
        'calibration/display',
        'std_msgs/String',
        'what the screen shows, as JSON; latched',
        'calibration',
        'screen',
    ),
    (
        'gap',
        'diagnostic_msgs/DiagnosticArray',
        'gap, noise floor and changes, mg; once a second',
        'monitor',
        'you',
    ),
    (
        'diagnostics',
        'diagnostic_msgs/DiagnosticArray',
        'state of each node, once a second; that of the driver at each change of level, too',
        'driver, compensation, calibration, keep_calibrated, stage, monitor, investigate',
        'you',
    ),
    (
        'imu/ideal',
        'sensor_msgs/Imu',
        'ideal samples of your simulator, for the link `topic`',
        'you',
        'driver',
    ),
]
"""Topics: name, type, content, from, to."""
SERVICES = {
    'calibration': 'start, resume, start_over, capture, redo, skip, finish, abort',
    'driver': 'self_test',
    'compensation': 'level',
    'keep_calibrated': 'undo',
    'monitor': 'diagnose',
    'investigate': 'abort',
}
"""Services (std_srvs/Trigger) by node."""
VERBS = (
    'read',
    'from_arrays',
    'load',
    'fit',
    'update',
    'apply',
    'diagnose',
    'check',
    'noise',
    'simulate',
)
"""The verbs of the front door, in the order of the page."""
RESULTS = (
    'adxl_ros.files.recording_columns:Recording',
    'adxl_ros.model.sensor:Sensor',
    'adxl_ros.api.calibration:Fit',
    'adxl_ros.api.updating:Update',
    'adxl_ros.api.correction:Corrected',
    'adxl_ros.api.gap:Gap',
    'adxl_ros.api.checking:Check',
    'adxl_ros.api.noise:Noise',
    'adxl_ros.api.result:FirstScreen',
    'adxl_ros.report.screen:NextStep',
    'adxl_ros.api.sensors:HasSensor',
)
"""What the verbs take and return; the types of their fields follow each."""
READ_FIRST = (
    (
        '`read`, `from_arrays`, `simulate`',
        'Recording',
        '`time_s`, `columns`, `notes`',
    ),
    ('`load`', 'Sensor', '`nominal_zero_g_v`, `nominal_scale_v_per_g`, `values`'),
    ('`fit`', 'Fit', '`outcome`, `coefficients`, `sensor`, `save`'),
    ('`update`', 'Update', '`outcome`, `sensor`, `save`'),
    ('`apply`', 'Corrected', '`force_mps2`, `force_std_mps2`, `columns`, `save`'),
    ('`diagnose`', 'Gap', '`verdict`, `effects`, `figures`, `sensor`, `save`'),
    ('`check`', 'Check', '`is_sound`, `faults`, `failures`'),
    ('`noise`', 'Noise', '`axes`, `tau_s`, `allan_deviation_mps2`, `save`'),
)
"""What each verb returns, and what people read of it first."""
STEPS = ('result', 'diagnosis', 'parts')
"""Fields whose types are no part of the interface: steps of the work."""
INPUTS = (
    'adxl_ros.api.recordings:RecordingInput',
    'adxl_ros.api.sensors:SensorInput',
    'adxl_ros.api.sensors:AddedEffects',
    'adxl_ros.api.recordings:Counts',
    'adxl_ros.api.result:Progress',
)
"""Types of arguments."""
USAGE = """\
import adxl_ros as adxl
recording = adxl.from_arrays(time_s=t, x_v=x, y_v=y, alpha_rad=alpha, beta_rad=beta)
fit = adxl.fit(recording, 'adxl203')                  # print(fit); fit.save('unit.yaml')
corrected = adxl.apply(recording, fit)                # corrected.force_mps2, .to_pandas()
gap = adxl.diagnose(recording, fit)                   # gap.verdict, gap.effects; gap.save('gap')
checked = adxl.check(recording)                       # checked.is_sound, checked.faults
checked = adxl.check(recording, against=earlier)      # checked.failures(): what became worse
noise = adxl.noise(still)                             # noise.axes[0].fit.white.value, m/s²/√Hz
updated = adxl.update([day_1, day_2], 'unit.yaml')    # updated.outcome; updated.save('new.yaml')
made = adxl.simulate('rich', fit, effects=['lever_arm'])  # made.columns['x_v'], V; made.save(...)
readings_mps2 = adxl.SensorModel(fit, seed=1)(force_mps2, dt_s)  # (n, 3), in a simulator's loop
"""
"""The way from arrays to a diagnosis, and the other verbs."""
LIBRARY = (
    'adxl_ros.simulate.sensor_model:SensorModel',
    'adxl_ros.simulate.motion:Motion',
    'adxl_ros.model.effects.base:Effect',
    'adxl_ros.model.effects.base:Parameter',
    'adxl_ros.links.support.base:Link',
)
"""The import paths that stay."""
REPORT = {
    'schema': 'version of the format: 1',
    'summary': 'the sentence of terminal and page',
    'verdict.status': 'no_gap, explained, partly, inseparable, unknown, insufficient or bad_data',
    'verdict.effects': 'effects that are named for certain; empty for no_gap and unknown',
    'verdict.groups': 'sets of effects; in each, the data cannot choose one',
    'verdict.of': 'what they are errors of: sensor, stage, reference; joined by "and", "or"',
    'verdict.data_fault': 'with bad_data its fault, one of those below; else null',
    'verdict.probability': 'how often such verdicts were right in other cases',
    'verdict.repeated': 'share of draws of the blocks that name the same',
    'verdict.surest': 'with `--limit` how often an ideal observer is right, at least and at most',
    'hypotheses': 'sets with probabilities that sum to 1; `[]` is no gap; `["unknown"]`',
    'gap': 'rms of recording minus simulation over samples and axes; null for bad_data',
    'gap.before': 'before any effect is added; `before_ci` is its 90 % interval',
    'gap.after': 'with the named effects, on blocks that were not fitted; `after_ci`',
    'gap.floor': 'noise, which no model predicts; `floor_ci`',
    'gap.floor_source': 'still, repeats or assumed',
    'gap.upper_limit': 'amplitude above which a gap of any kind would have shown',
    'gap.tolerated': 'part of that within the tolerances of zero-g, scale factor, filter, latency',
    'gap.reference': 'rms error of the reference that returns with each pose',
    'gap.closed': '(before² − after²)/(before² − floor²), held out; `closed_ci`',
    'gap.not_in_reference': 'rms of motion that a smooth reference lacks',
    'gap.noise': 'by recording: spectrum and Allan deviation of what is left, over the noise',
    'explained': 'by how much the named effects lower the held-out mean square',
    'rest': 'by how much flexible functions lower it further',
    'rest_follows': 'what that rest follows, the strongest first',
    'material': 'amplitude that counts as a gap, m/s²',
    'lost_without': 'by effect: what of `explained` is lost without it',
    'where': 'cells of the residual that noise does not explain, with share of the gap and p',
    'not_covered': 'what the recordings do not vary',
    'notes': 'what was left out or corrected',
    'could_show': 'by effect: the smallest size that would have shown; null where none',
    'candidates': 'by effect: probability, closed share, visibility, rivals, parameters',
    'candidates.parameters': 'value, 90 % interval, unit; null and not `determined` if not seen',
    'noise_remainders': 'by noise-like effect: a statistic recorded, simulated and left',
    'next_experiment': 'manoeuvre, why and command of what to record next; or null',
}
"""Meaning of the keys of report.json; those that are not listed stand within one that is."""


def main(target: Path) -> None:
    """Write every page that is made; the other pages of the folder are by hand."""
    target.mkdir(parents=True, exist_ok=True)
    pages = {
        'tools': tools,
        'nodes': nodes,
        'effects': effects,
        'parameter_file': file_keys,
        'sensors': sensors,
        'report_json': report_keys,
        'fleet_columns': fleet_columns,
        'library': documented_classes,
    }
    for name, make in pages.items():
        text = '\n'.join([*make()])
        text = re.sub(r'\n{3,}', '\n\n', text).strip()
        title, _, body = text.partition('\n')
        (target / f'{name}.md').write_text(f'{title}\n\n{MADE}\n{body}\n', 'utf-8')


@cache
def helps() -> dict[str, str]:
    """Return the help of each executable, which does not depend on the home of its user."""
    home = Path('/tmp/adxl_ros_reference')
    home.mkdir(exist_ok=True)
    environment = {key: value for key, value in os.environ.items() if key != 'ROS_HOME'}
    made = subprocess.run(
        [sys.executable, DOCS / 'helps.py', *TOOLS, *NODES],
        text=True,
        capture_output=True,
        stdin=subprocess.DEVNULL,
        env={**environment, 'HOME': str(home), 'COLUMNS': '80'},
    )
    if made.returncode:
        sys.exit(f'--help: {made.stderr}')
    return json.loads(made.stdout.replace(str(home), '~'))


def without(text: str, *begins: str) -> str:
    """Leave out the paragraphs that begin with one of some lines, to the next title."""
    kept, leaves_out = [], False
    for line in text.splitlines():
        if line and not line.startswith(' '):
            leaves_out = line.startswith(begins)
        if not leaves_out:
            kept.append(line)
    return '\n'.join(kept)


def block(text: str, language: str = 'text') -> list[str]:
    """Return a text as a block of a page."""
    return ['', f'```{language}', text.strip('\n'), '```', '']


def table(head: str, rows: Iterable[Iterable[object]]) -> list[str]:
    """Return a table with a line for each row; bars in cells are escaped."""
    lines = [
        '| ' + ' | '.join(str(cell).replace('|', '\\|') for cell in row) + ' |' for row in rows
    ]
    return ['', f'| {head} |', '|' + '---|' * (head.count('|') + 1), *lines, '']


def tools() -> Iterator[str]:
    """Describe the command-line tools by their own help."""
    yield from [
        '# Tools',
        '',
        'What `ros2 run adxl_ros NAME --help` prints. After `make build`, '
        '`./run NAME` does the same. The exit status is 0 when it is done. It is 1 where '
        'the tool ran but could not do the task: one line on stderr names file, line and '
        'column or the topic. It is 2 after wrong usage. A failed run leaves no half '
        'written file and does not damage an earlier one.',
        '',
    ]
    shared = ''
    for name in TOOLS:
        text = helps()[name]
        found = re.search(r'\n(recordings of other software:\n.*?)(?=\n\S|\Z)', text, re.DOTALL)
        shared = shared or (found[1] if found else '')
        yield from [f'## {name}', *block(without(text, 'recordings of other', 'effects:')), '']
    yield from [
        '## Recordings of other software',
        '',
        'Tools that read recordings share these '
        'options. [Read any log](../howto/logs.md) explains them.',
        *block(shared),
    ]


def nodes() -> Iterator[str]:
    """Describe topics and services, and nodes by their own help."""
    yield from [
        '# Nodes',
        '',
        'Topics with both ends, then each node as its `--help` states it. '
        'Names without a leading `/` are in the '
        'namespace of the node. Publishers are reliable and subscribers best effort, so '
        'that they hear both kinds; `qos_overrides.*` changes it. "ros2 launch adxl_ros '
        'robot.launch.py -s" lists the arguments of a launch file.',
        '',
        '## Topics',
    ]
    yield from table(
        'topic (type) | content | from | to',
        ((f'`{topic}` ({kind})', content, *ends) for topic, kind, content, *ends in TOPICS),
    )
    sensor = ''
    for name in NODES:
        text = helps()[name]
        found = re.search(r'\n(parameters of the sensor.*?)(?=\n\n\w)', text, re.DOTALL)
        sensor = sensor or (found[1] if found else '')
        services = ', '.join(f'`~/{part}`' for part in SERVICES.get(name, '').split(', ') if part)
        yield from [
            f'## {name}',
            *block(without(text, 'parameters of the sensor')),
            f'Services (std_srvs/Trigger): {services}.' if services else '',
            '',
        ]
    yield from [
        '## Parameters of the sensor',
        '',
        'Each node that knows the sensor has these, '
        'usually from its [parameter file](parameter_file.md).',
        *block(sensor),
    ]


def effects() -> Iterator[str]:
    """Describe the effects of the library."""
    yield from [
        '# Gallery of effects',
        '',
        'Each picture shows the output without and with one '
        'effect at its typical values, unless the caption states others. '
        '`simulate --effect NAME:key=value` takes the names of the parameters.',
        '',
    ]
    place = None
    for effect in sorted(library().values(), key=lambda e: (e.place, e.name)):
        if effect.place is not place:
            place = effect.place
            yield from [f'## Place in the chain: {place.name}', '']
        facts = [
            f'Acts on the {effect.acts_on.value}',
            f'{"" if effect.invertible else "not "}undone by the inverse',
            *(f'needs: {need.value}' for need in effect.needs),
            *(f'follows `{name}`' for name in effect.follows),
        ]
        yield from [
            f'### {effect.name}',
            '',
            effect.cause,
            '',
            f'![{effect.name}](effects/{effect.name}.png)',
            '',
        ]
        if effect.name in PICTURED:
            yield from [f'Here with {PICTURED[effect.name]}.', '']
        yield f'{"; ".join(facts)}.'
        yield from table(
            'parameter | bounds | typical | axes | meaning',
            (
                (
                    f'`{p.name}`, {p.unit}',
                    f'{p.lower:g} to {p.upper:g}',
                    f'{p.scale:g}',
                    ', '.join(p.axes) or '–',
                    f'{p.doc} ({p.source})',
                )
                for p in effect.parameters
            ),
        )


def file_keys() -> Iterator[str]:
    """Describe the parameter file."""
    yield from [
        '# The parameter file',
        '',
        'All keys stand under `/**: ros__parameters:`, as '
        'flat typed arrays with one entry for each axis: `1.0`, never `1`. [Describe your '
        'sensor](../howto/sensor.md) shows how to write one.',
    ]
    values = [field.metadata for field in dataclasses.fields(Sensor) if 'key' in field.metadata]
    yield from table(
        'key | unit | bounds | meaning',
        (
            (
                f'`{v["key"]}`',
                v['unit'] or '–',
                '–' if v['lower'] is None else f'{v["lower"]:g} to {v["upper"]:g}',
                v['doc'] + (f': {", ".join(v["choices"])}' if v['choices'] else ''),
            )
            for v in values
        ),
    )
    yield from table(
        'key | meaning',
        [
            ('`format`, `units`', 'version of the format: 1; units of the coefficients'),
            ('`effects`', 'names of the effects; under each name its [parameters](effects.md)'),
            (
                '`covariance`, `covariance_names`',
                'of the coefficients, row after row; names of rows',
            ),
            ('`datasheet.*`', 'typical and largest departures, for the comparison in reports'),
            ('`envelope.*`', 'range of force, temperature and supply of the calibration'),
            *(
                (f'`gyro.{name}`', f'gyroscope, x, y, z: {about["doc"]}, {about["unit"]}')
                for name, about in parameter_file.GYRO.items()
            ),
            ('`link.*`', 'how the driver reaches the unit'),
            ('`provenance.*`', 'id, date, source, hash of the data, errors and verdicts'),
        ],
    )


def sensors() -> Iterator[str]:
    """List the sensors with a file."""
    yield from [
        '# Sensors with a file',
        '',
        '`--params NAME` takes such a sensor. The head of '
        'each file names the datasheet, its pages, and what it assumes: supply, capacitor '
        'and ADC of an analog sensor, the settings after a reset of a digital one. '
        '`any_imu` is for a stream in m/s² of which nothing else is known.',
    ]
    paths = sorted((DOCS.parent / 'params').glob('*.yaml'))
    yield from table(
        'file | axes, range | noise, µg/√Hz | filter, rate | step, mg',
        filter(None, map(sensor_row, paths)),
    )


def sensor_row(path: Path) -> list[str] | None:
    """Return the row of a parameter file; None where it leaves values out."""
    sensor = parameter_file.load(path, may_measure=True)
    if sensor.unstated:
        return None
    noise = dict.fromkeys(f'{density * 1e6:.3g}' for density in sensor.noise_density_g_per_rthz)
    filter_hz = float(f'{1 / (2 * math.pi * sensor.rc_s):.3g}')
    step_mg = 1e3 * sensor.lsb_v / sensor.nominal_scale_v_per_g[0]
    return [
        f'[{path.stem}](../../params/{path.name})',
        f'{sensor.axes}, ±{sensor.range_g:.3g} g',
        ', z '.join(noise),
        f'{filter_hz:g} Hz, {sensor.rate_hz:g} Hz',
        f'{step_mg:.3g}',
    ]


def report_keys() -> Iterator[str]:
    """Describe report.json by a diagnosis of a simulated recording."""
    with tempfile.TemporaryDirectory() as folder:
        for words in (
            ['simulate', 'tilt_both', '--rate', '50', '--effect', 'bias', '-o', 'a.csv'],
            ['diagnose', 'a.csv', '-o', 'gap'],
        ):
            subprocess.run(
                [DOCS.parent / 'install/adxl_ros/lib/adxl_ros' / words[0], *words[1:]],
                check=True,
                capture_output=True,
                cwd=folder,
            )
        report = json.loads((Path(folder) / 'gap' / 'report.json').read_text('utf-8'))
    paths = [*keys_of(report)]
    unknown = [path for path in paths if path not in REPORT and not path.endswith('_ci')]
    missing = [path for path in REPORT if path not in paths]
    if unknown or missing:
        sys.exit(f'report.json: keys without a meaning {unknown}, or gone {missing}')
    yield from [
        '# report.json',
        '',
        'What `diagnose` writes for programs. Accelerations are in '
        'm/s², squares in (m/s²)². Intervals hold 90 %. [How the diagnosis decides]'
        '(../explain/diagnosis.md) defines the figures.',
    ]
    yield from table(
        'key | meaning', ((f'`{path}`', REPORT[path]) for path in paths if path in REPORT)
    )
    yield from table(
        'fault | meaning', ((f'`{name}`', meaning) for name, meaning in DATA_FAULTS.items())
    )


def keys_of(report: dict[str, Any]) -> Iterator[str]:
    """Yield the keys of a report, those of `verdict` and `gap` one by one."""
    for key, value in report.items():
        yield key if key != 'verdict' else 'verdict.status'
        if key in ('verdict', 'gap'):
            yield from (f'{key}.{name}' for name in value if name not in ('status', 'unit'))
        if key == 'candidates':
            yield 'candidates.parameters'


def fleet_columns() -> Iterator[str]:
    """List the columns of a fleet's table."""
    yield from [
        '# Columns of fleet.parquet',
        '',
        'One row a recording. Columns with `_x_` exist '
        'for y and z, too. Unit and meaning are metadata of the file. [Run a fleet]'
        '(../howto/fleet.md) has questions in SQL.',
    ]
    yield from table(
        'column | unit | meaning',
        (
            (f'`{column.name}`', column.unit or '–', column.meaning)
            for column in COLUMNS
            if not re.search('_[yz]_', column.name)
        ),
    )


def documented_classes() -> Iterator[str]:
    """Show the verbs with their results, then what other programs extend."""
    yield from [
        '# Library',
        '',
        '`import adxl_ros as adxl` gives the verbs below, without ROS. A '
        'result prints as the screen of its tool, and shows the top of its page in a '
        'notebook. Errors are `adxl.UserError`. [calibrate_arrays.py]'
        '(../examples/calibrate_arrays.py) and the files beside it run as they are.',
        *block(USAGE, 'python'),
        *table(
            'verb | returns | read first',
            ((verb, f'`{name}`', what) for verb, name, what in READ_FIRST),
        ),
    ]
    for name in VERBS:
        yield from verb(name)
    yield from ['## Arguments', *table('type | is | meaning', input_types())]
    yield from [
        '## Results',
        '',
        'Recordings are arrays with names; the other results also have '
        '`print`, and `plot(ax=None)` draws with matplotlib.',
        '',
    ]
    for path in with_fields(RESULTS):
        yield from described(path, 3)
    yield from [
        '## What programs extend',
        '',
        '[Add an effect](../howto/own_effect.md) and [add '
        'a link](../howto/own_link.md) use them; these paths stay.',
        '',
    ]
    shown = with_fields(RESULTS)
    for path in with_fields(LIBRARY):
        if path not in shown:
            yield from described(path, 3)


def with_fields(paths: Iterable[str]) -> list[str]:
    """Return types, each followed by the types of its fields that this package has."""
    found: list[str] = []
    todo = list(paths)
    while todo:
        path = todo.pop(0)
        if path in found:
            continue
        found.append(path)
        module, name = path.split(':')
        item = getattr(importlib.import_module(module), name)
        words = [
            word
            for field, annotation in inspect.get_annotations(item).items()
            if field not in STEPS
            for word in re.findall(r'[A-Z]\w+', str(annotation))
        ]
        types = [vars(sys.modules[module]).get(word) for word in words]
        todo[:0] = [
            f'{each.__module__}:{each.__name__}'
            for each in types
            if getattr(each, '__module__', '').startswith('adxl_ros') and has_fields(each)
        ]
    return found


def has_fields(item: Any) -> bool:
    """Return whether a type is described by its fields, or by the words of an enumeration."""
    return (
        dataclasses.is_dataclass(item)
        or hasattr(item, '_fields')
        or isinstance(item, enum.EnumMeta)
        or getattr(item, '_is_protocol', False)
    )


def input_types() -> Iterator[tuple[str, ...]]:
    """Show what arguments may be."""
    for path in INPUTS:
        module, name = path.split(':')
        source = inspect.getsource(importlib.import_module(module))
        found = re.search(rf'^{name}\b[^\n]* = (.*)\n"""(.*?)"""', source, re.MULTILINE)
        yield f'`{name}`', '`{}`'.format(found[1].strip("'")), found[2]


def verb(name: str) -> Iterator[str]:
    """Show signature and docstring of a verb."""
    item = getattr(adxl_ros, name)
    yield from [f'## {name}', *block(f'adxl.{name}{signature(item)}\n\n{inspect.getdoc(item)}')]


def signature(item: Any) -> str:
    """Return the parameters of a callable, without the quotes of annotations."""
    text = re.sub(r'<function (\S+) at 0x\w+>', r'\1', str(inspect.signature(item)))
    text = re.sub(r"(: |-> )'([^']*)'", r'\1\2', text)
    return '\n'.join(
        textwrap.wrap(
            text, 95, subsequent_indent='    ', break_long_words=False, break_on_hyphens=False
        )
    )


def described(path: str, level: int) -> Iterator[str]:
    """Show the fields of a dataclass or protocol, or a signature, and the public functions."""
    module, name = path.split(':')
    item = getattr(importlib.import_module(module), name)
    lines = [f'from {module} import {name}', '']
    if has_fields(item):
        # The fields have their meaning beside them; the functions follow.
        source = inspect.getsource(item).split('\n    def ')[0].rstrip()
        lines += re.sub(r'(\n    @\w+)+$', '', source).rstrip().splitlines()
    else:
        lines += [f'{name}{signature(item)}', '', inspect.getdoc(item) or '']
    yield from [f'{"#" * level} {name}', *block('\n'.join(lines))]
    functions = []
    for part, member in inspect.getmembers(item):
        function = getattr(member, 'fget', None) or getattr(member, 'func', None) or member
        is_shown = part == '__call__' or not part.startswith('_')
        if is_shown and inspect.isfunction(function) and function.__doc__:
            call = signature(function) if function is member else ''
            functions.append(
                f'{name}.{part}{call}\n' + textwrap.indent(inspect.getdoc(function) or '', '    ')
            )
    if functions:
        yield from block('\n\n'.join(functions))


def figures() -> dict[Path, str]:
    """Return the pages with figures between marks, as the measurements have them now."""
    made = {
        'demo': demo_table(),
        'working cases': working_cases(),
        'sealed': sealed(),
        'benchmark': benchmark('Level A: exactly right'),
        'better reference': benchmark(
            'Level C: share of the squared gap that is closed on a later part'
        ),
        'simulators': simulators(),
        'hand held': hand_held(),
        'tilt in motion': tilt_in_motion(),
        'units': units(),
    }
    pages = {}
    for path in [DOCS.parent / 'README.md', *DOCS.glob('*/*.md')]:
        text = path.read_text('utf-8')
        for mark, lines in made.items():
            begin, end = f'<!-- {mark} -->', f'<!-- /{mark} -->'
            if end in text:
                text = '\n'.join([text.split(begin)[0] + begin, *lines, end + text.split(end)[1]])
        pages[path] = text
    return pages


def demo_table() -> list[str]:
    """Return the rows of errors in the picture of `make demo`."""
    picture = (DOCS / 'screenshots' / 'demo.svg').read_text('utf-8')
    text = html.unescape(re.sub('<[^>]*>', ' ', picture)).replace('\xa0', ' ')
    names = ('datasheet values', 'linear calibration', 'full calibration')
    found = (re.search(rf'{name}\s+([\d.]+)\s+°\s+([\d.]+)\s+mg', text) for name in names)
    rows = [
        (match[0].split('  ')[0], f'{match[1]}°', f'{match[2]} mg') for match in found if match
    ]
    if len(rows) != len(names):
        sys.exit('screenshots/demo.svg: has no table of errors')
    return table('calibration | tilt error | acceleration error', rows)[1:-1]


def working_cases() -> list[str]:
    """Return the pooled scores of all draws of the last rule, with their commands."""
    text = (DOCS / 'measurements' / 'working_cases.txt').read_text('utf-8')
    draws = [Draw.parse(part) for part in text.split('\n== ')[1:]]
    latest = [draw for draw in draws if draw.rule == draws[-1].rule]
    commands = '; '.join(f'`{draw.command}`, {draw.date}, commit {draw.commit}' for draw in latest)
    earlier = [draw for draw in draws if draw not in latest]
    counts = {
        name: [(draw.hits[name], draw.counts[name]) for draw in latest if name in draw.hits]
        for name in SCORED
    }
    rows = [
        (
            name,
            *pooled_score(made).split(', '),
            *(pooled_limit([d.limits.get((name, forms)) for d in latest]) for forms in FORMS),
        )
        for name, made in counts.items()
        if made
    ]
    return [
        f'{commands}; two cores. In brackets 90 % intervals. The last columns: what an ideal '
        'observer could reach that knows the noise and the forms of the world, or of the library.',
        *table('verdict | share | cases | world | library', rows),
        f'{len(earlier)} draws of earlier rules: {pooled(earlier)}.',
    ]


SCORED = (
    'no gap where there is none',
    'single effect, exactly',
    'single effect, in the named set',
    'pair, exactly',
    'pair, in the named set',
    'outside the library: unknown or partly',
    'upper limit of no gap holds',
    'harm: another recording made worse',
)
"""Scores of the working cases that pages show."""
FORMS = ('world', 'library')
"""Whose forms an ideal observer of the working cases knows."""


@dataclasses.dataclass(frozen=True)
class Draw:
    """
    One draw of working cases, with the hits and the number of cases of each score.

    Limits are by score and whose forms are known: lowest and highest per cent, and cases.
    """

    command: str
    date: str
    commit: str
    rule: str
    hits: dict[str, int]
    counts: dict[str, int]
    limits: dict[tuple[str, str], tuple[int, int, int]]

    @classmethod
    def parse(cls, text: str) -> 'Draw':
        """Read a draw from its head and its table of scores."""
        head, *lines = text.splitlines()
        command, date, commit, rule = head.split(', ')
        hits, counts, limits, name = {}, {}, {}, ''
        for line in lines:
            found = re.match(r'(\w.*?) {2,}(\d+) % \(.*\), n = (\d+)$', line)
            if found:
                name, percent, count = found[1], int(found[2]), int(found[3])
                hits[name], counts[name] = round(percent * count / 100), count
            elif line in SCORED:
                name = line
            limit = re.match(r' +limit by .* (\w+) +(\d+) to (\d+) %, n = (\d+)$', line)
            if limit:
                limits[name, limit[1]] = int(limit[2]), int(limit[3]), int(limit[4])
        commit, rule = commit.removeprefix('commit '), rule.removeprefix('rule ')
        return cls(command, date, commit, rule, hits, counts, limits)


def pooled_score(made: list[tuple[int, int]]) -> str:
    """Return a share with its interval and number of cases, from hits and counts of draws."""
    hits = sum(hit for hit, _ in made)
    count = sum(count for _, count in made)
    return scores.in_words(scores.share([True] * hits + [False] * (count - hits)))


def pooled_limit(made: list[tuple[int, int, int] | None]) -> str:
    """Return the mean of limits over cases, in words; '-' where a draw has none."""
    if None in made:
        return '-'
    cases = sum(n for *_, n in made)
    low, high = (sum(limit[i] * limit[2] for limit in made) / cases for i in (0, 1))
    return f'{low:.0f} to {high:.0f} %, n = {cases}'


def pooled(draws: list[Draw]) -> str:
    """Return the three decisive scores over draws, in words."""
    words = {
        'single effect, exactly': 'single effects',
        'pair, exactly': 'pairs',
        'outside the library: unknown or partly': 'outside the library',
    }
    return ', '.join(
        f'{words[name]} {sum(d.hits[name] for d in draws)} of {sum(d.counts[name] for d in draws)}'
        for name in words
    )


def sealed() -> list[str]:
    """Return the result of the last sealed blind check, with all bars."""
    page = (DOCS / 'maintain' / 'blind_check.md').read_text('utf-8')
    result = page.split('<!-- result -->')[1].split('<!-- /result -->')[0]
    rows = [
        [cell.strip() for cell in line.strip('|').split('|')]
        for line in result.splitlines()
        if line.startswith('| ')
    ]
    return table(
        'score | figure (90 % interval) | bar | met',
        [row for row in rows[1:] if row[-1] not in ('-', 'met')],
    )[1:-1]


def benchmark(title: str) -> list[str]:
    """Return a table of the benchmark on public recordings, under its command."""
    text = (DOCS / 'measurements' / 'real_benchmark.md').read_text('utf-8')
    command = next(line for line in text.splitlines() if line.startswith('`./run benchmark'))
    rows = text.split(f'### {title}\n\n')[1].split('\n\n')[0].splitlines()
    # The page has room for the first four methods.
    cells = [row.strip('|').split('|')[:5] for row in rows]
    return [command, '', *(f'|{"|".join(row)}|' for row in cells)]


def simulators() -> list[str]:
    """Return the verdicts on simulated accelerometers, under their command."""
    text = (DOCS / 'measurements' / 'simulators.md').read_text('utf-8')
    command = next(line for line in text.splitlines() if line.startswith('`./run simulators'))
    rows = text.split('### Verdicts\n\n')[1].split('\n\n')[0].splitlines()
    # What would have shown stands in the last column, for which this page has no room.
    return [command, '', *(row.rstrip('|').rpartition('|')[0] + '|' for row in rows)]


def tilt_in_motion() -> list[str]:
    """Return the error of the tilt of robots that drive firmly, under the command."""
    text = (DOCS / 'measurements' / 'tilt_in_motion.md').read_text('utf-8')
    _, command, rest = text.split('\n\n', 2)
    rows = rest.split('## firm, 1 to 4 m/s²\n\n')[1].split('\n\n')[0].splitlines()
    return [*command.splitlines(), '', *rows]


def units() -> list[str]:
    """Return the names of units by quantity, that of the package first."""
    rows = [
        (
            quantity.name.lower(),
            ', '.join(
                f'`{name}`' for name in sorted(names, key=lambda name: name != quantity.value)
            ),
        )
        for quantity, names in UNITS.items()
    ]
    return table('quantity | units, that of the package first', rows)[:-1]


def hand_held() -> list[str]:
    """Return the tilt error by the number of rests."""
    text = (DOCS / 'measurements' / 'hand_held.txt').read_text('utf-8').splitlines()
    command, what = (line.removeprefix('# ') for line in text[:2])
    rows = [line.split(',') for line in text[3:]]
    return [
        f'{what[0].upper()}{what[1:]} (`{command.split(", ")[0]}`, {command.split(", ")[1]}):',
        *table(
            'rests | median of the units | worst',
            (
                [rests if rests != '0' else 'not calibrated', f'{median}°', f'{worst}°']
                for rests, median, worst in rows
            ),
        )[:-1],
    ]


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / 'reference')
    if len(sys.argv) == 1:
        for page, made in figures().items():
            page.write_text(made, 'utf-8')
