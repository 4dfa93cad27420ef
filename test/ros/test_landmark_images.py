# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer with the demo's CLIP in a map whose objects differ only in their images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    save_landmark_embeddings,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.core.observation import Detections
from cliploc_ros.models.clip_encoder import ClipEncoder
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.offline.datasets.intrinsics import find_camera
from cliploc_ros.offline.datasets.tum import read_tum
from cliploc_ros.ros.conversions import detections_to_msg
from cliploc_ros.ros.frame_localizer import load_localizer
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S
from demo import ASSETS
from demo.truth import read_frames

HEADER = Header(frame_id='camera')
FRAMES = list(read_frames(ASSETS / 'sequence', 0.5))
# Images of the landmarks come from neighbouring frames, since there is no other walk.
QUERY, NEIGHBOURS = FRAMES[34], FRAMES[32:34] + FRAMES[35:37]


def read_image(frame):
    return cv2.imread(str(frame.image))[..., ::-1].copy()


def mapped(frame):
    return [box for box in frame.boxes if box.in_map]


def images_of(landmark_map, encoder):
    """Return the mean embedding of each landmark that the neighbours show."""
    sums = np.zeros((len(landmark_map), encoder.embed_dim))
    for frame in NEIGHBOURS:
        boxes = mapped(frame)
        rows = [landmark_map.landmark_ids.index(box.object_id) for box in boxes]
        sums[rows] += encoder.encode_crops(read_image(frame),
                                           np.array([box.bbox_xyxy for box in boxes]))
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    means = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0)
    return LandmarkEmbeddings(encoder.key, landmark_map.landmark_ids, means.astype(np.float16),
                              np.zeros((0, encoder.embed_dim), np.float16),
                              np.zeros(len(landmark_map) + 1, np.int64))


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    """Return parameters for a map without names, with image embeddings next to it."""
    folder = tmp_path_factory.mktemp('nameless')
    named = LandmarkMap.from_file(ASSETS / 'map.yaml')
    count = len(named)
    write_map(folder / 'map.yaml',
              replace(named, labels=('a thing',) * count, class_ids=('thing',) * count))
    clip = ClipOptions(cache_dir=str(folder), pretrained=str(ASSETS / 'clip'))
    images = images_of(named, ClipEncoder(resolve_clip_weights(clip), clip))
    save_landmark_embeddings(embeddings_path(folder / 'map.yaml'), images)
    return RelocalizerParameters(
        map_file=str(folder / 'map.yaml'), clip_model=clip.model,
        clip_pretrained=clip.pretrained, cache_dir=str(folder), time_budget_ms=1e4)


@pytest.fixture(scope='module')
def frame():
    """Return the query as messages, with true boxes and a single class 'thing'."""
    image, boxes = read_image(QUERY), mapped(QUERY)
    detections = Detections(np.array([box.bbox_xyxy for box in boxes]), ('thing',) * len(boxes),
                            np.ones(len(boxes)))
    camera, _ = find_camera(None, ASSETS / 'sequence')
    info = CameraInfo(header=HEADER, width=camera.width, height=camera.height,
                      k=camera.matrix.ravel(), p=np.c_[camera.matrix, np.zeros(3)].ravel())
    return Frame(Image(header=HEADER, width=camera.width, height=camera.height, encoding='rgb8',
                       step=3 * camera.width, data=image.tobytes()),
                 info, detections_to_msg(detections, HEADER), 0.0, 0.0)


def finds(localizer, frame, values) -> bool:
    """Return whether the pose is accepted; fail if it is accepted but wrong."""
    found = localizer.localize(frame, values, KnownBefore(RobotState(np.eye(4))),
                               StageTimes('waiting', 0.0)).found
    if found.accepted:
        truth = read_tum(ASSETS / 'sequence').pose_at(round(float(QUERY.timestamp) * NS_PER_S))
        distance_m, angle_deg = pose_error(found.map_from_camera, truth)
        assert distance_m < 0.25 and angle_deg < 5.0
    return found.accepted


@pytest.mark.parametrize(('compare', 'accepted'), [('both', True), ('image', True),
                                                   ('text', False)])
def test_images_tell_objects_apart(make_node, world, frame, compare, accepted):
    values = replace(world, landmark_embeddings=compare)
    assert finds(load_localizer(make_node(), values), frame, values) is accepted
