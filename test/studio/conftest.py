# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the browser tests: Chromium, a studio of the demo's map, a person at its page."""

import pytest
from browser import Person, running_chromium
from studio_map import demo_studio, open_page


@pytest.fixture(scope='module')
def chromium():
    with running_chromium() as browser:
        yield browser


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'map.yaml'


@pytest.fixture
def studio(path):
    studio = demo_studio(path)
    with open_page(studio) as (studio.url, studio.server):
        yield studio


@pytest.fixture
def person(chromium, studio):
    person = Person(chromium, studio.url)
    yield person
    person.page.close()
    assert person.foreign == [], 'no request leaves the machine'
