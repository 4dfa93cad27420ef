# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layers of the tools: coverage and look-alike places, the running relocalizer.

No ROS here: the relocalizer comes as an object that ``live`` makes.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.files.page import MISLED
from cliploc_ros.offline.evaluation.map_check.page import LOOK_ALIKE
from cliploc_ros.offline.mapping.check.places import RADIUS_M
from cliploc_ros.offline.mapping.check.report import GridCheck
from cliploc_ros.offline.studio.panels import Actions
from cliploc_ros.offline.studio.places import Coverage, PlacesSearch
from cliploc_ros.offline.studio.scene import Ellipsoids, linear
from cliploc_ros.offline.studio.viewpoint import wxyz_of

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LivePose, LiveRelocalizer, LiveState

# No heading is accepted; few are, all are.
_NONE_RGB = (230, 159, 0)
_HEAT = np.array([[160, 210, 240], [0, 62, 107]], dtype=np.float64)
_UNSEEN_RGB = (120, 120, 120)
_TILE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
_TILE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
_GAP = 0.92
# Above the floor grid, which would flicker through.
_LIFT_M = 0.005
# A storey: landmarks that begin below this stand on the floor z = 0 [m].
_STOREY_M = 2.5
_MAX_LOOK_ALIKES = 20
_CIRCLE_POINTS = 48
_LEGEND = (
    ('#003E6B', 'all headings with three landmarks are accepted'), ('#A0D2F0', 'few of them'),
    ('#E69F00', 'none'), ('#787878', 'no heading shows three landmarks'),
    (MISLED, 'a heading is misled; the line leads to the wrong pose'),
    (LOOK_ALIKE, 'places that look alike'))

# Larger than the landmark itself, which shines through.
_MISSING_RGB, _MISSING_SCALE = (220, 0, 0), 1.3
_CURRENT_RGB, _OLD_RGB = (30, 170, 60), (150, 150, 150)
# The relocalizer's camera is not known here; a usual one.
_FOV_RAD, _ASPECT = 0.85, 4.0 / 3.0
_FRUSTUM_M = 0.25
_AXES_M = 0.3
# Semi-axes of a standard deviation of 1 m [m].
_RADIUS_95 = float(np.sqrt(chi2.ppf(0.95, 3)))
# What can be seen and drawn [m].
_LEAST_M, _GREATEST_M = 1e-3, 100.0
_MAX_TEXT = 600


class PlacesPanel:
    """The search of places, its figures for the page, and its layers in the scene."""

    def __init__(self, actions: Actions):
        self._actions = actions
        self.search = PlacesSearch(actions.studio, actions.changed.set)
        self._shown: Coverage | None = None
        self._coverage: list[Any] = []
        self._links: list[Any] = []
        self.shows_coverage = self.shows_links = True
        self._is_wanted = False

    def set_wanted(self, is_wanted: bool) -> None:
        """Show the layers only where a page asks for them."""
        self._is_wanted = is_wanted
        self._set_visible()

    def toggle_coverage(self) -> None:
        """Show or hide the tiles of coverage."""
        self.shows_coverage = not self.shows_coverage
        self._set_visible()

    def toggle_links(self) -> None:
        """Show or hide the places that look alike."""
        self.shows_links = not self.shows_links
        self._set_visible()

    def part(self) -> dict[str, Any]:
        """Return the search as the page shows it."""
        places, search = self.search.last, self.search
        return {'share': round(search.share, 2), 'is_searching': search.is_running,
                'failure': search.failure, 'is_stale': search.is_stale(),
                'lines': [] if places is None else places.lines(search.before),
                'legend': [] if places is None else _LEGEND,
                'coverage': self.shows_coverage, 'links': self.shows_links}

    def show(self) -> None:
        """Draw the layers of a new result."""
        places = self.search.last
        if places is not None and places is not self._shown:
            self._shown = places
            for handle in self._coverage + self._links:
                handle.remove()
            self._coverage = self._draw_coverage(places)
            self._links = self._draw_links(places)
            self._set_visible()

    def _set_visible(self) -> None:
        for handles, is_shown in ((self._coverage, self.shows_coverage),
                                  (self._links, self.shows_links)):
            for handle in handles:
                handle.visible = is_shown and self._is_wanted

    def _draw_coverage(self, places: Coverage) -> list[Any]:
        scene, check = self._actions.server.scene, places.check
        if not len(check.positions):
            return []
        positions = np.column_stack([check.positions[:, :2],
                                     np.full(len(check.positions), _floor(places) + _LIFT_M)])
        tiles = scene.add_batched_meshes_simple(
            '/coverage/tiles', _TILE * check.spacing_m * _GAP, _TILE_FACES,
            np.tile([1.0, 0.0, 0.0, 0.0], (len(positions), 1)), positions,
            batched_colors=linear(tile_colors(check)),
            opacity=0.9, material='toon5', side='double', lod='off',
            cast_shadow=False, receive_shadow=False)

        def figures(row: int | None) -> str | None:
            if row is None or row >= len(check.positions):
                return None
            x, y, z = check.positions[row]
            return (f'camera at x {x:.1f}, y {y:.1f}, z {z:.1f}: of {check.headings} headings, '
                    f'{check.useful[row]} show 3 landmarks, {check.accepted[row]} are accepted, '
                    f'{check.misled[row]} misled')

        tiles.on_click(lambda event: self._actions.ask(lambda: figures(event.instance_index)))
        wrong = [one for one in check.trials if one.verdict == 'misled']
        points = np.array([[one.position, one.estimate] for one in wrong]).reshape(-1, 2, 3)
        lines = scene.add_line_segments('/coverage/misled', points, _rgb(MISLED), thickness=3.0,
                                        thickness_units='screen')
        return [tiles, lines]

    def _draw_links(self, places: Coverage) -> list[Any]:
        """Draw circles around places that look alike, and lines between their landmarks."""
        angles = np.linspace(0.0, 2.0 * np.pi, _CIRCLE_POINTS + 1)
        ring = RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
        segments = []
        for one in places.look_alikes[:_MAX_LOOK_ALIKES]:
            for middle in (one.first, one.second):
                circle = ring + np.array([*middle[:2], _floor(places) + 2 * _LIFT_M])
                segments.append(np.stack([circle[:-1], circle[1:]], axis=1))
            segments.append(np.array([[places.landmarks[key].center for key in pair]
                                      for pair in one.matched]))
        if not segments:
            return []
        return [self._actions.server.scene.add_line_segments(
            '/look_alikes', np.concatenate(segments), _rgb(LOOK_ALIKE), thickness=2.5,
            thickness_units='screen')]


def tile_colors(check: GridCheck) -> NDArray[np.uint8]:
    """Return the colour (P, 3) of each position: how many of its useful headings are accepted."""
    useful = check.useful
    share = np.clip(check.accepted / np.maximum(useful, 1), 0.0, 1.0)
    colors = np.column_stack([np.interp(share, [0.0, 1.0], channel) for channel in _HEAT.T])
    colors[check.accepted == 0] = _NONE_RGB
    colors[(useful == 0) & (check.accepted == 0)] = _UNSEEN_RGB
    colors[check.misled > 0] = _rgb(MISLED)
    return np.asarray(colors.round(), dtype=np.uint8)


def _floor(places: Coverage) -> float:
    """Return the height of the floor: 0 where the landmarks begin a storey above it or less."""
    low = np.quantile([one.center[2] - one.semi_axes.max() for one in places.landmarks.values()],
                      0.03)
    return 0.0 if -_LIFT_M <= low < _STOREY_M else float(low)


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


class LivePanel:
    """The last answer of the running relocalizer, and requests to it."""

    def __init__(self, actions: Actions, live: 'LiveRelocalizer'):
        self._document, self._scene = actions.studio.document, actions.server.scene
        self._live = live
        self._shown: LiveState | None = None
        self._handles: list[Any] = []
        self._missing = Ellipsoids(
            self._scene, '/live/missing', lambda _, key: self._document.select([key]), 0.5,
            _MISSING_SCALE)
        self.relocalize = live.relocalize
        live.subscribe(actions.changed.set)

    @property
    def position(self) -> NDArray[np.float64] | None:
        """The position (3,) of the last pose in the map."""
        pose = self._live.state.pose
        return None if pose is None else pose.map_from_body[:3, 3]

    def reload_map(self) -> str:
        """Let the relocalizer read its map again."""
        message = self._live.reload_map()
        return message if self._document.is_saved else (
            f'{message}; without the edits not saved here')

    def part(self) -> dict[str, Any]:
        """Return the relocalizer's state as the page shows it."""
        state = self._live.state
        return {'lines': [line[:_MAX_TEXT] for line in self._lines(state)],
                'is_busy': state.is_busy}

    def show(self) -> None:
        """Draw the relocalizer's state."""
        state = self._live.state
        if state is self._shown:
            return
        self._shown = state
        for handle in self._handles:
            handle.remove()
        self._handles = []
        landmarks = self._document.landmarks
        self._missing.show([(key, landmarks[key]) for key in state.missing if key in landmarks],
                           lambda class_id: _MISSING_RGB)
        if state.pose is not None and state.pose.frame_id == self._document.frame_id:
            self._handles = self._draw(state.pose, state)

    def _lines(self, state: 'LiveState') -> list[str]:
        document = self._document
        lines = [f'{self._live.name}: nothing heard']
        if state.is_heard:
            lines = [f'{self._live.name}: {state.lifecycle}',
                     f'its map: {state.map_text or "none loaded"}']
            file = Path(state.map_file)
            if file.is_absolute() and file.resolve() != document.path.resolve():
                lines.append(f'it reads {file}, which is not the map of this studio')
        if state.watch:
            lines.append(f'watch: {state.watch}')
        if state.missing:
            lines.append(f'missing, red in the map: {", ".join(state.missing)}')
        if state.is_busy:
            lines.append('waiting for its answer')
        lines.append(f'last answer: {state.verdict}' if state.verdict else 'no answer yet')
        if state.pose is not None:
            of = state.base_frame or 'the camera'
            lines.append(f'{"" if state.is_current else "earlier "}pose of {of}, stamp '
                         f'{state.pose.stamp_s:.2f} s')
            if state.pose.frame_id != document.frame_id:
                lines.append(f'the pose is in {state.pose.frame_id}, the map in '
                             f'{document.frame_id}: it is not shown')
        return lines

    def _draw(self, pose: 'LivePose', state: 'LiveState') -> list[Any]:
        """Draw the pose, grey where it is not the last answer; return the handles."""
        scene, rgb = self._scene, _CURRENT_RGB if state.is_current else _OLD_RGB
        wxyz, position = wxyz_of(pose.map_from_body), pose.map_from_body[:3, 3]
        handles: list[Any] = [scene.add_label(
            '/live/label', 'robot' if state.is_current else 'robot, earlier', position=position,
            anchor='top-center')]
        if state.base_frame:
            handles.append(scene.add_frame(
                '/live/body', axes_length=_AXES_M, axes_radius=0.05 * _AXES_M, origin_color=rgb,
                origin_radius=0.1 * _AXES_M, wxyz=wxyz, position=position))
        else:
            handles.append(scene.add_camera_frustum(
                '/live/body', _FOV_RAD, _ASPECT, scale=_FRUSTUM_M, color=rgb, wxyz=wxyz,
                position=position, variant='filled', cast_shadow=False, receive_shadow=False))
        # eigenvectors of a symmetric matrix; a rotation has the determinant +1
        variances, basis = np.linalg.eigh((pose.covariance + pose.covariance.T) / 2.0)
        if np.linalg.det(basis) < 0.0:
            basis[:, 0] *= -1.0
        semi_axes = np.clip(_RADIUS_95 * np.sqrt(np.maximum(variances, 0.0)),
                            _LEAST_M, _GREATEST_M)
        handles.append(scene.add_icosphere(
            '/live/ellipsoid', 1.0, rgb, scale=tuple(semi_axes.tolist()), opacity=0.35,
            wxyz=np.roll(Rotation.from_matrix(basis).as_quat(), 1), position=position,
            cast_shadow=False, receive_shadow=False))
        return handles
