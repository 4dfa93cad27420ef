# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sensors that are wrong in a way that the robot does not know."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.observation import Observation
from cliploc_ros.evaluation.trials import Query
from cliploc_ros.simulation.sensors import turned


def with_mount_error(queries: Sequence[Query], groups: Sequence[int], noise_deg: float,
                     seed: int = 0) -> tuple[Query, ...]:
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


def tilted_vertical(queries: Sequence[Query], angle_deg: float, seed: int = 0
                    ) -> tuple[Query, ...]:
    """Return queries whose verticals are off by an angle, all frames of one in one direction."""
    found = []
    for query in queries:
        def change(one: Observation, number: int = query.number) -> Observation:
            rng = np.random.default_rng([seed, number, 2])
            return one if one.up_in_camera is None else replace(one, up_in_camera=turned(
                one.up_in_camera, np.radians(angle_deg), rng))

        found.append(_of_all_frames(query, change))
    return tuple(found)


def scaled_depth(queries: Sequence[Query], factor: float) -> tuple[Query, ...]:
    """Return queries whose depths are too large by a factor: of a scale, or of a unit."""
    return _with_depths(queries, lambda depths, rng: factor * depths)


def random_depth(queries: Sequence[Query], share: float, seed: int = 0) -> tuple[Query, ...]:
    """Return queries in which a share of the depths are anything from .3 to 6 m."""
    return _with_depths(queries, lambda depths, rng: np.where(
        rng.random(len(depths)) < share, rng.uniform(0.3, 6.0, len(depths)), depths), seed)


def missing_depth(queries: Sequence[Query], share: float, seed: int = 0) -> tuple[Query, ...]:
    """Return queries in which a share of the depths are not known."""
    return _with_depths(queries, lambda depths, rng: np.where(
        rng.random(len(depths)) < share, np.nan, depths), seed)


def depth_elsewhere(queries: Sequence[Query], share: float, seed: int = 0) -> tuple[Query, ...]:
    """Return queries with a share of depths of other boxes: the depth camera looks elsewhere."""
    known = [query.observation.depths for query in queries
             if query.observation.depths is not None]
    every = np.concatenate(known) if known else np.empty(0)
    return _with_depths(queries, lambda depths, rng: np.where(
        rng.random(len(depths)) < share, rng.choice(every, len(depths)), depths), seed)


def _with_depths(queries: Sequence[Query], change: Callable[
        [NDArray[np.float64], np.random.Generator], NDArray[np.float64]], seed: int = 0
        ) -> tuple[Query, ...]:
    """Return queries with other depths, where they have some."""
    found = []
    for query in queries:
        def changed(one: Observation, number: int = query.number) -> Observation:
            rng = np.random.default_rng([seed, number, 3])
            return one if one.depths is None else replace(one, depths=change(one.depths, rng))

        found.append(_of_all_frames(query, changed))
    return tuple(found)


def wrong_mount(queries: Sequence[Query], angle_deg: float, seed: int = 0) -> tuple[Query, ...]:
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


def scaled_odometry(queries: Sequence[Query], factor: float) -> tuple[Query, ...]:
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


def _of_all_frames(query: Query, change: Callable[[Observation], Observation]) -> Query:
    return replace(query, observation=change(query.observation),
                   neighbours=tuple(map(change, query.neighbours)))
