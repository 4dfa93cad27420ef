# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Viewpoints of the scene: the whole map, from above, one landmark, a view of the recording."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.offline.mapping.tilt import find_tilt, rotation_to_z

#: The vertical angle of view [rad].
FOV_RAD = 0.9
# Near plane [m].
_NEAR_M = 0.01
# If the vertical by hand-held cameras is within this angle of z, z is used [deg].
_SAME_UP_DEG = 20.0
# Share of landmarks and cameras within the extent.
_EXTENT_SHARE = 0.95
# Least radius [m] and margin of a landmark in view: it fills about a third of the page's height.
_LEAST_RADIUS_M, _AROUND = 0.2, 2.5
_LEAST_RISE = 0.35
#: Aspect of the scene between the panels, until the page reports it.
USUAL_ASPECT = 0.6


class Bounds(NamedTuple):
    """A sphere around the map."""

    middle: NDArray[np.float64]  #: (3,) [m]
    radius_m: float  #: Radius of a sphere around 95 % of landmarks and cameras
    up: NDArray[np.float64]  #: (3,): the unit vector that points up
    floor_m: float  #: Height of the floor along ``up``
    top_m: float  #: Height of the highest landmark or camera
    aside: NDArray[np.float64]  #: (3,): horizontal direction from the middle to the cameras

    @property
    def upright(self) -> NDArray[np.float64]:
        """The rotation (3, 3) from a coordinate frame with z up to the map's."""
        return rotation_to_z(self.up)[0].T


def extent_of(landmarks: Sequence[NDArray[np.float64]], poses: NDArray[np.float64] | None
              ) -> Bounds:
    """Return the extent of landmarks (n, 3) and the cameras (m, 4, 4) that saw them [m].

    Up is z, unless the cameras' tilt clearly differs, because the map is in a camera's coordinate
    frame.
    """
    centers = np.reshape(landmarks, (-1, 3))
    poses = np.empty((0, 4, 4)) if poses is None else poses
    up, found = np.array([0.0, 0.0, 1.0]), find_tilt(poses)
    if found is not None and found[1] >= _SAME_UP_DEG:
        up = np.asarray(found[0].T @ up)
    points = np.concatenate([centers, poses[:, :3, 3]])
    if not len(points):
        points = np.zeros((1, 3))
    share = np.array([1.0 - _EXTENT_SHARE, _EXTENT_SHARE])
    middle = np.quantile(centers if len(centers) else points, share, axis=0).mean(axis=0)
    distances = np.linalg.norm(points - middle, axis=1)
    # the floor of a map with z up is z = 0; for other maps it is estimated from the points
    floor_m = 0.0 if up[2] == 1.0 else float(np.quantile(points @ up, 0.02)) - 0.3
    aside = poses[:, :3, 3].mean(axis=0) - middle if len(poses) else np.zeros(3)
    aside = aside - (aside @ up) * up
    if np.linalg.norm(aside) < 0.3:
        aside = rotation_to_z(up)[0].T @ [-1.0, -1.0, 0.0]
    return Bounds(middle, max(1.0, float(np.quantile(distances, _EXTENT_SHARE))), up, floor_m,
                  float((points @ up).max()), aside / np.linalg.norm(aside))


def overview(extent: Bounds, aspect: float, is_from_above: bool = False) -> NDArray[np.float64]:
    """Return a position (3,) with a view of the whole map, from the side or from above.

    The side is that of the map's cameras. ``aspect`` is the width of the page divided by its
    height. From above, y is up on the page.
    """
    # not exactly vertical, because the camera orbits about the vertical
    direction = (extent.upright @ [0.0, -1e-3, 1.0] if is_from_above
                 else extent.aside + 0.8 * extent.up)
    distance = 1.15 * extent.radius_m / np.tan(FOV_RAD / 2.0) / min(1.0, max(aspect, 0.1))
    return np.asarray(extent.middle + distance * direction / np.linalg.norm(direction))


def look_at(client: Any, center: NDArray[np.float64], radius_m: float, up: NDArray[np.float64]
            ) -> None:
    """Move the camera of a browser to an object, keeping its viewing direction if possible."""
    camera = client.camera
    direction = camera.position - camera.look_at
    direction = direction / max(float(np.linalg.norm(direction)), 1e-9)
    direction = direction + max(0.0, _LEAST_RISE - float(direction @ up)) * up
    distance = _AROUND * max(radius_m, _LEAST_RADIUS_M) / np.tan(FOV_RAD / 2.0)
    move_to(client, center + distance * direction / np.linalg.norm(direction), center, up)


def move_to(client: Any, position: NDArray[np.float64], look_at: NDArray[np.float64],
            up: NDArray[np.float64]) -> None:
    """Move the camera of a browser to a position (3,), looking at a point (3,).

    From then on it orbits that point.
    """
    camera = client.camera
    with client.atomic():
        camera.up_direction = up
        camera.position, camera.look_at = position, look_at
        camera.fov, camera.near = FOV_RAD, _NEAR_M
        camera.far = max(1000.0, 3.0 * float(np.linalg.norm(position - look_at)))


def look_through(client: Any, pose: NDArray[np.float64], intrinsics: Camera) -> None:
    """Move the camera of a browser to the pose of an image, with the whole image in view."""
    camera = client.camera
    with client.atomic():
        camera.near = _NEAR_M
        camera.position = pose[:3, 3]
        camera.look_at = pose[:3, 3] + pose[:3, 2]
        camera.up_direction = -pose[:3, 1]
        camera.wxyz = wxyz_of(pose)
        # show the whole image even if the gap between the panels is narrow
        half = max(intrinsics.height / intrinsics.fy,
                   intrinsics.width / intrinsics.fx / max(camera.aspect, 0.1)) / 2.0
        camera.fov = 2.0 * float(np.arctan(1.1 * half))


def wxyz_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation of a pose (4, 4) or matrix (3, 3) as viser's quaternion w, x, y, z."""
    return np.asarray(np.roll(Rotation.from_matrix(rotation[:3, :3]).as_quat(), 1))
