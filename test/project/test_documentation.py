# SPDX-License-Identifier: Apache-2.0

"""What the documentation shows is so: commands, links, figures, and the reference."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
import inspect
from pathlib import Path
import re
import shlex
import subprocess

from adxl_ros.files import parameter_file
from processes import REPO, TOOLS
import pytest
import rclpy
from rclpy.context import Context

DOCS = REPO / 'docs'
PAGES = [REPO / 'README.md', REPO / 'CONTRIBUTING.md', *sorted(DOCS.glob('**/*.md'))]
BY_HAND = [
    page
    for page in PAGES
    if 'measurements' not in page.parts
    and 'Made by `make reference`' not in page.read_text('utf-8')
]
MOST_WORDS = 24_310
"""Words of the pages by hand: what they have more, somebody has to read and to keep true."""
EXECUTABLES = (
    *TOOLS,
    'driver',
    'compensation',
    'calibration',
    'stage',
    'monitor',
    'keep_calibrated',
    'investigate',
    'screen',
    'demo',
    'bench',
)
OPTIONS_OF_ALL = {'--help', '--version', '--ros-args'}


def name_of(page: Path) -> str:
    """Return the name of a page for the test's title."""
    return str(page.relative_to(REPO))


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page in a language."""
    return re.findall(
        rf'^```{language}\n(.*?)^```', page.read_text('utf-8'), re.DOTALL | re.MULTILINE
    )


def commands(page: Path) -> list[list[str]]:
    """Return the commands of a page as words; comments do not count."""
    lines = '\n'.join(blocks(page, 'sh')).replace('\\\n', ' ').splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def reference():
    """Return the program that makes the reference."""
    spec = spec_from_file_location('reference', DOCS / 'reference.py')
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_own_sensor_loads(tmp_path: Path) -> None:
    """The file of the page has eight lines below its head; its additions fit."""
    head, *additions = blocks(DOCS / 'howto' / 'sensor.md', 'yaml')
    path = tmp_path / 'my_sensor.yaml'
    path.write_text(head)
    assert len(head.splitlines()) == 2 + 8
    assert parameter_file.load(path).effects == ()
    path.write_text(''.join([head, *additions]))
    assert parameter_file.load(path).effects == ('supply',)


@pytest.mark.parametrize('page', BY_HAND, ids=name_of)
def test_ros_parses_the_arguments(page: Path) -> None:
    for words in commands(page):
        if '--ros-args' in words and '--params-file' not in words:
            context = Context()
            rclpy.init(args=['node', *words[words.index('--ros-args') :]], context=context)
            context.shutdown()


def test_an_argument_that_ros_does_not_parse() -> None:
    with pytest.raises(RuntimeError, match='parse'):
        rclpy.init(args=['node', '--ros-args', '-p', 'link.uri:=local:'], context=Context())


@pytest.mark.parametrize('page', BY_HAND, ids=name_of)
def test_options_and_parameters_exist(page: Path, help_of: Callable) -> None:
    """Each executable exists, and has the options and parameters with which it is called."""
    for words in commands(page):
        if words[:3] != ['ros2', 'run', 'adxl_ros'] and words[0] != 'adxl_ros':
            continue
        name, *rest = words[words.index('adxl_ros') + 1 :]
        assert name in EXECUTABLES, f'{name_of(page)}: {name} is no executable'
        text = help_of(name)
        cut = rest.index('--ros-args') if '--ros-args' in rest else len(rest)
        for word in rest[:cut]:
            if re.match('--[a-z]', word):
                assert word in text, f'{name_of(page)}: {name} has no {word}'
        if name != 'screen':
            for flag, rule in zip(rest[cut:], rest[cut + 1 :]):
                key = rule.split(':=')[0]
                assert flag != '-p' or key in text + ' use_sim_time', (
                    f'{name_of(page)}: {name} has no parameter {key}'
                )


@pytest.mark.parametrize('page', BY_HAND, ids=name_of)
def test_launch_files_have_the_arguments(page: Path) -> None:
    declared = ''.join(
        path.read_text('utf-8')
        for path in [
            *(REPO / 'launch').glob('*.py'),
            *(REPO / 'adxl_ros' / 'nodes').glob('**/*launch*.py'),
        ]
    )
    for words in commands(page):
        if words[:3] == ['ros2', 'launch', 'adxl_ros']:
            assert (REPO / 'launch' / words[3]).exists()
            for word in words[4:]:
                argument = word.split(':=')[0]
                known = argument.replace('alpha', '{joint}').replace('beta', '{joint}')
                assert argument == '-s' or argument in declared or known in declared, (
                    f'{name_of(page)}: {words[3]} has no argument {argument}'
                )


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    """Links to files and to headings of pages."""
    for target, anchor in re.findall(
        r'\]\(\s*(?!https?:)([^)#\s]*)(#[^)\s]*)?\)', page.read_text('utf-8')
    ):
        linked = page.parent / target if target else page
        assert linked.exists(), f'{name_of(page)} links to {target}'
        if anchor and linked.suffix == '.md':
            headings = re.findall(r'^#+ (.*)$', linked.read_text('utf-8'), re.MULTILINE)
            assert anchor in {
                '#' + re.sub(r'[^\w\- ]', '', heading).lower().replace(' ', '-')
                for heading in headings
            }, f'{name_of(page)}: {target}{anchor}'


def test_pages_that_messages_name_exist() -> None:
    listed = subprocess.run(
        ['git', 'ls-files', '-z'], cwd=REPO, text=True, capture_output=True, check=True
    ).stdout.split('\0')
    sources = [
        REPO / name
        for name in listed
        if name.endswith(('.py', '.html', '.xml', '.h', '.c', 'Makefile', '.ino'))
    ]
    for path in filter(Path.exists, sources):
        for page in re.findall(r'\bdocs/[\w/]+\.(?:md|txt|yaml)', path.read_text('utf-8')):
            assert (REPO / page).exists(), f'{name_of(path)} names {page}'


def test_each_page_names_the_next() -> None:
    """The last line of a page leads on; index pages are lists of pages."""
    for page in BY_HAND:
        if page.parent != REPO and page.name != 'index.md':
            text = page.read_text('utf-8').strip()
            assert 'Next: ' in text.rsplit('\n\n', 1)[-1], name_of(page)


def test_the_pages_by_hand_stay_short() -> None:
    texts = (
        re.sub(r'<!-- ([\w ]+) -->\n.*?<!-- /\1 -->', '', page.read_text('utf-8'), flags=re.DOTALL)
        for page in BY_HAND
        if 'reference' not in page.parts
    )
    assert sum(len(text.split()) for text in texts) <= MOST_WORDS


def test_the_first_page_stays_short() -> None:
    """Of a front page, a newcomer reads one screen or two."""
    assert len((REPO / 'README.md').read_text('utf-8').split()) <= 750
    assert (DOCS / 'gap.svg').stat().st_size < 1_000_000


def test_the_tilt_error_has_one_definition() -> None:
    """The glossary defines it, and each page that states one links there."""
    texts = {page: page.read_text('utf-8').lower() for page in BY_HAND}
    glossary = DOCS / 'explain' / 'glossary.md'
    assert [
        page
        for page, text in texts.items()
        if re.search(r'angle\s+between\s+(the\s+)?true\s+and', text)
    ] == [glossary]
    assert not [
        name_of(page)
        for page, text in texts.items()
        if re.search(r'tilt\s+error', text)
        and page != glossary
        and 'glossary.md#tilt-error' not in text
    ]


@pytest.mark.parametrize('page', BY_HAND, ids=name_of)
def test_tables_are_narrow(page: Path) -> None:
    for line in re.sub('```.*?```', '', page.read_text('utf-8'), flags=re.DOTALL).splitlines():
        if line.startswith('|--'):
            assert line.count('|') <= 6, f'{name_of(page)}: {line}'


def test_figures_are_those_of_the_measurements() -> None:
    for page, made in reference().figures().items():
        assert page.read_text('utf-8') == made, f'{name_of(page)}: run make reference'


def test_reference_is_that_of_the_package(tmp_path: Path) -> None:
    pytest.importorskip('plotly')
    reference().main(tmp_path)
    for page in tmp_path.glob('*.md'):
        assert (DOCS / 'reference' / page.name).read_text('utf-8') == page.read_text('utf-8'), (
            f'{page.name}: run make reference'
        )


def test_every_field_of_a_result_has_a_meaning() -> None:
    made = reference()
    for path in made.with_fields(made.RESULTS):
        module, name = path.split(':')
        lines = inspect.getsource(getattr(import_module(module), name)).splitlines()
        attributes = {
            line.split()[0] for line in lines if re.match(r'    [a-z]\w*( : .*)?$', line)
        }
        for before, line, after in zip(lines, lines[1:], [*lines[2:], '']):
            is_said = before.strip().startswith('#') or after.strip().startswith('"""')
            is_said |= line.strip().partition(':')[0] in attributes
            is_said |= any(mark in line for mark in ('#', '_nominal(', '_by_axis('))
            assert is_said or not re.match(r'    [a-z]\w*: ', line), f'{path}: {line}'


def test_every_effect_has_a_picture() -> None:
    text = (DOCS / 'reference' / 'effects.md').read_text('utf-8')
    pictures = re.findall(r'!\[\w+\]\((.*?)\)', text)
    assert {DOCS / 'reference' / name for name in pictures} == set(
        (DOCS / 'reference' / 'effects').glob('*.png')
    )
