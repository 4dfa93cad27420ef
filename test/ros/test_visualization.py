# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Markers and pictures, which are made only for subscribers."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from scene import CAMERA, make_layer, make_room, see_room
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.ros.visualization import (
    SeenImage,
    Visualization,
    class_color,
    landmark_markers,
    match_markers,
)

ROOM = make_room()
HEADER = Header(frame_id='map')
CAMERA_FROM_BASE = transform_from_pose(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))


@pytest.fixture
def visualization(make_node):
    node = make_node('shower')
    return node, Visualization(node)


@pytest.mark.parametrize(('topic', 'message_type'), [
    ('hypotheses', PoseArray), ('matches', MarkerArray), ('landmarks', MarkerArray),
    ('debug_image', Image)])
def test_each_is_made_for_itself(visualization, make_node, spin_until, topic, message_type):
    node, shown = visualization
    viewer, heard = make_node('viewer'), []
    viewer.create_subscription(message_type, f'shower/{topic}', heard.append, 10)
    spin_until([node, viewer], lambda: node.count_subscribers(f'shower/{topic}') == 1, 'a viewer')
    shown.set_map(ROOM)
    found = Relocalizer(ROOM, RelocalizerOptions(matching='class', algorithm='bf')).relocalize(
        [Observation(CAMERA, see_room(ROOM))])
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
