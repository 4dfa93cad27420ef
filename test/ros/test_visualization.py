# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures are made only for subscribers."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from scene import CAMERA, make_room, see_room
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.ros.visualization import SeenImage, Visualization

ROOM = make_room()
HEADER = Header(frame_id='map')
CAMERA_FROM_BASE = transform_from_pose(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))


@pytest.fixture
def visualization(make_node):
    node = make_node('shower')
    return node, Visualization(node)


def test_what_nobody_looks_at_is_not_computed(visualization):
    _, shown = visualization
    shown.set_map(ROOM)
    # there is no input to compute it from
    shown.show(HEADER, None, None, None)
    assert not shown.wants_debug_image


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
