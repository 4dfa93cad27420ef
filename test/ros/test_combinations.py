# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Combinations of features: cameras, priors and kinds of requests, in one process."""

import math
import time
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from cameras import MAP, MOUNTS, NAMES, look
from frames import frame_of, header_of
from scene import CAMERA, depth_image, make_layer
from sensor_msgs.msg import Image

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer, repeat
from cliploc_ros.core.observation import Region
from cliploc_ros.core.query import Case, read_case
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.ros.answer import Answer, CaseRecorder, Verdict
from cliploc_ros.ros.frame_localizer import FrameLocalizer, Instants, Keyframes
from cliploc_ros.ros.inputs.odometry import OdometryPlace
from cliploc_ros.ros.inputs.robot_state import KnownBefore, RobotState
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters

ANY_YAW = 1e3
COMBINATIONS = [(1, 'nothing'), (1, 'depth'), (1, 'prior'), (1, 'keyframes'), (1, 'all'),
                (4, 'nothing'), (4, 'all')]
LAYER = make_layer(MAP)


class Drive:
    """A robot that drives ahead, its cameras' observations, and the localizer."""

    def __init__(self, cameras, known, folder, mode='on_request'):
        self.parameters = RelocalizerParameters(
            matching='class', mode=mode, cameras=list(NAMES) if cameras > 1 else [],
            time_budget_ms=5000.0, record_folder=str(folder / 'cases'))
        options = self.parameters.options()
        keyframes = Keyframes(KeyframeLocalizer(LAYER)) if known in ('keyframes', 'all') else None
        self.localizer = FrameLocalizer(MAP, None, Relocalizer(MAP, options), options, '',
                                        keyframes)
        self.has_odometry, self.has_depth = True, known in ('depth', 'all')
        self.region = None if known not in ('prior', 'all') else Region(
            'map', np.zeros(3), np.diag([0.5, 0.5, ANY_YAW]) ** 2, 0.95)
        self.recorder = CaseRecorder(True)
        self.cameras, self.rng, self.objects = cameras, np.random.default_rng(3), 8

    def see(self, number):
        """Return the frames of an instant with their states, and the first one's true pose."""
        robot = make_transform(np.eye(3), np.array([0.0, 0.0, 0.05 * number]))
        frames = []
        for name, mount, seen in zip(NAMES, MOUNTS, look(self.rng, robot, self.objects,
                                                           noise_px=0.3),
                                     strict=True):
            header = header_of((100 + number) * 10**9, name)
            # some blobs, different each time
            pixels = cv2.resize(self.rng.integers(0, 255, (6, 8), np.uint8),
                                (CAMERA.width, CAMERA.height))
            depth = Image(header=header, width=CAMERA.width, height=CAMERA.height,
                          encoding='32FC1', step=4 * CAMERA.width, data=depth_image(
                              MAP, robot @ mount, seen.detections.bboxes_xyxy).tobytes())
            frames.append((frame_of(
                seen.detections, header, pixels, received_at=float(number),
                detected_at=float(number), depth=depth if self.has_depth else None,
                camera=name if self.cameras > 1 else ''),
                RobotState(invert_transform(mount), place=OdometryPlace(
                    robot @ mount, 0, 0.05 * number) if self.has_odometry else None)))
        return frames[:self.cameras], robot @ MOUNTS[0]

    def localize(self, number=0, deadline=math.inf):
        """Localize an instant as the node does; return the result and the pose's error [m]."""
        ((frame, state), *beside), truth = self.see(number)
        found = self.localizer.localize(frame, self.parameters, KnownBefore(
            state, beside, self.region), StageTimes('waiting', time.monotonic()), deadline)
        answer = Answer(Verdict.ACCEPTED if found.found.accepted else Verdict.REFUSED, '',
                        received_at=frame.received_at, query=found.query)
        self.recorder.add(answer)
        self.recorder.end(answer)
        pose = found.found.map_from_camera
        return found, math.inf if pose is None else pose_error(pose, truth)[0]

    def recorded(self):
        """Store the request; return the answer of another localizer to the file."""
        self.recorder.store(self.parameters)
        *_, path = sorted(Path(self.parameters.record_folder).iterdir())
        case = read_case(path)
        return case, self.repeated(case, case.options)

    def repeated(self, case, options):
        """Return the answer of another localizer to the last query of a case."""
        return repeat(case, Localizer(
            Relocalizer(MAP, options),
            KeyframeLocalizer(LAYER) if self.localizer.keyframes else None))


def equal(one, other):
    """Assert that two results are equal bit by bit, except for times."""
    np.testing.assert_array_equal(one.map_from_camera, other.map_from_camera)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert (one.accepted, one.evidence, one.reason) == (other.accepted, other.evidence,
                                                        other.reason)


@pytest.mark.parametrize('cameras', [1, 3])
@pytest.mark.parametrize(('left_s', 'searched'), [(60.0, 'thorough'), (0.4, 'none'),
                                                  (math.inf, 'fast')])
def test_a_refused_request_searches_keyframes_as_far_as_its_time_allows(
        cameras, left_s, searched, tmp_path):
    """A frame of continuous mode has no deadline, and no thorough pass."""
    drive = Drive(cameras, 'all', tmp_path)
    drive.objects = 2
    found, _ = drive.localize(deadline=time.monotonic() + left_s)
    assert not found.found.accepted and found.found.keyframe_search == searched
    case, again = drive.recorded()
    assert again.keyframe_search == searched
    assert case.queries[-1].is_thorough == (searched == 'thorough')


@pytest.mark.parametrize(('cameras', 'known'), COMBINATIONS)
def test_a_request_is_answered_and_its_record_is_answered_alike(cameras, known, tmp_path):
    drive = Drive(cameras, known, tmp_path)
    for number in range(2):  # the second fuses the first, with odometry
        found, error_m = drive.localize(number)
        assert found.found.accepted and error_m < 0.05 and found.found.source == 'objects'
        assert len(found.query.frames) == cameras
        depths = found.query.newest.depths
        assert (depths is not None and np.isfinite(depths).sum() >= 6) == drive.has_depth
    assert len(found.found.frame_matches) == 2 * cameras
    case, again = drive.recorded()
    assert asdict(drive.parameters).items() >= case.report['parameters'].items()
    assert len(case.queries) == 2
    equal(again, found.found)


@pytest.mark.parametrize(('cameras', 'known'), COMBINATIONS)
def test_continuous_answers_tell_a_filter_only_what_is_new(cameras, known, tmp_path):
    drive = Drive(cameras, known, tmp_path, 'continuous')
    shares, queries = [], []
    for number in range(4):
        found, error_m = drive.localize(number)
        assert found.found.accepted and error_m < 0.05
        queries.append(found.query)
        shares.append(np.trace(found.found.covariance[:3, :3])
                      / np.trace(found.for_filter[:3, :3]))
        assert np.linalg.norm((found.carried - found.found.map_from_camera)[:3, 3]) < 0.05
    assert shares[0] == pytest.approx(1.0)
    assert max(shares[1:]) < 0.9
    equal(drive.repeated(Case(tuple(queries), {}), drive.parameters.options()), found.found)


def test_a_carried_robot_has_no_pose_until_two_answers_agree(tmp_path):
    """Odometry does not see the carry. A request begins a new track."""
    drive = Drive(1, 'nothing', tmp_path, 'continuous')
    poses = [drive.localize(number)[0].carried for number in range(3)]
    assert all(pose is not None for pose in poses)
    drive.objects = 0
    blind, _ = drive.localize(12)
    truth = drive.see(12)[1]
    assert blind.found.map_from_camera is None and pose_error(blind.carried, truth)[0] < 0.05
    drive.objects = 8
    track = drive.localizer.localizer.track
    elsewhere = track.map_from_camera.copy()
    elsewhere[0, 3] += 3.0
    drive.localizer.localizer.track = replace(track, map_from_camera=elsewhere)
    found = [drive.localize(number)[0] for number in (13, 14)]
    assert all(each.found.accepted for each in found)
    assert found[0].carried is None
    np.testing.assert_array_equal(found[1].carried, found[1].found.map_from_camera)
    drive.localizer.localizer.track = replace(track, map_from_camera=elsewhere)
    found, _ = drive.localize(15, deadline=time.monotonic() + 60.0)
    np.testing.assert_array_equal(found.carried, found.found.map_from_camera)


def test_mounts_of_cameras_are_no_odometry(tmp_path):
    """Without odometry a filter updates at each instant; the watch never assumes standing."""
    drive = Drive(4, 'nothing', tmp_path, 'continuous')
    drive.has_odometry = False
    for number in range(3):
        found, error_m = drive.localize(number)
        assert found.found.accepted and error_m < 0.05
        assert len(found.query.frames) == 4 and found.query.run is None
        np.testing.assert_array_equal(found.for_filter, found.found.covariance)
    (frame, state), *_ = drive.see(0)[0]
    assert Instants(MAP, True).query(
        frame, drive.parameters, KnownBefore(state)).newest.odom_from_camera is None
