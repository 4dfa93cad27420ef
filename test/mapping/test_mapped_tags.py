# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tags mapped from images with poses that have errors."""

import cv2
import numpy as np
import pytest

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import (
    make_transform,
    pose_error,
    quaternion_from_transform,
)
from cliploc_ros.core.map.tags import Tag
from cliploc_ros.core.observation import Detections, Observation, SeenTags
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.mapping.tags import map_tags, parse_sizes, seen_tags

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
# tag axes into map axes: on a wall that the camera faces along x
WALL = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def tag_at(number, x, y, z=0.0):
    return Tag(f't{number}', 'tag36h11', number, 0.2, (x, y, z),
               tuple(quaternion_from_transform(make_transform(WALL, np.zeros(3)))))


def drive(tags_at, poses=40, seed=0):
    """Yield observations of tags and poses with errors; tags_at returns the tags of a step."""
    rng = np.random.default_rng(seed)
    for step in range(poses):
        turn, _ = cv2.Rodrigues(np.array([0.0, 0.01 * (step % 7 - 3), 0.0]))
        pose = make_transform(OPTICAL @ turn, np.array([0.02 * step, 0.6 - 0.03 * step, 0.1]))
        names, corners = [], []
        for tag in tags_at(step):
            inside = np.linalg.inv(pose) @ np.c_[tag.corners, np.ones(4)].T
            names.append(tag.name)
            corners.append(CAMERA.project_normalized((inside[:2] / inside[2]).T)
                           + rng.normal(0.0, 0.2, (4, 2)))
        error = make_transform(cv2.Rodrigues(rng.normal(0.0, 0.005, 3))[0],
                               rng.normal(0.0, 0.01, 3))
        yield Observation(CAMERA, Detections(np.empty((0, 4)), (), np.empty(0)), tags=SeenTags(
            tuple(names), np.array(corners).reshape(-1, 4, 2))), pose @ error


@pytest.mark.parametrize('size', ['', ':0.2'])
def test_tags_are_mapped_and_a_moved_or_copied_one_is_left_out(size):
    tags = [tag_at(1, 3.0, 0.5), tag_at(2, 3.5, -0.4, 0.3)]
    before, after = tag_at(3, 3.0, 0.0), tag_at(3, 3.0, -1.0)

    def tags_at(step):
        return [*tags, before if step < 20 else after, *[tag_at(4, 4.0, 1.0)] * (step < 2)]
    found = map_tags(seen_tags(drive(tags_at)), parse_sizes([f'tag36h11{size}']))
    assert [tag.name for tag in found.tags] == ['tag36h11_1', 'tag36h11_2']
    for tag, true in zip(found.tags, tags, strict=True):
        distance_m, angle_deg = pose_error(tag.map_from_tag, true.map_from_tag)
        assert distance_m < 0.02
        assert angle_deg < 2.0
        assert tag.size == pytest.approx(0.2, abs=0.004 if not size else 1e-9)
    line = found.line()
    assert 'tag36h11_3 is seen at two places' in line
    assert 'tag36h11_4: 2 images from one place' in line
    assert line.startswith('2 tags, corners within 0.')
    assert max(found.off_m) < 0.01


def test_families_and_sizes_that_are_wrong():
    for text in ('tag36h12:0.1', 'tag36h11:wide', 'tag36h11:0', ':0.1'):
        with pytest.raises(OptionsError, match='--tags'):
            parse_sizes([text])
