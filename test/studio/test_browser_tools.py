# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layers of the page: coverage, places that look alike, and keyframes."""


import pytest
from browser import wait_for
from studio_map import person_at, write_two_rooms

from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.studio import Studio

pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]


def test_coverage_and_look_alikes(chromium, path):
    """They are found, become outdated by an edit, and are found again with the changes."""
    write_two_rooms(path)
    document = Document(path)
    with person_at(chromium, Studio(document)) as (person, server):
        page = person.page
        person.mode('Test')
        person.click('Coverage and look-alikes')
        person.row('cup_0').click()
        wait_for(lambda: document.selection == ('cup_0',), 'the page stays responsive')
        page.get_by_text('pairs of places that look alike: 1').wait_for()
        person.picture('places')
        tiles = server.scene._handle_from_node_name['/coverage/tiles']
        for mode, is_shown in (('Edit', False), ('Test', True)):
            person.mode(mode)
            wait_for(lambda is_shown=is_shown: tiles.visible == is_shown, 'the tiles')
        with document.lock:
            document.edit(edits.delete, ['cup_0'])
        page.get_by_text('of the map before the last edits').wait_for()
        person.click('Coverage and look-alikes')
        page.get_by_text('(was 1)').wait_for()
        assert page.get_by_text('of the map before the last edits').count() == 0


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
    outline = studio.recording.outlines(studio.document.landmarks, 3)[0]
    page.mouse.click(*person.on_image(outline.ellipse[:2]))
    wait_for(lambda: studio.document.selection, 'the selection')
    page.mouse.click(*person.on_image((2, 2)))
    wait_for(lambda: not studio.document.selection, 'nothing there')
