# SPDX-License-Identifier: Apache-2.0

"""Draw what each effect of the library does: the pictures of docs/reference/effects.md."""

from dataclasses import dataclass, replace
from pathlib import Path
import sys

from adxl_ros.files import parameter_file
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient, Effect, Manoeuvre, Need
from adxl_ros.model.sensor import put, Sensor, typical, with_axes
from adxl_ros.simulate.motion import ForcePath, Held, Knots, Motion
from adxl_ros.simulate.response import Columns, simulate
from adxl_ros.simulate.trajectories import Steps, swept_sine
import matplotlib

matplotlib.use('Agg')
import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import welch

DOCS = Path(__file__).resolve().parent
COLOURS = {'x': 'tab:blue', 'y': 'tab:orange', 'z': 'tab:green'}
TURN = 2 * np.pi
"""One turn, rad."""


@dataclass(frozen=True)
class Scene:
    """A manoeuvre and how its output is drawn."""

    motion: Motion  # The manoeuvre
    across: str = 'time_s'  # Column of the horizontal axis
    label: str = 'time, s'  # Label of the horizontal axis
    unit: float = 1.0  # Factor from the column to the horizontal axis
    noisy: bool = False  # Whether noise and ADC are simulated
    axes: str = 'xy'  # Axes that are drawn
    kind: str = 'lines'  # Kind of the plot: lines, spectrum or codes


@dataclass(frozen=True)
class Pair:
    """Recordings of one manoeuvre without and with an effect."""

    sensor: Sensor  # The unit without the effect
    # clean, changed: Columns without and with the effect
    clean: Columns
    changed: Columns


def turning(alpha_deg: float, seconds: float = 36.0) -> Motion:
    """
    Turn beta forth and back at constant velocity in one plane.

    seconds: duration, s.
    """
    half, rate = seconds / 2, TURN / (seconds / 2 - 1)
    return Motion(
        seconds,
        Held(np.radians(alpha_deg)),
        Knots(
            [0, 1, half - 1, half, half + 1, seconds - 1, seconds],
            [0, rate / 2, TURN - rate / 2, TURN, TURN - rate / 2, rate / 2, 0],
            [0, rate, rate, 0, -rate, -rate, 0],
        ),
    )


def plane(alpha_deg: float, axes: str = 'xy') -> Scene:
    """Draw the output over beta in one plane."""
    return Scene(
        turning(alpha_deg),
        'beta_rad',
        f'beta at alpha = {alpha_deg:g}°, deg',
        180 / np.pi,
        axes=axes,
    )


REST = Motion(300.0, Held(np.radians(60)), Held(np.radians(30)), internal_rate_hz=1000.0)
SWING = Motion(6.0, Held(np.pi / 2), Knots([0, 1, 2, 3, 4, 5, 6], [0, 0, 1.5, 0, -1.5, 0, 0]))
SHAKE = Motion(44.0, Held(np.pi / 2), Held(np.pi / 2), swept_sine(2.0))
WARM = replace(
    REST,
    duration_s=1200.0,
    internal_rate_hz=10.0,
    temperature_c=Steps(25.0, ((200, 45), (700, 10)), 60.0),
)
CYCLE = replace(WARM, temperature_c=Knots([0, 600, 1200], [5.0, 65.0, 5.0], [0.1, 0.0, -0.1]))
SUPPLY = replace(REST, duration_s=60.0, supply_v=Steps(5.0, ((15, 4.8), (30, 5.2), (45, 5.0)), 1))
TILTING = Scene(
    Motion(18.0, turning(0.0).beta, Held(np.radians(30))),
    'alpha_rad',
    'alpha at beta = 30°, deg',
    180 / np.pi,
)
CARRIED_S = np.arange(0.0, 4.0, 0.01)


class Arm(ForcePath):
    """The end of an arm of 0.5 m that swings about its y, with the errors of a robot."""

    is_robot = True

    def __init__(self) -> None:
        """Take the swing of a joint."""
        super().__init__(CARRIED_S, self.force(self.turn(0.0)))
        q, force = self.turn(0.0), self.force(self.turn(0.0))
        self.modes = {
            'joint1': (self.force(q + 1e-4) - force) / 1e-4,
            'flexible': (self.force(self.turn(1e-5)) - force) / 1e-5,
            'late_acceleration': -self.acceleration_rate(),
        }

    def turn(self, compliance_s2: float) -> np.ndarray:
        """Return the angle of the joint, rad, with links that yield."""
        q = 0.8 * np.sin(6 * CARRIED_S) + 0.1 * np.sin(25 * CARRIED_S)
        return q - compliance_s2 * np.gradient(np.gradient(q, CARRIED_S), CARRIED_S)

    def acceleration_rate(self) -> np.ndarray:
        """Return how fast the acceleration changes in the world, in the frame, m/s³, (n, 3)."""
        q = self.turn(0.0)
        x, _, z = self.force(q).T
        # Gravity is constant in the world.
        dx = np.gradient(x * np.cos(q) + z * np.sin(q), CARRIED_S)
        dz = np.gradient(z * np.cos(q) - x * np.sin(q), CARRIED_S)
        return np.column_stack(
            [dx * np.cos(q) - dz * np.sin(q), 0 * q, dx * np.sin(q) + dz * np.cos(q)]
        )

    def force(self, q: np.ndarray) -> np.ndarray:
        """Return the specific force, m/s², (n, 3)."""
        rate = np.gradient(q, CARRIED_S)
        return np.column_stack(
            [
                -0.5 * rate**2 - 9.80665 * np.sin(q),
                0 * q,
                -0.5 * np.gradient(rate, CARRIED_S) + 9.80665 * np.cos(q),
            ]
        )


SWUNG = Motion(4.0, force=Arm())
CARRIED = Motion(
    4.0,
    force=ForcePath(
        CARRIED_S,
        9.80665
        * np.column_stack(
            [
                0.2 * np.sin(2 * CARRIED_S) + 0.05 * np.sin(25 * CARRIED_S),
                0.3 * np.sin(3 * CARRIED_S) + 0.02 * np.sin(50 * CARRIED_S),
                np.ones(len(CARRIED_S)),
            ]
        ),
    ),
)
OVER_TIME = Scene(REST, noisy=True, axes='x')
SCENES = {
    'cross_axis_z': TILTING,
    'scale_factor_z': plane(30),
    'gravity': plane(45, 'xyz'),
    'base_tilt': plane(90, 'xyz'),
    'stage_offset': plane(45, 'xyz'),
    'saturation': Scene(turning(90), 'beta_rad', 'beta at alpha = 90°, deg', 180 / np.pi),
    'lever_arm': Scene(SWING),
    'time_offset': Scene(SWING),
    'bandwidth': Scene(SWING),
    'clock_skew': Scene(turning(90, 120.0)),
    'thermal_hysteresis': Scene(CYCLE, 'temperature_c', 'temperature, °C'),
    'reference_filter': Scene(CARRIED),
    'joint_offset': Scene(SWUNG),
    'flexible_link': Scene(SWUNG),
    'late_acceleration': Scene(SWUNG),
    'reference_delay': Scene(CARRIED),
    'reference_frame': Scene(CARRIED),
    'bias_walk': Scene(replace(REST, duration_s=1200.0)),
    'spikes': replace(OVER_TIME, motion=replace(REST, duration_s=20.0)),
    'stuck': Scene(replace(SWING, duration_s=6.0), noisy=True, axes='x'),
    'mains_hum': replace(OVER_TIME, kind='spectrum'),
    'flicker': replace(OVER_TIME, kind='spectrum'),
    'noise_excess': replace(OVER_TIME, kind='spectrum'),
    'quantisation': replace(OVER_TIME, kind='codes'),
}
SCENES_BY_MANOEUVRE = {
    Manoeuvre.HEAT: Scene(WARM),
    Manoeuvre.SUPPLY: Scene(SUPPLY),
    Manoeuvre.SHAKE: Scene(SHAKE, axes='x'),
}
"""Scenes of other effects by the manoeuvre that reveals them; `plane(90)` for the rest."""
LOUDER = {
    Coefficient('stuck', 'rate_hz'): 1.0,
    Coefficient('stuck', 'duration_s'): 0.2,
    **{Coefficient('saturation', 'limit_g', axis): 0.9 for axis in AXES},
    Coefficient('clock_skew', 'ratio'): 1e-3,
    Coefficient('mount_resonance', 'frequency_hz'): 25.0,
}
"""Values of parameters whose typical value does not show in the plot."""


def main(output: Path) -> None:
    """Draw every effect."""
    nominal = with_axes(parameter_file.load(DOCS.parent / 'params' / 'adxl203.yaml'), AXES)
    nominal = replace(nominal, rate_hz=500.0)
    output.mkdir(parents=True, exist_ok=True)
    for effect in library().values():
        draw(nominal, effect, output / f'{effect.name}.png')


def draw(nominal: Sensor, effect: Effect, path: Path) -> None:
    """Draw one effect."""
    scene = SCENES.get(effect.name) or SCENES_BY_MANOEUVRE.get(
        effect.diagnosis.revealed_by, plane(90)
    )
    sensor = (
        nominal
        if scene.noisy
        else replace(
            nominal,
            noise_density_g_per_rthz=np.zeros(3),
            adc_bits=nominal.adc_bits if Need.ADC in effect.needs else 0,
        )
    )
    changed = replace(sensor, effects=(effect.name,), values={effect.name: typical(effect, AXES)})
    louder = {name: value for name, value in LOUDER.items() if name.effect == effect.name}
    changed = put(changed, list(louder), list(louder.values()))
    pair = Pair(sensor, simulate(sensor, scene.motion, 0), simulate(changed, scene.motion, 0))
    figure, (above, below) = plt.subplots(2, 1, figsize=(7.5, 4.6), constrained_layout=True)
    {'lines': draw_lines, 'spectrum': draw_spectrum, 'codes': draw_codes}[scene.kind](
        above, below, scene, pair
    )
    above.set_title(effect.name, loc='left', fontweight='bold')
    figure.savefig(path, dpi=85)
    plt.close(figure)


def draw_lines(above: plt.Axes, below: plt.Axes, scene: Scene, pair: Pair) -> None:
    """Draw output and difference over time or an angle, in the direction of travel."""
    across = pair.clean[scene.across] * scene.unit
    forth = np.ones(len(across), bool)
    if np.ptp(np.sign(np.diff(across))) == 2:
        forth[len(across) // 2 :] = False
    scale, zero = pair.sensor.nominal_scale_v_per_g[0], pair.sensor.nominal_zero_g_v[0]
    for axis in scene.axes:
        clean_g, changed_g = (
            (columns[f'{axis}_v'] - zero) / scale for columns in (pair.clean, pair.changed)
        )
        above.plot(across[forth], clean_g[forth], color='0.7', lw=3)
        above.plot(across[forth], changed_g[forth], color=COLOURS[axis], lw=1, label=axis)
        difference_mg = (changed_g - clean_g) * 1e3
        below.plot(across[forth], difference_mg[forth], color=COLOURS[axis], lw=1.2)
        if not forth.all():
            below.plot(across[~forth], difference_mg[~forth], color=COLOURS[axis], lw=1, ls='--')
    above.set_ylabel('output, g')
    above.plot([], [], color='0.7', lw=3, label='clean')
    above.legend(ncol=4, loc='lower right', bbox_to_anchor=(1, 1), fontsize=8, frameon=False)
    low, high = below.get_ylim()
    if high - low < 1e-3 * max(abs(low), abs(high)):
        below.set_ylim(0, 1.3 * high)
    back = '' if forth.all() else '\ndashed: on the way back'
    below.set_ylabel(f'difference, mg{back}')
    below.set_xlabel(scene.label)
    for ax in (above, below):
        ax.grid(alpha=0.3)


def draw_spectrum(above: plt.Axes, below: plt.Axes, _: Scene, pair: Pair) -> None:
    """Draw a part of the output, and the noise densities."""
    part = slice(0, 1000)
    for columns, colour, width, label in (
        (pair.clean, '0.7', 3, 'clean'),
        (pair.changed, COLOURS['x'], 1, 'with it'),
    ):
        volts = columns['x_v'] - columns['x_v'].mean()
        above.plot(columns['time_s'][part], volts[part] * 1e3, color=colour, lw=width / 2)
        f, density = welch(volts, pair.sensor.rate_hz, nperseg=16384)
        below.loglog(f[1:], np.sqrt(density[1:]) * 1e6, color=colour, lw=width, label=label)
    above.set_ylabel('x, mg')
    above.set_xlabel('time, s')
    below.set_ylabel('density, ug/sqrt(Hz)')
    below.set_xlabel('frequency, Hz')
    below.legend(fontsize=8)
    for ax in (above, below):
        ax.grid(alpha=0.3, which='both')


def draw_codes(above: plt.Axes, below: plt.Axes, _: Scene, pair: Pair) -> None:
    """Draw a part of the output, and the share of each code."""
    part = slice(0, 150)
    for columns, colour, width, label in (
        (pair.clean, '0.7', 3, 'clean'),
        (pair.changed, COLOURS['x'], 1.2, 'with it'),
    ):
        above.step(columns['time_s'][part], columns['x_v'][part] * 1e3, color=colour, lw=width)
        code, count = np.unique(np.rint(columns['x_v'] / pair.sensor.lsb_v), return_counts=True)
        below.vlines(code, 0, count / count.sum(), color=colour, lw=width * 1.5, label=label)
    above.set_ylabel('x, mV')
    above.set_xlabel('time, s')
    below.set_ylabel('share of samples')
    below.set_xlabel('code of the ADC')
    below.legend(fontsize=8)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / 'reference' / 'effects')
