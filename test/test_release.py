# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a release agree: versions, dates, dependencies, container and workflows."""

import re
import runpy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parents[1]
# Rosdep keys that name an apt package on Ubuntu 24.04. The build farm accepts no others.
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
    """Return the extras that setup.py declares."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('setuptools.setup', lambda **options: None)
        patch.chdir(PROJECT)
        return runpy.run_path('setup.py')['EXTRAS']


def test_extras_are_what_the_tests_run_with(extras):
    """Each extra has the versions of script/requirements*.txt, with an upper bound."""
    required = ''.join(read(f'script/requirements{part}.txt')
                       for part in ('', '-models', '-test', '-all'))
    assert {name for extra in extras.values() for name in extra} <= set(required.splitlines())
    assert all('<' in pin or '==' in pin for pin in extras['all'])


@pytest.mark.parametrize(('lock', 'files'), [
    ('pypi', ('requirements', 'requirements-ros', 'constraints')),
    ('jazzy', ('requirements', 'constraints', 'constraints-jazzy')),
    *((f'{kind}-{part}', (f'requirements-{part}', 'constraints'))
      for kind in ('pypi', 'jazzy') for part in ('test', 'models', 'all')),
    ('numpy1', ('requirements-numpy1',)), ('release', ('requirements-release',))])
def test_locks_meet_their_requirements_and_hold_hashes(lock, files):
    """script/freeze writes them again."""
    text = re.sub(r' \\\n +', ' ', read(f'script/lock/{lock}.txt'))
    lines = [line for line in text.splitlines() if line and line[0] != '#']
    assert all(re.fullmatch(r'\S+==\S+( ; [^-]+)?( --hash=sha256:[0-9a-f]{64})+', line)
               for line in lines)
    versions = dict(line.split()[0].split('==') for line in lines)
    for file in files:
        for line in filter(None, read(f'script/{file}.txt').splitlines()):
            if line[0] != '#':
                wanted = Requirement(line)
                version = versions.get(canonicalize_name(wanted.name))
                if version is None and file.startswith('constraints'):
                    continue
                assert version is not None and version in wanted.specifier, line


def test_container_and_setup_install_the_locks():
    assert 'pip install --no-cache-dir --require-hashes' in read('docker/Dockerfile')
    assert '"$root/script/lock/$lock.txt" --require-hashes' in read('script/common.bash')
    # PyTorch's own index, whose hashes are in no lock
    assert re.findall(r'pip_install "\$venv"[^\n]*\n?[^\n]*', read('script/setup')) == [
        'pip_install "$venv" "$root/script/requirements-models.txt" "${pip_options[@]}" \\\n'
        '      --extra-index-url https://download.pytorch.org/whl/cpu']
    writers = [job for job in yaml.safe_load(read('.github/workflows/release.yml'))[
        'jobs'].values() if job['permissions'] == {'contents': 'write'}]
    assert not [step for job in writers for step in job['steps'] if 'pip' in step.get('run', '')]
