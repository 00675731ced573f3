# SPDX-License-Identifier: Apache-2.0

"""The driver on devices with faults: it stays up, and its samples are right and counted."""

from contextlib import contextmanager
from dataclasses import replace
import os
from pathlib import Path
import socket
import threading
import time

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.links import iio
from adxl_ros.links.support import emulated_board
from adxl_ros.model.effects import effect_named
from faults import IIO_FAULTS, RESET, run_fault, SERIAL_FAULTS
from graph import accel, Graph
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import GetState
from needs import lack
import numpy as np
from processes import PATIENCE
import pytest
from rig import IioRig, memory_mib, SerialRig
from sensor_msgs.msg import BatteryState, Imu, Temperature
from units import nominal

ROS = '--ros-args'
TIMED = 0.5
"""Relative error of a gap that the host has timed; a busy one reads late."""


@contextmanager
def board_rig(tmp_path, options=None):
    with Graph() as graph, SerialRig(graph, tmp_path, options) as rig:
        yield rig


def lines(process):
    return [line for line in process.output().splitlines() if line]


def test_every_fault_of_a_board_is_counted_exactly(start, tmp_path):
    with board_rig(tmp_path, {'banner': True, 'ppm': 60}) as rig:
        driver = start('driver', ROS, *rig.driver_parameters())
        rig.wait_for_samples(500, 30)

        def inject_all(rig, pid):
            for name, inject in SERIAL_FAULTS.items():
                if back_ns := inject(rig, pid):
                    rig.wait_for_recovery(back_ns, name)
                rig.wait_for_samples(100, 20, name)
            return 0

        report = run_fault(inject_all, rig, driver.popen.pid, 'all faults')
        assert report.wrong == 0
        assert report.missing > 1137, 'there were faults'
        assert report.missing == report.counted
        assert report.estimated == 0
        assert np.percentile(np.abs(rig.errors), 90) < 20

        report = run_fault(RESET, rig, driver.popen.pid, 'a reset')
        assert report.wrong == 0
        assert report.counted == report.estimated
        # After its reset the board has no count. The host's time gives it, to the delay of a read.
        assert report.missing > 450
        assert report.counted == pytest.approx(report.missing, rel=TIMED)
        assert rig.diagnostic('resets') == 1
        assert float(rig.graph.value('driver', 'clock_drift_ppm')) == pytest.approx(60, abs=200)
    assert driver.popen.poll() is None
    assert driver.stop() == 0
    assert 'Traceback' not in driver.output()


def test_every_fault_of_an_iiod_is_survived(start, tmp_path):
    try:
        iio.import_libiio()
    except UserError:
        pytest.skip(lack('libiio', 'libiio0'))
    with Graph() as graph, IioRig(graph) as rig:
        driver = start('driver', ROS, *rig.driver_parameters())
        rig.wait_for_samples(500, 30)
        for name, inject in IIO_FAULTS.items():
            report = run_fault(inject, rig, driver.popen.pid, name)
            assert report.wrong == 0, name
            assert report.counted == report.estimated, name
            assert report.missing > 500, name
            assert report.counted == pytest.approx(report.missing, rel=TIMED), name
        graph.spin_until(
            lambda: graph.value('driver', 'link_state') == 'streaming at 1000 Hz', 10, 'streaming'
        )
    assert driver.stop() == 0
    # One line at the start, and those of the link. A clock that is read late seems to stop.
    messages = [line for line in lines(driver) if '[driver]' in line and 'stepped' not in line]
    assert len(messages) <= 1 + 2 + (len(IIO_FAULTS) + 1) * 2, messages


def test_two_drivers_cannot_have_one_port(start, tmp_path):
    with board_rig(tmp_path, {'keeps': True}) as rig:
        first = start('driver', ROS, *rig.driver_parameters())
        rig.wait_for_samples(500, 30)
        rig.begin_report()
        second = start('driver', ROS, *rig.driver_parameters(), '-r', '__node:=second')
        graph = rig.graph
        graph.spin_until(lambda: graph.reports('second', 'in use'), 20, 'the refusal')
        graph.spin(1.0)
        report = rig.report()
        assert (report.wrong, report.missing, report.counted) == (0, 0, 0)
        first.stop()
        graph.spin_until(lambda: graph.reports('second', 'streaming'), 10, 'taking over')
    assert second.popen.poll() is None


def test_a_hostile_stream_costs_no_memory_and_disturbs_no_other_link(start, tmp_path):
    """Send noise as fast as it is read, then frames with false lengths, on a socket."""
    with (
        board_rig(tmp_path, {'keeps': True}) as rig,
        socket.create_server(('127.0.0.1', 0)) as server,
    ):
        start('driver', ROS, *rig.driver_parameters())
        port = server.getsockname()[1]
        hurt = start(
            'driver',
            ROS,
            '-p',
            'link.type:=serial',
            '-p',
            f'link.port:=socket://127.0.0.1:{port}',
            '-r',
            '__ns:=/hurt',
        )
        peer, _ = server.accept()
        peer.sendall(b'hello')
        rig.wait_for_samples(500, 30)
        rig.begin_report()
        before = memory_mib(hurt.popen.pid)
        rng = np.random.default_rng(0)
        chunk = rng.bytes(1_000_000)
        bombs = b''.join(bytes([0xFF]) * 254 + rng.bytes(3) for _ in range(4000))
        peer.settimeout(0.2)
        sent, end = 0, time.monotonic() + PATIENCE * 10
        while sent < 5_000_000 and time.monotonic() < end:
            try:
                sent += peer.send(chunk if sent % 2 else bombs)
            except TimeoutError:
                pass
            except OSError:  # the driver has connected again
                peer = server.accept()[0]
            rig.graph.spin(0.01)
        after = memory_mib(hurt.popen.pid)
        report = rig.report()
        assert sent >= 5_000_000
        assert (report.wrong, report.missing, report.counted) == (0, 0, 0)
        assert after - before < 8, f'{before} MiB before, {after} MiB after'
        assert hurt.popen.poll() is None
        peer.close()


def test_a_system_manager_changes_the_state_of_the_driver(start, tmp_path):
    with board_rig(tmp_path) as rig:
        graph = rig.graph
        driver = start('driver', ROS, *rig.driver_parameters(), '-p', 'autostart:=false')
        for transition, state in (
            (None, 'unconfigured'),
            (Transition.TRANSITION_CONFIGURE, 'inactive'),
            (Transition.TRANSITION_ACTIVATE, 'active'),
            (Transition.TRANSITION_DEACTIVATE, 'inactive'),
            (Transition.TRANSITION_ACTIVATE, 'active'),
            (Transition.TRANSITION_DEACTIVATE, 'inactive'),
            (Transition.TRANSITION_CLEANUP, 'unconfigured'),
            (Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, 'finalized'),
        ):
            assert transition is None or graph.change('driver', transition)
            answer = graph.call(GetState, 'driver/get_state', GetState.Request())
            assert answer.current_state.label == state
            if state == 'active':
                rig.wait_for_samples(300, 20)
                continue
            # Samples of the active driver may be under way.
            graph.wait_for_silence('imu/data_raw', 0.3)
            rig.collect()
            before = len(rig.numbers)
            graph.diagnostics.clear()
            graph.spin_until(lambda: graph.reports('driver', 'inactive'), 5, 'inactive')
            rig.collect()
            assert len(rig.numbers) == before, 'an inactive driver reads nothing'
            held = [
                os.readlink(f)
                for f in Path(f'/proc/{driver.popen.pid}/fd').iterdir()
                if f.is_symlink() and os.path.lexists(f)
            ]
            assert os.path.realpath(rig.path) not in held
        assert rig.wrong == 0


def repeat_on_board(tmp_path, sensor, columns):
    """Let a board repeat the same samples; return its port and a function that ends it."""
    path, stop = str(tmp_path / 'fed'), threading.Event()
    ready = threading.Event()

    def feed():
        with emulated_board.open_terminal(path) as fd:
            sender = emulated_board.Board(sensor, emulated_board.roles_of(sensor, columns), fd)
            ready.set()
            while not stop.is_set():
                sender.send(columns)

    thread = threading.Thread(target=feed)
    thread.start()
    ready.wait()
    return path, lambda: (stop.set(), thread.join())


def test_a_measured_supply_corrects_the_supply_effect(start, tmp_path):
    """Without correction, a ratiometric sensor at 4.8 V shows -0.2 V / (1 V/g) at 0 g."""
    effect = effect_named('supply')
    sensor = replace(
        nominal(),
        effects=('supply',),
        values={
            'supply': {
                p.name: np.full(2, 1.0) if p.axes else np.array(5.0) for p in effect.parameters
            }
        },
    )
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    columns = {
        'x_v': np.full(200, 2.4),
        'y_v': np.full(200, 2.4 + 0.96 / 2),
        'supply_v': np.full(200, 4.8),
        'temperature_c': np.full(200, 31.0),
    }
    path, end = repeat_on_board(tmp_path, nominal(), columns)
    try:
        with Graph() as graph:
            raw = graph.listen(Imu, 'imu/data_raw')
            corrected = graph.listen(Imu, 'imu/data')
            supply = graph.listen(BatteryState, 'supply')
            temperature = graph.listen(Temperature, 'temperature')
            start(
                'driver',
                ROS,
                '-p',
                'link.type:=serial',
                '-p',
                f'link.port:={path}',
                '-p',
                'link.channels:=x,y,supply,temperature',
                '-p',
                'link.supply_scale:=2.0',
            )
            start('compensation', ROS, '--params-file', tmp_path / 'unit.yaml')
            graph.spin_until(lambda: supply and temperature and raw and corrected, 30, 'all of it')
            # A constant supply is published once a second: the compensation may not have it yet.
            graph.spin_until(
                lambda: accel(corrected[-1])[:2] == pytest.approx([0, 0.5 * 9.80665], abs=0.01),
                10,
                'the correction',
            )
    finally:
        end()
    assert supply[-1].voltage == pytest.approx(4.8, abs=1e-3)
    assert temperature[-1].temperature == pytest.approx(31, abs=0.02)
    assert accel(raw[-1])[:2] == pytest.approx([-0.1 * 9.80665, 0.38 * 9.80665], abs=0.01)
