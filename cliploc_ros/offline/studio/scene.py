# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The three-dimensional view: ellipsoids, labels, cameras, the selected image and the gizmo."""

import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import trimesh.creation
import viser
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera, frusta
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio.landmark import Landmark, Landmarks
from cliploc_ros.offline.studio.recording import ViewAnswer
from cliploc_ros.offline.studio.viewpoint import pixels_of, wxyz_of

# More labels than these hide the map.
_MAX_LABELS = 60
_MAX_LABEL_LENGTH, _SHORT_LABEL_LENGTH = 60, 24
# Size of a letter and of a line with its margins, in a label of scale 1 [px].
_LETTER_PX, _LINE_PX = 6.5, 28.0
_MAX_CAMERAS = 300
_FRUSTUM_M = 0.08
_KEYFRAME_RGB = (0, 150, 136)
_VERDICT_RGB = {'accepted': (30, 170, 60), 'refused': (150, 150, 150), 'wrong': (220, 0, 0)}
# The image of the selected view lies this far in front of its camera [m].
_IMAGE_DEPTH_M = 0.1
_SPHERE = trimesh.creation.icosphere(subdivisions=2)
_RING_POINTS = 40


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
    """Landmarks as one node of many equal spheres, each with its own scale.

    A click calls a function with the event and the landmark's id. With outlines, each is a
    shade with three rings along its axes, which hides nothing behind it.
    """

    def __init__(self, scene: viser.SceneApi, name: str, on_click: Callable[[Any, str], None],
                 opacity: float | None = None, scale: float = 1.0, has_outlines: bool = False):
        self._scene, self._name, self._on_click = scene, name, on_click
        self._opacity, self._scale, self._has_outlines = opacity, scale, has_outlines
        self._shown: tuple[tuple[str, Landmark], ...] = ()
        self._handles: list[Any] = []

    def show(self, landmarks: Sequence[tuple[str, Landmark]],
             rgb_of: Callable[[str], tuple[int, int, int]]) -> None:
        """Show these landmarks, in the colours of their classes."""
        landmarks = tuple(landmarks)
        if _fields_of(landmarks) == _fields_of(self._shown):
            return
        count_changed = len(landmarks) != len(self._shown)
        self._shown = landmarks
        if count_changed:
            for handle in self._handles:
                handle.remove()
            self._handles = []
        if not landmarks:
            return
        arrays: dict[str, Any] = {
            'batched_wxyzs': np.array([np.roll(one.quat_xyzw, 1) for _, one in landmarks],
                                      dtype=np.float32),
            'batched_positions': np.array([one.center for _, one in landmarks], dtype=np.float32),
            'batched_scales': np.array([self._scale * one.semi_axes for _, one in landmarks],
                                       dtype=np.float32)}
        colors = np.array([rgb_of(one.class_id) for _, one in landmarks], dtype=np.uint8)
        if not self._handles:
            self._add(arrays, colors)
        else:
            for handle in self._handles:
                for key, value in arrays.items():
                    setattr(handle, key, value)
            self._handles[0].batched_colors = linear(colors)
            if self._has_outlines:
                self._handles[1].batched_colors = colors

    def _add(self, arrays: dict[str, Any], colors: NDArray[np.uint8]) -> None:
        add: Any = partial(self._scene.add_batched_meshes_simple, cast_shadow=False,
                           receive_shadow=False, **arrays)
        body = add(self._name, _SPHERE.vertices, _SPHERE.faces, opacity=self._opacity,
                   batched_colors=linear(colors))
        for modifier in (None, 'shift'):
            body.on_click(modifier=modifier)(self._clicked)
        self._handles = [body]
        if self._has_outlines:
            # edges of empty triangles: a mesh of lines, one pixel wide at any scale, and dark
            self._handles.append(add(f'{self._name}_outlines', *_RINGS, wireframe=True,
                                     lod='off', batched_colors=colors))

    def _clicked(self, event: Any) -> None:
        shown = self._shown
        if event.instance_index is not None and event.instance_index < len(shown):
            self._on_click(event, shown[event.instance_index][0])


def _fields_of(landmarks: Sequence[tuple[str, Landmark]]) -> list[tuple[str, object]]:
    return [(key, one.fields) for key, one in landmarks]


class Labels:
    """The landmarks' labels in the scene, as many as have room there, the nearest first.

    The room is that of the browser whose camera moved last.
    """

    def __init__(self, server: viser.ViserServer, up: NDArray[np.float64]):
        self._server, self._up = server, up
        self._handles: dict[str, tuple[Landmark, Any]] = {}
        self._count = 0
        # landmarks, selection, where the labels begin, their texts
        self._shown: tuple[Landmarks, Sequence[str], NDArray[np.float64], list[str]] = (
            {}, (), np.empty((0, 3)), [])
        self._camera: Any = None
        self._lock, self._is_stale = threading.Lock(), False
        self.is_shown = True

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            client.camera.on_update(self._moved)
            self._moved(client.camera)

    def show(self, landmarks: Landmarks, selection: Sequence[str]) -> None:
        """Show the labels of these landmarks; those of the selection come first."""
        tops = np.array([one.center + float(np.linalg.norm(one.basis.T @ self._up)) * self._up
                         for one in landmarks.values()]).reshape(-1, 3)
        self._shown = landmarks, selection, tops, [
            _shortened(one.label, key in selection) for key, one in landmarks.items()]
        self._lay_out()

    def _moved(self, camera: Any) -> None:
        self._camera = camera
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the labels; a call during another one has that one do it once more."""
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
            if not any(left < one[2] and right > one[0] and top < one[3] and bottom > one[1]
                       for one in taken):
                taken.append((left, top, right, bottom))
                yield row, scale
            if len(taken) >= _MAX_LABELS:
                return

    def _set(self, landmarks: Landmarks, selection: Sequence[str], tops: NDArray[np.float64],
             texts: Sequence[str]) -> None:
        keys = list(landmarks)
        rows = dict(self._with_room(tops, texts, np.isin(keys, selection))
                    if self.is_shown and keys else ())
        for key in self._handles.keys() - landmarks.keys():
            self._handles.pop(key)[1].remove()
        for key in self._handles.keys() - {keys[row] for row in rows}:
            if self._handles[key][1].visible:
                self._handles[key][1].visible = False
        for row, scale in rows.items():
            key, text = keys[row], texts[row]
            one = landmarks[key]
            old, handle = self._handles.get(key, (None, None))
            if handle is None:
                # ids may hold any characters, names of nodes not
                handle = self._server.scene.add_label(f'/labels/{self._count}', text,
                                                      anchor='bottom-center')
                self._count += 1
            if old is not one:
                handle.position = tops[row]
            for name, value in (('text', text), ('font_screen_scale', scale), ('visible', True)):
                if getattr(handle, name) != value:
                    setattr(handle, name, value)
            self._handles[key] = (one, handle)


def _shortened(label: str, is_selected: bool) -> str:
    length = _MAX_LABEL_LENGTH if is_selected else _SHORT_LABEL_LENGTH
    return label if len(label) <= length else f'{label[:length - 1]}…'


class ViewImage:
    """The image of the selected view, in the scene in front of its camera."""

    def __init__(self, scene: viser.SceneApi):
        self._scene = scene
        self._camera: Camera | None = None
        self.handle: Any = None
        self.pose = np.eye(4)

    def _take(self, camera: Camera, picture: NDArray[np.uint8]) -> None:
        """Show the pictures of this camera from now on, as large as its view."""
        self._camera, self.pose = camera, np.eye(4)
        half = (camera.width / 2.0, camera.height / 2.0)
        self._middle = np.array([(half[0] - camera.cx) / camera.fx,
                                 (half[1] - camera.cy) / camera.fy, 1.0]) * _IMAGE_DEPTH_M
        self.handle = self._scene.add_image(
            '/view/image', picture, camera.width / camera.fx * _IMAGE_DEPTH_M,
            camera.height / camera.fy * _IMAGE_DEPTH_M, format='jpeg', cast_shadow=False,
            receive_shadow=False)

    def show(self, picture: NDArray[np.uint8], camera: Camera,
             map_from_camera: NDArray[np.float64]) -> None:
        """Show a picture of a camera at a pose (4, 4)."""
        if camera != self._camera:
            self._take(camera, picture)
        self.handle.image = picture
        if not np.array_equal(self.pose, map_from_camera):
            self.pose = map_from_camera
            self.handle.wxyz = wxyz_of(map_from_camera)
            self.handle.position = map_from_camera[:3, :3] @ self._middle + map_from_camera[:3, 3]


class Answers:
    """The relocalizer's answers: a sphere where it was asked, a line to the pose it found."""

    def __init__(self, scene: viser.SceneApi, detections: PosedDetections):
        self._scene, self._poses = scene, detections.map_from_camera
        self._shown: tuple[ViewAnswer, ...] = ()

    def show(self, answers: tuple[ViewAnswer, ...]) -> None:
        """Show these answers instead of the last ones."""
        if answers is self._shown:
            return
        self._shown = answers
        asked = np.array([self._poses[one.view, :3, 3] for one in answers])
        colors = np.array([_VERDICT_RGB[one.verdict] for one in answers], dtype=np.uint8)
        self._scene.add_batched_meshes_simple(
            '/answers', _SPHERE.vertices * 0.03, _SPHERE.faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (len(answers), 1)), asked, batched_colors=linear(colors),
            cast_shadow=False, receive_shadow=False)
        pairs = [(asked[row], one.result.map_from_camera[:3, 3], colors[row])
                 for row, one in enumerate(answers) if one.result.map_from_camera is not None]
        points = np.array([pair[:2] for pair in pairs]).reshape(-1, 2, 3)
        line_colors = np.array([[pair[2]] * 2 for pair in pairs], dtype=np.uint8)
        self._scene.add_line_segments('/answers/lines', points, line_colors.reshape(-1, 2, 3),
                                      thickness=2.0, thickness_units='screen')


def linear(rgb: Any) -> NDArray[np.uint8]:
    """Return colours (n, 3) as viser takes those of instances: for linear light."""
    return np.asarray(255.0 * (np.asarray(rgb) / 255.0) ** 2.2, dtype=np.uint8)


def some_cameras(count: int) -> NDArray[np.int64]:
    """Return the rows of the cameras to draw: all, or every n-th of many."""
    return np.arange(0, count, max(1, -(-count // _MAX_CAMERAS)))


def draw_recording(scene: viser.SceneApi, detections: PosedDetections,
                   on_click: Callable[[Any, int], None]) -> list[Any]:
    """Draw the trajectory and the cameras, all of them or every n-th; a click chooses a view."""
    handles: list[Any] = []
    poses, order = detections.map_from_camera, detections.by_camera
    is_way = np.diff(detections.frame_cameras[order]) == 0
    if is_way.any():
        path = np.stack([poses[order[:-1][is_way], :3, 3], poses[order[1:][is_way], :3, 3]],
                        axis=1)
        handles.append(scene.add_line_segments('/trajectory', path, (90, 90, 90), thickness=1.5,
                                               thickness_units='screen'))
    shown = order[some_cameras(len(poses))]
    handles.append(scene.add_line_segments(
        '/cameras', frusta([detections.camera_of(row) for row in shown], poses[shown],
                           _FRUSTUM_M),
        (120, 120, 200), thickness=1.0, thickness_units='screen'))
    handle = scene.add_batched_meshes_simple(
        '/camera_centers', _SPHERE.vertices * 0.012, _SPHERE.faces,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(shown), 1)), poses[shown, :3, 3],
        batched_colors=linear((120, 120, 200)), cast_shadow=False, receive_shadow=False)

    @handle.on_click
    def _(event: Any) -> None:
        if event.instance_index is not None:
            on_click(event, int(shown[event.instance_index]))

    return [*handles, handle]


def draw_keyframes(scene: viser.SceneApi, layer: KeyframeLayer) -> list[Any]:
    """Draw the cameras of the keyframes, all of them or every n-th."""
    shown = some_cameras(len(layer))
    return [scene.add_line_segments(
        '/keyframes', frusta([layer.camera_of(row) for row in shown],
                             layer.map_from_camera[shown], 1.5 * _FRUSTUM_M),
        _KEYFRAME_RGB, thickness=1.5, thickness_units='screen')]
