# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The line that every program prints for an answer. Diagnostics and files have all figures."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.geometry.transforms import quaternion_from_transform
from cliploc_ros.core.relocalizer import Relocalization


def figures_of_pose(pose: NDArray[np.float64], covariance: NDArray[np.float64], ahead: int
                    ) -> dict[str, Any]:
    """Return the figures of a pose (4, 4) as doc/interface.md describes them.

    `ahead` is the axis of the heading: 0 (x) of a robot, 2 (the viewing direction) of a camera.
    """
    x, y, z = pose[:3, 3].tolist()
    return {'x [m]': x, 'y [m]': y, 'z [m]': z,
            'orientation xyzw': ' '.join(map(repr, quaternion_from_transform(pose).tolist())),
            'heading [deg]': math.degrees(math.atan2(pose[1, ahead], pose[0, ahead])),
            'position deviation [m]': math.sqrt(np.trace(covariance[:3, :3])),
            'heading deviation [deg]': math.degrees(math.sqrt(covariance[5, 5])),
            'covariance': ' '.join(map(repr, covariance.ravel().tolist()))}


def detail_of(found: Relocalization, frame_id: str, figures: Mapping[str, Any] | None = None
              ) -> str:
    """Return the pose of an accepted answer and its evidence, or the reason of a refusal.

    `frame_id` is that of the map, `figures` are those of the robot's pose, by default those of
    the camera's pose.
    """
    if not found.accepted:
        return found.reason
    assert found.map_from_camera is not None and found.covariance is not None
    evidence, points, depth = found.evidence, found.recognized, found.depth
    of_objects = found.source in ('objects', 'both')
    by = [f'{evidence.inliers} landmarks'] if evidence and of_objects else []
    by += [f'{points.inliers} keyframe points{points.recorded and f" of {points.recorded}"}'
           ] if points and found.source != 'objects' else []
    by += [f'depth of {depth.objects} objects'] if depth and depth.is_passed else []
    by += [', '.join(evidence.tags.names)] if evidence and evidence.tags else []
    by += ['the prior'] if evidence and evidence.prior else []
    images = len(found.frame_matches)
    of = figures or figures_of_pose(found.map_from_camera, found.covariance, 2)
    return (f'x {of["x [m]"]:.2f} y {of["y [m]"]:.2f} z {of["z [m]"]:.2f} m in {frame_id}, '
            f'heading {round(of["heading [deg]"])} deg; deviation '
            f'{of["position deviation [m]"]:.2f} m, {of["heading deviation [deg]"]:.1f} deg; by '
            + ', '.join(by) + (f' in {images} images' if images > 1 else ''))


def answer_line(verdict: str, detail: str, kind: RefusalKind | None = None,
                time_s: float | None = None) -> str:
    """Return an answer in one line; `time_s` is the time that it took."""
    return '; '.join([f'{verdict}: {detail}', *([f'kind {kind}'] if kind else []),
                      *([f'{time_s:.2f} s'] if time_s is not None else [])])
