# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of several cameras at one instant: which belong together, and which are left out."""

import math
import threading
import time

import pytest
from builtin_interfaces.msg import Time
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.parameters import RelocalizerParameters

NAMES = ('front', 'left', 'back')
PARAMETERS = RelocalizerParameters(cameras=list(NAMES), sync_tolerance_s=0.05)
ALL = {'front': 0.0, 'left': 0.0, 'back': 0.0}


@pytest.fixture
def heard():
    return []


@pytest.fixture
def cameras(make_node):
    """Return a function that publishes a frame of some cameras, given their names and stamps."""
    node = make_node('cameras')
    publishers = {(name, kind): node.create_publisher(kind, f'{name}/{topic}', 10)
                  for name in NAMES for kind, topic in (
                      (CameraInfo, 'camera_info'), (Detection2DArray, 'detections'),
                      (Image, 'image'))}

    def publish(at_s, late_s, kinds=(CameraInfo, Detection2DArray, Image)):
        for name, own_s in late_s.items():
            ns = round((at_s - own_s) * 1e9)
            header = Header(frame_id=name, stamp=Time(sec=ns // 10**9, nanosec=ns % 10**9))
            for kind in kinds:
                publishers[name, kind].publish(kind(header=header))
    return publish


@pytest.fixture
def rig(make_node, context, heard):
    """A rig whose node is spun by another thread."""
    node = make_node()
    rig = CameraRig(node, PARAMETERS, math.inf, heard.append)
    rig.open()
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    yield rig
    rig.close('the test ends')
    executor.shutdown()
    spinning.join()


def names(frame):
    return [frame.camera, *(other.camera for other in frame.beside)]


def now_s():
    """Return a stamp; evenly spaced stamps are recognized at once as image stamps."""
    return 100.0 + time.monotonic()


@pytest.fixture
def passed(cameras, wait, heard):
    """Wait until the cameras are known, and until a later whole instant; return those before it.

    Instants are passed on in order, so all earlier ones were passed on or dropped.
    """
    def until_whole(since_s):
        def is_whole():
            return any(not frame.left_out and frame.stamp_ns >= since_s * 1e9 for frame in heard)
        wait(is_whole, 'a whole instant', lambda: cameras(now_s(), ALL) or time.sleep(0.05))

    def since(begun_s, end_s):
        until_whole(end_s)
        assert len({frame.stamp_ns for frame in heard}) == len(heard), 'each once'
        return [frame for frame in heard if begun_s * 1e9 <= frame.stamp_ns + 1 < end_s * 1e9]
    until_whole(0.0)
    return since


@pytest.mark.parametrize(('order', 'gap_s', 'skew_s'), [
    (NAMES, 0.0, 0.0), (NAMES[::-1], 0.1, 0.06), (('back', 'left'), 0.0, 0.0)])
def test_instants_are_passed_on_once_with_all_cameras_that_publish(rig, cameras, passed, order,
                                                                   gap_s, skew_s):
    """In any order, however late the others arrive. A silent camera holds no instant up."""
    begun_s = now_s()
    for _ in range(6):  # with detections one camera after another
        at_s = now_s()
        late_s = {name: 0.04 if name == 'back' else 0.0 for name in order}  # stamps
        for name in order:
            cameras(at_s, {name: late_s[name]}, (CameraInfo, Image))
            time.sleep(skew_s)
        for name in order:
            time.sleep(gap_s)
            cameras(at_s, {name: late_s[name]}, (Detection2DArray,))
        time.sleep(0.05)
    found = passed(begun_s, now_s())
    assert [names(frame) for frame in found] == [[name for name in NAMES if name in order]] * 6
    assert {frame.left_out for frame in found} == {tuple(
        name for name in NAMES if name not in order)}


def test_a_frame_that_is_too_late_makes_no_instant_of_its_own(rig, cameras, wait, heard, passed):
    """Requests that wait for a frame may use it."""
    at_s = now_s()
    cameras(at_s, {'front': 0.0, 'back': 0.0})
    wait(lambda: heard[-1].stamp_ns == round(at_s * 1e9), 'the instant without a camera')
    now = time.monotonic()
    cameras(at_s, {'left': 0.0})
    assert names(rig.next_frame(now, now + 30.0)) == ['left']
    assert [frame.left_out for frame in passed(at_s, now_s())] == [('left',)]
