# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``pip install .`` without ROS: the content of the wheel, and its commands; the site."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from browser import running_chromium

from cliploc_ros.core.map.landmark_map import LandmarkMap

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[1]
ROOM = PROJECT / 'test/mapping/changed_room'
SOURCES = ('cliploc_ros', 'config', 'demo', 'launch', 'resource', 'LICENSE', 'README.md',
           'package.xml', 'setup.cfg', 'setup.py')
MAX_BYTES = 1.2e6
#: Packages missing on a computer without ROS and the extra "models". ROS's .pth file restarts the
#: interpreter with its libraries.
LEFT_OUT = re.compile(r'(?!rosbags)(rclpy|rpyutils|ament|ros|\w+_(msgs|srvs|interfaces)|launch|'
                      r'tf2|torch|ultralytics|open_clip|openvino|cliploc)|.*\.pth$')
COMMANDS = {'build_map', 'check_map', 'evaluate', 'export_network', 'import_map', 'studio',
            'tum_to_bag'}


@pytest.fixture(scope='module')
def wheel(tmp_path_factory):
    """Build from a copy: build/ of the source tree may contain deleted modules."""
    source, out = tmp_path_factory.mktemp('source'), tmp_path_factory.mktemp('wheel')
    for name in SOURCES:
        path = PROJECT / name
        if path.is_dir():
            shutil.copytree(path, source / name, ignore=shutil.ignore_patterns('__pycache__'))
        else:
            shutil.copy(path, source)
    pip('wheel', '--no-deps', '--no-build-isolation', '--wheel-dir', out, source)
    (built,) = out.glob('*.whl')
    return built


@pytest.fixture(scope='module')
def programs(wheel, tmp_path_factory):
    """Install the commands in an environment without ROS and PyTorch."""
    folder = tmp_path_factory.mktemp('fresh')
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', folder], check=True,
                   timeout=300)
    (site,) = folder.glob('lib/python3*/site-packages')
    for packages in sys.path:
        if packages.endswith(('/site-packages', '/dist-packages')):
            link_libraries(Path(packages), site)
    pip('--python', folder / 'bin/python', 'install', '--no-deps', '--no-index', wheel)
    return folder / 'bin'


def link_libraries(packages, site):
    """Link the installed packages to a new environment, except for the missing ones."""
    if packages.is_relative_to('/opt/ros'):
        return
    for path in packages.iterdir():
        if not LEFT_OUT.match(path.name) and not (site / path.name).exists():
            (site / path.name).symlink_to(path)


def pip(*arguments):
    """Run it without PYTHONPATH, which would contain this workspace's installed package."""
    subprocess.run([sys.executable, '-m', 'pip', '--quiet', '--disable-pip-version-check',
                    *map(str, arguments)], check=True, timeout=300, env=environment())


def environment():
    """Return an environment without ROS, with the kernels that are already compiled."""
    hidden = {'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH', 'PYTHONHOME'}
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    return {'NUMBA_CACHE_DIR': str(PROJECT / 'cliploc_ros/__pycache__/kernels')} | kept


def run(program, *arguments, cwd):
    return subprocess.run([program, *map(str, arguments)], cwd=cwd, env=environment(), text=True,
                          capture_output=True, timeout=300)


def test_a_robot_gets_neither_worlds_nor_training_nor_tests(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition('/')[0] for name in names} == {
        'cliploc_ros', wheel.name.removesuffix('-py3-none-any.whl') + '.dist-info',
        wheel.name.removesuffix('-py3-none-any.whl') + '.data'}
    of_package = {name for name in names if name.startswith('cliploc_ros/')}
    assert of_package == {str(path.relative_to(PROJECT)) for path in (
        PROJECT / 'cliploc_ros').rglob('*.*') if path.is_file() and path.suffix != '.pyc'
        and '__pycache__' not in path.parts}
    assert not [name for name in names if re.search(r'train_|make_world|test|/build/', name)]
    assert wheel.stat().st_size < MAX_BYTES


def test_commands_have_names_of_their_own(programs):
    installed = {path.name for path in programs.iterdir() if 'cliploc' in path.name}
    assert installed == {f'cliploc_{name}' for name in COMMANDS}


def test_build_map_runs_and_says_what_it_lacks(programs, tmp_path):
    done = run(programs / 'cliploc_build_map', '--observations', ROOM / 'after.npz', '--every',
               '5', '--no-joint', '--no-check', '--out', 'map.yaml', cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 'class names: ' in done.stdout
    assert len(LandmarkMap.from_file(tmp_path / 'map.yaml')) > 5


def test_images_need_the_extra_with_the_networks(programs, tmp_path):
    done = run(programs / 'cliploc_build_map', '--tum',
               PROJECT / 'demo/assets/mapping', '--model', PROJECT / 'demo/assets/yolo.onnx',
               '--no-clip', '--record-to', 'o.npz', '--out', 'map.yaml', cwd=tmp_path)
    assert done.returncode == 1
    assert 'OpenVINO, which is not installed' in done.stderr and "extra 'runtime'" in done.stderr
    assert done.stderr.count('\n') == 1


# ---- the site is built without warnings, and is readable in a browser
PAGES = ['library', *sorted(path.stem for path in (PROJECT / 'doc').glob('*.md'))]
# Sizes of the window [px]: a laptop, a phone.
WIDTHS = (1280, 400)


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Build the site as script/site does, with warnings as errors."""
    folder = tmp_path_factory.mktemp('site')
    done = subprocess.run([PROJECT / 'script/site', folder], text=True, capture_output=True,
                          timeout=300, env={'PATH': '/usr/bin:/bin', 'PYTHON': sys.executable})
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.needs('sphinx')
def test_every_page_is_in_the_menu_and_the_reference_has_the_docstrings(site):
    menu = (site / 'index.html').read_text()
    for page in PAGES:
        assert (site / f'{page}.html').is_file()
        assert f'href="{page}.html"' in menu, page
    text = (site / 'library.html').read_text()
    assert 'Find the pose of the camera at the last of one or more frames.' in text
    assert 'id="cliploc_ros.core.relocalizer.Relocalizer.relocalize"' in text


@pytest.mark.needs('sphinx', 'chromium', 'playwright')
def test_a_browser_shows_every_page(site):
    with running_chromium() as chromium:
        for width in WIDTHS:
            page = chromium.new_page(viewport={'width': width, 'height': 800})
            for name in ('index', *PAGES):
                page.goto(f'file://{site}/{name}.html')
                assert page.locator('h1').first.is_visible()
                broken = page.evaluate(
                    '[...document.images].filter(one => !one.naturalWidth).map(one => one.src)')
                assert broken == [], name
                assert page.evaluate('document.documentElement.scrollWidth') <= width, name
