# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the browser tests: Chromium, a studio of the demo's map, a person at its page."""

import pytest
from browser import running_chromium
from studio_map import demo_studio, person_at


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
    yield studio
    studio.document.close()


@pytest.fixture
def person(chromium, studio):
    """Open the page of the studio."""
    with person_at(chromium, studio) as (person, studio.server):
        yield person
