# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layers of the scene around the landmarks, each drawn again when its content changes.

Surfaces, cameras, keyframes, the relocalizer's answers, coverage and look-alike places, and the
running relocalizer. No ROS here: its state comes as a value that ``live`` makes.
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
from cliploc_ros.offline.mapping.check.places import RADIUS_M
from cliploc_ros.offline.mapping.check.relocalization import Trial
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.page import LOOK_ALIKE, MISLED
from cliploc_ros.offline.studio.places import Coverage
from cliploc_ros.offline.studio.viewpoint import wxyz_of

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LiveState

SPHERE = trimesh.creation.icosphere(subdivisions=2)
_NO_SHADOW: dict[str, Any] = {'cast_shadow': False, 'receive_shadow': False}
_MAX_CAMERAS = 300
_FRUSTUM_M = 0.08
_CAMERA_RGB, _PATH_RGB, _KEYFRAME_RGB = (120, 120, 200), (90, 90, 90), (0, 150, 136)
_VERDICT_RGB = {'accepted': (30, 170, 60), 'refused': (150, 150, 150), 'misled': (220, 0, 0)}
# Colours without an accepted heading and without a useful heading; range from few to all accepted.
_NONE_RGB, _UNSEEN_RGB = (230, 159, 0), (120, 120, 120)
_HEAT = np.array([[160, 210, 240], [0, 62, 107]], dtype=np.float64)
_TILE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
_TILE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
_GAP = 0.92
# Height above the floor grid, which would flicker through.
_LIFT_M = 0.005
# Height of a storey: if the lowest landmarks begin below it, the floor is z = 0 [m].
_STOREY_M = 2.5
_MAX_LOOK_ALIKES = 20
_CIRCLE_POINTS = 48
LEGEND = (
    ('#003E6B', 'all headings with three landmarks are accepted'),
    ('#A0D2F0', 'few of them are accepted'), ('#E69F00', 'none of them is accepted'),
    ('#787878', 'no heading shows three landmarks'),
    ('#009688', 'none is accepted, but a keyframe is within reach'),
    (MISLED, 'a heading is misled; the line leads to the wrong pose'),
    (LOOK_ALIKE, 'places that look alike'))
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


# ---- coverage and look-alike places -------------------------------------------------------------

def draw_coverage(tell: Callable[[str], None]) -> Draw:
    """Return a function that draws a tile at each position. A click shows its numbers."""
    def draw(scene: viser.SceneApi, places: Coverage) -> list[Any]:
        check = places.check
        if not len(check.positions):
            return []
        positions = np.column_stack([check.positions[:, :2],
                                     np.full(len(check.positions), _floor(places) + _LIFT_M)])
        tiles = scene.add_batched_meshes_simple(
            '/coverage/tiles', _TILE * check.spacing_m * _GAP, _TILE_FACES,
            np.tile([1.0, 0.0, 0.0, 0.0], (len(positions), 1)), positions,
            batched_colors=linear(tile_colors(places)),
            opacity=0.9, material='toon5', side='double', lod='off', **_NO_SHADOW)

        @tiles.on_click
        def _(event: Any) -> None:
            row = event.instance_index
            if row is not None and row < len(check.positions):
                x, y, z = check.positions[row]
                tell(f'camera at x {x:.1f}, y {y:.1f}, z {z:.1f}: of {check.headings} headings, '
                     f'{check.useful[row]} show 3 landmarks, {check.accepted[row]} are accepted, '
                     f'{check.misled[row]} misled' + (
                         '' if places.keyframes is None else
                         f', {places.keyframes.headings[row]} within reach of a keyframe'))

        return [tiles, _lines(scene, '/coverage/misled', [
            (trial.position, trial.estimate) for trial in check.trials
            if trial.verdict == 'misled'],
            _rgb(MISLED), 3.0)]

    return draw


def draw_look_alikes(scene: viser.SceneApi, places: Coverage) -> list[Any]:
    """Draw circles around places that look alike, and lines between their landmarks."""
    angles = np.linspace(0.0, 2.0 * np.pi, _CIRCLE_POINTS + 1)
    ring = RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    segments = [np.empty((0, 2, 3))]
    for look_alike in places.look_alikes[:_MAX_LOOK_ALIKES]:
        for middle in (look_alike.first, look_alike.second):
            circle = ring + np.array([*middle[:2], _floor(places) + 2 * _LIFT_M])
            segments.append(np.stack([circle[:-1], circle[1:]], axis=1))
        segments.append(np.array([[places.landmarks[key].center for key in pair]
                                  for pair in look_alike.matched]))
    return [_lines(scene, '/look_alikes', np.concatenate(segments), _rgb(LOOK_ALIKE), 2.5)]


def tile_colors(places: Coverage) -> NDArray[np.uint8]:
    """Return a colour (P, 3) for each position, by the share of useful headings accepted."""
    check, useful = places.check, places.check.useful
    share = np.clip(check.accepted / np.maximum(useful, 1), 0.0, 1.0)
    colors = np.column_stack([np.interp(share, [0.0, 1.0], channel) for channel in _HEAT.T])
    colors[check.accepted == 0] = _NONE_RGB
    colors[(useful == 0) & (check.accepted == 0)] = _UNSEEN_RGB
    if places.keyframes is not None:
        colors[(check.accepted == 0) & (places.keyframes.headings > 0)] = _KEYFRAME_RGB
    colors[check.misled > 0] = _rgb(MISLED)
    return np.asarray(colors.round(), dtype=np.uint8)


def _floor(places: Coverage) -> float:
    """Return the height of the floor: 0 if the lowest landmarks are at most a storey above 0."""
    low = np.quantile([landmark.center[2] - landmark.semi_axes.max()
                       for landmark in places.landmarks.values()], 0.03)
    return 0.0 if -_LIFT_M <= low < _STOREY_M else float(low)


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


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
