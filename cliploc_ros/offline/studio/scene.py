# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The 3D scene: landmarks as ellipsoids with labels, the gizmo, and the selected image."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.offline.studio.landmark import Landmark, Landmarks
from cliploc_ros.offline.studio.layers import SPHERE, linear
from cliploc_ros.offline.studio.viewpoint import Bounds, wxyz_of

_MAX_LABEL_LENGTH = 60
# Distance of the image of the selected view from its camera [m].
_IMAGE_DEPTH_M = 0.1
_RING_POINTS = 40
_GIZMO_PX = 90.0


def _make_rings() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return three unit circles as vertices (v, 3) and triangles without area (f, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_RING_POINTS)])
    rows = np.arange(3 * _RING_POINTS)
    after = rows // _RING_POINTS * _RING_POINTS + (rows + 1) % _RING_POINTS
    return (np.concatenate([np.roll(circle, axis, axis=1) for axis in range(3)]),
            np.column_stack([rows, after, after]))


_RINGS = _make_rings()


class Ellipsoids:
    """Landmarks as one node with an instance of a sphere for each, scaled to its ellipsoid.

    A click calls a function with the event and the landmark's id. With outlines, each landmark is
    a translucent body with three rings along its axes, so that it hides nothing behind it.
    """

    def __init__(self, scene: viser.SceneApi, name: str, on_click: Callable[[Any, str], None],
                 opacity: float | None = None, scale: float = 1.0, has_outlines: bool = False):
        self._scene, self._name, self._on_click = scene, name, on_click
        self._opacity, self._scale, self._has_outlines = opacity, scale, has_outlines
        self._shown: Landmarks = {}
        self._handles: list[Any] = []

    def show(self, landmarks: Landmarks, rgb_of: Callable[[str], tuple[int, int, int]]) -> None:
        """Show the given landmarks in the colours of their classes."""
        if list(landmarks.items()) == list(self._shown.items()):
            return
        before, self._shown = self._shown, landmarks
        shown = list(landmarks.values())
        colors = np.array([rgb_of(landmark.class_id) for landmark in shown], dtype=np.uint8)
        arrays: dict[str, Any] = {
            'batched_wxyzs': np.array([np.roll(landmark.quat_xyzw, 1) for landmark in shown],
                                      np.float32),
            'batched_positions': np.array([landmark.center for landmark in shown], np.float32),
            'batched_scales': np.array([self._scale * landmark.semi_axes for landmark in shown],
                                       np.float32)}
        if len(shown) != len(before):
            for handle in self._handles:
                handle.remove()
            self._handles = self._added(arrays, colors) if shown else []
            return
        for handle, its in zip(self._handles, (linear(colors), colors), strict=False):
            for key, value in (arrays | {'batched_colors': its}).items():
                setattr(handle, key, value)

    def _added(self, arrays: dict[str, Any], colors: NDArray[np.uint8]) -> list[Any]:
        add: Any = partial(self._scene.add_batched_meshes_simple, cast_shadow=False,
                           receive_shadow=False, **arrays)
        body = add(self._name, SPHERE.vertices, SPHERE.faces, opacity=self._opacity,
                   batched_colors=linear(colors))
        for modifier in (None, 'shift'):
            body.on_click(modifier=modifier)(self._clicked)
        # wireframe of triangles without area: dark lines, one pixel wide at any scale
        return [body] + ([add(f'{self._name}_outlines', *_RINGS, wireframe=True, lod='off',
                              batched_colors=colors)] if self._has_outlines else [])

    def _clicked(self, event: Any) -> None:
        ids = list(self._shown)
        if event.instance_index is not None and event.instance_index < len(ids):
            self._on_click(event, ids[event.instance_index])


class Labels:
    """Ids and labels of the selected landmarks, above them in the scene."""

    def __init__(self, scene: viser.SceneApi, up: NDArray[np.float64]):
        self._scene, self._up = scene, up
        self._handles: list[Any] = []

    def show(self, landmarks: Landmarks) -> None:
        """Show the labels of the given landmarks."""
        while len(self._handles) < len(landmarks):
            # nodes are numbered, because ids may contain characters that names must not
            self._handles.append(self._scene.add_label(
                f'/labels/{len(self._handles)}', '', anchor='bottom-center', visible=False))
        for handle in self._handles[len(landmarks):]:
            _set_props(handle, visible=False)
        for handle, (key, one) in zip(self._handles, landmarks.items(), strict=False):
            top = one.center + float(np.linalg.norm(one.basis.T @ self._up)) * self._up
            _set_props(handle, position=top, text=f'{key}: {one.label}'[:_MAX_LABEL_LENGTH],
                       visible=True)


def _set_props(handle: Any, **props: Any) -> None:
    """Set the properties that changed: viser sends each property that is set to all browsers."""
    for name, value in props.items():
        if not np.array_equal(getattr(handle, name), value):
            setattr(handle, name, value)


class Gizmo:
    """The handles for moving and rotating the selected landmark."""

    def __init__(self, scene: viser.SceneApi, on_drag: Callable[[Any], None]):
        # fixed size at any distance, and visible inside large landmarks
        self.handle = scene.add_transform_controls('/gizmo', scale=_GIZMO_PX, fixed=True,
                                                   depth_test=False, visible=False)
        self.handle.on_update(on_drag)

    def show(self, landmark: Landmark | None) -> None:
        """Place the gizmo at a landmark, or hide it."""
        _set_props(self.handle, visible=landmark is not None)
        if landmark is None:
            return
        if np.abs(self.handle.position - landmark.center).max() > 1e-5:
            self.handle.position = landmark.center
        turned = Rotation.from_quat(np.roll(self.handle.wxyz, -1)).inv() * Rotation.from_quat(
            landmark.quat_xyzw)
        if turned.magnitude() > 1e-4:
            self.handle.wxyz = np.roll(landmark.quat_xyzw, 1)


def draw_image(scene: viser.SceneApi, picture: NDArray[np.uint8], camera: Camera,
               map_from_camera: NDArray[np.float64]) -> list[Any]:
    """Draw an image in front of its camera, at a pose (4, 4)."""
    middle = _IMAGE_DEPTH_M * np.array([(camera.width / 2.0 - camera.cx) / camera.fx,
                                        (camera.height / 2.0 - camera.cy) / camera.fy, 1.0])
    return [scene.add_image(
        '/view/image', picture, camera.width / camera.fx * _IMAGE_DEPTH_M,
        camera.height / camera.fy * _IMAGE_DEPTH_M, format='jpeg', cast_shadow=False,
        receive_shadow=False, wxyz=wxyz_of(map_from_camera),
        position=map_from_camera[:3, :3] @ middle + map_from_camera[:3, 3])]


def draw_floor(scene: viser.SceneApi, extent: Bounds) -> None:
    """Draw the grid of the floor, with cells of half a metre."""
    side = 2.0 * float(np.ceil(1.3 * extent.radius_m)) + 2.0
    below = extent.middle - (extent.middle @ extent.up - extent.floor_m) * extent.up
    scene.add_grid('/floor', width=side, height=side, cell_size=0.5, fade_strength=2.0,
                   cell_color=(225, 225, 225), section_color=(190, 190, 190), position=below,
                   wxyz=wxyz_of(extent.upright))
