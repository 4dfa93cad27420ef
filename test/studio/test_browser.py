# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio in a real browser, used as a person would."""


import numpy as np
import pytest
from browser import wait_for

from cliploc_ros.core.map.landmark_map import LandmarkMap

# Software rendering needs an idle machine.
pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]


def test_select_type_relabel_undo_save_reload(person, studio, path):
    """The file contains exactly the typed text; every other line is unchanged."""
    document, before = studio.document, path.read_text()
    person.select(document, 'mug_2')
    person.mode('Edit')
    person.type('Position x', '5.5')
    wait_for(lambda: document.landmarks['mug_2'].center[0] == 5.5, 'the position')
    person.type('Label', 'a <b>green</b> mug & "brown" dots')
    wait_for(lambda: '"brown"' in document.landmarks['mug_2'].label, 'the label')
    person.type('Class', 'cup')
    wait_for(lambda: document.landmarks['mug_2'].class_id == 'cup', 'the class')
    person.picture('edited')
    person.page.keyboard.press('Control+z')
    wait_for(lambda: document.landmarks['mug_2'].class_id == 'mug', 'undo')
    assert path.read_text() == before
    person.click('Save')
    wait_for(lambda: document.is_saved, 'saving')
    person.page.reload()
    person.page.get_by_text('landmarks in map').first.wait_for()
    person.page.wait_for_function("() => [...document.querySelectorAll('input')].some("
                                  "input => input.value.includes('<b>green</b>'))")
    lost = [line.strip() for line in before.splitlines()
            if line not in path.read_text().splitlines()]
    won = [line.strip() for line in path.read_text().splitlines()
           if line not in before.splitlines()]
    assert lost == ['label: a green mug with brown dots', 'center: [5.28825, 0.32457, 0.81462]']
    assert won == ['label: "a <b>green</b> mug & \\"brown\\" dots"',
                   'center: [5.5, 0.32457, 0.81462]']
    assert LandmarkMap.from_file(path).labels[1] == 'a <b>green</b> mug & "brown" dots'


def test_boxes_are_drawn_dragged_and_linked(person, studio):
    """Draw a box with the mouse and drag its edge; the next view shows the object's place."""
    person.mode('Create')
    person.draw_box(studio, 0, (300, 200, 360, 290))
    assert np.allclose(studio.new.boxes[0], (300, 200, 360, 290), atol=2.0)
    person.drag(person.on_image((360, 245)), person.on_image((400, 250)))
    person.page.mouse.up()
    wait_for(lambda: studio.new.boxes[0][2] > 395, 'the edge')
    assert np.allclose(studio.new.boxes[0], (300, 200, 400, 290), atol=2.0)
    person.page.get_by_text('changed the box of view 0').wait_for()
    person.page.keyboard.press('c')
    wait_for(lambda: studio.view != 0, 'a view from another side')
    person.page.locator('polyline.guess').wait_for(state='attached')
    person.picture('drawn')
    before = person.page.evaluate('$("image").viewBox.baseVal.width')
    person.page.mouse.move(*person.on_image((320, 240)))
    person.page.mouse.wheel(0, -600)
    wait_for(lambda: person.page.evaluate('$("image").viewBox.baseVal.width') < 0.7 * before,
             'the zoom')
