# SPDX-License-Identifier: Apache-2.0
"""The page of a made-up fleet in a real browser: what it names, its layout, and its size."""

import re

from adxl_ros.errors import UserError
from adxl_ros.files.calibration_store import read_population
from adxl_ros.fleet import page as fleet_page
from made_up_fleet import MadeUpFleet
from pages import layout_faults, NEEDS_CHROMIUM, wait_until_drawn, WIDTHS
import pytest

pa = pytest.importorskip('pyarrow')
pq = pytest.importorskip('pyarrow.parquet')
pytestmark = pytest.mark.long

FLEETS = {
    'bad': MadeUpFleet(
        units=60, per_unit=12, batch=12, drifting_mg=2.5, refused=0.05, stage_fault=True
    ),
    'sound': MadeUpFleet(units=8, per_unit=6),
    'single': MadeUpFleet(units=1, per_unit=1),
    'refused': MadeUpFleet(units=3, per_unit=2, refused=1.0),
}


@pytest.fixture(scope='module')
def folders(tmp_path_factory):
    made = {}
    for name, fleet in FLEETS.items():
        made[name] = tmp_path_factory.mktemp(name)
        # A fleet without faults has a claim or an outlier in 15 % of draws; this one has none.
        fleet.write(made[name], seed=1)
        fleet_page.write(made[name])
    return made


def page_without(column, fleet, folder):
    """Return the text of the page of a fleet whose table lacks the values of a column."""
    path = fleet.write(folder)
    table = pq.read_table(path)
    pq.write_table(
        pa.Table.from_pylist([row | {column: None} for row in table.to_pylist()], table.schema),
        path,
    )
    fleet_page.write(folder)
    return (folder / 'fleet.html').read_text()


def test_the_end_of_a_run_names_batch_and_drifts(tmp_path):
    fleets = {
        'batch': MadeUpFleet(units=24, per_unit=3, batch=6, batch_scale=1.05),
        'drift': FLEETS['bad'],
        'noise': MadeUpFleet(units=12, rising_noise=0.2),
        'sound': FLEETS['sound'],
    }
    findings = {}
    for name, fleet in fleets.items():
        (tmp_path / name).mkdir()
        fleet.write(tmp_path / name, seed=1)
        findings[name] = ' '.join(fleet_page.write(tmp_path / name).findings)
    assert '6 units with a serial number B… have a scale factor x' in findings['batch']
    assert 'A-0003 drifts' in findings['drift']
    drift = re.fullmatch(
        r'A-0005 drifts: white noise N, y \+(.*) \(\+(.*) to \+(.*)\) µg/√Hz per year.',
        findings['noise'],
    )
    assert drift and float(drift[2]) < 0.2 * 110 < float(drift[3])
    assert findings['sound'] == ''


@pytest.fixture
def page(opened, folders):
    drawn, _ = opened(folders['bad'] / 'fleet.html', 1280)
    wait_until_drawn(drawn)
    return drawn


@NEEDS_CHROMIUM
def test_the_page_names_what_is_wrong(page):
    assert page.locator('.tile').first.inner_text().split()[1] == '720'
    first = page.locator('#urgent tbody tr').first.inner_text()
    assert 'A-0003' in first and 'drifts' in first and 'out of tolerance in' in first
    effects = page.locator('[data-figure=matrix]').evaluate('plot => plot.data[0].x')
    assert {'temperature_bias', 'stage_eccentricity'} <= set(effects)
    assert page.locator('.multiples figure').first.locator('h3').inner_text().startswith('A-0003')
    trace = page.locator('[data-figure=trend-0]').evaluate('plot => plot.data.map(t => t.name)')
    assert 'recording' in trace and 'line' in trace
    assert (
        page.locator('[data-figure=trend-0]').evaluate('plot => (plot.layout.shapes || []).length')
        == 1
    )
    # The unit was calibrated once meanwhile, where its line may have a step.
    assert trace.count('line') == 2


@NEEDS_CHROMIUM
def test_search(page):
    page.get_by_role('tab', name='all units').click()
    rows = page.locator('#all-units tbody tr')
    assert rows.filter(visible=True).count() == 60
    page.locator('input.search').fill('b-005')
    assert rows.filter(visible=True).count() == 10
    assert page.locator('#matches').inner_text() == '10 units'
    page.locator('input.search').fill('A-0003 drifts')
    assert rows.filter(visible=True).count() == 1


@NEEDS_CHROMIUM
@pytest.mark.parametrize(
    'name, width',
    [*(('bad', width) for width in WIDTHS), ('sound', 1280), ('single', 480), ('refused', 480)],
)
def test_layout(opened, folders, name, width):
    path = folders[name] / 'fleet.html'
    page, messages = opened(path, width)
    assert layout_faults(page) == []
    assert messages == []


def test_a_sound_fleet_is_in_order(folders):
    text = (folders['sound'] / 'fleet.html').read_text()
    assert 'bad batch.' not in text
    assert text.count('in order</span>') > 2 * 2


def test_files_beside_the_page(folders):
    population = read_population(folders['bad'] / 'population.yaml')
    pooled = population.coefficients['zero_g_y_v']
    assert pooled.units == 60
    assert abs(pooled.mean - 2.5) < 4 * pooled.mean_std
    assert pooled.spread_low < 0.02 < pooled.spread_high
    assert read_population(folders['single'] / 'population.yaml').coefficients == {}


@pytest.mark.parametrize('batch', [6, 10])
def test_a_bad_batch_shows_without_a_diagnosis(tmp_path, batch):
    """The page names it, and the others are the population."""
    fleet = MadeUpFleet(units=24, per_unit=3, batch=batch, batch_scale=1.05)
    text = page_without('effects', fleet, tmp_path)
    assert f'{batch} units with a serial number B… have a scale factor x that differs by +' in text
    assert f'from that of the {24 - batch} others: a bad batch.' in text
    pooled = read_population(tmp_path / 'population.yaml').coefficients['scale_x_v_per_g']
    assert pooled.units == 24 - batch


def test_a_file_that_is_no_table(tmp_path):
    for contents in (b'', b'not parquet'):
        (tmp_path / 'fleet.parquet').write_bytes(contents)
        with pytest.raises(UserError, match='fleet.parquet: not a table of `fleet`'):
            fleet_page.write(tmp_path)
    assert list(tmp_path.iterdir()) == [tmp_path / 'fleet.parquet']
