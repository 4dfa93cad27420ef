# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a release agree: versions, dates, dependencies, container and workflows."""

import re
import runpy
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parents[1]
MANIFEST = ElementTree.parse(PROJECT / 'package.xml').getroot()
# Rosdep keys that name an apt package on Ubuntu 24.04. The build farm accepts no others.
OF_UBUNTU = {'python3-matplotlib', 'python3-numba', 'python3-numpy', 'python3-opencv',
             'python3-pytest', 'python3-scipy', 'python3-tqdm', 'python3-yaml'}


def read(name: str) -> str:
    return (PROJECT / name).read_text()


def test_versions_are_equal():
    found = {re.search(pattern, read(name), re.MULTILINE).group(1) for name, pattern in {
        'package.xml': '<version>(.+)</version>', 'CITATION.bib': 'version = {(.+)}',
        'CITATION.cff': '^version: (.+)$', 'doc/conf.py': "version = '(.+)'",
        'CHANGELOG.rst': r'^(\d+\.\d+\.\d+) '}.items()}
    assert len(found) == 1, found


def test_addresses_are_those_of_the_manifest():
    """The owner fills package.xml, and this test lists the pages to change."""
    email = MANIFEST.find('maintainer').get('email')
    urls = {url.get('type'): url.text for url in MANIFEST.iter('url')}
    pages = [*PROJECT.glob('*.*'), *(file for folder in ('doc', 'docker', '.github', 'script')
                                     for file in (PROJECT / folder).rglob('*.*'))]
    found = {(address, page.name) for page in pages
             if page.suffix in ('.cff', '.md', '.rst', '.py', '.xml', '.yml')
             for address in re.findall(r'(?:https?://|[\w.-]+@)[\w.-]*\w(?:/[\w./-]*\w)?',
                                       page.read_text())
             if 'cliploc' in address}
    assert not {one for one in found if one[0] not in (email, *urls.values())}
    for text, names in (
            (f'git clone {urls["repository"]}\n', (
                'README.md', 'doc/install.md', 'doc/first_relocalization.md')),
            (f']({urls["bugtracker"]})', ('README.md', 'CONTRIBUTING.md')),
            (f' {email},', ('SECURITY.md',))):
        assert all(text in read(name) for name in names)


@pytest.mark.parametrize(('address', 'code'), [('//example.org', 1), ('@example.com', 1),
                                               ('//github.com', 0)])
def test_a_release_with_placeholders_is_refused(address, code, tmp_path):
    step, = (step['run'] for job in yaml.safe_load(read('.github/workflows/release.yml'))[
        'jobs'].values() for step in job['steps'] if 'package.xml' in step.get('run', ''))
    (tmp_path / 'package.xml').write_text(address)
    assert subprocess.run(['bash', '-e', '-c', step], cwd=tmp_path).returncode == code


def test_bibtex_and_cff_cite_the_same():
    software, text = yaml.safe_load(read('CITATION.cff')), read('CITATION.bib')
    paper, text = software['preferred-citation'], re.sub(r'[{}\\]', '', text)
    authors = (f'{one["family-names"]}, {one["given-names"]}' for one in paper['authors'])
    assert re.findall(r'= (.+?),?$', text, re.MULTILINE) == [
        paper['title'], ' and '.join(authors), paper['collection-title'], str(paper['year']),
        paper['url'], software['title'], software['authors'][0]['name'], software['version'],
        software['date-released'][:4]]


def test_rosdep_can_resolve_every_key():
    keys = {entry.text for entry in MANIFEST if entry.tag.endswith('depend')}
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
