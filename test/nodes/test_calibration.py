"""The guided calibration through the live graph: stage, rests, journal, verdict, file."""

from dataclasses import replace
from itertools import count

from adxl_ros.calibrate.recorded_poses import extract_poses
from adxl_ros.files import parameter_file, recording, sweep_journal
from adxl_ros.files.recording_columns import recorded_nominal
from adxl_ros.model.sensor import with_neutral
from adxl_ros.simulate.motion import Held, Knots, Motion
from adxl_ros.simulate.response import simulate
from diagnostic_msgs.msg import DiagnosticStatus
from graph import Graph, QUEUE, RELIABLE
from lifecycle_msgs.msg import Transition
import numpy as np
import pytest
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger
from units import drawn, nominal, with_effects

FAST = ('-p', 'use_sim_time:=true')
# At many times real time a best-effort subscriber, or one with a short queue, loses samples on a
# busy machine.
LOSSLESS = (
    *RELIABLE,
    '-p',
    f'qos_overrides./imu/data_raw.subscription.depth:={QUEUE}',
    '-p',
    'qos_overrides./stage/command.publisher.depth:=1000',
)
KEPT = ('-p', f'qos_overrides./imu/data_raw.publisher.depth:={QUEUE}')
QUICK = (
    '-p',
    'sweep.planes_deg:=[45.0, 90.0, 135.0]',
    '-p',
    'sweep.step_deg:=45.0',
    '-p',
    'sweep.dwell_s:=1.0',
    '-p',
    'sweep.check_poses:=6',
)


def _files(tmp_path, seed=3, axes='xy'):
    """Write the file of a drawn unit of 200 Hz and of its nominal sensor."""
    base = nominal(axes, serial='T1', rate_hz=200.0)
    truth, bare = tmp_path / 'truth.yaml', tmp_path / 'nominal.yaml'
    parameter_file.save(truth, drawn(np.random.default_rng(seed), base))
    parameter_file.save(bare, base)
    return truth, bare


def _sweep(start, truth, bare, *options, speed=4.0, slew_rad_s=0.5):
    bench = [
        start(
            'driver',
            '--ros-args',
            '--params-file',
            truth,
            '-p',
            'link.type:=sim',
            '-p',
            f'link.speed:={speed}',
            *FAST,
            *KEPT,
        ),
        start(
            'stage',
            '--ros-args',
            '--params-file',
            bare,
            *FAST,
            '-p',
            f'slew_rate_rad_s:={slew_rad_s}',
            '-p',
            f'qos_overrides./stage/joint_states.publisher.depth:={QUEUE}',
        ),
    ]
    return bench, start(
        'calibration', '--ros-args', '--params-file', bare, *FAST, *LOSSLESS, *QUICK, *options
    )


def check_settings(read, unit, entries):
    """Assert that a recording numbers the settings of the joints as its journal does."""
    alpha, beta = (
        [getattr(e, f'{joint}_setting') for e in entries] for joint in ('alpha', 'beta')
    )
    poses = extract_poses(read, unit, entries)
    assert (poses.alpha_setting == alpha).all() and (poses.beta_setting == beta).all()
    # Without the journal a rest may begin later, and end with the next move.
    poses = extract_poses(read, unit)
    begin, end = (read.epoch_ns + np.rint(poses.time_s * 1e9).astype(np.int64)).T
    overlap_ns = [np.minimum(end, e.stop_ns) - np.maximum(begin, e.start_ns) for e in entries]
    assert min(map(max, overlap_ns)) > 0
    rest = [int(both.argmax()) for both in overlap_ns]
    check_partitions(poses.alpha_setting[rest], poses.beta_setting[rest], alpha, beta)


def check_partitions(alpha, beta, expected_alpha, expected_beta):
    for found, expected in ((alpha, expected_alpha), (beta, expected_beta)):
        pairs = set(zip(found.tolist(), expected))
        assert len(pairs) == len(set(found.tolist())) == len(set(expected))


def test_a_sweep_ends_with_a_file_and_fit_agrees_on_its_bag(start, run_tool, tmp_path):
    rosbags = pytest.importorskip('bags', reason='rosbags is not installed: pip install rosbags')
    truth, bare = _files(tmp_path)
    kinds = {
        '/imu/data_raw': Imu,
        '/stage/joint_states': JointState,
        '/sensor_info': DiagnosticStatus,
        '/stage/command': JointState,
    }
    with Graph() as graph:
        kept = {
            topic: graph.listen(kind, topic, latched=topic == '/sensor_info', raw=True)
            for topic, kind in kinds.items()
        }
        bench, node = _sweep(
            start,
            truth,
            bare,
            '-p',
            'output:=unit.yaml',
            '-p',
            'report:=report',
            '-p',
            'link.type:=serial',
            '-p',
            'link.port:=/dev/ttyACM0',
            speed=10.0,
            slew_rad_s=3.0,
        )
        # The record begins before the sweep does.
        graph.spin_until(
            lambda: all(kept[topic] for topic in kinds if topic != '/stage/command'),
            60,
            'all topics',
        )
        assert graph.call(Trigger, 'calibration/start', Trigger.Request()).success
        graph.spin_until((tmp_path / 'unit.yaml').exists, 120, 'the parameter file')
        # 2000 samples a second would need the processor time of the report.
        for process in bench:
            process.stop()
        node.wait_for('wrote unit.yaml', 120)
    live = parameter_file.load(tmp_path / 'unit.yaml')
    truth_sensor = parameter_file.load(truth)
    assert (live.model, live.serial) == ('full', 'T1')
    assert live.link == {'type': 'serial', 'port': '/dev/ttyACM0'}, 'the file carries the link'
    np.testing.assert_allclose(live.zero_g_v, truth_sensor.zero_g_v, atol=1e-3)
    np.testing.assert_allclose(live.scale_v_per_g, truth_sensor.scale_v_per_g, atol=1e-3)
    (copy,) = (tmp_path / 'ros_home' / 'adxl_ros' / 'calibrations' / 'T1').iterdir()
    assert copy.read_text() == (tmp_path / 'unit.yaml').read_text()
    assert copy.stem == live.provenance['id']
    assert 'held out' in (tmp_path / 'report' / 'report.html').read_text()
    head = (tmp_path / 'unit.yaml').read_text().split('/**')[0]
    assert all(f'#  {model} calibration' in head for model in ('linear', 'physical', 'full'))

    sent = []
    for topic, kind in (
        ('/imu/data_raw', rosbags.IMU),
        ('/stage/joint_states', rosbags.JOINTS),
        ('/sensor_info', rosbags.INFO),
        ('/stage/command', rosbags.JOINTS),
    ):
        sent += [
            rosbags.Sent(topic, kind, arrival_ns, raw=raw)
            for arrival_ns, raw in zip(graph.arrived_ns[topic], kept[topic])
        ]
    bag = rosbags.bag_of(tmp_path / 'bag', sorted(sent, key=lambda message: message.stamp_ns))
    done = run_tool(
        'fit', bag, '--params', bare, '--journal', 'unit.yaml.journal', '-o', 'offline.yaml'
    )
    assert done.returncode == 0, done.stderr
    offline = parameter_file.load(tmp_path / 'offline.yaml')
    for effect, values in live.values.items():
        for name, value in values.items():
            np.testing.assert_allclose(offline.values[effect][name], value, rtol=0, atol=1e-9)
    # From the samples `fit` also estimates the filter, whose rows are the last.
    both = len(live.covariance)
    assert offline.covariance_names[:both] == live.covariance_names
    np.testing.assert_allclose(offline.covariance[:both, :both], live.covariance, rtol=1e-5)

    entries = sweep_journal.read(tmp_path / 'unit.yaml.journal').entries
    assert entries[-1].done
    assert sum(entry.check for entry in entries[-1].rests) == 6
    assert all(entry.samples == 200 for entry in entries[-1].rests)

    # The bag and its CSV number the settings of the joints as the sweep does.
    read = recording.read(bag)
    recording.write(tmp_path / 'bag.csv', read, truth_sensor)
    for path in (bag, tmp_path / 'bag.csv'):
        read = recording.read(path)
        check_settings(
            read, recorded_nominal(nominal(serial='T1', rate_hz=200.0), read), entries[-1].rests
        )
    counts = [
        len({getattr(entry, f'{joint}_setting') for entry in entries[-1].rests})
        for joint in ('alpha', 'beta')
    ]
    assert 5 <= min(counts) < len(entries[-1].rests) / 2, 'neighbours share one joint'


def test_services_and_refusals(start, tmp_path):
    truth, bare = _files(tmp_path)
    with Graph() as graph:

        def ask(name):
            answer = graph.call(Trigger, f'calibration/{name}', Trigger.Request())
            return answer.success, answer.message

        _sweep(start, truth, bare)
        graph.spin_until(lambda: graph.reports('driver', ''), 30, 'the driver')
        graph.spin_until(lambda: graph.reports('calibration', 'call ~/start'), 30, 'idle')
        assert ask('finish') == (False, 'no calibration is running')
        assert ask('abort')[0] is False
        assert ask('start')[0]
        graph.spin_until(lambda: graph.number('calibration', 'accepted') >= 2, 60, 'two poses')
        assert ask('start') == (False, 'a calibration is running; finish or abort it first')
        assert ask('capture')[0] is False
        second = start(
            'calibration',
            '--ros-args',
            '--params-file',
            bare,
            *FAST,
            *QUICK,
            '-p',
            'autostart:=true',
            '-r',
            '__node:=second',
        )
        second.wait_for('another calibration is writing this journal')
        assert 'Traceback' not in second.output()
        done, words = ask('abort')
        assert done and 'its poses stay in' in words
        assert not (tmp_path / 'calibration.yaml').exists()

        assert ask('start')[0]
        graph.spin_until(lambda: graph.number('calibration', 'accepted') >= 6, 60, 'resumed')
        done, words = ask('finish')
        assert done and words.startswith('wrote calibration.yaml; '), words
        assert words.endswith(' poses are open: start again to go on')
        # Poses at two or three angles beta do not determine the full model.
        fitted = parameter_file.load(tmp_path / 'calibration.yaml')
        assert fitted.model in ('linear', 'physical')


@pytest.mark.parametrize('output, status', [('unit.yaml', 0), ('none/unit.yaml', 1)])
def test_the_node_can_end_with_its_calibration(start, tmp_path, output, status):
    truth, bare = _files(tmp_path)
    with Graph() as graph:
        _, node = _sweep(
            start,
            truth,
            bare,
            '-p',
            'autostart:=true',
            '-p',
            'exit_when_done:=true',
            '-p',
            f'output:={output}',
        )
        if status == 0:
            graph.spin_until(lambda: graph.number('calibration', 'accepted') >= 6, 60, 'six poses')
            assert graph.call(Trigger, 'calibration/finish', Trigger.Request()).success
        graph.spin_until(lambda: node.popen.poll() is not None, 60, 'the end')
        assert node.wait() == status
        if status == 0:
            assert graph.number('calibration', 'accepted') >= 6
            assert 0 < len(graph.value('calibration', 'verdict')) < 80
            assert graph.value('calibration', 'verdict') in node.output()


@pytest.mark.parametrize(
    'setting, words',
    [
        ('sweep.planes_deg:=[thirty]', 'sweep.planes_deg: '),
        ('sweep.step_deg:=0.0', 'sweep.step_deg'),
        ('thermal.range_c:=[50.0, 0.0]', 'thermal.range_c: [50.0, 0.0] is no lowest'),
        ('output:=.', 'output: . is a directory; name a'),
    ],
)
def test_settings_out_of_range_end_the_node(refusal, tmp_path, setting, words):
    _, bare = _files(tmp_path)
    assert words in refusal('calibration', '--ros-args', '--params-file', bare, '-p', setting)


def test_a_resting_sensor_is_calibrated_over_temperature(start, tmp_path):
    unit = with_neutral(nominal('xyz', serial='T7', rate_hz=20.0), ['bias'])
    parameter_file.save(tmp_path / 'base.yaml', replace(unit, model='linear'))
    motion = Motion(
        440.0,
        Held(0.7),
        Held(0.4),
        temperature_c=Knots([0, 200, 400, 440], [5, 45, 5, 5]),
        internal_rate_hz=20.0,
    )
    columns = simulate(with_effects(unit, ['temperature_bias:per_k=4e-4']), motion, 3)
    columns['temperature_c'] = np.round(columns['temperature_c'], 1)
    columns = {name: values for name, values in columns.items() if not name.endswith('_rad')}
    with open(tmp_path / 'oven.csv', 'w', encoding='utf-8') as file:
        print(','.join(columns), file=file)
        np.savetxt(file, np.column_stack(list(columns.values())), '%.9f', ',')
    with Graph() as graph:
        start(
            'calibration',
            '--ros-args',
            '--params-file',
            tmp_path / 'base.yaml',
            *FAST,
            *LOSSLESS,
            '-p',
            'qos_overrides./temperature.subscription.reliability:=reliable',
            '-p',
            'qos_overrides./temperature.subscription.depth:=1000',
            '-p',
            'mode:=thermal',
            '-p',
            'thermal.range_c:=[10.0, 40.0]',
            '-p',
            'thermal.block_s:=4.0',
            '-p',
            'autostart:=true',
            '-p',
            'output:=warm.yaml',
        )
        graph.spin_until(lambda: graph.reports('calibration', 'waiting for sensor_info'), 30, 'up')
        start(
            'driver',
            '--ros-args',
            '--params-file',
            tmp_path / 'base.yaml',
            *FAST,
            '-p',
            'link.type:=replay',
            '-p',
            f'link.recording:={tmp_path / "oven.csv"}',
            '-p',
            'link.speed:=40.0',
            '-p',
            'autostart:=false',
            *KEPT,
        )
        assert graph.change('driver', Transition.TRANSITION_CONFIGURE)
        graph.spin_until(lambda: graph.node.count_publishers('imu/data_raw'), 30, 'a publisher')
        assert graph.change('driver', Transition.TRANSITION_ACTIVATE)
        graph.spin_until((tmp_path / 'warm.yaml').exists, 60, 'the file')
        assert graph.has_reported('calibration', 'blocks; warming')
        assert graph.has_reported('calibration', 'mg expected over 10 to 40 °C')
    warm = parameter_file.load(tmp_path / 'warm.yaml')
    # On a busy machine, temperatures at 40 times real time come late, which is a hysteresis. That
    # there is none otherwise is for the tests of the guide.
    assert {'bias', 'temperature_bias'} <= set(warm.effects)
    np.testing.assert_allclose(warm.values['temperature_bias']['per_k'], 4e-4, atol=5e-5)
    assert len(warm.covariance_names) >= 6


def test_a_compensated_stream_and_a_wrong_rate_are_refused(start, tmp_path):
    _, bare = _files(tmp_path)
    common = ('--ros-args', '--params-file', bare, '-p', 'autostart:=true')
    with Graph() as graph:
        start('driver', '--ros-args', '--params-file', bare, '-p', 'link.type:=sim')
        start('compensation', '--ros-args', '--params-file', bare)
        start('calibration', *common, '-r', 'imu/data_raw:=imu/data')
        start(
            'calibration',
            *common,
            '-r',
            '__node:=other',
            '-r',
            'imu/data_raw:=half',
            '-p',
            'journal:=other.journal',
        )
        raw = graph.listen(Imu, 'imu/data_raw')
        half = graph.node.create_publisher(Imu, 'half', 1000)
        dead, numbers = [], count()

        def feed_half():
            for message in raw:
                if dead:
                    message.linear_acceleration.x = float('nan')
                if next(numbers) % 2:
                    half.publish(message)
            raw.clear()

        graph.node.create_timer(0.1, feed_half)
        graph.spin_until(
            lambda: graph.reports('calibration', 'this stream is already compensated'), 60, 'why'
        )
        graph.spin_until(
            lambda: graph.reports('other', 'samples are 100 a second'), 60, 'the reason'
        )
        dead.append('x')
        graph.spin_until(
            lambda: graph.reports('other', 'x is not a number in all samples'), 60, 'which axis'
        )
