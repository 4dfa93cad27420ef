# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The 3D scene: landmarks as ellipsoids with labels, the gizmo, and the layers around them.

The layers are the cameras, keyframes, the relocalizer's answers, and the running relocalizer. Each
is drawn again when its content changes. No ROS here: the state of the running relocalizer comes as
a value that ``live`` makes.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh.creation
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from cliploc_ros.core.geometry.camera import Camera, frusta
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.offline.mapping.check.relocalization import Trial
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio.edits import Landmark, Landmarks
from cliploc_ros.offline.studio.viewpoint import Bounds, wxyz_of

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LiveState

_MAX_LABEL_LENGTH = 60
# Distance of the image of the selected view from its camera [m].
_IMAGE_DEPTH_M = 0.1
_RING_POINTS = 40
_GIZMO_PX = 90.0
_SPHERE = trimesh.creation.icosphere(subdivisions=2)
_NO_SHADOW: dict[str, Any] = {'cast_shadow': False, 'receive_shadow': False}
_MAX_CAMERAS = 300
_FRUSTUM_M = 0.08
_CAMERA_RGB, _PATH_RGB, _KEYFRAME_RGB = (120, 120, 200), (90, 90, 90), (0, 150, 136)
_VERDICT_RGB = {'accepted': (30, 170, 60), 'refused': (150, 150, 150), 'misled': (220, 0, 0)}
_CURRENT_RGB, _OLD_RGB = (30, 170, 60), (150, 150, 150)
# Field of view and aspect of the robot's camera: typical values, because they are unknown here.
_FOV_RAD, _ASPECT = 0.85, 4.0 / 3.0
_ROBOT_M = 0.25
# Radius of the 95 % ellipsoid for a standard deviation of 1 m [m]; limits of its semi-axes [m].
_RADIUS_95 = float(np.sqrt(chdtri(3, 0.05)))
_LEAST_M, _GREATEST_M = 1e-3, 100.0

#: Draws something into a scene, and returns the handles of the nodes.
Draw = Callable[[viser.SceneApi, Any], list[Any]]


def _make_rings() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return three unit circles as vertices (v, 3) and triangles without area (f, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_RING_POINTS)])
    rows = np.arange(3 * _RING_POINTS)
    after = rows // _RING_POINTS * _RING_POINTS + (rows + 1) % _RING_POINTS
    return (np.concatenate([np.roll(circle, axis, axis=1) for axis in range(3)]),
            np.column_stack([rows, after, after]))


_RINGS = _make_rings()


def _linear(rgb: Any) -> NDArray[np.uint8]:
    """Convert sRGB colours (n, 3) to linear colours, as viser expects for instances."""
    return np.asarray(255.0 * (np.asarray(rgb) / 255.0) ** 2.2, dtype=np.uint8)


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
        for handle, its in zip(self._handles, (_linear(colors), colors), strict=False):
            for key, value in (arrays | {'batched_colors': its}).items():
                setattr(handle, key, value)

    def _added(self, arrays: dict[str, Any], colors: NDArray[np.uint8]) -> list[Any]:
        add: Any = partial(self._scene.add_batched_meshes_simple, **_NO_SHADOW, **arrays)
        body = add(self._name, _SPHERE.vertices, _SPHERE.faces, opacity=self._opacity,
                   batched_colors=_linear(colors))
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
        camera.height / camera.fy * _IMAGE_DEPTH_M, format='jpeg', wxyz=wxyz_of(map_from_camera),
        position=map_from_camera[:3, :3] @ middle + map_from_camera[:3, 3], **_NO_SHADOW)]


def draw_floor(scene: viser.SceneApi, extent: Bounds) -> None:
    """Draw the grid of the floor, with cells of half a metre, for a light or dark ground."""
    side = 2.0 * float(np.ceil(1.3 * extent.radius_m)) + 2.0
    below = extent.middle - (extent.middle @ extent.up - extent.floor_m) * extent.up
    scene.add_grid('/floor', width=side, height=side, cell_size=0.5, fade_strength=2.0,
                   cell_color=(190, 190, 190), section_color=(150, 150, 150), position=below,
                   wxyz=wxyz_of(extent.upright))


# ---- the layers --------------------------------------------------------------------------------

class Layers:
    """Parts of the scene by name."""

    def __init__(self, scene: viser.SceneApi):
        self._scene = scene
        self._drawn: dict[str, tuple[object, list[Any]]] = {}

    def show(self, name: str, what: Any, draw: Draw, is_shown: bool = True) -> None:
        """Draw an object (None: nothing) unless it is already drawn; show or hide the layer."""
        old, handles = self._drawn.get(name, (None, []))
        if what is not old:
            for handle in handles:
                handle.remove()
            handles = [] if what is None else draw(self._scene, what)
            self._drawn[name] = what, handles
        for handle in handles:
            if handle.visible != is_shown:
                handle.visible = is_shown


def _lines(scene: viser.SceneApi, name: str, points: Any, rgb: Any, thickness: float = 1.5) -> Any:
    """Draw lines (n, 2, 3) in one colour, or with a colour for each end (n, 2, 3)."""
    return scene.add_line_segments(name, np.reshape(points, (-1, 2, 3)), rgb, thickness=thickness,
                                   thickness_units='screen')


def _dots(scene: viser.SceneApi, name: str, points: NDArray[np.float64], radius_m: float, rgb: Any
          ) -> Any:
    """Draw spheres at points (n, 3) in one colour, or with a colour for each point (n, 3)."""
    return scene.add_batched_meshes_simple(
        name, _SPHERE.vertices * radius_m, _SPHERE.faces,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)), points, batched_colors=_linear(rgb),
        **_NO_SHADOW)


def some_cameras(count: int) -> NDArray[np.int64]:
    """Return the rows of the cameras to draw: all of few, every n-th of many."""
    return np.arange(0, count, max(1, -(-count // _MAX_CAMERAS)))


def draw_cameras(on_click: Callable[[int], None]) -> Draw:
    """Return a function that draws the trajectory and the cameras. A click selects a view."""
    def draw(scene: viser.SceneApi, detections: PosedDetections) -> list[Any]:
        poses, order = detections.map_from_camera, detections.by_camera
        is_way = np.diff(detections.frame_cameras[order]) == 0
        shown = order[some_cameras(len(poses))]
        dots = _dots(scene, '/camera_centers', poses[shown, :3, 3], 0.012, _CAMERA_RGB)

        @dots.on_click
        def _(event: Any) -> None:
            if event.instance_index is not None:
                on_click(int(shown[event.instance_index]))

        return [dots, _lines(scene, '/trajectory', np.stack(
            [poses[order[:-1][is_way], :3, 3], poses[order[1:][is_way], :3, 3]], axis=1),
            _PATH_RGB), _lines(scene, '/cameras', frusta(
                [detections.camera_of(row) for row in shown], poses[shown], _FRUSTUM_M),
                _CAMERA_RGB, 1.0)]

    return draw


def draw_keyframes(scene: viser.SceneApi, layer: KeyframeLayer) -> list[Any]:
    """Draw the cameras of the keyframes: all of few, every n-th of many."""
    shown = some_cameras(len(layer))
    return [_lines(scene, '/keyframes', frusta(
        [layer.camera_of(row) for row in shown], layer.map_from_camera[shown], 1.5 * _FRUSTUM_M),
        _KEYFRAME_RGB)]


def draw_answers(scene: viser.SceneApi, answers: Mapping[int, Trial]) -> list[Any]:
    """Draw the relocalizer's answers: a sphere at the true pose, a line to the pose it found."""
    colors = [_VERDICT_RGB[answer.verdict] for answer in answers.values()]
    found = [(answer, rgb) for answer, rgb in zip(answers.values(), colors, strict=True)
             if answer.estimate is not None]
    return [_dots(scene, '/answers/places', np.reshape(
        [answer.position for answer in answers.values()], (-1, 3)), 0.03, colors or (0, 0, 0)),
            _lines(scene, '/answers/lines',
                   [(answer.position, answer.estimate) for answer, _ in found],
                   np.repeat([rgb for _, rgb in found] or np.empty((0, 3)), 2, axis=0).reshape(
                       -1, 2, 3).astype(np.uint8), 2.0)]


# ---- the running relocalizer --------------------------------------------------------------------

def draw_robot(scene: viser.SceneApi, state: 'LiveState') -> list[Any]:
    """Draw the last pose and its covariance, in grey if it is not the last answer."""
    pose = state.pose
    if pose is None:
        return []
    rgb, at = _CURRENT_RGB if state.is_current else _OLD_RGB, pose.map_from_body[:3, 3]
    # eigenvectors of a symmetric matrix; a rotation has the determinant +1
    variances, basis = np.linalg.eigh((pose.covariance + pose.covariance.T) / 2.0)
    basis[:, 0] *= np.linalg.det(basis)
    semi_axes = np.clip(_RADIUS_95 * np.sqrt(np.maximum(variances, 0.0)), _LEAST_M, _GREATEST_M)
    body: Any = scene.add_frame(
        '/live/body', axes_length=_ROBOT_M, axes_radius=0.05 * _ROBOT_M, origin_color=rgb,
        origin_radius=0.1 * _ROBOT_M) if state.base_frame else scene.add_camera_frustum(
            '/live/body', _FOV_RAD, _ASPECT, scale=_ROBOT_M, color=rgb, variant='filled',
            **_NO_SHADOW)
    body.wxyz, body.position = wxyz_of(pose.map_from_body), at
    return [body,
            scene.add_label('/live/label', 'robot' if state.is_current else 'robot, earlier',
                            position=at, anchor='top-center'),
            scene.add_icosphere(
                '/live/ellipsoid', 1.0, rgb, scale=tuple(semi_axes.tolist()), opacity=0.35,
                wxyz=np.roll(Rotation.from_matrix(basis).as_quat(), 1), position=at,
                **_NO_SHADOW)]
