# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulate sensor errors that are unknown to the robot."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.observation import Observation
from cliploc_ros.offline.evaluation.trials import turned
from cliploc_ros.offline.posed_query import PosedQuery

Floats = NDArray[np.float64]
#: A function that changes queries by a level.
Change = Callable[[Sequence[PosedQuery], float], tuple[PosedQuery, ...]]


def _of_frames(change: Callable[[Observation, float, np.random.Generator], Observation],
               salt: int = 3) -> Change:
    """Return a change that applies one rule to all frames of the queries.

    All frames of a query get the same random numbers.
    """
    def changed(queries: Sequence[PosedQuery], level: float) -> tuple[PosedQuery, ...]:
        def of_frame(frame: Observation, number: int) -> Observation:
            return change(frame, level, np.random.default_rng([0, number, salt]))

        return tuple(replace(
            query, observation=of_frame(query.observation, query.number),
            neighbours=tuple(of_frame(neighbour, query.number) for neighbour in query.neighbours))
            for query in queries)

    return changed


def _of_boxes(change: Callable[[Floats, Camera, float], Floats]) -> Change:
    """Return a change that applies one rule to the boxes (n, 4) of each frame."""
    return _of_frames(lambda frame, level, rng: replace(frame, detections=replace(
        frame.detections, bboxes_xyxy=np.ascontiguousarray(change(
            frame.detections.bboxes_xyxy.reshape(-1, 4), frame.camera, level), dtype=np.float64))))


def _of_camera(change: Callable[[Camera, float], Camera]) -> Change:
    """Return a change that makes the intrinsics wrong by a level."""
    return _of_frames(lambda frame, level, rng: replace(frame, camera=change(frame.camera, level)))


def _of_depths(change: Callable[[Floats, float, np.random.Generator], Floats]) -> Change:
    """Return a change that makes the depths (n,) wrong, in frames that have depths."""
    return _of_frames(lambda frame, level, rng: frame if frame.depths is None else replace(
        frame, depths=change(frame.depths, level, rng)))


def with_mount_error(queries: Sequence[PosedQuery], groups: Sequence[int], noise_deg: float,
                     seed: int = 0) -> tuple[PosedQuery, ...]:
    """Return queries with a known vertical that has the same error in all frames of a group.

    Such an error is that of a sensor, or of its mount.

    Parameters
    ----------
    groups : sequence of int
        The group of each query.
    noise_deg : float
        Standard deviation of the error on each of two axes [deg].
    seed : int
        Equal seeds give equal noise.
    """
    found = []
    for query, group in zip(queries, groups, strict=True):
        turn = np.radians(noise_deg) * np.random.default_rng([seed, abs(group), 2]).normal(size=3)
        up = Rotation.from_rotvec(turn).apply(query.map_from_camera[2, :3])
        found.append(replace(query, observation=replace(query.observation, up_in_camera=up)))
    return tuple(found)


@partial(_of_frames, salt=2)
def tilted_vertical(frame: Observation, angle_deg: float, rng: np.random.Generator) -> Observation:
    """Return a frame whose vertical is off by an angle."""
    return frame if frame.up_in_camera is None else replace(frame, up_in_camera=turned(
        frame.up_in_camera, np.radians(angle_deg), rng))


@_of_frames
def wrong_mount(frame: Observation, angle_deg: float, rng: np.random.Generator) -> Observation:
    """Return a frame of a camera that is turned in its mount by an angle about a random axis.

    The robot's tilt and odometry are transformed to the camera by the mount, so both are wrong.
    """
    axis, up, pose = rng.normal(size=3), frame.up_in_camera, frame.odom_from_camera
    turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis))
    wrong = make_transform(turn.as_matrix(), np.zeros(3))
    return replace(frame, up_in_camera=None if up is None else wrong[:3, :3].T @ up,
                   odom_from_camera=None if pose is None else pose @ wrong)


#: Depths too large by a factor, such as a wrong scale or unit.
scaled_depth = _of_depths(lambda depths, factor, rng: factor * depths)
#: A share of the depths is random, from .3 to 6 m.
random_depth = _of_depths(lambda depths, share, rng: np.where(
    rng.random(len(depths)) < share, rng.uniform(0.3, 6.0, len(depths)), depths))
#: A share of the depths is missing.
missing_depth = _of_depths(lambda depths, share, rng: np.where(
    rng.random(len(depths)) < share, np.nan, depths))


def depth_elsewhere(queries: Sequence[PosedQuery], share: float) -> tuple[PosedQuery, ...]:
    """Return queries with a share of depths of other boxes, as if the depth camera were turned."""
    known = [query.observation.depths for query in queries
             if query.observation.depths is not None]
    every = np.concatenate(known) if known else np.empty(0)
    return _of_depths(lambda depths, level, rng: np.where(
        rng.random(len(depths)) < level, rng.choice(every, len(depths)), depths))(queries, share)


def scaled_odometry(queries: Sequence[PosedQuery], factor: float) -> tuple[PosedQuery, ...]:
    """Return queries whose odometry overestimates distances and turns by a factor."""
    found = []
    for query in queries:
        frames = sorted((*query.neighbours, query.observation), key=lambda frame: frame.stamp_ns)
        poses = [np.eye(4)]
        for before, after in pairwise(frames):
            assert before.odom_from_camera is not None
            assert after.odom_from_camera is not None
            step = invert_transform(before.odom_from_camera) @ after.odom_from_camera
            turn = Rotation.from_rotvec(factor * Rotation.from_matrix(step[:3, :3]).as_rotvec())
            poses.append(poses[-1] @ make_transform(turn.as_matrix(), factor * step[:3, 3]))
        scaled = {frame.stamp_ns: replace(frame, odom_from_camera=pose)
                  for frame, pose in zip(frames, poses, strict=True)}
        found.append(replace(query, observation=scaled[query.observation.stamp_ns],
                             neighbours=tuple(scaled[neighbour.stamp_ns]
                                              for neighbour in query.neighbours)))
    return tuple(found)


#: Boxes of an image of another size.
scaled_boxes = _of_boxes(lambda boxes, camera, factor: factor * boxes)
#: Boxes shifted to the right by a share of the image's width.
shifted_boxes = _of_boxes(lambda boxes, camera, share: boxes + [share * camera.width, 0.0] * 2)


@_of_boxes
def middle_crop(boxes: Floats, camera: Camera, side_px: float) -> Floats:
    """Return boxes in the pixels of a network whose input is the middle square of the image."""
    side = min(camera.width, camera.height)
    corner = np.tile([camera.width - side, camera.height - side], 2) / 2
    return np.clip((boxes - corner) * side_px / side, 0.0, side_px)


@_of_boxes
def letterboxed(boxes: Floats, camera: Camera, side_px: float) -> Floats:
    """Return boxes in the pixels of a network whose input is the image with two bars, a square."""
    size = np.array([camera.width, camera.height])
    scale = side_px / size.max()
    return scale * boxes + np.tile((side_px - scale * size) / 2, 2)


@_of_boxes
def turned_boxes(boxes: Floats, camera: Camera, angle_deg: float) -> Floats:
    """Return the boxes of an image turned by a multiple of 90 degrees."""
    width, height = camera.width, camera.height
    for _ in range(round(angle_deg / 90.0) % 4):
        left, top, right, bottom = boxes.T
        boxes = np.stack([height - bottom, left, height - top, right], axis=1)
        width, height = height, width
    return boxes


@_of_boxes
def mirrored_boxes(boxes: Floats, camera: Camera, level: float) -> Floats:
    """Return the boxes of an image mirrored left to right (0) or top to bottom (1)."""
    left, top, right, bottom = boxes.T
    if level:
        return np.stack([left, camera.height - bottom, right, camera.height - top], axis=1)
    return np.stack([camera.width - right, top, camera.width - left, bottom], axis=1)


#: Conventions for the four numbers of a box, computed from its corners and the image's size.
CONVENTIONS: tuple[Callable[..., tuple[NDArray[np.float64], NDArray[np.float64]]], ...] = (
    lambda low, high, size: (0.5 * (low + high), high - low),  # x and y of the centre, sides
    lambda low, high, size: (low, high - low),  # corner and sides
    lambda low, high, size: (low / size, high / size),  # shares of the image
    lambda low, high, size: (low[:, ::-1], high[:, ::-1]),  # rows before columns
    # corners interpreted as centre and sides, and as corner and sides
    lambda low, high, size: (low - 0.5 * high, low + 0.5 * high),
    lambda low, high, size: (low, low + high))
#: Boxes in one of the CONVENTIONS, interpreted as corners.
of_convention = _of_boxes(lambda boxes, camera, number: np.hstack(CONVENTIONS[int(number)](
    boxes[:, :2], boxes[:, 2:], np.array([camera.width, camera.height]))))


@_of_boxes
def fisheye_boxes(boxes: Floats, camera: Camera, level: float) -> Floats:
    """Return the boxes of an ideal fisheye camera, interpreted as those of a pinhole camera."""
    middle, scale = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    x, y = boxes.reshape(-1, 2, 2).transpose(2, 0, 1)
    # the middles of the edges: left, top, right, bottom
    points = np.stack([np.stack([x[:, 0], y.mean(axis=1)], axis=1),
                       np.stack([x.mean(axis=1), y[:, 0]], axis=1),
                       np.stack([x[:, 1], y.mean(axis=1)], axis=1),
                       np.stack([x.mean(axis=1), y[:, 1]], axis=1)], axis=1)
    rays = (points - middle) / scale
    distances = np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-9)
    pixels = rays * np.arctan(distances) / distances * scale + middle
    return np.stack([pixels[:, 0, 0], pixels[:, 1, 1], pixels[:, 2, 0], pixels[:, 3, 1]], axis=1)


#: Intrinsics of an image of another size.
scaled_camera = _of_camera(lambda camera, factor: replace(
    camera, fx=factor * camera.fx, fy=factor * camera.fy, cx=factor * camera.cx,
    cy=factor * camera.cy))
#: Focal lengths that are wrong by a factor.
scaled_focal = _of_camera(lambda camera, factor: replace(
    camera, fx=factor * camera.fx, fy=factor * camera.fy))
#: A principal point that is off by a share of the width.
shifted_center = _of_camera(lambda camera, share: replace(
    camera, cx=camera.cx + share * camera.width))
