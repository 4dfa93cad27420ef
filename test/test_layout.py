# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layout of the package: imports point downwards."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
ROOT = 'cliploc_ros'
MODULES = {'.'.join(path.relative_to(PROJECT).with_suffix('').parts).removesuffix('.__init__'):
           path for path in sorted((PROJECT / ROOT).rglob('*.py'))}

# Lowest first. A module belongs to its longest prefix. It may import modules of the same prefix
# and of lower layers, but none of another prefix in the same layer.
LAYERS = (
    ('errors', 'units', 'core.calibration'),
    ('files',),
    ('core.kernels',),
    ('core.geometry',),
    ('core.map',),
    ('core.observation', 'core.options'),
    ('core.search',),
    ('core.keyframes',),
    ('core.fit',),
    ('core.acceptance',),
    ('core',),
    ('messages', 'command'),
    ('models',),
    ('ros.qos', 'ros.conversions'),
    ('ros.node',),
    ('ros.parameters',),
    ('ros.inputs',),
    ('ros',),
    ('nodes',),
    ('offline.simulation', 'offline.vocabulary', 'offline.page', 'offline.posed_query'),
    ('offline.mapping',),
    ('offline.datasets',),
    ('offline.recording',),
    ('offline.mapping.make_map',),
    ('offline.evaluation',),
    ('offline.replay',),
    ('offline.studio',),
    ('offline',),
    ('cli',),
)
RANKS = {f'{ROOT}.{prefix}': rank for rank, prefixes in enumerate(LAYERS) for prefix in prefixes}


def prefix_of(module: str) -> str:
    """Return the longest prefix in LAYERS that a module belongs to."""
    prefix = module
    while prefix not in RANKS:
        prefix, dot, _ = prefix.rpartition('.')
        assert dot, f'{module} is in no layer: add it to LAYERS'
    return prefix


def imported_modules(path: Path) -> set[str]:
    """Return the modules of the package that a file imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f'{path}:{node.lineno}: import relative to the package'
            submodules = {f'{node.module}.{alias.name}' for alias in node.names}
            found |= submodules & MODULES.keys() or {node.module}
    return {name for name in found if name.startswith(f'{ROOT}.')}


def test_no_imports_form_a_circle():
    TopologicalSorter({module: (imported_modules(path) & MODULES.keys()) - {module}
                       for module, path in MODULES.items()}).prepare()  # raises CycleError


def test_imports_point_downwards():
    upward = []
    for module in sorted(MODULES.keys() - {ROOT}):
        here = prefix_of(module)
        for imported in sorted(imported_modules(MODULES[module])):
            there = prefix_of(imported)
            if there != here and RANKS[there] >= RANKS[here]:
                upward.append(f'{module} ({here}) imports {imported} ({there})')
    assert not upward, '\n' + '\n'.join(upward)


def test_each_folder_stands_in_one_layer():
    """Only core, ros and offline have separate layers."""
    folders = [prefix.partition('.')[0] for prefixes in LAYERS for prefix in prefixes]
    twice = {name for name in folders if folders.count(name) > 1}
    assert twice == {'core', 'ros', 'offline'}


#: Greatest number of the package's modules that the import of a node loads, which limits what a
#: reader needs.
MOST_LOADED = 99


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_a_node_loads_few_modules(node):
    program = (f'import sys, cliploc_ros.nodes.{node}\n'
               f'print(sum(name.startswith({ROOT!r}) for name in sys.modules))')
    loaded = subprocess.run([sys.executable, '-c', program], cwd=PROJECT, check=True,
                            capture_output=True, text=True).stdout
    assert int(loaded) <= MOST_LOADED


#: Names that several classes still share.
SHARED_NAMES = {
    'Camera', 'Evidence', 'Fit', 'Groups', 'Keyframes', 'Known', 'Look', 'Overlaps', 'Place',
    'Poses', 'Record', 'Sample', 'State', 'Turn', 'Views'}


def test_a_class_name_leads_to_one_definition():
    names = [node.name.lstrip('_') for path in MODULES.values()
             for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef)]
    assert {name for name in names if names.count(name) > 1} <= SHARED_NAMES
