# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Fit a calibration to recordings, without a running graph."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from adxl_ros.calibrate import calibration, pose_extraction
from adxl_ros.calibrate.report import report_html
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file, recording, sweep_journal
from adxl_ros.files.checksum import sha256
from adxl_ros.files.stream_unit import recorded_unit
from adxl_ros.model.sensor import Sensor
from adxl_ros.tools.common import make_folder, run, say_notes


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argparse.ArgumentParser(prog='fit', description=__doc__)
    parse.add_argument('recording', nargs='+',
                       help='rosbag2 directory, .mcap or CSV, all of one unit')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='figures that are not fitted (default: the nominal sensor)')
    parse.add_argument('--model', choices=list(calibration.STAGE_FITS),
                       help='against stage angles (default: the richest that the poses '
                            'determine); a three-axis recording without them is '
                            'calibrated against gravity')
    parse.add_argument('--effect', metavar='NAME', action='append', default=[],
                       help='an effect more for the full model to find')
    parse.add_argument('--journal', metavar='FILE',
                       help='use the rests that the journal of this very run names')
    parse.add_argument('-o', dest='output', metavar='FILE.yaml', required=True)
    parse.add_argument('--report', metavar='DIR',
                       help='leave a page there, report.html, and the figures')
    parse.add_argument('--store', metavar='DIR', default=str(calibration_store.default_folder()),
                       help="the folder of all units' calibrations, which gets a copy (default: "
                            '%(default)s); empty for none')
    return parse


def fit(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if options.journal and len(options.recording) != 1:
        raise UserError(f'--journal {options.journal}: names the rests of one recording, but '
                        f'{len(options.recording)} are given')
    sensor = parameter_file.load(options.params or parameter_file.nominal_path())
    records = _records(options.journal)
    unit: Sensor | None = None
    parts, filters = [], []
    for path in options.recording:
        read = recording.read(path)
        say_notes('fit', read)
        unit = recorded_unit(unit or sensor, read)
        parts.append(pose_extraction.extract_poses(read, unit, records))
        filters.append(pose_extraction.estimate_filters(read, unit, parts[-1]))
    found = calibration.calibrate(unit, parts, options.model,
                                  [Path(path).name for path in options.recording],
                                  options.effect, filters, sha256(options.recording))
    if options.report:
        make_folder(Path(options.report))
        report_html.write(options.report, found, options.store)
    found.save(options.output)
    kept = found.keep(options.store)
    print('\n'.join(found.comments()))
    print(f'fit: {kept}', file=sys.stderr)
    return 0


def _records(path: str | None) -> list[sweep_journal.PoseRecord] | None:
    return None if path is None else sweep_journal.poses_to_fit(sweep_journal.read(path).entries)


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), fit)
