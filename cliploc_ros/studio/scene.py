# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The three-dimensional view: ellipsoids, labels, cameras, the selected image and the gizmo."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import trimesh.creation
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera, frusta
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.studio.edits import Landmarks
from cliploc_ros.studio.landmark import Landmark
from cliploc_ros.studio.recording import Answer
from cliploc_ros.studio.studio import color_of

# More labels than these hide the map, and slow the browser down.
_MAX_LABELS = 150
_MAX_LABEL_LENGTH = 60
_LABEL_M = 0.035
_MAX_CAMERAS = 1000
_FRUSTUM_M = 0.08
_VERDICT_RGB = {'accepted': (30, 170, 60), 'refused': (150, 150, 150), 'wrong': (220, 0, 0)}
# The image of the selected view lies this far in front of its camera [m].
_IMAGE_DEPTH_M = 0.3
_SPHERE = trimesh.creation.icosphere(subdivisions=2)


class Ellipsoids:
    """Landmarks as one node of many equal spheres, each with its own scale.

    A click calls a function with the event and the landmark's id.
    """

    def __init__(self, scene: viser.SceneApi, name: str, on_click: Callable[[Any, str], None],
                 opacity: float | None = None, scale: float = 1.0):
        self._scene, self._name, self._on_click = scene, name, on_click
        self._opacity, self._scale = opacity, scale
        self._shown: tuple[tuple[str, Landmark], ...] = ()
        self._handle: Any = None

    def show(self, landmarks: Sequence[tuple[str, Landmark]], rgb: tuple[int, int, int] | None
             ) -> None:
        """Show these landmarks, in the colours of their classes unless one is given."""
        landmarks = tuple(landmarks)
        if landmarks == self._shown:
            return
        count_changed = len(landmarks) != len(self._shown)
        self._shown = landmarks
        if not landmarks:
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
            return
        arrays: dict[str, Any] = {
            'batched_wxyzs': np.array([np.roll(one.quat_xyzw, 1) for _, one in landmarks],
                                      dtype=np.float32),
            'batched_positions': np.array([one.center for _, one in landmarks], dtype=np.float32),
            'batched_scales': np.array([self._scale * one.semi_axes for _, one in landmarks],
                                       dtype=np.float32),
            'batched_colors': np.array([rgb or color_of(one.class_id) for _, one in landmarks],
                                       dtype=np.uint8)}
        if count_changed or self._handle is None:
            self._handle = self._scene.add_batched_meshes_simple(
                self._name, _SPHERE.vertices, _SPHERE.faces, cast_shadow=False,
                receive_shadow=False, opacity=self._opacity, **arrays)
            for modifier in (None, 'shift'):
                self._handle.on_click(modifier=modifier)(self._clicked)
        else:
            for key, value in arrays.items():
                setattr(self._handle, key, value)

    def _clicked(self, event: Any) -> None:
        shown = self._shown
        if event.instance_index is not None and event.instance_index < len(shown):
            self._on_click(event, shown[event.instance_index][0])


class Labels:
    """The landmarks' labels in the scene."""

    def __init__(self, scene: viser.SceneApi):
        self._scene = scene
        self._handles: dict[str, tuple[Landmark, Any]] = {}
        self._count = 0

    def show(self, landmarks: Landmarks, selection: Sequence[str]) -> None:
        """Show the labels of all landmarks, or of the selection if there are too many."""
        keys = list(landmarks) if len(landmarks) <= _MAX_LABELS else selection
        for key in self._handles.keys() - set(keys):
            self._handles.pop(key)[1].remove()
        for key in keys:
            one = landmarks[key]
            old, handle = self._handles.get(key, (None, None))
            if old is one:
                continue
            text = one.label[:_MAX_LABEL_LENGTH]
            position = one.center + np.array([0.0, 0.0, one.semi_axes.max()])
            if handle is None:
                # ids may hold any characters, names of nodes not
                handle = self._scene.add_label(
                    f'/labels/{self._count}', text, position=position, anchor='bottom-center',
                    font_size_mode='scene', font_scene_height=_LABEL_M)
                self._count += 1
            handle.text, handle.position = text, position
            self._handles[key] = (one, handle)


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
        self._shown: tuple[Answer, ...] = ()

    def show(self, answers: tuple[Answer, ...]) -> None:
        """Show these answers instead of the last ones."""
        if answers is self._shown:
            return
        self._shown = answers
        asked = np.array([self._poses[one.view, :3, 3] for one in answers])
        colors = np.array([_VERDICT_RGB[one.verdict] for one in answers], dtype=np.uint8)
        self._scene.add_batched_meshes_simple(
            '/answers', _SPHERE.vertices * 0.03, _SPHERE.faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (len(answers), 1)), asked, batched_colors=colors,
            cast_shadow=False, receive_shadow=False)
        pairs = [(asked[row], one.result.map_from_camera[:3, 3], colors[row])
                 for row, one in enumerate(answers) if one.result.map_from_camera is not None]
        points = np.array([pair[:2] for pair in pairs]).reshape(-1, 2, 3)
        line_colors = np.array([[pair[2]] * 2 for pair in pairs], dtype=np.uint8)
        self._scene.add_line_segments('/answers/lines', points, line_colors.reshape(-1, 2, 3),
                                      thickness=2.0, thickness_units='screen')


def wxyz_of(map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose's rotation as viser wants it: w first."""
    return np.asarray(np.roll(Rotation.from_matrix(map_from_camera[:3, :3]).as_quat(), 1))


def some_cameras(count: int) -> NDArray[np.int64]:
    """Return the rows of the cameras to draw: all, or every n-th of many."""
    return np.arange(0, count, max(1, -(-count // _MAX_CAMERAS)))


def draw_recording(scene: viser.SceneApi, detections: PosedDetections,
                   on_click: Callable[[Any, int], None]) -> None:
    """Draw the trajectory and the cameras, all of them or every n-th; a click chooses a view."""
    poses, order = detections.map_from_camera, detections.by_camera
    is_way = np.diff(detections.frame_cameras[order]) == 0
    if is_way.any():
        path = np.stack([poses[order[:-1][is_way], :3, 3], poses[order[1:][is_way], :3, 3]],
                        axis=1)
        scene.add_line_segments('/trajectory', path, (90, 90, 90), thickness=1.5,
                                thickness_units='screen')
    shown = order[some_cameras(len(poses))]
    scene.add_line_segments('/cameras', frusta([detections.camera_of(row) for row in shown],
                                               poses[shown], _FRUSTUM_M),
                            (120, 120, 200), thickness=1.0, thickness_units='screen')
    handle = scene.add_batched_meshes_simple(
        '/camera_centers', _SPHERE.vertices * 0.012, _SPHERE.faces,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(shown), 1)), poses[shown, :3, 3],
        batched_colors=(120, 120, 200), cast_shadow=False, receive_shadow=False)

    @handle.on_click
    def _(event: Any) -> None:
        if event.instance_index is not None:
            on_click(event, int(shown[event.instance_index]))
