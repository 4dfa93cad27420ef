# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio in a real browser, which does what a person does."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import TIMEOUT_S, Person, wait_for
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap

# Software rendering needs an idle machine.
pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]


def test_select_type_relabel_undo_save_reload(person, studio, path):
    """The file holds exactly what a person typed, and every other line as it was."""
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


def on_screen(person, server, point):
    """Return the pixel of the page at which a point (3,) of the map is."""
    camera = next(iter(server.get_clients().values())).camera
    frame = person.page.locator('iframe').bounding_box()
    middle = np.array([frame['x'] + frame['width'] / 2, frame['y'] + frame['height'] / 2])
    right, down, forward = Rotation.from_quat(np.roll(camera.wxyz, -1)).as_matrix().T
    offset = np.asarray(point) - camera.position
    focal = frame['height'] / 2 / np.tan(camera.fov / 2) / (offset @ forward)
    return middle + focal * np.array([offset @ right, offset @ down])


def test_boxes_are_drawn_dragged_and_linked(person, studio):
    """A box by the mouse, its edge dragged; the next view shows where the object lies."""
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


def test_the_gizmo_is_dragged(chromium, studio):
    """The landmark follows, along the axis that was grabbed; one undo takes all of it back."""
    person = Person(chromium, studio.url, has_scene=True)
    document, server = studio.document, studio.server
    person.mode('Edit')
    person.select(document, 'mug_2')
    before = document.landmarks['mug_2']
    camera = next(iter(server.get_clients().values())).camera
    wait_for(lambda: np.allclose(camera.look_at, before.center, atol=1e-4), 'flying to it')
    near = before.center + np.array([-0.9, -0.9, 0.7])
    camera.position, camera.look_at = near, before.center
    # the camera reports where it is: another report shows that the browser moved it
    person.page.mouse.move(*on_screen(person, server, before.center))
    person.page.mouse.wheel(0, 1)
    wait_for(lambda: np.linalg.norm(camera.position - near) < 0.2, 'coming near')
    person.picture('gizmo')
    up = np.array([0.0, 0.0, 1.0])
    # the gizmo has the same size on the page at any distance: its arrow begins at the centre
    grip, goal = (on_screen(person, server, before.center + height * up) for height in (0.1, 0.3))
    person.drag(grip, goal)
    wait_for(lambda: document.landmarks['mug_2'].center[2] > before.center[2] + 0.1, 'the drag')
    person.page.mouse.up()
    person.picture('dragged')
    moved = document.landmarks['mug_2'].center - before.center
    assert abs(moved[2] - 0.2) < 0.08 and np.abs(moved[:2]).max() < 1e-3
    person.page.keyboard.press('Control+z')
    wait_for(lambda: document.landmarks['mug_2'] == before, 'undo')
    assert document.to_undo is None
    person.page.close()


def test_the_exported_page_opens_without_a_server(chromium, person, studio, path):
    person.page.get_by_title('More', exact=True).click()
    person.click('Export the scene as one page')
    exported = path.with_suffix('.html')
    wait_for(exported.is_file, 'the export')
    page = chromium.new_page(viewport={'width': 600, 'height': 400})
    foreign = []
    page.on('request', lambda request: foreign.append(request.url) if request.url.startswith(
        ('http', 'ws')) else None)
    page.goto(exported.as_uri())

    def shows_colours():
        image = cv2.imdecode(np.frombuffer(page.screenshot(timeout=TIMEOUT_S * 1000), np.uint8),
                             cv2.IMREAD_COLOR).astype(int)
        return ((image.max(axis=2) - image.min(axis=2)) > 60).mean() > 0.005

    wait_for(shows_colours, 'the ellipsoids')
    if folder := os.environ.get('CLIPLOC_SCREENSHOTS'):
        page.screenshot(path=Path(folder) / 'exported.png', timeout=TIMEOUT_S * 1000)
    assert foreign == []
    page.close()
