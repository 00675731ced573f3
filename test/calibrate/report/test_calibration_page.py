# SPDX-License-Identifier: Apache-2.0

"""The report of a calibration in a browser: it opens offline, without errors, and turns."""

from dataclasses import replace
from itertools import product
import re

from adxl_ros.files import calibration_store, parameter_file
import numpy as np
from pages import layout_faults, NEEDS_CHROMIUM, wait_until_drawn, WIDTHS
from processes import run_executable
import pytest
from units import NOMINAL

pytestmark = [pytest.mark.long, NEEDS_CHROMIUM]


@pytest.fixture
def report_folder(made_once):
    return made_once('reported', fill_report)


def fill_report(folder):
    text = NOMINAL.read_text().replace('serial: nominal', "serial: '<U&7>'")
    (folder / 'u7.yaml').write_text(text)

    def run(name, *arguments):
        done = run_executable(name, *arguments, '--params', 'u7.yaml', cwd=folder)
        assert done.returncode == 0, done.stderr

    run(
        'simulate',
        'sweep',
        '--rate',
        '100',
        '--effect',
        'bias',
        '--effect',
        'cross_axis_z',
        '--seed',
        '5',
        '-o',
        'sweep.csv',
    )
    run(
        'fit',
        'sweep.csv',
        '--model',
        'physical',
        '-o',
        'unit.yaml',
        '--store',
        'store',
        '--report',
        'first',
    )
    ((path, sensor),) = calibration_store.history(folder / 'store', '<U&7>').calibrations
    path.unlink()
    bias = sensor.values['bias']['offset_v'] - [0.004, 0.0]
    old = replace(
        sensor,
        values={**sensor.values, 'bias': {'offset_v': bias}},
        provenance={
            **sensor.provenance,
            'id': 'last-year',
            'date': '2026-01-01T00:00:00+00:00',
            'data_sha256': '0' * 64,
            'temperature_c': '25.00',
        },
    )
    calibration_store.put(folder / 'store', old)
    run('fit', 'sweep.csv', '-o', 'unit.yaml', '--store', 'store', '--report', 'report')


def test_the_report_has_its_contents(opened, report_folder):
    page, messages = opened(report_folder / 'report' / 'report.html')
    wait_until_drawn(page)
    assert messages == []
    text = page.locator('body').inner_text()
    assert 'Calibration of <U&7>' in text
    assert 'green' in page.locator('.badge').get_attribute('class')
    assert page.locator('.tile').count() == 3
    rows = page.locator('table.limits tbody tr')
    assert rows.locator('td:first-child').all_inner_texts() == [
        'nominal',
        'linear',
        'physical',
        'full',
    ]
    assert 'PASS' in rows.nth(3).inner_text() and 'FAIL' in rows.nth(1).inner_text()
    # Each cell has one outcome.
    assert not any(
        ' ' in cell
        for cell in page.locator('table.limits .PASS, table.limits .FAIL').all_inner_texts()
    )
    coefficients = page.locator('table.coefficients')
    sensor = parameter_file.load(report_folder / 'unit.yaml')
    names = coefficients.inner_text()
    assert all(str(name) in names for name in sensor.covariance_names)
    assert coefficients.locator('.whisker').count() == len(sensor.covariance_names)
    cubic = coefficients.locator('tr', has_text='nonlinearity.cubic_per_g2.x').inner_text()
    assert 'typical ±0.00069, maximum ±0.0043' in cubic and 'cubic x' in cubic
    assert 'last-year' in text
    assert page.locator('[data-figure=errors] .point').count() >= 2
    assert page.locator('img').count() == 1
    assert page.evaluate('[...document.images].every(i => i.complete && i.naturalWidth > 500)')
    for value in (sensor.provenance['id'], sensor.provenance['data_sha256']):
        assert value in text


@pytest.mark.parametrize('width', WIDTHS)
def test_layout(opened, report_folder, width):
    """No text overlaps another one or is cut, and no number has an exponent."""
    path = report_folder / 'report' / 'report.html'
    page, messages = opened(path, width)
    assert layout_faults(page) == []
    assert messages == []
    assert path.stat().st_size < 5_000_000


def test_the_sphere_turns(opened, report_folder):
    """Mouse, wheel and keys turn it. A text names the pose below the pointer."""
    page, messages = opened(report_folder / 'report' / 'report.html')
    sphere = page.locator('#sphere')
    sphere.scroll_into_view_if_needed()
    box = sphere.bounding_box()
    pictures = [sphere.screenshot()]

    def changed():
        pictures.append(sphere.screenshot())
        return pictures[-1] != pictures[-2]

    assert len(set(np.frombuffer(pictures[0], np.uint8))) > 100
    page.mouse.move(box['x'] + 300, box['y'] + 200)
    page.mouse.down()
    page.mouse.move(box['x'] + 380, box['y'] + 260, steps=4)
    page.mouse.up()
    assert changed()
    yaw, pitch, zoom = map(float, sphere.get_attribute('data-turn').split())
    assert (yaw, pitch, zoom) == pytest.approx((-0.7 + 0.64, 0.45 + 0.48, 1.0), abs=0.02)
    page.mouse.move(box['x'] + 500, box['y'] + 260)
    assert sphere.get_attribute('data-turn').startswith(f'{yaw:.3f}')
    page.mouse.wheel(0, -300)
    page.wait_for_function('document.getElementById("sphere").dataset.turn.endsWith("1.35")')
    assert changed()
    sphere.press('ArrowLeft')
    assert changed()
    page.select_option('#sphere-model', label='linear')
    assert changed()
    page.select_option('#sphere-quantity', label='error of x, mg')
    assert changed()
    pose_text = page.locator('#sphere-about')
    sphere.scroll_into_view_if_needed()
    box = sphere.bounding_box()
    for x, y in product(range(300, 520, 10), range(180, 360, 10)):
        page.mouse.move(box['x'] + x, box['y'] + y)
        if pose_text.inner_text().startswith('pose'):
            break
    assert re.match(r'pose \d+, alpha [\d.]+°, beta [\d.]+°: -?[\d.]+ mg', pose_text.inner_text())
    assert messages == []
