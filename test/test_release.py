# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a release consists of agrees: versions, dates, dependencies, container and workflows."""

import re
import runpy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
# Keys of rosdep that name a package of apt on Ubuntu 24.04. The build farm takes no others.
OF_UBUNTU = {'python3-matplotlib', 'python3-numba', 'python3-numpy', 'python3-opencv',
             'python3-pytest', 'python3-scipy', 'python3-tqdm', 'python3-yaml'}


def read(name: str) -> str:
    return (PROJECT / name).read_text()


def test_versions_are_equal():
    found = {re.search(pattern, read(name), re.MULTILINE).group(1) for name, pattern in {
        'package.xml': '<version>(.+)</version>', 'setup.py': "version='(.+)'",
        'CITATION.cff': '^version: (.+)$', 'doc/conf.py': "version = '(.+)'",
        'CHANGELOG.rst': r'^(\d+\.\d+\.\d+) '}.items()}
    assert len(found) == 1, found


def test_rosdep_can_resolve_every_key():
    manifest = ElementTree.parse(PROJECT / 'package.xml').getroot()
    keys = {entry.text for entry in manifest if entry.tag.endswith('depend')}
    assert {key for key in keys if key.startswith('python3-')} == OF_UBUNTU
    assert not [key for key in keys if key.endswith('-pip')]


@pytest.fixture(scope='module')
def extras() -> dict[str, list[str]]:
    """The extras that setup.py declares."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('setuptools.setup', lambda **options: None)
        patch.chdir(PROJECT)
        return runpy.run_path('setup.py')['EXTRAS']


def test_extras_are_what_the_tests_run_with(extras):
    """Each has the versions of script/requirements*.txt, with an upper bound."""
    required = ''.join(read(f'script/requirements{part}.txt')
                       for part in ('', '-models', '-test', '-all'))
    assert {one for extra in extras.values() for one in extra} <= set(required.splitlines())
    assert all('<' in one or '==' in one for one in extras['all'])
