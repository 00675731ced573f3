# SPDX-License-Identifier: Apache-2.0

"""
Diagnoses by a robot as the reference: clean runs, and defects that another simulator puts in.

    ./run --exec python docs/measurements/robot_cases.py              20 cases each, ten minutes
    ./run --exec python docs/measurements/robot_cases.py --cases 4 -o /tmp/cases.md

An arm that moves from rest to rest, and a leg on a stand that trots, carry a sensor. The encoders
are read with their steps. A defect is one of the blind check's world, as `blind --real` puts it
in, or a sensor that sits 10 to 30 mm beside its place.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from functools import partial
from itertools import product
from pathlib import Path
import tempfile
from typing import NamedTuple

import adxl_ros as adxl
from adxl_ros.files.atomic_write import write_text
from adxl_ros.process import package_version
from adxl_ros.simulate.robot import Robot
from adxl_ros_validation.blind import scores, simulator as sim, trials
from adxl_ros_validation.blind.faults import KINDS, KNOWN
from adxl_ros_validation.blind.ideal_observer import rms
from adxl_ros_validation.blind.real_sensors import acted_on, Half, with_samples
from adxl_ros_validation.blind.report import markdown_table
from adxl_ros_validation.blind.simulator import G0
from adxl_ros_validation.simulators import arm
import numpy as np
import pandas as pd
import scipy

RATE_HZ = 100.0  # Of samples and encoders; chosen: usual for an arm
FINE_HZ = 1000.0  # Of the path of the joints; chosen: far above its fastest motion
SECONDS = 60.0  # Length of a case; chosen: 10 to 15 rests
DENSITY = (6e-5, 2.5e-4)  # Stated noise density, g/√Hz: from a good analog sensor to a phone's
NOISES = (1.0, 20.0)  # Weakest and strongest defect, in the noise of a sample
PLACE_M = (0.01, 0.03)  # Distance of a sensor from its place
LEG = """<robot name="leg"><link name="base"/><link name="hip"/><link name="thigh"/>
<link name="shank"/><link name="imu_link"/>
<joint name="hip_roll" type="revolute"><parent link="base"/><child link="hip"/>
<origin xyz="0.2 0.05 0.5"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="9" velocity="30"/></joint>
<joint name="hip_pitch" type="revolute"><parent link="hip"/><child link="thigh"/>
<origin xyz="0 0.08 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="3" effort="9" velocity="30"/></joint>
<joint name="knee" type="revolute"><parent link="thigh"/><child link="shank"/>
<origin xyz="0 0 -0.21"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="0" effort="9" velocity="30"/></joint>
<joint name="mount" type="fixed"><parent link="shank"/><child link="imu_link"/>
<origin xyz="0.02 0.01 -0.12" rpy="0.1 1.2 -0.2"/></joint></robot>
"""
ARM_PLACE = 'xyz="0.08 -0.05 0.06"'
LEG_PLACE = 'xyz="0.02 0.01 -0.12"'


@dataclass(frozen=True)
class Body:
    """A robot, and how it moves."""

    name: str
    urdf: str  # Text of the URDF
    place: str  # The place of the sensor in it
    joints: tuple[str, ...]
    pose_rad: np.ndarray  # Middle of its poses
    reach_rad: np.ndarray  # Largest distance of a pose from the middle
    stride_rad: np.ndarray  # Amplitude of a trot; 0 without
    step_rad: float  # Of the encoders, at the joint

    def moved(self, offset_m: Sequence[float]) -> str:
        """Return the URDF with the sensor beside its place."""
        at = np.fromstring(self.place[5:-1], sep=' ') + offset_m
        return self.urdf.replace(self.place, f'xyz="{" ".join(map(str, at))}"')


BODIES = (
    Body(
        'arm',
        arm.URDF.read_text(encoding='utf-8'),
        ARM_PLACE,
        ('joint1', 'joint2', 'joint3'),
        np.zeros(3),
        np.array([1.2, 1.0, 1.2]),
        np.zeros(3),
        2 * np.pi / 2**19,
    ),
    Body(
        'leg',
        LEG,
        LEG_PLACE,
        ('hip_roll', 'hip_pitch', 'knee'),
        np.array([0.0, 0.8, -1.5]),
        np.array([0.4, 0.6, 0.6]),
        np.array([0.05, 0.3, 0.4]),
        2 * np.pi / 2**14 / 9,  # 14 bits before a gear of 9
    ),
)


def smooth(u: np.ndarray) -> np.ndarray:
    """Return the share of a move that begins and ends with no acceleration and no jerk."""
    u = np.clip(u, 0, 1)
    return u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3)


def joints_of(body: Body, rng: np.random.Generator) -> np.ndarray:
    """Return position, rate and acceleration of the joints at the samples, (3, n, 3)."""
    time_s = np.arange(0, SECONDS + 0.5 / FINE_HZ, 1 / FINE_HZ)
    path = np.tile(body.pose_rad, (len(time_s), 1))
    begin_s, pose = rng.uniform(2.0, 3.0), body.pose_rad
    while begin_s < SECONDS - 4.0:
        target = body.pose_rad + body.reach_rad * rng.uniform(-1, 1, 3)
        takes_s, rests_s = rng.uniform(1.0, 2.0), rng.uniform(1.2, 2.5)
        path += smooth((time_s - begin_s) / takes_s)[:, None] * (target - pose)
        pose, begin_s = target, begin_s + takes_s + rests_s
        if body.stride_rad.any() and begin_s < SECONDS - 10:
            trots_s, hertz = rng.uniform(4.0, 6.0), rng.uniform(1.2, 2.0)
            fade = smooth((time_s - begin_s) / 0.7) * smooth((begin_s + trots_s - time_s) / 0.7)
            phase = 2 * np.pi * hertz * (time_s - begin_s)[:, None] + np.array([0.0, 0.5, 2.0])
            path += fade[:, None] * body.stride_rad * np.sin(phase)
            begin_s += trots_s + rng.uniform(1.2, 2.5)
    spline = scipy.interpolate.make_interp_spline(time_s, path, 7)
    at_s = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    return np.array([spline(at_s, order) for order in range(3)])


class Found(NamedTuple):
    """What a diagnosis names."""

    verdict: str
    certain: frozenset[str]  # 'unknown' among them
    groups: tuple[frozenset[str], ...]

    @classmethod
    def of(cls, gap: adxl.Gap) -> Found:
        """Return what a verdict names."""
        verdict = gap.to_dict()['verdict']
        certain = {*verdict['effects'], *(['unknown'] if gap.verdict == 'unknown' else [])}
        return cls(gap.verdict, frozenset(certain), tuple(map(frozenset, verdict['groups'])))

    @property
    def words(self) -> str:
        """Return it for people."""
        groups = [f'({" or ".join(sorted(group))})' for group in self.groups]
        return ', '.join([*sorted(self.certain), *groups]) or self.verdict


@dataclass
class Case:
    """A recording of a sensor on a robot, and its defect."""

    body: Body
    defect: str  # '' for none
    recording: pd.DataFrame
    force: pd.DataFrame  # Exact force
    parameters: str
    noises: float = 0.0  # Strength of the defect, in the noise of a sample
    found: dict[str, Found] = field(default_factory=dict)  # By what the reference is

    @property
    def words(self) -> str:
        """Return the defect, and its strength."""
        return f'{self.defect}, {self.noises:.1f} times' if self.defect else 'none'


def draw(body: Body, defect: str, seed: Sequence[int], folder: Path) -> Case:
    """Draw a case."""
    rng = np.random.default_rng(seed)
    joints = joints_of(body, rng)
    time_s = np.arange(joints.shape[1]) / RATE_HZ
    offset_m = rng.normal(size=3)
    offset_m *= rng.uniform(*PLACE_M) / np.linalg.norm(offset_m)
    urdf = folder / 'true.urdf'
    forces = []
    for text in (body.urdf, body.moved(offset_m)):
        urdf.write_text(text)
        forces.append(Robot(urdf, arm.FRAME).motion(joints, None, G0).force_mps2)
    sits = forces[defect == 'lever_arm']
    stated = rng.uniform(*DENSITY) * np.ones(3)
    noise_mps2 = stated[0] * rng.uniform(0.85, 1.2) * np.sqrt(RATE_HZ / 2) * G0
    samples = sits + noise_mps2 * rng.normal(size=sits.shape)
    names = ('ax_mps2', 'ay_mps2', 'az_mps2')
    table = pd.DataFrame({'time_s': time_s, **dict(zip(names, samples.T))})
    exact = pd.DataFrame({'time_s': time_s, **dict(zip(names, forces[0].T))})
    half = Half(body.name, 'simulator', table, exact, {}, noise_mps2=noise_mps2)
    strength_mps2 = rms((sits - forces[0]).T)
    if defect and defect != 'lever_arm':
        measure = partial(_with_fault, half, tuple(seed))
        kind = KINDS[defect]
        _, _, strength_mps2, changed = trials.sized(
            rng, kind, half.unit(), NOISES, measure, noise_mps2
        )
        half = with_samples(half, changed)
    read = np.rint(joints[0] / body.step_rad) * body.step_rad
    unit = replace(
        half.unit(),
        stated_zero_v=np.zeros(3),
        stated_scale_v_per_g=np.ones(3),
        stated_noise_g_per_rthz=stated,
        resolution_rad=1e-4,
    )
    return Case(
        body,
        defect,
        half.columns.assign(**{f'{n}_rad': q for n, q in zip(body.joints, read.T)}),
        exact,
        sim.parameter_file(
            unit, 'unit', nominal_zero_v=0.0, adc_bits=0, adc_vref_v=100.0, range_g=16.0
        ),
        strength_mps2 / noise_mps2,
    )


def _with_fault(half: Half, seed: tuple[int, ...], fault: sim.Fault) -> tuple[float, np.ndarray]:
    """Let a fault act on the samples; return its strength, m/s², and samples, g."""
    after = acted_on(half, seed, fault)
    return rms(G0 * (after - half.g())), after


def defects(half: Half) -> list[str]:
    """Return the defects of the library that can be put into samples, and the sensor's place."""
    return ['lever_arm', *(name for name in half.kinds() if name in KNOWN)]


def drawn(count: int, seed: int, folder: Path) -> Iterator[Case]:
    """Draw cases of each robot in turn, without and with a defect."""
    first = draw(BODIES[0], '', [seed, 0, 0], folder)
    kinds = defects(Half('', 'simulator', first.recording, first.force, {}))
    for k, (number, body) in product(range(count), enumerate(BODIES)):
        for defect in ('', kinds[k % len(kinds)]):
            yield draw(body, defect, [seed, number, k, bool(defect)], folder)


def diagnosed(case: Case, folder: Path) -> None:
    """Diagnose a case by its robot, and one with a defect by the exact force, too."""
    urdf, parameters = folder / 'robot.urdf', folder / 'unit.yaml'
    urdf.write_text(case.body.urdf)
    parameters.write_text(case.parameters)
    recording = adxl.from_arrays(case.recording, name=case.body.name)
    gap = adxl.diagnose(recording, parameters, urdf=urdf, frame=arm.FRAME)
    case.found['robot'] = Found.of(gap)
    # A force does not show where the sensor sits.
    if case.defect not in ('', 'lever_arm'):
        exact = adxl.from_arrays(case.force, name='force')
        case.found['exact'] = Found.of(adxl.diagnose(recording, parameters, sim=exact))


def row(body: Body, cases: Sequence[Case]) -> list[str]:
    """Return the row of a robot."""
    clean = [case.found['robot'].verdict == 'no_gap' for case in cases if not case.defect]
    cells = [body.name, scores.in_words(scores.share(clean))]
    for reference in ('robot', 'exact'):
        found = [
            (case.defect, case.found[reference])
            for case in cases
            if case.defect and reference in case.found
        ]
        exact = [each.words == defect for defect, each in found]
        in_set = [defect in each.certain.union(*each.groups) for defect, each in found]
        cells += [scores.in_words(scores.share(exact)), scores.in_words(scores.share(in_set))]
    return cells


def main() -> int:
    """Draw, diagnose, and write the page."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--cases', type=int, default=20)
    parse.add_argument('--seed', type=int, default=0)
    parse.add_argument('-o', dest='output', default=str(Path(__file__).with_suffix('.md')))
    options = parse.parse_args()
    cases: list[Case] = []
    # What is done until an interruption counts.
    with tempfile.TemporaryDirectory() as temporary, suppress(KeyboardInterrupt):
        for case in drawn(options.cases, options.seed, Path(temporary)):
            diagnosed(case, Path(temporary))
            answers = [found.words for found in case.found.values()]
            print(case.body.name, case.words, *answers, sep=' | ', flush=True)
            cases.append(case)
    write_text(options.output, page(options, cases))
    return 0


def page(options: argparse.Namespace, cases: Sequence[Case]) -> str:
    """Return the page."""
    table = [row(body, [case for case in cases if case.body is body]) for body in BODIES]
    wrong = []
    for case in cases:
        answers = {reference: found.words for reference, found in case.found.items()}
        if answers['robot'] != (case.defect or 'no_gap'):
            exact = answers.get('exact', '-')
            wrong.append([case.body.name, case.words, answers['robot'], exact])
    head = (
        'robot',
        'clean: no gap',
        'single, exactly',
        'in the named set',
        'by the exact force, exactly',
        'in the named set',
    )
    return f"""# Diagnoses by a robot

{date.today()}, version {package_version()},
`docs/measurements/robot_cases.py --cases {options.cases} --seed {options.seed}`.
{SECONDS:.0f} s at {RATE_HZ:.0f} Hz each; 90 % intervals in brackets.

An arm that moves from rest to rest, and the leg of a quadruped on a stand, which trots between
rests, carry a sensor of three axes. Their encoders have 19 bits, and 14 bits before a gear of 9.
Defects are those of the blind check's world, 1 to 20 times the noise, and a sensor 10 to 30 mm
beside its place. Those with a defect are diagnosed by the exact force, too, which does not show
that place.

{markdown_table(head, table)}

What is not exactly right; strength in multiples of the noise of a sample:

{markdown_table(('robot', 'defect', 'by the robot', 'by the exact force'), wrong)}
"""


if __name__ == '__main__':
    raise SystemExit(main())
