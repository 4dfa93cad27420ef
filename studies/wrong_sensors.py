# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sensors that are wrong in a way that the robot does not know."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.observation import Observation
from cliploc_ros.offline.evaluation.trials import PosedQuery, turned


def with_mount_error(queries: Sequence[PosedQuery], groups: Sequence[int], noise_deg: float,
                     seed: int = 0) -> tuple[PosedQuery, ...]:
    """Return queries with a known vertical, wrong by the same in all frames of a group.

    That is the error of a sensor, or of its mount.

    Parameters
    ----------
    groups : sequence of int
        The group of each.
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


def tilted_vertical(queries: Sequence[PosedQuery], angle_deg: float, seed: int = 0
                    ) -> tuple[PosedQuery, ...]:
    """Return queries whose verticals are off by an angle, all frames of one in one direction."""
    found = []
    for query in queries:
        def change(one: Observation, number: int = query.number) -> Observation:
            rng = np.random.default_rng([seed, number, 2])
            return one if one.up_in_camera is None else replace(one, up_in_camera=turned(
                one.up_in_camera, np.radians(angle_deg), rng))

        found.append(_of_all_frames(query, change))
    return tuple(found)


def scaled_depth(queries: Sequence[PosedQuery], factor: float) -> tuple[PosedQuery, ...]:
    """Return queries whose depths are too large by a factor: of a scale, or of a unit."""
    return _with_depths(queries, lambda depths, rng: factor * depths)


def random_depth(queries: Sequence[PosedQuery], share: float, seed: int = 0
                 ) -> tuple[PosedQuery, ...]:
    """Return queries in which a share of the depths are anything from .3 to 6 m."""
    return _with_depths(queries, lambda depths, rng: np.where(
        rng.random(len(depths)) < share, rng.uniform(0.3, 6.0, len(depths)), depths), seed)


def missing_depth(queries: Sequence[PosedQuery], share: float, seed: int = 0
                  ) -> tuple[PosedQuery, ...]:
    """Return queries in which a share of the depths are not known."""
    return _with_depths(queries, lambda depths, rng: np.where(
        rng.random(len(depths)) < share, np.nan, depths), seed)


def depth_elsewhere(queries: Sequence[PosedQuery], share: float, seed: int = 0
                    ) -> tuple[PosedQuery, ...]:
    """Return queries with a share of depths of other boxes: the depth camera looks elsewhere."""
    known = [query.observation.depths for query in queries
             if query.observation.depths is not None]
    every = np.concatenate(known) if known else np.empty(0)
    return _with_depths(queries, lambda depths, rng: np.where(
        rng.random(len(depths)) < share, rng.choice(every, len(depths)), depths), seed)


def _with_depths(queries: Sequence[PosedQuery], change: Callable[
        [NDArray[np.float64], np.random.Generator], NDArray[np.float64]], seed: int = 0
        ) -> tuple[PosedQuery, ...]:
    """Return queries with other depths, where they have some."""
    found = []
    for query in queries:
        def changed(one: Observation, number: int = query.number) -> Observation:
            rng = np.random.default_rng([seed, number, 3])
            return one if one.depths is None else replace(one, depths=change(one.depths, rng))

        found.append(_of_all_frames(query, changed))
    return tuple(found)


def wrong_mount(queries: Sequence[PosedQuery], angle_deg: float, seed: int = 0
                ) -> tuple[PosedQuery, ...]:
    """Return queries of a camera that is turned in its mount by an angle, one way for each.

    The robot's tilt and odometry reach the camera through the mount, so both are wrong.
    """
    found = []
    for query in queries:
        rng = np.random.default_rng([seed, query.number, 3])
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis))
        wrong = make_transform(turn.as_matrix(), np.zeros(3))

        def change(one: Observation, wrong: NDArray[np.float64] = wrong) -> Observation:
            up, pose = one.up_in_camera, one.odom_from_camera
            return replace(one, up_in_camera=None if up is None else wrong[:3, :3].T @ up,
                           odom_from_camera=None if pose is None else pose @ wrong)

        found.append(_of_all_frames(query, change))
    return tuple(found)


def scaled_odometry(queries: Sequence[PosedQuery], factor: float) -> tuple[PosedQuery, ...]:
    """Return queries whose odometry counts distances and turns too long by a factor."""
    found = []
    for query in queries:
        frames = sorted((*query.neighbours, query.observation), key=lambda one: one.stamp_ns)
        poses = [np.eye(4)]
        for before, after in pairwise(frames):
            assert before.odom_from_camera is not None
            assert after.odom_from_camera is not None
            step = invert_transform(before.odom_from_camera) @ after.odom_from_camera
            turn = Rotation.from_rotvec(factor * Rotation.from_matrix(step[:3, :3]).as_rotvec())
            poses.append(poses[-1] @ make_transform(turn.as_matrix(), factor * step[:3, 3]))
        scaled = {one.stamp_ns: replace(one, odom_from_camera=pose)
                  for one, pose in zip(frames, poses, strict=True)}
        found.append(replace(query, observation=scaled[query.observation.stamp_ns],
                             neighbours=tuple(scaled[one.stamp_ns] for one in query.neighbours)))
    return tuple(found)


def middle_crop(queries: Sequence[PosedQuery], side_px: float) -> tuple[PosedQuery, ...]:
    """Return queries with the boxes of a network that sees the middle square, in its pixels."""
    def change(boxes: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
        side = min(camera.width, camera.height)
        corner = np.tile([camera.width - side, camera.height - side], 2) / 2
        return np.clip((boxes - corner) * side_px / side, 0.0, side_px)

    return _with_boxes(queries, change)


def scaled_boxes(queries: Sequence[PosedQuery], factor: float) -> tuple[PosedQuery, ...]:
    """Return queries with boxes of an image of another size."""
    return _with_boxes(queries, lambda boxes, camera: factor * boxes)


def shifted_boxes(queries: Sequence[PosedQuery], share: float) -> tuple[PosedQuery, ...]:
    """Return queries with boxes shifted to the right by a share of the image's width."""
    return _with_boxes(queries, lambda boxes, camera: boxes + [share * camera.width, 0.0] * 2)


def turned_boxes(queries: Sequence[PosedQuery], angle_deg: float) -> tuple[PosedQuery, ...]:
    """Return queries with the boxes of images turned by a multiple of 90 degrees."""
    def change(boxes: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
        width, height = camera.width, camera.height
        for _ in range(round(angle_deg / 90.0) % 4):
            left, top, right, bottom = boxes.T
            boxes = np.stack([height - bottom, left, height - top, right], axis=1)
            width, height = height, width
        return boxes

    return _with_boxes(queries, change)


def mirrored_boxes(queries: Sequence[PosedQuery], level: float) -> tuple[PosedQuery, ...]:
    """Return queries with the boxes of images mirrored left to right (0) or top to bottom (1)."""
    def change(boxes: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
        left, top, right, bottom = boxes.T
        if level:
            return np.stack([left, camera.height - bottom, right, camera.height - top], axis=1)
        return np.stack([camera.width - right, top, camera.width - left, bottom], axis=1)

    return _with_boxes(queries, change)


#: Numbers of a box in the order of some convention, made of corners (2, n) and the image's size.
CONVENTIONS: tuple[Callable[..., tuple[NDArray[np.float64], NDArray[np.float64]]], ...] = (
    lambda low, high, size: (0.5 * (low + high), high - low),  # x and y of the centre, sides
    lambda low, high, size: (low, high - low),  # corner and sides
    lambda low, high, size: (low / size, high / size),  # shares of the image
    lambda low, high, size: (low[:, ::-1], high[:, ::-1]),  # rows before columns
    # corners taken for centre and sides, and for corner and sides
    lambda low, high, size: (low - 0.5 * high, low + 0.5 * high),
    lambda low, high, size: (low, low + high))


def of_convention(queries: Sequence[PosedQuery], number: float) -> tuple[PosedQuery, ...]:
    """Return queries with boxes of another one of CONVENTIONS, taken for corners."""
    return _with_boxes(queries, lambda boxes, camera: np.hstack(CONVENTIONS[int(number)](
        boxes[:, :2], boxes[:, 2:], np.array([camera.width, camera.height]))))


def fisheye_boxes(queries: Sequence[PosedQuery], level: float) -> tuple[PosedQuery, ...]:
    """Return queries with the boxes that an ideal fisheye sees, taken for a pinhole's."""
    def change(boxes: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
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
        return np.stack([pixels[:, 0, 0], pixels[:, 1, 1], pixels[:, 2, 0], pixels[:, 3, 1]],
                        axis=1)

    return _with_boxes(queries, change)


def scaled_camera(queries: Sequence[PosedQuery], factor: float) -> tuple[PosedQuery, ...]:
    """Return queries with the intrinsics of an image of another size."""
    return _with_camera(queries, lambda camera: replace(
        camera, fx=factor * camera.fx, fy=factor * camera.fy, cx=factor * camera.cx,
        cy=factor * camera.cy))


def scaled_focal(queries: Sequence[PosedQuery], factor: float) -> tuple[PosedQuery, ...]:
    """Return queries with focal lengths that are wrong by a factor."""
    return _with_camera(queries, lambda camera: replace(camera, fx=factor * camera.fx,
                                                        fy=factor * camera.fy))


def shifted_center(queries: Sequence[PosedQuery], share: float) -> tuple[PosedQuery, ...]:
    """Return queries with a principal point that is off by a share of the width."""
    return _with_camera(queries, lambda camera: replace(camera,
                                                        cx=camera.cx + share * camera.width))


def _with_camera(queries: Sequence[PosedQuery], change: Callable[[Camera], Camera]
                 ) -> tuple[PosedQuery, ...]:
    return tuple(_of_all_frames(query, lambda one: replace(one, camera=change(one.camera)))
                 for query in queries)


def _with_boxes(queries: Sequence[PosedQuery], change: Callable[
        [NDArray[np.float64], Camera], NDArray[np.float64]]) -> tuple[PosedQuery, ...]:
    """Return queries with other boxes, all changed by one rule."""
    return tuple(_of_all_frames(query, lambda one: replace(one, detections=replace(
        one.detections, bboxes_xyxy=np.ascontiguousarray(change(
            one.detections.bboxes_xyxy.reshape(-1, 4), one.camera), dtype=np.float64))))
        for query in queries)


def _of_all_frames(query: PosedQuery, change: Callable[[Observation], Observation]) -> PosedQuery:
    return replace(query, observation=change(query.observation),
                   neighbours=tuple(map(change, query.neighbours)))
