# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Markers and pictures, which are made only for subscribers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from scene import CAMERA, make_layer, make_room, see_room
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.core.keyframes.places import Recognition, RecognizedPlace
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.ros.visualization import (
    SeenImage,
    Visualization,
    class_color,
    draw_debug_image,
    landmark_markers,
    match_markers,
)

ROOM = make_room()
HEADER = Header(frame_id='map')
CAMERA_FROM_BASE = transform_from_pose(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))


BOX, ELLIPSE, UNMATCHED = (86, 180, 233), (230, 159, 0), (255, 255, 255)


@pytest.fixture(scope='module')
def found():
    relocalizer = Relocalizer(ROOM, RelocalizerOptions(matching='class', algorithm='bf'))
    found = relocalizer.relocalize([Observation(CAMERA, see_room(ROOM))])
    assert found.accepted and len(found.matches) == len(ROOM)
    return found


@pytest.mark.parametrize(('topic', 'message_type'), [
    ('hypotheses', PoseArray), ('matches', MarkerArray), ('landmarks', MarkerArray),
    ('debug_image', Image)])
def test_each_is_made_for_itself(make_node, spin_until, found, topic, message_type):
    node = make_node('shower')
    shown = Visualization(node)
    viewer, heard = make_node('viewer'), []
    viewer.create_subscription(message_type, f'shower/{topic}', heard.append, 10)
    spin_until([node, viewer], lambda: node.count_subscribers(f'shower/{topic}') == 1, 'a viewer')
    shown.set_map(ROOM)
    if topic == 'debug_image':
        spin_until([node, viewer], lambda: shown.wants_debug_image, 'a subscriber')
        shown.show(HEADER, None, None, None)  # the others have no subscriber
        seen = SeenImage(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8),
                         Observation(CAMERA, see_room(ROOM)))
        spin_until([node, viewer], lambda: heard, 'the image', lambda: shown.show_debug_image(
            HEADER, seen, ROOM, found, 'accepted'))
        assert heard[0].header == HEADER and heard[0].width == CAMERA.width
        assert np.any(heard[0].data)
        return
    spin_until([node, viewer], lambda: heard, 'what is shown',
               lambda: shown.show(HEADER, ROOM, found, CAMERA_FROM_BASE))
    assert not shown.wants_debug_image
    if topic == 'hypotheses':
        assert heard[0].header == HEADER
        best = found.hypotheses[0].map_from_camera @ CAMERA_FROM_BASE
        p = heard[0].poses[0].position
        np.testing.assert_allclose([p.x, p.y, p.z], best[:3, 3])


def test_every_landmark_is_an_ellipsoid_with_its_label_and_every_keyframe_a_camera():
    room = make_room()
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 1.0, 2.0, 3.0
    layer = replace(make_layer(room, keyframes=3), map_from_camera=poses)
    first, *markers, cameras = landmark_markers(room, layer).markers
    assert first.action == Marker.DELETEALL, 'earlier markers are removed'
    ellipsoids, texts = markers[::2], markers[1::2]
    assert [text.text for text in texts] == list(room.labels)
    assert len({(marker.ns, marker.id) for marker in markers}) == 2 * len(room)
    for row, (ellipsoid, text) in enumerate(zip(ellipsoids, texts, strict=True)):
        assert (ellipsoid.type, text.type) == (Marker.SPHERE, Marker.TEXT_VIEW_FACING)
        assert ellipsoid.header.frame_id == text.header.frame_id == 'map'
        position, q = ellipsoid.pose.position, ellipsoid.pose.orientation
        np.testing.assert_array_equal([position.x, position.y, position.z], room.centers[row])
        np.testing.assert_array_equal([q.x, q.y, q.z, q.w], room.quats_xyzw[row])
        # RViz expects diameters
        np.testing.assert_array_equal(
            [ellipsoid.scale.x, ellipsoid.scale.y, ellipsoid.scale.z], 2 * room.semi_axes[row])
        assert text.pose.position.z > room.centers[row][2] + room.semi_axes[row].max()
        assert ellipsoid.color == class_color(room.class_ids[row])
    assert len({(color.r, color.g, color.b) for color in map(class_color, 'abc')}) == 3
    assert (cameras.ns, cameras.type, cameras.header.frame_id) == (
        'keyframes', Marker.LINE_LIST, 'map')
    assert len(cameras.points) == 2 * 8 * len(poses)
    tip, corner = cameras.points[:2]
    assert (tip.x, tip.y, tip.z) == (1.0, 0.0, 0.0)
    assert corner.z > 0.05 and corner.x < 1.0, 'it looks along z of the camera'


def test_matches_are_lines_from_the_camera():
    header = Header(frame_id='map')
    camera, centers = np.array([1.0, 2.0, 3.0]), [np.zeros(3), np.array([4.0, 5.0, 6.0])]
    lines, = match_markers(header, camera, centers, True).markers
    assert (lines.type, lines.action, lines.header) == (Marker.LINE_LIST, Marker.ADD, header)
    assert [(point.x, point.y, point.z) for point in lines.points] == [
        (1.0, 2.0, 3.0), (0.0, 0.0, 0.0), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]
    refused, = match_markers(header, camera, centers, False).markers
    assert lines.color.g > lines.color.r and refused.color.r > refused.color.g
    nothing, = match_markers(header, camera, [], False).markers
    assert nothing.action == Marker.DELETEALL


# ---- the debug image ----------------------------------------------------------------------------

def grey_image(**fields):
    image = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    return SeenImage(image, replace(Observation(CAMERA, see_room(ROOM)), **fields))


def pixels_of(canvas, color):
    return np.argwhere((canvas == color).all(axis=2))[:, ::-1]


def test_boxes_and_outlines_are_where_they_were_seen(found):
    seen = grey_image()
    canvas = draw_debug_image(seen, found, ROOM, '')
    shown = draw_debug_image(seen, found, ROOM, 'accepted: ' + ' '.join(99 * ['words']))
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


def test_boxes_beyond_all_measure_do_no_harm(found):
    seen = grey_image()
    boxes = seen.observation.detections.bboxes_xyxy.copy()
    boxes[:, 2:] = 1e300
    detections = replace(seen.observation.detections, bboxes_xyxy=boxes)
    huge = replace(seen.observation, detections=detections)
    draw_debug_image(SeenImage(seen.image_rgb, huge), found, ROOM, 'x')
    small = SeenImage(np.zeros((1, 1, 3), np.uint8), seen.observation)
    assert draw_debug_image(small, found, ROOM, 'accepted: ' + 99 * 'x').shape[1] == 1


def layer_of(ROOM, **images):
    """Return one keyframe with the camera's size, and ten points along its middle row."""
    pixels = np.column_stack([np.linspace(50, 590, 10), np.full(10, 240.0)])
    return replace(make_layer(ROOM, keyframes=1, points=10),
                   pixels=(16 * pixels).astype(np.uint16), **images)


def recognized(found):
    """Answer from five of the points, which are 100 px further up in the image."""
    pixels = np.column_stack([np.linspace(50, 290, 5), np.full(5, 140.0)])
    seen = RecognizedPlace(np.eye(4), np.eye(6), np.eye(6), 5, 0.8, keyframes=(0,),
                           pixels=pixels, rows=np.arange(5))
    return replace(found, recognition=Recognition((seen,)))


def test_the_best_keyframe_is_beside_the_image(found):
    seen = grey_image()
    alone = draw_debug_image(seen, found, ROOM, '')
    assert draw_debug_image(seen, recognized(found), ROOM, '').shape == alone.shape
    without = draw_debug_image(replace(seen, layer=layer_of(ROOM)), recognized(found), ROOM, '')
    height, width = alone.shape[:2]
    assert without.shape == alone.shape, 'no empty half if no image is stored'
    assert (alone == draw_debug_image(seen, found, ROOM, '')).all()
    assert np.ptp(without[140, 290].astype(int)) > 200, 'points that agree are drawn anyway'
    jpeg = cv2.imencode('.jpg', np.full((192, 256, 3), (200, 30, 30), np.uint8)[..., ::-1])[1]
    shown = draw_debug_image(replace(seen, layer=layer_of(
        ROOM, images=jpeg.ravel(), image_offsets=np.array([0, jpeg.size]))),
        recognized(found), ROOM, '')
    assert shown.shape == (height, 2 * width, 3)
    assert np.abs(shown[20, width + 20].astype(int) - (200, 30, 30)).max() < 12
    dot_here, dot_there = shown[140, 290], shown[240, width + 290]
    assert (dot_here == dot_there).all() and np.ptp(dot_here.astype(int)) > 200, 'equal colours'
