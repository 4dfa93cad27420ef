# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A recorded request comes back as it was, with depth of another camera."""

import numpy as np
from scene import CAMERA, make_room, see_room

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.messages import depths_from_msg
from cliploc_ros.offline.datasets.bag_messages import (
    CAMERA_INFO,
    DETECTIONS,
    IMAGE,
    camera_info_message,
    detections_message,
    image_message,
)
from cliploc_ros.offline.datasets.bags import typestore
from cliploc_ros.offline.datasets.cases import Case, CaseFrame, read_case, write_case

POSE = make_transform(np.eye(3), np.array([0.05, 0.0, 0.0]))


def frame(stamp_ns, **depth):
    def data(msg, msgtype):
        return bytes(typestore().serialize_cdr(msg, msgtype))
    image = image_message(stamp_ns, 'color', np.zeros((480, 640, 3), dtype=np.uint8))
    return CaseFrame(
        stamp_ns, IMAGE, data(image, IMAGE),
        data(camera_info_message(stamp_ns, 'color', CAMERA), CAMERA_INFO),
        data(detections_message(stamp_ns, 'color', see_room(make_room())), DETECTIONS),
        odom_from_camera=np.eye(4), **depth)


def depth_of(stamp_ns):
    types = typestore().types
    header = camera_info_message(stamp_ns, 'depth', CAMERA).header
    pixels = np.full((480, 640), 2500, dtype=np.uint16)
    msg = types[IMAGE](header=header, height=480, width=640, encoding='16UC1', is_bigendian=0,
                       step=1280, data=pixels.view(np.uint8).ravel())
    return {'depth_type': IMAGE, 'depth': bytes(typestore().serialize_cdr(msg, IMAGE)),
            'depth_camera_info': bytes(typestore().serialize_cdr(
                camera_info_message(stamp_ns, 'depth', CAMERA), CAMERA_INFO)),
            'camera_from_depth': POSE}


def test_depth_of_another_camera_is_kept(tmp_path):
    frames = (frame(10**12), frame(10**12 + 10**8, **depth_of(10**12 + 10**8)))
    write_case(tmp_path / 'case', Case(frames, {'verdict': 'refused'}))
    without, found = read_case(tmp_path / 'case').frames
    assert without.depth == b'' and without.camera_from_depth is None
    np.testing.assert_allclose(found.camera_from_depth, POSE)
    boxes = see_room(make_room()).bboxes_xyxy
    depths = depths_from_msg(found.message('depth'), 'color', CAMERA, boxes,
                             found.message('depth_camera_info'), found.camera_from_depth)
    known = np.isfinite(depths)
    assert known.sum() > 8
    np.testing.assert_allclose(depths[known], 2.5)
