# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The check of the map, and the layers of the scene, in a real browser."""

import pytest
from browser import wait_for
from studio_map import person_at, write_two_rooms

from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.studio import Studio

pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]


def test_the_check_becomes_outdated_by_an_edit_and_opens_as_a_page(chromium, path):
    write_two_rooms(path)
    document = Document(path)
    studio = Studio(document)
    studio.CHECK = CheckOptions(max_positions=9, headings=4)
    with person_at(chromium, studio) as (person, _):
        page = person.page
        person.mode('Test')
        person.click('Coverage and look-alikes')
        person.row('cup_0').click()
        wait_for(lambda: document.selection == ('cup_0',), 'the page stays responsive')
        page.get_by_text('checked the map').first.wait_for()
        with page.context.expect_page() as opened:
            person.click('Open the check')
        opened.value.get_by_text('places that look alike').first.wait_for()
        person.picture('places')
        with document.lock:
            document.edit(edits.delete, ['cup_0'])
        page.get_by_text('of the map before the last edits').wait_for()


def test_layers_film_and_a_click_on_the_image(person, studio):
    """The scene's panel switches layers and plays views; a click sets the outline there."""
    page, handles = person.page, studio.server.scene._handle_from_node_name
    page.get_by_text('Layers and viewpoints').click()
    page.get_by_label('Cameras').click()
    wait_for(lambda: not handles['/cameras'].visible, 'hidden cameras')
    page.get_by_label('Follow the view').click()
    page.get_by_label('Follow the view').click()
    wait_for(lambda: handles['/cameras'].visible, 'cameras after following')
    person.click('Play the recording')
    wait_for(lambda: studio.view >= 3, 'the film')
    person.click('Stop')
    person.show_view(studio, 3)
    outline = next(iter(studio.recording.outlines(studio.document.landmarks, 3).values()))
    page.mouse.click(*person.on_image(outline[:2]))
    wait_for(lambda: studio.document.selection, 'the selection')
    page.mouse.click(*person.on_image((2, 2)))
    wait_for(lambda: not studio.document.selection, 'nothing there')
