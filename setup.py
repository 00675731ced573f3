# SPDX-License-Identifier: Apache-2.0

"""Install the package, its executables, launch files and parameter files."""

from glob import glob
from pathlib import Path
import subprocess
import sys

from setuptools import find_packages, setup

PACKAGE = 'adxl_ros'
REQUIREMENTS = Path(__file__).resolve().parent / 'requirements'


def requirements(name: str) -> list[str]:
    """Read the lines of requirements/NAME.txt, which `make build` gives to pip, too."""
    lines = (REQUIREMENTS / f'{name}.txt').read_text(encoding='utf-8').splitlines()
    return [line for line in lines if line and not line.startswith('#')]


def executables(package: str, end: str = '') -> list[str]:
    """Make an executable of each module in a package that has a main(); `end` of its name goes."""
    modules = sorted(
        Path(__file__).resolve().parent.joinpath(*package.split('.')).glob(f'*{end}.py')
    )
    return [
        f'{path.stem.removesuffix(end)} = {package}.{path.stem}:main'
        for path in modules
        if '\ndef main(' in path.read_text(encoding='utf-8')
    ]


def scripts() -> list[str]:
    """
    Return the executables.

    `ros2 run` looks for one of each name in lib/adxl_ros, where colcon and bloom put them. pip
    puts those of a wheel on the PATH, where `check` or `export` could be anybody's: it has one.
    """
    if {'bdist_wheel', 'dist_info', 'editable_wheel'} & {*sys.argv}:
        return [f'{PACKAGE} = {PACKAGE}.__main__:main']
    return [
        *executables(f'{PACKAGE}.nodes'),
        *executables(f'{PACKAGE}.tools'),
        *executables(f'{PACKAGE}_validation', '_command'),
    ]


def state_commit() -> None:
    """Write the commit that is built into the package, so that pages and figures can name it."""
    here = Path(__file__).resolve().parent
    if (here / '.git').exists():
        made = subprocess.run(
            ['git', 'describe', '--always', '--dirty=_changed', '--exclude', '*'],
            cwd=here,
            capture_output=True,
            text=True,
        )
        if made.returncode == 0:
            (here / PACKAGE / 'commit.txt').write_text(made.stdout, encoding='utf-8')


state_commit()
setup(
    name=PACKAGE,
    version='0.1.0',
    # The parameter files are part of the package, too: a cluster node has no ROS to locate them.
    packages=[
        *find_packages(include=[PACKAGE, f'{PACKAGE}.*', f'{PACKAGE}_validation*']),
        f'{PACKAGE}.params',
    ],
    package_dir={f'{PACKAGE}.params': 'params'},
    package_data={
        PACKAGE: [
            'commit.txt',
            'py.typed',
            'calibrate/keep/*.html',
            'calibrate/report/*.html',
            'calibrate/report/*.js',
            'calibrate/report/*.xml',
            'diagnose/*.html',
            'files/export_templates/*',
            'fleet/*.csv',
            'fleet/*.html',
            'investigate/*.yaml',
            'report/page_templates/*',
            'signals/*.csv',
            'signals/*.html',
        ],
        f'{PACKAGE}_validation': ['*.yaml', 'blind/*.yaml', 'pages/*'],
        f'{PACKAGE}.params': ['*.yaml'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.py') + ['launch/ekf.yaml']),
        (f'share/{PACKAGE}/params', glob('params/*.yaml')),
        (f'share/{PACKAGE}/security', glob('security/*.xml')),
        *(
            (f'share/{PACKAGE}/{name}', glob(f'share/{name}/*'))
            for name in ('completion', 'layouts', 'udev', 'urdf')
        ),
    ],
    python_requires='>=3.10',
    install_requires=['setuptools', *requirements('core')],
    extras_require={name: requirements(name) for name in ('extras', 'fleet', 'robot', 'test')},
    zip_safe=True,
    maintainer='the adxl_ros authors',
    maintainer_email='adxl-ros-maintainers@users.noreply.github.com',
    description='Driver, calibration and compensation of low-g analog MEMS accelerometers',
    license='Apache-2.0',
    entry_points={
        'console_scripts': scripts(),
        f'{PACKAGE}.commands': [
            f'benchmark = {PACKAGE}_validation.benchmark_command:main',
        ],
    },
)
