# SPDX-License-Identifier: Apache-2.0

"""Make docs/gap.svg: a log goes in, its cause is named, the gap closes. All of it is computed."""

from collections.abc import Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

import adxl_ros as adxl
from adxl_ros.model.constants import G0_MPS2
import numpy as np

PATH = Path(__file__).parent / 'gap.svg'
RATE_HZ = 50.0  # Of the log
MEAN_S = 0.5  # Readings are shown as means of this time, which leave the gap above the noise
WIDTH, HEIGHT = 840, 450  # Of the picture
LEFT, TOP, PLOT_WIDTH, PLOT_HEIGHT = 70, 70, 740, 170  # Of the curves
LARGEST_MG = 4.0  # End of the axis
COLOURS = {'x': '#1f6fb4', 'y': '#c4651a'}
LOOP_S = 12  # Of the animation
SCENES = {'cause': (28, 95), 'before': (0, 62), 'after': (64, 95)}
"""When the parts are seen, in percent of the loop."""


def means(values: np.ndarray) -> np.ndarray:
    """Return the means of blocks, (k,)."""
    count = round(MEAN_S * RATE_HZ)
    return values[: len(values) // count * count].reshape(-1, count).mean(1)


def curves(gap_mg: dict[str, np.ndarray], name: str) -> list[str]:
    """Draw the difference of each axis, where it is compared."""
    lines = []
    for axis, values in gap_mg.items():
        shown = np.clip(means(values), -LARGEST_MG, LARGEST_MG)
        x = LEFT + PLOT_WIDTH * np.arange(len(shown)) / (len(shown) - 1)
        y = TOP + PLOT_HEIGHT / 2 * (1 - shown / LARGEST_MG)
        places = [f'{a:.1f},{b:.1f}' if np.isfinite(b) else '|' for a, b in zip(x, y)]
        for points in ' '.join(places).split('|'):
            if points.strip():
                colour = f'stroke="{COLOURS[axis]}"'
                lines.append(f'<polyline class="{name}" {colour} points="{points.strip()}"/>')
    return lines


def text(x: float, y: float, words: str, kind: str = '') -> str:
    """Write a line."""
    return f'<text x="{x}" y="{y}" class="{kind}" xml:space="preserve">{escape(words)}</text>'


def style() -> list[str]:
    """Return the rules that show each part in its time; without motion all parts are seen."""
    rules = [
        'text{font:15px sans-serif;fill:#222}',
        '.title{font-weight:bold;font-size:18px}',
        '.table{font:14px monospace}',
        'polyline{fill:none;stroke-width:1.3}',
        '.end{text-anchor:end}',
        *(f'.{axis}{{fill:{colour};font-weight:bold}}' for axis, colour in COLOURS.items()),
        '@media (prefers-reduced-motion:reduce){*{animation:none!important}.before{opacity:0}}',
    ]
    for name, (begin, end) in SCENES.items():
        rules += [
            f'.{name}{{animation:{name} {LOOP_S}s linear infinite}}',
            f'@keyframes {name}{{0%,{max(begin - 2, 0)}%{{opacity:{int(begin == 0)}}}'
            f'{begin}%,{end}%{{opacity:1}}{min(end + 3, 100)}%,100%{{opacity:0}}}}',
        ]
    return ['<style>', *rules, '</style>']


def picture(
    before_mg: dict[str, np.ndarray],
    after_mg: dict[str, np.ndarray],
    span_s: float,
    gap: adxl.Gap,
) -> Sequence[str]:
    """Return the lines of the file."""
    figures = gap.figures
    assert figures is not None
    rms_mg = [v.value / G0_MPS2 * 1e3 for v in (figures.before_mps2, figures.after_mps2)]
    screen = gap.screen
    first = next(i for i, line in enumerate(screen) if line.startswith(' effect'))
    rows = screen[first : screen.index('', first)]
    bottom = TOP + PLOT_HEIGHT
    middle = TOP + PLOT_HEIGHT / 2
    return [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">',
        '<title>A log minus its simulation, the causes that diagnose names, and the gap after '
        'them</title>',
        *style(),
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
        text(LEFT, 30, 'adxl_ros diagnose: log minus simulation, mg, means of 0.5 s', 'title'),
        text(LEFT, 54, f'gap {rms_mg[0]:.2f} mg rms', 'before'),
        text(LEFT, 54, f'gap {rms_mg[0]:.2f} mg → {rms_mg[1]:.2f} mg, the noise floor', 'after'),
        *(
            text(LEFT + PLOT_WIDTH - 70 + 40 * i, 54, f'— {axis}', axis)
            for i, axis in enumerate(COLOURS)
        ),
        text(LEFT - 6, TOP + 6, f'+{LARGEST_MG:g} mg', 'end'),
        text(LEFT - 6, middle + 5, '0', 'end'),
        text(LEFT - 6, bottom + 4, f'−{LARGEST_MG:g} mg', 'end'),
        text(LEFT, bottom + 20, '0 s'),
        text(LEFT + PLOT_WIDTH, bottom + 20, f'{span_s:.0f} s', 'end'),
        f'<path d="M{LEFT} {middle}H{LEFT + PLOT_WIDTH}" stroke="#bbb"/>',
        f'<rect x="{LEFT}" y="{TOP}" width="{PLOT_WIDTH}" height="{PLOT_HEIGHT}" fill="none" '
        'stroke="#bbb"/>',
        *curves(before_mg, 'before'),
        *curves(after_mg, 'after'),
        '<g class="cause">',
        *(text(LEFT, bottom + 50 + 20 * i, row, 'table') for i, row in enumerate(rows)),
        '</g>',
        '</svg>',
    ]


def main() -> None:
    """Simulate a log of a sensor with two effects, diagnose it, and draw the three steps."""
    nominal = adxl.load('adxl203')
    hidden = ['lever_arm', 'temperature_bias']
    log = adxl.simulate('rich', nominal, effects=hidden, rate=RATE_HZ, seed=3)
    gap = adxl.diagnose(log, nominal)
    (compared,) = gap.diagnosis.full_rate

    def differences_mg(sensor: adxl.Sensor) -> dict[str, np.ndarray]:
        quiet = replace(sensor, noise_density_g_per_rthz=np.zeros(2), adc_bits=0)
        simulated = adxl.simulate(log, quiet)
        return {
            axis: np.where(
                compared.used,
                (log.columns[f'{axis}_v'] - simulated.columns[f'{axis}_v']) / scale * 1e3,
                np.nan,
            )
            for axis, scale in zip(sensor.axes, sensor.nominal_scale_v_per_g)
        }

    lines = picture(differences_mg(nominal), differences_mg(gap.sensor), log.span_s, gap)
    PATH.write_text('\n'.join(lines) + '\n', 'utf-8')
    print(f'wrote {PATH}, {PATH.stat().st_size / 1e3:.0f} kB')


if __name__ == '__main__':
    main()
