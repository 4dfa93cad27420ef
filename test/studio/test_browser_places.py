# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layers of the page: coverage, and places that look alike."""

import pytest
from browser import wait_for
from two_rooms import write_two_rooms

from cliploc_ros.studio.document import Document
from cliploc_ros.studio.studio import Studio

pytestmark = [pytest.mark.clock, pytest.mark.needs('viser', 'playwright', 'chromium')]


@pytest.fixture
def studio(tmp_path):
    from cliploc_ros.studio.server import serve_studio

    write_two_rooms(tmp_path / 'map.yaml')
    studio = Studio(Document(tmp_path / 'map.yaml'))
    with serve_studio(studio, '127.0.0.1', 0) as (studio.url, studio.server):
        yield studio
    studio.document.close()


def test_coverage_and_look_alikes(person, studio):
    """They are found, stale after an edit, and found again with what has changed."""
    page, document = person.page, studio.document
    person.click('Find coverage and look-alikes')
    person.click('cup_0')
    wait_for(lambda: document.selection == ('cup_0',), 'the page answers meanwhile')
    page.get_by_text('pairs of places that look alike: 1').wait_for()
    person.picture('places')
    person.click('Delete')
    page.get_by_text('of the map before the last edits').wait_for()
    person.click('Find coverage and look-alikes')
    page.get_by_text('(was 1)').wait_for()
    assert page.get_by_text('of the map before the last edits').count() == 0
