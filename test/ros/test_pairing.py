# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import copy
import math

import pytest
from frames import header_of
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.ros.inputs.frame_source import FrameSource
from cliploc_ros.ros.inputs.stamps import ExactPairing
from cliploc_ros.ros.parameters import RelocalizerParameters

TOPICS = ('image', 'camera_info', 'detections')
LIMITS = {'image': 100, 'camera_info': 30, 'detections': 50}
MAX_COUNT = 4

# Few stamps, so that they repeat, go back, and often form pairs; some items exceed every limit.
ADDITIONS = st.lists(st.tuples(st.sampled_from(TOPICS), st.integers(-2, 4), st.integers(0, 120)),
                     max_size=80)


class Expected:
    """A reference with lists: (stamp, item, size) of each topic in order of arrival."""

    def __init__(self):
        self.waiting = {topic: [] for topic in TOPICS}

    def size(self, topic):
        return sum(size for _, _, size in self.waiting[topic])

    def add(self, topic, stamp, item, size):
        entries = [entry for entry in self.waiting[topic] if entry[0] != stamp]
        self.waiting[topic] = [*entries, (stamp, item, size)]
        while len(self.waiting[topic]) > 1 and (
                len(self.waiting[topic]) > MAX_COUNT or self.size(topic) > LIMITS[topic]):
            del self.waiting[topic][0]
        stamps = {name: [entry[0] for entry in waiting] for name, waiting in self.waiting.items()}
        if not all(stamp in seen for seen in stamps.values()):
            return None
        complete = {}
        for name, seen in stamps.items():
            place = seen.index(stamp)
            complete[name] = self.waiting[name][place][1]
            self.waiting[name] = self.waiting[name][place + 1:]
        return complete


@given(ADDITIONS)
def test_a_set_is_complete_if_and_only_if_nothing_of_it_was_evicted(additions):
    pairing, expected = ExactPairing(LIMITS, MAX_COUNT), Expected()
    for item, (topic, stamp, size) in enumerate(additions):
        assert pairing.add(topic, stamp, item, size) == expected.add(topic, stamp, item, size)
        assert sum(pairing._bytes.values()) == sum(map(expected.size, TOPICS))


@pytest.mark.parametrize(('behind', 'room'), [(12, 10), (60, 43), (300, 10), (5, 43)])
def test_images_pair_however_slow_the_detector_is(behind, room):
    """4K images at 30 Hz, of which 10 fit into memory, and 1080p: .2 to 10 s late.

    A detector processes the newest image when it is ready.
    """
    pairing = ExactPairing({'image': 100 * room, 'detections': 10**9}, 2000, 'image', 'detections')
    paired, taken, done_at = [], 0, behind // 2  # it was already running
    for number in range(1, 10 * behind + 1):
        pairing.add('image', number, number, 100)
        assert sum(pairing._bytes.values()) <= 100 * room
        if number >= done_at:
            if taken and pairing.add('detections', taken, 'boxes', 0):
                paired.append(taken)
            taken, done_at = number, number + behind
    assert len(paired) >= 8, paired


def test_detections_of_forgotten_images_are_noticed():
    pairing = ExactPairing({'image': 300, 'detections': 10**9}, 2000, 'image', 'detections')
    for number in range(1, 10):
        pairing.add('image', number, number, 100)
    assert pairing.add('detections', 3, 'boxes', 0) is None and pairing.is_outrun
    assert pairing.received == {'image': 9, 'detections': 1}
    assert pairing.last_stamp_ns == {'image': 9, 'detections': 3}
    assert pairing.add('detections', 10, 'boxes', 0) is None and not pairing.is_outrun
    pairing.clear()
    assert pairing.received == {'image': 0, 'detections': 0} and pairing.last_stamp_ns == {}
    assert pairing.add('image', 3, 3, 100) is None


# ---- with real messages of depth ----------------------------------------------------------------

PERIOD_NS = 33_333_333


def stamped(msg, number):
    found = copy.copy(msg)  # all share the same pixels
    found.header = header_of((number + 1) * PERIOD_NS)
    return found


@pytest.mark.parametrize(('late', 'depth_bytes', 'share'), [
    (3, 2 * 1280 * 720, 1.0), (45, 2 * 1280 * 720, 0.45), (45, 4 * 1920 * 1080, 0.1)])
def test_depth_waits_as_long_as_its_image_does(make_node, late, depth_bytes, share):
    """A camera at 30 Hz, whose detections arrive some images late.

    More images than fit into memory: some are left out, but not all.
    """
    frames, depth = [], Image(data=bytes(depth_bytes))
    source = FrameSource(make_node(), RelocalizerParameters(depth_transport='raw'), math.inf,
                         frames.append)
    source.open()
    for number in range(3 * late + 30):
        for name, msg in (('depth', depth), ('image', Image(data=[number % 256])),
                          ('camera_info', CameraInfo())):
            source._receive(name, stamped(msg, number))
        if number >= late:
            source._receive('detections', stamped(Detection2DArray(), number - late))
    source.close('the end')
    assert len(frames) > 20
    assert sum(frame.depth is not None for frame in frames) >= share * len(frames)
    for frame in frames:
        assert frame.depth is None or frame.depth.header.stamp == frame.image.header.stamp
