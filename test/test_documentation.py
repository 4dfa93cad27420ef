# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""README, doc/ and config/ agree with the declarations in the code."""

import ast
import json
import math
import re
import runpy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_ANSWER
from cliploc_ros.core.map.landmark_map import DEFAULT_SIGMA_M, LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.offline.mapping import building, triangulation
from cliploc_ros.offline.mapping.update import alignment, judging, updating
from cliploc_ros.ros.parameters import RelocalizerParameters

PROJECT = Path(__file__).resolve().parents[1]
DOCUMENTS = [PROJECT / 'README.md', *sorted((PROJECT / 'doc').glob('*.md'))]
LINKING = [*DOCUMENTS, *(PROJECT / name for name in (
    'CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'SECURITY.md', 'studies/README.md'))]
POLICY = ElementTree.parse(PROJECT / 'config/security_policy.xml')
# parameters of every node
OF_ROS = re.compile('/(clock|rosout|parameter_events|transition_event|get_type_description|'
                    'change_state|get_state|get_available_.*|get_transition_graph|'
                    '.*_parameters(_atomically)?|get_parameter_types)$')


def test_documents_are_what_the_tables_say():
    for path, text in runpy.run_path(str(PROJECT / 'script/document'))['documents']().items():
        assert path.read_text() == text, f'{path} is out of date: run script/document'


def test_the_readme_leads_to_every_page():
    linked = re.findall(r'\]\(doc/(\w+\.md)', (PROJECT / 'README.md').read_text())
    assert set(linked) == {path.name for path in DOCUMENTS[1:]}


def anchors(path):
    """Return the valid anchors of a page: its headings, as GitHub writes them."""
    headings = re.findall('^#+ (.+)$', path.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


@pytest.mark.parametrize('path', LINKING, ids=lambda path: str(path.relative_to(PROJECT)))
def test_links_lead_somewhere(path):
    for link in re.findall(r'\]\((?!https?:)([^)]+)\)', path.read_text()):
        name, _, anchor = link.partition('#')
        target = path.parent / name if name else path
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize('path', LINKING, ids=lambda path: str(path.relative_to(PROJECT)))
def test_commands_run_what_there_is(path):
    """Programs of this package, and the tests that a number comes from."""
    text = path.read_text()
    for module in re.findall(r'python -m ((?:cliploc_ros|demo|studies)[\w.]*)', text):
        path = PROJECT / module.replace('.', '/')
        assert path.with_suffix('.py').is_file() or (path / '__main__.py').is_file(), module
    for test in re.findall(r'\b(test/[\w/]+\.py)', text):
        assert (PROJECT / test).is_file(), test
    for script in re.findall(r'\bscript/([\w.-]+)', text):
        assert (PROJECT / 'script' / script).exists(), script


def test_what_draws_the_figures_starts():
    """No other test imports it, so a renamed function would break it unnoticed."""
    assert callable(runpy.run_path(str(PROJECT / 'script/draw_figures'))['main'])


def test_the_tests_of_the_capabilities_exist():
    text = (PROJECT / 'test/README.md').read_text()
    named = re.findall(r'`([\w/]+(?:\.py|/))`', text)
    assert len(named) > 90
    assert not [name for name in named if not (PROJECT / 'test' / name).exists()]


def texts(node):
    """Yield the strings of a syntax tree, with an ellipsis for inserted values."""
    if isinstance(node, ast.JoinedStr):
        yield ''.join(value.value if isinstance(value, ast.Constant) else '...'
                      for value in node.values)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    else:
        for child in ast.iter_child_nodes(node):
            yield from texts(child)


def test_the_messages_that_are_looked_up_exist():
    sources = (PROJECT / 'cliploc_ros').rglob('*.py')
    known = [text for path in sources for text in texts(ast.parse(path.read_text()))]
    page = (PROJECT / 'doc/your_robot.md').read_text().split('\n## Troubleshooting')[1]
    rows = [line.strip('| ').split(' | ') for line in page.split('\n## ')[0].splitlines()
            if line.startswith('| ')]
    assert len(rows) > 25 and all(len(row) == 3 and all(row) for row in rows)
    quoted = [message for symptom, *_ in rows for message in re.findall('`([^`]+ [^`]+)`', symptom)
              if not message.startswith('ros2 ')]
    assert len(quoted) > 12
    for message in quoted:
        for part in message.split('...'):
            part = part.strip('; ')
            assert any(part in text for text in known), f'no program says: {part}'


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_the_interface_has_every_topic_and_service_and_no_other(node):
    """The policy has them all; a test compares it with the graph."""
    profile = POLICY.find(f'.//profile[@node="{node}"]')
    used = {entry.text for group in profile for entry in group if not OF_ROS.search(entry.text)}
    section = (PROJECT / 'doc/interface.md').read_text().split(f'\n## {node}\n')[1]
    section = re.split('^##', section, maxsplit=1, flags=re.MULTILINE)[0]
    cells = [line.split('|')[1] for line in section.splitlines() if line.startswith('| `')]
    named = [name for cell in cells for name in re.findall('`(.+?)`', cell)]
    assert len(named) == len(set(named))
    assert {name if name[0] == '/' else f'/{name}'.replace('/~', f'/{node}')
            for name in named} == used


@pytest.mark.parametrize('page', ['README.md', 'doc/mapping.md'])
def test_the_map_of_the_documents_is_valid(page, tmp_path):
    text = (PROJECT / page).read_text()
    path = tmp_path / 'map.yaml'
    path.write_text(re.search(r'    /\*\*:\n(?: {6}.*\n)+', text).group())
    assert LandmarkMap.from_file(path).labels == ('a red mug with white dots',)


def test_nav2s_example_is_of_parameters_that_there_are():
    text = (PROJECT / 'doc/nav2.md').read_text()
    example = re.search(r'    /\*\*:\n(?: {6}.*\n)+', text).group()
    values = yaml.safe_load(example)['/**']['ros__parameters']
    rows = {row.name: row for row in RelocalizerParameters.rows()}
    for name, value in values.items():
        assert rows[name].validated(value) == value
    RelocalizerParameters(**values).check()


def test_foxglove_shows_what_is_published_and_calls_what_is_served():
    tree = json.loads((PROJECT / 'config/foxglove.json').read_text())
    panels = tree['configById']
    assert set(panels['3D!map']['topics']) == {
        '/initialpose', *(f'/relocalizer/{topic}' for topic in (
            'landmarks', 'matches', 'hypotheses', 'pose'))}
    shown = {*panels['3D!map']['topics'], panels['Image!debug']['imageMode']['imageTopic'],
             panels['DiagnosticStatusPanel!relocalizer']['topicToRender']}
    assert shown <= {topic.text for topic in POLICY.findall(
        './/profile[@node="relocalizer"]/topics[@publish="ALLOW"]/topic')}
    served = {service.text for service in POLICY.findall('.//services[@reply="ALLOW"]/service')}
    called = {panel['serviceName'] for name, panel in panels.items() if 'CallService' in name}
    assert called <= served

    def names(node):
        return {node} if isinstance(node, str) else names(node['first']) | names(node['second'])
    assert names(tree['layout']) == set(panels)


# Numbers that pages name, in the order of the pattern's groups, and where the code has them.
CONSTANTS = [
    ('trust.md', r'reaches `min_confidence` \(([.\d]+)\)', [RelocalizerOptions.min_confidence]),
    ('trust.md', r'give it a confidence of ([.\d]+) on average',
     [CALIBRATION.looks.mean_confidence]),
    ('trust.md', r'At odds of (\d+) to 1, .*; at (\d+) to 1',
     [float(f'{math.exp(CALIBRATION.camera[name]):.1g}') for name in ('doubted', 'sure')]),
    ('trust.md', r'probability is below ([.\d]+) and two or three', [CALIBRATION.watch.lost]),
    ('trust.md', r'`position_sigma` \(([.\d]+) m without it\)', [DEFAULT_SIGMA_M]),
    ('trust.md', r'Poses within (\d+) m and (\d+) degrees count',
     [SAME_ANSWER.distance_m, SAME_ANSWER.angle_deg]),
    ('mapping.md', r'less than ([.\d]+) of the boxes of its classes',
     [building.LEAST_EXPLAINED]),
    ('mapping.md', r'a factor above ([.\d]+) is refused', [triangulation._UNIT_FACTOR]),
    ('mapping.md', r'in view from at least (\d+) viewpoints', [judging.LEAST_VIEWS]),
    ('mapping.md', r'fewer than (\d+) landmarks or less than ([.\d]+) .* less than ([.\d]+) of',
     [alignment.MIN_CONFIRMED, updating._MIN_CONFIRMED_SHARE, updating._MIN_WELL_SHARE]),
    ('interface.md', r'The last images \(at most (\d+)\) .* confidence of ([.\d]+) on average',
     [CALIBRATION.looks.most, CALIBRATION.looks.mean_confidence]),
    ('interface.md', r'off by more than (\d+) %', [100 * (CALIBRATION.depth.most_ratio - 1)]),
    ('interface.md', r'\((4\.6) refuses poses by objects, (6\.9) reports', [
        CALIBRATION.camera.doubted, CALIBRATION.camera.sure])]


@pytest.mark.parametrize(('page', 'pattern', 'values'), CONSTANTS,
                         ids=[pattern for _, pattern, _ in CONSTANTS])
def test_the_numbers_of_the_pages_are_those_of_the_code(page, pattern, values):
    text = ' '.join((PROJECT / 'doc' / page).read_text().split())
    (found,) = (match.groups() for match in re.finditer(pattern, text))
    assert [*map(float, found)] == pytest.approx(values)
