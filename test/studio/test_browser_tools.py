# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layers of the page: coverage, places that look alike, and keyframes."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from browser import wait_for
from studio_map import ASSETS, person_at, write_two_rooms

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.studio import edits
from cliploc_ros.studio.document import Document
from cliploc_ros.studio.images import views_of_folder
from cliploc_ros.studio.recording import Recording
from cliploc_ros.studio.studio import Studio

pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]
KEYFRAMES, POINTS = 12, 50


def test_coverage_and_look_alikes(chromium, path):
    """They are found, stale after an edit, and found again with what has changed."""
    write_two_rooms(path)
    document = Document(path)
    with person_at(chromium, Studio(document)) as (person, server):
        page = person.page
        person.mode('Test')
        person.click('Coverage and look-alikes')
        person.row('cup_0').click()
        wait_for(lambda: document.selection == ('cup_0',), 'the page answers meanwhile')
        page.get_by_text('pairs of places that look alike: 1').wait_for()
        person.picture('places')
        tiles = server.scene._handle_from_node_name['/coverage/tiles']
        for mode, is_shown in (('Edit', False), ('Test', True)):
            person.mode(mode)
            wait_for(lambda is_shown=is_shown: tiles.visible == is_shown, 'the tiles')
        with document.lock:
            document.apply(edits.delete(document.landmarks, ['cup_0']))
        page.get_by_text('of the map before the last edits').wait_for()
        person.click('Coverage and look-alikes')
        page.get_by_text('(was 1)').wait_for()
        assert page.get_by_text('of the map before the last edits').count() == 0


def studio_with_keyframes(path):
    """Return the demo's map with keyframes along its wake-ups, which see points on landmarks."""
    shutil.copy(ASSETS / 'map.yaml', path)
    detections = views_of_folder(ASSETS / 'sequence')
    document = Document(path)
    landmark_map = document.to_map()
    poses = detections.map_from_camera[::4][:KEYFRAMES]
    rng = np.random.default_rng(0)
    seen = landmark_map.centers[rng.integers(0, len(landmark_map), (KEYFRAMES, POINTS))]
    points = np.concatenate([(some - pose[:3, 3]) @ pose[:3, :3]
                             for some, pose in zip(seen, poses, strict=True)])
    count = len(points)
    layer = KeyframeLayer(
        landmark_map.frame_id, landmark_map.landmark_ids,
        landmark_map.centers.astype(np.float32), detections.cameras[0], poses,
        np.arange(KEYFRAMES + 1) * POINTS, np.zeros((count, 2), np.uint16),
        points.astype(np.float32), np.ones((count, 128), np.uint8), np.zeros(count, np.uint16),
        np.ones((1, 128), np.uint8))
    return Studio(document, layer=layer)


def test_keyframes_are_shown_and_hidden(chromium, path):
    studio = studio_with_keyframes(path)
    with person_at(chromium, studio, has_scene=True) as (person, server):
        nodes = server.scene._handle_from_node_name
        wait_for(lambda: '/cloud' in nodes, 'their points, without being asked for')
        centers = studio.document.to_map().centers
        points = nodes['/cloud'].points
        assert np.abs(points[:, None] - centers[None]).max(axis=2).min(axis=1).max() < 0.01
        frusta = nodes['/keyframes']
        assert frusta.points.shape == (8 * KEYFRAMES, 2, 3) and not frusta.visible
        scene = person.page.frame_locator('iframe')
        scene.get_by_text('Layers and viewpoints').click()
        box = scene.get_by_label('Keyframes', exact=True)
        box.wait_for()
        box.check(force=True)
        wait_for(lambda: frusta.visible, 'the frusta')
        person.picture('keyframes')
        box.uncheck(force=True)
        wait_for(lambda: not frusta.visible, 'they are hidden')


def test_the_camera_of_a_view_is_named(chromium, path):
    """The second of two cameras has half the pixels, and a wider view."""
    shutil.copy(ASSETS / 'map.yaml', path)
    views = views_of_folder(ASSETS / 'sequence')
    camera, = views.cameras
    small = replace(camera, width=320, height=240, fx=200.0, fy=200.0, cx=159.5, cy=119.5)
    views = replace(views, cameras=(camera, small), camera_names=('front', 'back'),
                    camera_rows=np.arange(len(views)) % 2)
    studio = Studio(Document(path), Recording(views))
    with person_at(chromium, studio) as (person, server):
        person.page.get_by_text('checked 60 landmarks').wait_for()
        for view, name, one in ((0, 'front', camera), (1, 'back', small), (2, 'front', camera)):
            person.show_view(studio, view)
            person.page.get_by_text(f'view {view} camera {name}').wait_for()
            image = server.scene._handle_from_node_name['/view/image']
            wait_for(lambda one=one, image=image: np.isclose(
                image.render_width, 0.1 * one.width / one.fx), 'the image is as wide as its view')
        person.picture('cameras')
