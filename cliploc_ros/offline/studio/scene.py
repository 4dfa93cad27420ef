# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The 3D scene: landmarks as ellipsoids with labels, the gizmo, and the selected image."""

import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.offline.studio.landmark import Landmark, Landmarks, fields_of
from cliploc_ros.offline.studio.layers import SPHERE, linear
from cliploc_ros.offline.studio.viewpoint import Bounds, pixels_of, wxyz_of

# Greatest number of labels: more hide the map.
_MAX_LABELS = 60
_MAX_LABEL_LENGTH, _SHORT_LABEL_LENGTH = 60, 24
# Width of a letter, and height of a line with its margins, in a label of scale 1 [px].
_LETTER_PX, _LINE_PX = 6.5, 28.0
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
        if list(fields_of(landmarks).items()) == list(fields_of(self._shown).items()):
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
    """Ids of the landmarks in the scene. Of overlapping ids, only the nearest is shown.

    Selected landmarks also show their labels, which may be equal and long. The layout fits the
    window of the browser whose camera moved last.
    """

    def __init__(self, server: viser.ViserServer, up: NDArray[np.float64]):
        self._server, self._up = server, up
        self._handles: dict[str, Any] = {}
        self._count = 0
        self._shown: tuple[Landmarks, Sequence[str]] = {}, ()
        self._camera: Any = None
        self._lock, self._is_stale = threading.Lock(), False

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            client.camera.on_update(self._moved)
            self._moved(client.camera)

    def show(self, landmarks: Landmarks, selection: Sequence[str]) -> None:
        """Show the labels of the given landmarks, with priority for the selection."""
        self._shown = landmarks, selection
        self._lay_out()

    def _moved(self, camera: Any) -> None:
        self._camera = camera
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the labels. A call during another call makes that call repeat the layout."""
        self._is_stale = True
        while self._is_stale and self._lock.acquire(blocking=False):
            try:
                self._is_stale = False
                if self._camera is not None:
                    with self._server.atomic():
                        self._set(*self._shown)
            finally:
                self._lock.release()

    def _with_room(self, tops: NDArray[np.float64], texts: Sequence[str],
                   is_selected: NDArray[np.bool_]) -> Iterator[tuple[int, float]]:
        """Yield the rows of the labels that do not overlap, and their sizes."""
        camera = self._camera
        pixels, depths = pixels_of(camera, tops)
        orbit_m = float(np.linalg.norm(camera.look_at - camera.position))
        with np.errstate(invalid='ignore'):
            is_inside = (depths > 0.05) & (pixels > 0.0).all(axis=1) & (
                pixels < (camera.image_width, camera.image_height)).all(axis=1)
        order = np.lexsort([depths, ~is_selected])
        taken: list[tuple[float, float, float, float]] = []
        for row in order[is_inside[order]].tolist():
            scale = round(min(max(orbit_m / float(depths[row]), 0.8), 1.1), 1)
            half = 0.5 * scale * _LETTER_PX * (len(texts[row]) + 2)
            x, bottom = pixels[row].tolist()
            left, top, right = x - half, bottom - scale * _LINE_PX, x + half
            if not any(left < other[2] and right > other[0] and top < other[3]
                       and bottom > other[1] for other in taken):
                taken.append((left, top, right, bottom))
                yield row, scale
            if len(taken) >= _MAX_LABELS:
                return

    def _set(self, landmarks: Landmarks, selection: Sequence[str]) -> None:
        tops = np.array([
            landmark.center + float(np.linalg.norm(landmark.basis.T @ self._up)) * self._up
            for landmark in landmarks.values()]).reshape(-1, 3)
        keys, texts = list(landmarks), [
            _shortened(f'{key}: {landmark.label}', _MAX_LABEL_LENGTH) if key in selection
            else _shortened(key, _SHORT_LABEL_LENGTH) for key, landmark in landmarks.items()]
        rows = dict(self._with_room(tops, texts, np.isin(keys, selection)) if keys else ())
        for key in self._handles.keys() - landmarks.keys():
            self._handles.pop(key).remove()
        for key in self._handles.keys() - {keys[row] for row in rows}:
            _set_props(self._handles[key], visible=False)
        for row, scale in rows.items():
            if keys[row] not in self._handles:
                # nodes are numbered, because ids may contain characters that names must not
                self._handles[keys[row]] = self._server.scene.add_label(
                    f'/labels/{self._count}', texts[row], anchor='bottom-center')
                self._count += 1
            _set_props(self._handles[keys[row]], position=tops[row], text=texts[row],
                       font_screen_scale=scale, visible=True)


def _set_props(handle: Any, **props: Any) -> None:
    """Set the properties that changed: viser sends each property that is set to all browsers."""
    for name, value in props.items():
        if not np.array_equal(getattr(handle, name), value):
            setattr(handle, name, value)


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f'{text[:length - 1]}…'


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
