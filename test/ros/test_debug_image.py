# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scene import CAMERA, make_layer, make_room, see_room

from cliploc_ros.core.keyframes.places import Recognition, RecognizedPlace
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.ros.visualization import SeenImage, draw_debug_image

BOX, ELLIPSE, UNMATCHED = (86, 180, 233), (230, 159, 0), (255, 255, 255)


@pytest.fixture(scope='module')
def room():
    return make_room()


@pytest.fixture(scope='module')
def found(room):
    relocalizer = Relocalizer(room, RelocalizerOptions(matching='class', algorithm='bf'))
    found = relocalizer.relocalize([Observation(CAMERA, see_room(room))])
    assert found.accepted and len(found.matches) == len(room)
    return found


def grey_image(room, **fields):
    image = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    return SeenImage(image, replace(Observation(CAMERA, see_room(room)), **fields))


def pixels_of(canvas, color):
    return np.argwhere((canvas == color).all(axis=2))[:, ::-1]


def test_boxes_and_outlines_are_where_they_were_seen(room, found):
    seen = grey_image(room)
    canvas = draw_debug_image(seen, found, room, '')
    shown = draw_debug_image(seen, found, room, 'accepted: ' + ' '.join(99 * ['words']))
    assert (seen.image_rgb == 128).all(), 'the image itself is unchanged'
    height, width = canvas.shape[:2]
    assert (shown[:height] == canvas).all(), 'the verdict covers none of the image'
    assert height < len(shown) < 1.1 * height and shown.shape[1] == width
    box = seen.observation.detections.bboxes_xyxy[0]
    middle = (box[:2] + box[2:]) / 2
    outline = pixels_of(canvas, ELLIPSE)
    inside = outline[(np.abs(outline - middle) <= (box[2:] - box[:2]) / 2 + 3).all(axis=1)]
    # the outline of a perfect pose touches its box
    assert np.abs(inside.min(axis=0) - box[:2]).max() < 4
    assert np.abs(inside.max(axis=0) - box[2:]).max() < 4
    assert len(pixels_of(canvas, BOX)) > 100
    assert len(pixels_of(canvas, UNMATCHED)) == 0


def test_boxes_beyond_all_measure_do_no_harm(room, found):
    seen = grey_image(room)
    boxes = seen.observation.detections.bboxes_xyxy.copy()
    boxes[:, 2:] = 1e300
    detections = replace(seen.observation.detections, bboxes_xyxy=boxes)
    huge = replace(seen.observation, detections=detections)
    draw_debug_image(SeenImage(seen.image_rgb, huge), found, room, 'x')
    small = SeenImage(np.zeros((1, 1, 3), np.uint8), seen.observation)
    assert draw_debug_image(small, found, room, 'accepted: ' + 99 * 'x').shape[1] == 1


def layer_of(room, **images):
    """Return one keyframe with the camera's size, and ten points along its middle row."""
    pixels = np.column_stack([np.linspace(50, 590, 10), np.full(10, 240.0)])
    return replace(make_layer(room, keyframes=1, points=10),
                   pixels=(16 * pixels).astype(np.uint16), **images)


def recognized(found):
    """Answer from five of the points, which are 100 px further up in the image."""
    pixels = np.column_stack([np.linspace(50, 290, 5), np.full(5, 140.0)])
    seen = RecognizedPlace(np.eye(4), np.eye(6), np.eye(6), 5, 0.8, 0.8, keyframes=(0,),
                           pixels=pixels, rows=np.arange(5))
    return replace(found, recognition=Recognition((seen,)))


def test_the_best_keyframe_is_beside_the_image(room, found):
    seen = grey_image(room)
    alone = draw_debug_image(seen, found, room, '')
    assert draw_debug_image(seen, recognized(found), room, '').shape == alone.shape
    without = draw_debug_image(replace(seen, layer=layer_of(room)), recognized(found), room, '')
    height, width = alone.shape[:2]
    assert without.shape == alone.shape, 'no empty half if no image is stored'
    assert (alone == draw_debug_image(seen, found, room, '')).all()
    assert np.ptp(without[140, 290].astype(int)) > 200, 'points that agree are drawn anyway'
    jpeg = cv2.imencode('.jpg', np.full((192, 256, 3), (200, 30, 30), np.uint8)[..., ::-1])[1]
    shown = draw_debug_image(replace(seen, layer=layer_of(
        room, images=jpeg.ravel(), image_offsets=np.array([0, jpeg.size]))),
        recognized(found), room, '')
    assert shown.shape == (height, 2 * width, 3)
    assert np.abs(shown[20, width + 20].astype(int) - (200, 30, 30)).max() < 12
    dot_here, dot_there = shown[140, 290], shown[240, width + 290]
    assert (dot_here == dot_there).all() and np.ptp(dot_here.astype(int)) > 200, 'equal colours'
