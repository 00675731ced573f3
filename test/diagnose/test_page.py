# SPDX-License-Identifier: Apache-2.0
"""The page of a diagnosis in a real browser: what it shows first, its proofs, layout and files."""

from pages import layout_faults, NEEDS_CHROMIUM, wait_until_drawn, WIDTHS
import pytest

pytestmark = [pytest.mark.long, NEEDS_CHROMIUM]

EFFECTS = ('temperature_bias', 'lever_arm')


@pytest.fixture
def page(opened, two_effects):
    drawn, _ = opened(two_effects / 'gap' / 'report.html', 1280)
    wait_until_drawn(drawn)
    return drawn


def test_the_first_screen(page):
    page.set_viewport_size({'width': 1280, 'height': 900})
    assert 'green' in page.locator('.badge').get_attribute('class')
    assert page.locator('.tile').count() == 4
    assert page.locator('.effect h3').all_inner_texts() == list(EFFECTS)
    for place in ('.badge', '.tiles', '[data-figure=waterfall]', '.effect >> nth=1'):
        box = page.locator(place).first.bounding_box()
        assert box['y'] + box['height'] < 900, place
    assert (
        page.locator('.command code').first.inner_text()
        == 'ros2 run adxl_ros diagnose run.csv -o gap --self-check 1 --limit'
    )


@pytest.mark.parametrize('width', WIDTHS)
@pytest.mark.parametrize('name', ['gap', 'fault'])
def test_layout(opened, two_effects, name, width):
    """No text overlaps another one or is cut, and no number has an exponent."""
    path = two_effects / name / 'report.html'
    page, messages = opened(path, width)
    assert layout_faults(page) == []
    assert messages == []
    assert path.stat().st_size < 5_000_000


def test_faults_of_layout_are_found(opened, tmp_path):
    """The search for faults can fail."""
    path = tmp_path / 'bad.html'
    path.write_text(
        '<body data-drawn="yes"><p>1.3e-14</p><p style="width:3000px">wide</p>'
        '<p style="position:absolute;top:0">above</p>'
        '<div style="width:30px;overflow:hidden;white-space:nowrap">a long text</div>'
    )
    page, _ = opened(path)
    kinds = {fault.partition(':')[0] for fault in layout_faults(page)}
    assert kinds == {'exponent', 'overlap', 'cut', 'wider than the window'}


def test_each_effect_has_its_proof(page):
    """Means over the temperature lie on the line of the model, within their error bars."""
    plots = page.locator('.plot[data-figure^=proof]')
    assert plots.count() == len(EFFECTS)
    plot = page.locator('[data-figure=proof-temperature_bias]')
    assert 'temperature, °C' in plot.inner_text()
    traces = plot.evaluate('plot => plot.data.map(t => ({x: t.x, y: t.y, e: t.error_y}))')
    recorded, model = traces[:2]
    assert recorded['x'] == model['x'] and len(recorded['x']) > 5
    ratios = [abs(r - m) / e for r, m, e in zip(recorded['y'], model['y'], recorded['e']['array'])]
    assert sum(ratio < 1.5 for ratio in ratios) > 0.8 * len(ratios)
    # The effect is visible: the line rises by far more than the error bars.
    assert max(model['y']) - min(model['y']) > 5 * min(recorded['e']['array'])


def test_zoom_is_linked(page):
    plot = page.locator('[data-figure=signals]')
    plot.scroll_into_view_if_needed()
    box = plot.locator('.nsewdrag').first.bounding_box()
    page.mouse.move(box['x'] + 100, box['y'] + 20)
    page.mouse.down()
    page.mouse.move(box['x'] + 300, box['y'] + 21, steps=5)
    page.mouse.up()
    page.wait_for_function(
        'document.querySelector("[data-figure=signals]").layout.xaxis.autorange !== true'
    )
    assert plot.evaluate('plot => plot.data.every(t => !t.xaxis || t.xaxis === "x")')
    assert plot.locator('.nsewdrag').count() == 4
