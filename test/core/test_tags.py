# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tags: their fields in a map, corners in rendered images, and poses that they name."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tag_images import paint_tag

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import (
    SAME_ANSWER,
    make_transform,
    pose_error,
    quaternion_from_transform,
)
from cliploc_ros.core.localizer import Localizer, repeat
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.core.map.tags import Tag
from cliploc_ros.core.observation import Detections, Observation, SeenTags
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import CASE, Case, Query, case_arrays, read_case
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.watch.watch import Watch
from cliploc_ros.errors import MapError

NOTHING = Detections(np.empty((0, 4)), (), np.empty(0))
CAMERAS = [Camera(640, 480, 500.0, 500.0, 320.0, 240.0),
           Camera(640, 480, 300.0, 300.0, 320.0, 240.0, 'equidistant', (-0.02, 0.004, 0.0, 0.0)),
           Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 'plumb_bob', (-0.3, 0.1, 0.0, 0.0, 0.0))]
#: Pose of a tag in front of the camera at the origin, which looks along x: it faces the camera.
FACING = make_transform(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), np.array([1.5, 0, 0]))
CAMERA = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))


def tag_at(number, map_from_tag, size=0.3, family='tag36h11'):
    return Tag(f'{family}_{number}', family, number, size, tuple(map_from_tag[:3, 3]),
               tuple(quaternion_from_transform(map_from_tag)))


def turned(vertical_deg, tag=FACING):
    turn, _ = cv2.Rodrigues(np.radians([0.0, vertical_deg, 0.0]))
    return make_transform(tag[:3, :3] @ turn, tag[:3, 3])


def map_of(*tags, landmarks=None):
    return replace(landmarks or LandmarkMap.empty('map'), tags=tags)


def pixels_of(tag, camera, map_from_camera=CAMERA):
    inside = np.linalg.inv(map_from_camera) @ np.c_[tag.corners, np.ones(4)].T
    return camera.project_normalized((inside[:2] / inside[2]).T)


def ask(landmark_map, corners, camera=CAMERAS[0], detections=NOTHING, **fields):
    seen = Observation(camera, detections, tags=SeenTags(
        tuple(corners), np.array([*corners.values()]).reshape(-1, 4, 2)), **fields)
    options = RelocalizerOptions(matching='class')
    return Relocalizer(landmark_map, options).relocalize([seen])


def test_a_map_with_tags_is_written_and_read(tmp_path):
    path, tag = tmp_path / 'map.yaml', tag_at(12, turned(20.0))
    write_map(path, map_of(tag))
    read = LandmarkMap.from_file(path)
    np.testing.assert_allclose(read.tags[0].corners, tag.corners, atol=1e-4)
    assert len(read) == 0
    fields = {'family': 'tag36h11', 'id': 12, 'size': 0.3, 'center': [0.0, 0.0, 0.0],
              'orientation': [0.0, 0.0, 0.0, 1.0]}
    for change, fault in (({'family': 'tag36h12'}, "did you mean 'tag36h11'"), (
            {'id': 587}, 'from 0 to 586'), ({'id': True}, 'id'), ({'size': 0.0}, 'size'),
            ({'size': float('nan')}, 'size'), ({'center': [0.0]}, 'center'),
            ({'family': []}, 'family'), ({'color': 1}, 'unknown field')):
        with pytest.raises(MapError, match=fault):
            LandmarkMap.from_mapping({'frame_id': 'map', 'landmarks': {}, 'tags': {
                'door': fields | change}}, 'source')
    with pytest.raises(MapError, match="those of 'a'"):
        LandmarkMap.from_mapping({'frame_id': 'map', 'landmarks': {}, 'tags': {
            'a': fields, 'b': fields}}, 'source')


@pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no aruco')
@pytest.mark.parametrize('camera', CAMERAS, ids=['pinhole', 'fisheye', 'plumb_bob'])
@pytest.mark.parametrize('family', ['tag36h11', 'tag25h9', 'DICT_5X5_100'])
def test_a_tag_in_an_image_gives_the_pose_again_and_again(camera, family, tmp_path):
    tag = tag_at(7, turned(35.0), family=family)
    image = paint_tag(np.full((480, 640, 3), 150, np.uint8), tag, camera, CAMERA)
    localizer = Localizer(Relocalizer(map_of(tag), RelocalizerOptions(matching='class')))
    found = localizer.answer(Query((Observation(camera, NOTHING),), (image,)))
    assert found.accepted, found.reason
    assert found.source == 'tags'
    assert found.evidence.tags.names == (tag.name,)
    assert pose_error(found.map_from_camera, CAMERA)[0] < 0.02
    seen = localizer.query.newest.tags
    assert np.abs(seen.corners_px[0] - pixels_of(tag, camera)).max() < 0.35
    case = Case((localizer.query,), {'options': {}})
    CASE.write(tmp_path / 'case.npz', case_arrays(case))
    again = repeat(read_case(tmp_path / 'case.npz'), Localizer(Relocalizer(
        map_of(tag), RelocalizerOptions(matching='class'))))
    np.testing.assert_array_equal(again.map_from_camera, found.map_from_camera)
    # a map without tags does not look for any
    bare = Localizer(Relocalizer(LandmarkMap.empty('map'), RelocalizerOptions(matching='class')))
    bare.answer(Query((Observation(camera, NOTHING),), (image,)))
    assert bare.query.newest.tags is None


def test_flips_are_accepted_only_with_other_evidence():
    """A small tag seen from the front fits two poses; noise decides which fits better."""
    rng, right, wrong, decided = np.random.default_rng(0), 0, 0, 0
    for _ in range(40):
        tag = tag_at(3, turned(rng.uniform(-20.0, 20.0)), size=0.06)
        corners = pixels_of(tag, CAMERAS[0]) + rng.normal(0.0, 0.3, (4, 2))
        found = ask(map_of(tag), {tag.name: corners})
        is_right = SAME_ANSWER.agree(found.map_from_camera, CAMERA)
        wrong += found.accepted and not is_right
        right += found.accepted and is_right
        other = tag_at(4, make_transform(FACING[:3, :3], np.array([1.2, 0.5, 0.1])))
        both = ask(map_of(tag, other), {tag.name: corners, other.name: pixels_of(
            other, CAMERAS[0])})
        decided += both.accepted and pose_error(both.map_from_camera, CAMERA)[0] < 0.05
    assert (wrong, decided) == (0, 40)


def test_what_a_tag_must_not_contradict():
    """Objects, other tags, and keyframes, which the pose does not explain."""
    tag = tag_at(1, turned(30.0))
    far = make_transform(tag.map_from_tag[:3, :3], np.array([1.5, 4.0, 0.0]))
    landmarks = LandmarkMap(
        'map', ('cup', 'box'), ('x', 'x'), ('cup', 'box'), np.array([[2.0, 0.5, 0.1], [2.0, -0.4,
                                                                                      -0.2]]),
        np.full((2, 3), 0.1), np.tile([0.0, 0, 0, 1], (2, 1)))
    boxes = Detections(np.array([[170.0, 190, 220, 240], [395.0, 265, 445, 315]]),
                       ('cup', 'box'), np.ones(2))
    corners = {tag.name: pixels_of(tag, CAMERAS[0])}
    right = ask(map_of(tag, landmarks=landmarks), corners, detections=boxes)
    assert right.accepted, right.reason
    wrong = ask(map_of(tag_at(1, far), landmarks=landmarks), corners, detections=boxes)
    assert not wrong.accepted
    assert wrong.refusal_kind == 'contradiction'
    assert 'tag36h11_1 and objects or keyframes disagree' in wrong.reason
    others = [tag_at(number, make_transform(FACING[:3, :3], np.array([1.5, y, 0.4])))
              for number, y in ((2, 0.4), (3, -0.4))]
    seen = corners | {other.name: pixels_of(other, CAMERAS[0]) for other in others}
    outvoted = ask(map_of(tag_at(1, far), *others), seen)
    assert outvoted.accepted, outvoted.reason
    assert outvoted.evidence.tags.others == ('tag36h11_1',)
    assert pose_error(outvoted.map_from_camera, CAMERA)[0] < 0.02
    assert not ask(map_of(tag_at(1, far), others[0]), dict([*seen.items()][:2])).accepted


def test_another_camera_of_the_instant_and_the_watch_use_tags():
    tag = tag_at(5, turned(30.0))
    beside = CAMERA @ make_transform(cv2.Rodrigues(np.radians([0.0, 90.0, 0.0]))[0],
                                     np.array([0.2, 0.0, 0.0]))
    sees = Observation(CAMERAS[0], NOTHING, camera_name='front', odom_from_camera=CAMERA,
                       tags=SeenTags((tag.name,), pixels_of(tag, CAMERAS[0])[None]))
    blind = Observation(CAMERAS[0], NOTHING, camera_name='left', odom_from_camera=beside)
    options = RelocalizerOptions(matching='class')
    localizer = Localizer(Relocalizer(map_of(tag), options))
    found = localizer.answer(Query((sees, blind), run=None))
    assert found.accepted, found.reason
    assert pose_error(found.map_from_camera, beside)[0] < 0.02
    for pose, state in ((CAMERA, 'localized'), (CAMERA @ make_transform(
            np.eye(3), np.array([2.0, 0.0, 2.0])), 'lost')):
        watch = Watch(Relocalizer(map_of(tag), options))
        for step in range(30):
            odom = make_transform(np.eye(3), np.array([0.3 * step, 0.0, 0.0])) @ pose
            report = watch.look(replace(sees, odom_from_camera=odom, stamp_ns=step * 10**10),
                                pose)
        assert report.state == state, report.reason
