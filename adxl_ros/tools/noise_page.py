# SPDX-License-Identifier: Apache-2.0

"""The page and the plot of `noise`: the Allan deviation with the fitted lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from adxl_ros.files import html_page
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.plot_file import pyplot, write_plot
from adxl_ros.signals.axis_noise import RecordingNoise, TERMS
from adxl_ros.tools import noise_text

_INCHES = (5.0, 4.4)
"""Width and height of the plot of an axis, inches. Chosen: three fit beside each other."""
_COLUMNS = ('axis', 'white noise N, µg/√Hz', 'bias instability B, µg', 'random walk K, µg/√s',
            'lowest Allan deviation, µg', 'noise of a sample, m/s²', 'fitted below, Hz')
"""Head of the table."""


def write(folder: Path, result: RecordingNoise) -> list[Path]:
    """Write the page, the plot and the curve."""
    page, plot, curve = (folder / name for name in ('report.html', 'allan.png', 'allan.csv'))
    figure = _plot(result)
    write_text(page, _page(result, figure))
    write_plot(figure, plot)
    with csv_writer(curve) as append:
        append({'tau_s': result.rest.allan.tau_s, 'averages': result.rest.allan.averages,
                **{f'{noise.axis}_mps2': result.rest.allan.deviation[:, i]
                   for i, noise in enumerate(result.axes)}})
    return [page, plot, curve]


def _page(result: RecordingNoise, figure: Any) -> str:
    """Return the page."""
    rows = [[noise.axis, *(noise_text.interval(estimate.scaled(noise_text.MICRO_G))
                           for estimate in noise.estimates),
             f'{noise.lowest * noise_text.MICRO_G:.3g} at {noise.lowest_s:.3g} s',
             f'{noise.sample_std:.3g}', f'{noise.fit.highest_hz:.3g}'] for noise in result.axes]
    return html_page.render('adxl_ros.tools', 'noise.html', {
        'title': 'Noise at rest', 'about': noise_text.head(result), 'badge': None, 'figures': {},
        'warnings': noise_text.warnings(result), 'columns': _COLUMNS, 'rows': rows,
        'picture': html_page.picture_url(figure),
        'paste_lines': noise_text.paste_lines(result)})


def _plot(result: RecordingNoise) -> Any:
    """Return the plot of the Allan deviation by axis."""
    figure, axes = pyplot().subplots(1, len(result.axes), squeeze=False, sharey=True,
                                     figsize=(_INCHES[0] * len(result.axes), _INCHES[1]),
                                     layout='constrained')
    tau_s, error = result.rest.allan.tau_s, result.rest.allan.relative_error
    for i, (noise, plot) in enumerate(zip(result.axes, axes[0])):
        measured = result.rest.allan.deviation[:, i] * noise_text.MICRO_G
        plot.errorbar(tau_s, measured, yerr=measured * error.clip(max=0.9), fmt='o', ms=4,
                      color='#36c', label='measured')
        for name, line, estimate in zip(TERMS, noise.fit.lines(tau_s), noise.estimates):
            if estimate.is_seen:
                plot.plot(tau_s, line * noise_text.MICRO_G, '--', lw=1,
                          label=f'{noise_text.NAMES[name]}')
        plot.plot(tau_s, noise.fit.allan_deviation(tau_s) * noise_text.MICRO_G, color='#222',
                  lw=1, label='all three')
        plot.set(xscale='log', yscale='log', title=f'axis {noise.axis}',
                 xlabel='averaging time τ, s', ylim=(measured.min() / 3, measured.max() * 2))
        plot.grid(True, which='both', alpha=0.3)
        plot.legend(fontsize=8)
    axes[0][0].set_ylabel('Allan deviation, µg')
    return figure
