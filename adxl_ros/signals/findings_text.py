# SPDX-License-Identifier: Apache-2.0

"""The sentences of a check: what is said of the stamps of a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adxl_ros.report.quantities import counted, duration
from adxl_ros.wording import option

if TYPE_CHECKING:
    from adxl_ros.signals.recording_contents import RecordingContents


def bad_stamps(contents: RecordingContents) -> list[str]:
    """Say which samples have no stamp of their own, one line a kind."""
    leaves_out = option(drop_bad_stamps=True)
    return [f'{text}; {leaves_out} leaves them out' for text in contents.bad_stamps.texts]


def missing(contents: RecordingContents) -> str:
    """Say how many samples are missing."""
    share = contents.missing / (contents.samples + contents.missing)
    verb = 'is' if contents.missing == 1 else 'are'
    return (
        f'{counted(contents.missing, "sample")} {verb} missing ({100 * share:.2g} %) in '
        f'{counted(contents.gaps, "gap")}, the longest of {contents.longest_gap_s:.3g} s'
    )


def jitter(contents: RecordingContents, largest_s: float) -> str:
    """Say that stamps scatter by more than a sound log's."""
    return (
        f'stamps scatter by {1e3 * contents.jitter_s:.3g} ms rms, expected {1e3 * largest_s:.3g} '
        f'ms at most; {option(rate="HZ")} stamps by index'
    )


def bursts(contents: RecordingContents) -> str:
    """Say that stamps come in bursts."""
    return (
        f'stamps come in bursts of {contents.burst} samples; '
        f'{option(rate=f"{contents.rate_hz:.4g}")} stamps by index'
    )


def log_delay(delay_s: float) -> str:
    """Say that a recorder's clock differs from that of the sensor."""
    order = 'after' if delay_s > 0 else 'before'
    return (
        f'log time is {duration(abs(delay_s))} {order} header time; the clocks of sensor and '
        'recorder differ, or the headers have simulated time'
    )
