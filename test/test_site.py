# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation site is built without warnings, and is readable in a browser."""

import subprocess
import sys
from pathlib import Path

import pytest
from browser import running_chromium

PROJECT = Path(__file__).resolve().parents[1]
PAGES = ['library', *sorted(path.stem for path in (PROJECT / 'doc').glob('*.md'))]
# Sizes of the window [px]: a laptop, a phone.
WIDTHS = (1280, 400)

pytestmark = [pytest.mark.full, pytest.mark.needs('sphinx')]


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Build the site as script/site does, with warnings as errors."""
    folder = tmp_path_factory.mktemp('site')
    done = subprocess.run([PROJECT / 'script/site', folder], text=True, capture_output=True,
                          timeout=300, env={'PATH': '/usr/bin:/bin', 'PYTHON': sys.executable})
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_there_and_in_the_menu(site):
    menu = (site / 'index.html').read_text()
    for page in PAGES:
        assert (site / f'{page}.html').is_file()
        assert f'href="{page}.html"' in menu, page


def test_the_reference_has_the_docstrings(site):
    text = (site / 'library.html').read_text()
    assert 'Find the pose of the camera at the last of one or more frames.' in text
    assert 'id="cliploc_ros.core.relocalizer.Relocalizer.relocalize"' in text


@pytest.mark.needs('chromium', 'playwright')
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
