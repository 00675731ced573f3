# SPDX-License-Identifier: Apache-2.0

"""What nodes are started with: no silent simulation, no unknown parameter, no lost file."""

from importlib import import_module
from pathlib import Path
import sys

from adxl_ros.files import parameter_file
from adxl_ros.nodes.parameters import node_specs
from adxl_ros.nodes.params_files import has_section, write_into
from adxl_ros.nodes.sensor_parameters import sensor_specs
from adxl_ros.process import NODES
from diagnostic_msgs.msg import DiagnosticStatus
from graph import Graph
from lifecycle_msgs.msg import Transition
import pytest
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter, parameter_value_to_python
from sensor_msgs.msg import Imu
from units import NOMINAL, nominal

OWN_PARAMETERS = {
    node: [spec.name for spec in node_specs(import_module(f'adxl_ros.nodes.{node}'))]
    for node in NODES
    if node != 'screen'
}
ROS = '--ros-args'
SIMULATED = 'SIMULATED sensor (link.type: sim)'
CHOICES = 'set it to iio, replay, serial, topic, or to sim for a simulated sensor'


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    parameter_file.save(tmp_path / 'unit.yaml', nominal(serial='17'))
    return tmp_path / 'unit.yaml'


def listed(graph: Graph, node: str) -> list[str]:
    return graph.call(
        ListParameters, f'{node}/list_parameters', ListParameters.Request()
    ).result.names


def test_a_driver_alone_warns_of_its_simulated_sensor_and_describes_its_parameters(start):
    driver = start('driver')
    driver.wait_for(SIMULATED)
    with Graph() as graph:
        samples = graph.listen(Imu, 'imu/data_raw')
        graph.spin_until(lambda: samples and graph.reports('driver', SIMULATED), 30, 'a sample')
        assert graph.diagnostics['driver'].level == DiagnosticStatus.WARN
        assert graph.value('driver', 'link_type') == 'sim'
        stated = [
            name
            for name in listed(graph, 'driver')
            if not name.startswith(('qos_overrides', 'use_sim', 'start_type'))
        ]
        described = graph.call(
            DescribeParameters,
            'driver/describe_parameters',
            DescribeParameters.Request(names=stated),
        ).descriptors
        (answer,) = graph.call(
            SetParameters,
            'driver/set_parameters',
            SetParameters.Request(
                parameters=[Parameter('sensor.rate_hz', value=500.0).to_parameter_msg()]
            ),
        ).results
    info, warning, *_ = driver.output().splitlines()
    assert '[INFO]' in info
    assert 'active: link sim, unit nominal, 1000 Hz, topic /imu/data_raw' in info
    assert '[WARN]' in warning
    assert all(d.description and d.read_only for d in described)
    by_name = {d.name: d for d in described}
    assert {'sensor.rate_hz', 'link.type', 'link.speed', 'frame_id'} <= set(by_name)
    (rate,) = by_name['sensor.rate_hz'].floating_point_range
    assert (rate.from_value, rate.to_value) == (0.01, 100000)
    assert not answer.successful and 'read-only' in answer.reason


def test_the_file_of_a_unit_without_a_link_is_refused(refusal, unit):
    line = refusal('driver', ROS, '--params-file', unit)
    assert 'link.type: is not set, but the sensor is the unit 17' in line
    assert CHOICES in line


@pytest.mark.parametrize(
    'parameter, words',
    [
        ('link.port:=/dev/ttyACM0', 'link.type: is not set, but link.port is given; set it to'),
        ('link.speed:=2.0', 'link.type: is not set, but link.speed is given; set it to'),
        ('link.tpye:=serial', 'link.type: is not set, but link.tpye is given; set it to iio'),
        (
            'lnk.type:=serial',
            'lnk.type: no node has a parameter of this name; did you mean link.type',
        ),
        ('sensor.rate_herz:=100.0', 'did you mean sensor.rate_hz?'),
        ('frameid:=case', 'did you mean frame_id?'),
    ],
)
def test_a_driver_that_may_mean_a_real_sensor_is_refused(refusal, parameter, words):
    assert words in refusal('driver', ROS, '-p', parameter)


def test_a_misspelt_name_is_reported_although_another_node_does_not_load(refusal, monkeypatch):
    monkeypatch.setitem(sys.modules, 'adxl_ros.nodes.monitor', None)
    line = refusal('driver', ROS, '-p', 'frameid:=case')
    assert 'did you mean frame_id?' in line
    assert 'monitor does not load' in line


@pytest.mark.parametrize(
    'link, parameter, words',
    [
        ('sim', 'link.port:=/dev/ttyACM0', 'the link sim has no such parameter; it has link.type'),
        ('serial', 'link.prot:=/dev/ttyACM0', 'no such parameter; it has link.type, '),
        ('serial', 'link.port:=""', 'names no port; set it to a device path or a pyserial URL'),
        ('iio', 'link.uri:=nowhere', 'is none of local:, ip:HOST, usb:..., serial:...'),
        ('sim', 'link.sped:=2.0', ' link.speed, '),
    ],
)
def test_a_parameter_of_another_link_is_refused(refusal, link, parameter, words):
    line = refusal('driver', ROS, '-p', f'link.type:={link}', '-p', parameter)
    assert f'{parameter.split(":")[0]}: ' in line
    assert words in line


@pytest.mark.parametrize(
    'rule, words',
    [
        ('link.type:=seral', "driver: link.type: 'seral' is not one of sim, iio, replay, serial"),
        (
            'driver:sensor.rate_hz:=-4.0',
            'driver: sensor.rate_hz: -4.0 is refused; expected DOUBLE, 0.01 to 1',
        ),
        ('sensor.serial:=7', """expected STRING; write 'sensor.serial:="7"'"""),
        (
            'qos_overrides./imu/data_raw.publisher.depht:=5',
            'data_raw.publisher.depht: expected qos_overrides./TOPIC.ENTITY.POLICY',
        ),
        (
            'stamp_offset:=1',
            'driver: stamp_offset: 1 is refused; expected DOUBLE, -10 to 10, s; write 1.0',
        ),
    ],
)
def test_the_error_of_an_argument_names_no_file(refusal, unit, rule, words):
    line = refusal('driver', ROS, '--params-file', unit, '-p', 'link.type:=sim', '-p', rule)
    assert words in line
    assert 'unit.yaml' not in line


def test_a_text_with_a_colon_gets_the_hint_of_its_quotes(refusal):
    assert """needs quotes of its own: -p 'link.uri:="usb:"'""" in refusal(
        'driver', ROS, '-p', 'link.uri:=usb:', status=2
    )


@pytest.mark.parametrize(
    'node', ['stage', 'calibration', 'compensation', 'investigate', 'monitor', 'keep_calibrated']
)
def test_an_unknown_parameter_of_a_file_is_refused_at_its_line(refusal, tmp_path, node):
    text = NOMINAL.read_text() + '    sweep: {dwel_s: 2.0}\n'
    (tmp_path / 'own.yaml').write_text(text)
    line = refusal(node, ROS, '--params-file', 'own.yaml')
    assert f'own.yaml:{text.count(chr(10))}:' in line
    assert 'sweep.dwel_s: no node has a parameter of this name; did you mean sweep.dwell_s' in line


@pytest.mark.parametrize('node', ['driver', 'compensation'])
def test_a_file_for_another_node_is_refused(refusal, tmp_path, node):
    text = NOMINAL.read_text().replace('/**:', 'other:')
    (tmp_path / 'other.yaml').write_text(text)
    line = refusal(node, ROS, '--params-file', 'other.yaml')
    assert f'other.yaml: has parameters of /other, but none of the node /{node}' in line


@pytest.mark.parametrize('section', ['/*', '/**/driver', 'driver', '/arm/driver', '/arm/**'])
@pytest.mark.parametrize('namespace', ['/', '/arm', '/leg'])
def test_the_sections_of_a_file_are_those_of_ros(ros_env, tmp_path, section, namespace):
    path = str(tmp_path / 'own.yaml')
    Path(path).write_text(f'{section}:\n  ros__parameters:\n    frame_id: case\n')
    context = Context()
    rclpy.init(args=[ROS, '--params-file', path, '-r', f'__ns:={namespace}'], context=context)
    node = rclpy.create_node('driver', context=context, start_parameter_services=False)
    frame = node.declare_parameter('frame_id', 'other').value
    assert has_section(path, node.get_fully_qualified_name()) == (frame == 'case')
    node.destroy_node()
    context.shutdown()


@pytest.mark.parametrize(
    'text, written',
    [
        (
            '/**:\n  ros__parameters:\n    format: 1 # as it was\n',
            '/**:\n  ros__parameters:\n    a.b: [1.0]\n    format: 1 # as it was\n',
        ),
        (
            'driver: {ros__parameters: {c: 1}}\n/arm/*: {ros__parameters: {a: '
            '{b: [7.0]}, d: 2}}\n',
            'driver: {ros__parameters: {c: 1}}\n/arm/*: {ros__parameters: {a: '
            '{b: [1.0]}, d: 2}}\n',
        ),
        ('/**: {ros__parameters: {c: 1}}\n', '/**: {ros__parameters: {a.b: [1.0], c: 1}}\n'),
        (
            '/arm/node: {ros__parameters: {}}\n/**: {ros__parameters: {c: 1}}\n',
            '/arm/node: {ros__parameters: {}}\n/**: {ros__parameters: {a.b: [1.0], c: 1}}\n',
        ),
    ],
)
def test_a_parameter_is_written_into_a_file_whose_rest_stays(tmp_path, text, written):
    path = tmp_path / 'own.yaml'
    path.write_text(text)
    write_into(str(path), '/arm/node', {'a.b': '[1.0]'})
    assert path.read_text() == written


def test_all_nodes_with_one_file(start, tmp_path):
    """
    One file serves all nodes of a launch, and parameters of other nodes are no error.

    Each node declares the parameters of the table. `ros2 param dump` gets the values of all of
    them: it asks for all at once, and gets none where one has no value.
    """
    (tmp_path / 'all.yaml').write_text(
        NOMINAL.read_text()
        + (
            '    stage.mode: manual\n    slew_rate_rad_s: 1.0\n    undo_filter: true\n'
            '    link.type: sim\n    link.seed: 3\n'
        )
    )
    nodes = [start(name, ROS, '--params-file', 'all.yaml') for name in OWN_PARAMETERS]
    nodes.append(
        start(
            'stage',
            ROS,
            '-p',
            'stage.type:=trajectory',
            '-p',
            'bridge.alpha.joint:=a',
            '-p',
            'bridge.beta.joint:=b',
            '-r',
            '__node:=bridge',
        )
    )
    with Graph() as graph:
        graph.spin_until(lambda: set(OWN_PARAMETERS) <= set(graph.diagnostics), 40, 'all nodes')
        declared = {node: listed(graph, node) for node in (*OWN_PARAMETERS, 'bridge')}
        for node in OWN_PARAMETERS:
            check_dump(graph, node, declared[node])
    assert all(node.popen.poll() is None for node in nodes)
    names = {node: set(own_parameters(declared[node])) for node in declared}
    names['stage'] |= names.pop('bridge')
    names['driver'] = {
        name for name in names['driver'] if name == 'link.type' or not name.startswith('link.')
    }
    assert names == {node: set(own_parameters(table)) for node, table in OWN_PARAMETERS.items()}


def own_parameters(names: list[str]) -> list[str]:
    """Return the parameters that are neither of the sensor nor of all nodes."""
    ignored = {
        'use_sim_time',
        'start_type_description_service',
        *(spec.name for spec in sensor_specs()),
    }
    return [
        name for name in names if name not in ignored and not name.startswith('qos_overrides.')
    ]


def check_dump(graph: Graph, node: str, names: list[str]) -> None:
    """Check that a node gives the values of all its parameters at once."""
    assert len(names) > 10, node
    values = graph.call(
        GetParameters, f'{node}/get_parameters', GetParameters.Request(names=names)
    ).values
    dumped = {name: parameter_value_to_python(value) for name, value in zip(names, values)}
    assert dumped.keys() == set(names), node
    assert None not in dumped.values(), node
    if node != 'stage':
        assert dumped['sensor.rate_hz'] == 1000.0
        assert dumped['format'] == 1
        assert dumped['effects'] == []


def test_an_inactive_driver_is_a_warning_and_each_transition_is_one_line(start):
    driver = start(
        'driver',
        ROS,
        '-p',
        'link.type:=replay',
        '-p',
        'link.recording:=none.csv',
        '-p',
        'autostart:=false',
    )
    with Graph() as graph:
        graph.spin_until(lambda: graph.reports('driver', 'inactive'), 30, 'inactive')
        assert graph.diagnostics['driver'].level == DiagnosticStatus.WARN
        assert graph.change('driver', Transition.TRANSITION_CONFIGURE)
        assert not graph.change('driver', Transition.TRANSITION_ACTIVATE)
        graph.spin_until(lambda: graph.reports('driver', 'none.csv'), 5, 'the reason')
        assert graph.diagnostics['driver'].level == DiagnosticStatus.ERROR
        assert graph.change('driver', Transition.TRANSITION_CLEANUP)
    assert driver.stop() == 0
    states = [
        line.split('[driver]: ')[1].split(':')[0]
        for line in driver.output().splitlines()
        if 'INFO' in line
    ]
    assert states == ['unconfigured', 'inactive', 'unconfigured']


def test_a_parameter_file_carries_a_link(tmp_path):
    sensor = nominal(serial='17', link={'type': 'serial', 'port': '/dev/ttyACM0'})
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    assert parameter_file.load(tmp_path / 'unit.yaml').link == sensor.link
