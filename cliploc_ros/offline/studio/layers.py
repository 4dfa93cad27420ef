# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layers of the scene around the landmarks, each drawn again when its content changes.

Cameras, keyframes, the relocalizer's answers, and the running relocalizer. No ROS here: its state
comes as a value that ``live`` makes.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh.creation
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.geometry.camera import frusta
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.offline.mapping.check.relocalization import Trial
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio.viewpoint import wxyz_of

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LiveState

SPHERE = trimesh.creation.icosphere(subdivisions=2)
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
_RADIUS_95 = float(np.sqrt(chi2.ppf(0.95, 3)))
_LEAST_M, _GREATEST_M = 1e-3, 100.0

#: Draws something into a scene, and returns the handles of the nodes.
Draw = Callable[[viser.SceneApi, Any], list[Any]]


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


def linear(rgb: Any) -> NDArray[np.uint8]:
    """Convert sRGB colours (n, 3) to linear colours, as viser expects for instances."""
    return np.asarray(255.0 * (np.asarray(rgb) / 255.0) ** 2.2, dtype=np.uint8)


def _lines(scene: viser.SceneApi, name: str, points: Any, rgb: Any, thickness: float = 1.5) -> Any:
    """Draw lines (n, 2, 3) in one colour, or with a colour for each end (n, 2, 3)."""
    return scene.add_line_segments(name, np.reshape(points, (-1, 2, 3)), rgb, thickness=thickness,
                                   thickness_units='screen')


def _dots(scene: viser.SceneApi, name: str, points: NDArray[np.float64], radius_m: float, rgb: Any
          ) -> Any:
    """Draw spheres at points (n, 3) in one colour, or with a colour for each point (n, 3)."""
    return scene.add_batched_meshes_simple(
        name, SPHERE.vertices * radius_m, SPHERE.faces,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)), points, batched_colors=linear(rgb),
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
