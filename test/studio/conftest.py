# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the browser tests: Chromium, a studio of the demo's map, a person at its page."""

import shutil
from pathlib import Path

import pytest
from browser import Person, running_chromium

from cliploc_ros.studio.document import Document
from cliploc_ros.studio.images import open_images, views_of_folder
from cliploc_ros.studio.recording import Recording
from cliploc_ros.studio.studio import Studio

ASSETS = Path(__file__).parents[2] / 'cliploc_ros/demo/assets'


@pytest.fixture(scope='module')
def chromium():
    with running_chromium() as browser:
        yield browser


@pytest.fixture
def path(tmp_path):
    path = tmp_path / 'map.yaml'
    shutil.copy(ASSETS / 'map.yaml', path)
    return path


@pytest.fixture
def studio(path):
    from cliploc_ros.studio.server import serve_studio

    folder = ASSETS / 'sequence'
    studio = Studio(Document(path), Recording(views_of_folder(folder)),
                    open_images(folder, None))
    with serve_studio(studio, '127.0.0.1', 0) as (studio.url, studio.server):
        yield studio
    studio.document.close()


@pytest.fixture
def person(chromium, studio):
    person = Person(chromium, studio.url)
    yield person
    person.page.close()
    assert person.foreign == [], 'no request leaves the machine'
