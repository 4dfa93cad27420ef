# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The line that every program prints for an answer. Diagnostics and files have all figures."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.core.relocalizer import Relocalization


class Place(NamedTuple):
    """The pose of a robot or of its camera, and its standard deviations."""

    pose: NDArray[np.float64]  #: (4, 4): into the map
    covariance: NDArray[np.float64]  #: (6, 6)
    heading_deg: float  #: From the map's x axis towards y
    position_m: float  #: Standard deviation of the position
    turn_deg: float  #: Standard deviation of the rotation about z


def place_of(found: Relocalization, camera_from_base: NDArray[np.float64], ahead: int = 0
             ) -> Place:
    """Return where the robot is by the best pose. `ahead` is the axis of its heading: 0, x.

    For a camera, it is 2: the viewing direction.
    """
    camera, covariance = found.map_from_camera, found.covariance
    assert camera is not None and covariance is not None
    pose = camera @ camera_from_base
    covariance = move_covariance(covariance, pose[:3, 3] - camera[:3, 3])
    ahead_xy = pose[:2, ahead]
    return Place(pose, covariance, math.degrees(math.atan2(*ahead_xy[::-1])), math.sqrt(
        np.trace(covariance[:3, :3])), math.degrees(math.sqrt(covariance[5, 5])))


def detail_of(found: Relocalization, frame_id: str, place: Place | None = None,
              left_out: Sequence[str] = ()) -> str:
    """Return the pose of an accepted answer and its evidence, or the reason of a refusal.

    `frame_id` is that of the map, `place` that of the robot (default: of the camera). `left_out`
    names the cameras without an image.
    """
    if not found.accepted:
        return found.reason
    pose, _, *others = place or place_of(found, np.eye(4), 2)
    evidence, points = found.evidence, found.recognized
    by = [f'{evidence.inliers} landmarks'] if evidence and found.source != 'keyframes' else []
    by += [f'{points.inliers} keyframe points'] if points and found.source != 'objects' else []
    by += [f'the depth of {found.depth.objects}'] if found.depth and found.depth.is_passed else []
    by += ['the prior'] if evidence and evidence.prior else []
    images = len(found.frame_matches)
    return ('x {:.2f} y {:.2f} z {:.2f} m in {}, heading {:.0f} deg; deviation {:.2f} m, '
            '{:.1f} deg; by {}{}{}').format(
                *pose[:3, 3], frame_id, *others, ', '.join(by),
                f' in {images} images' if images > 1 else '',
                f', without {", ".join(left_out)}' if left_out else '')


def answer_line(verdict: str, detail: str, kind: RefusalKind | None = None,
                time_s: float | None = None) -> str:
    """Return an answer in one line; `time_s` is the time that it took."""
    return '; '.join([f'{verdict}: {detail}', *([f'kind {kind}'] if kind else []),
                      *([f'{time_s:.2f} s'] if time_s is not None else [])])
