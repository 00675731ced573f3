# SPDX-License-Identifier: Apache-2.0

"""The files of a diagnosis: report, parameters with its effects, and page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import json
from typing import Any

from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.page import page, Run
from adxl_ros.files import parameter_file


def as_text(values: dict[str, Any]) -> str:
    """Return values as JSON."""
    return json.dumps(values, indent=1, allow_nan=False) + '\n'


def documents(diagnosis: Diagnosis, report: dict[str, Any], comments: Sequence[str],
              run: Run | None) -> dict[str, str]:
    """
    Return the files of a diagnosis by name.

    report: its JSON; comments: head of the parameters, which a fault leaves out; run: what the
    page says of the run, None without a page.
    """
    texts = {'report.json': as_text(report)}
    if diagnosis.report is not None:
        texts['params.yaml'] = parameter_file.as_text(diagnosis.report.sensor, comments)
    if run is not None:
        texts['report.html'] = page(diagnosis, replace(
            run, parameters_text=texts.get('params.yaml', '')))
    return texts
