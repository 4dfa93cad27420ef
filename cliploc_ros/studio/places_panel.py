# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Layers of the page: where a robot would be accepted or misled, and places that look alike."""

import html
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import frusta
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.evaluation.map_check.page import LOOK_ALIKE, MISLED
from cliploc_ros.mapping.checking.look_alikes import RADIUS_M, LookAlike
from cliploc_ros.mapping.checking.report import GridCheck
from cliploc_ros.studio.places import Places, PlacesSearch
from cliploc_ros.studio.scene import some_cameras

if TYPE_CHECKING:
    from cliploc_ros.studio.page import Page

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
_LEGEND = tuple(f'<span style="color:{color}">■</span> {text}' for color, text in (
    ('#003E6B', 'all headings with three landmarks are accepted'), ('#A0D2F0', 'few of them'),
    ('#E69F00', 'none'), ('#787878', 'no heading shows three landmarks'),
    (MISLED, 'a heading is misled; the line leads to the wrong pose'),
    (LOOK_ALIKE, 'places that look alike')))
_RGB = (0, 150, 136)
_FRUSTUM_M, _POINT_M = 0.12, 0.015
# More points slow the browser down.
_MOST_POINTS = 30_000


class PlacesPanel:
    """The search of places, and its layers in the scene."""

    def __init__(self, page: 'Page'):
        self._page = page
        self.search = PlacesSearch(page.studio, page.redraw_soon)
        self._shown: Places | None = None
        self._coverage: list[Any] = []
        self._links: list[Any] = []
        gui = page.server.gui
        self._start = gui.add_button(
            'Find coverage and look-alikes', hint='relocalizes in simulated views all over the '
            'map, up to a minute')
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._stop = gui.add_button('Stop', visible=False, color='red')
        self._text = gui.add_html('')
        self._shows_coverage = gui.add_checkbox('Show coverage', True)
        self._shows_links = gui.add_checkbox('Show look-alikes', True)
        self._start.on_click(lambda event: page.ask(event, self.search.start))
        self._stop.on_click(lambda event: page.ask(event, self.search.stop))
        for box in (self._shows_coverage, self._shows_links):
            box.on_update(lambda event: self._set_visible())

    def show(self) -> None:
        """Show progress, figures and layers."""
        is_running = self.search.is_running
        for handle, name, value in (
                (self._start, 'disabled', is_running), (self._stop, 'visible', is_running),
                (self._bar, 'visible', is_running),
                (self._bar, 'value', round(100.0 * self.search.share)),
                (self._text, 'content', self._content())):
            if getattr(handle, name) != value:
                setattr(handle, name, value)
        places = self.search.last
        if places is not None and places is not self._shown:
            self._shown = places
            for handle in self._coverage + self._links:
                handle.remove()
            self._coverage = self._draw_coverage(places)
            self._links = self._draw_links(places)
            self._set_visible()

    def _content(self) -> str:
        places, lines = self.search.last, []
        if self.search.failure:
            lines.append(f'<b>{html.escape(self.search.failure)}</b>')
        if places is not None:
            if self.search.is_stale():
                lines.append('<b>of the map before the last edits: find again</b>')
            lines += map(html.escape, places.lines(self.search.before))
            lines += _LEGEND
        return ('<div style="padding:0.3em 1em;font-size:0.85em;overflow-wrap:anywhere">'
                f'{"<br>".join(lines)}</div>' if lines else '')

    def _set_visible(self) -> None:
        for handles, box in ((self._coverage, self._shows_coverage),
                             (self._links, self._shows_links)):
            for handle in handles:
                handle.visible = box.value

    def _draw_coverage(self, places: Places) -> list[Any]:
        scene, check = self._page.server.scene, places.check
        if not len(check.positions):
            return []
        positions = np.column_stack([check.positions[:, :2],
                                     np.full(len(check.positions), _floor(places) + _LIFT_M)])
        tiles = scene.add_batched_meshes_simple(
            '/coverage/tiles', _TILE * check.spacing_m * _GAP, _TILE_FACES,
            np.tile([1.0, 0.0, 0.0, 0.0], (len(positions), 1)), positions,
            # the page takes colours of instances for linear light
            batched_colors=(255.0 * (tile_colors(check) / 255.0) ** 2.2).astype(np.uint8),
            opacity=0.9, material='toon5', side='double', lod='off',
            cast_shadow=False, receive_shadow=False)
        tiles.on_click(lambda event: self._page.ask(
            event, lambda: _tile_text(check, event.instance_index)))
        wrong = [one for one in check.trials if one.verdict == 'misled']
        points = np.array([[one.position, one.estimate] for one in wrong]).reshape(-1, 2, 3)
        lines = scene.add_line_segments('/coverage/misled', points, _rgb(MISLED), thickness=3.0,
                                        thickness_units='screen')
        return [tiles, lines]

    def _draw_links(self, places: Places) -> list[Any]:
        segments = [self._segments(one, places) for one in places.look_alikes[:_MAX_LOOK_ALIKES]]
        if not segments:
            return []
        scene = self._page.server.scene
        return [scene.add_line_segments('/look_alikes', np.concatenate(segments),
                                        _rgb(LOOK_ALIKE), thickness=2.5,
                                        thickness_units='screen')]

    def _segments(self, one: LookAlike, places: Places) -> NDArray[np.float64]:
        """Return a circle around each place, and a line between landmarks that look alike."""
        angles = np.linspace(0.0, 2.0 * np.pi, _CIRCLE_POINTS + 1)
        ring = RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
        rings = [np.array([*middle[:2], _floor(places) + 2 * _LIFT_M]) + ring
                 for middle in (one.first, one.second)]
        links = [[places.landmarks[first].center, places.landmarks[second].center]
                 for first, second in one.matched]
        return np.concatenate([*(np.stack([circle[:-1], circle[1:]], axis=1)
                                 for circle in rings), np.array(links)])


def tile_colors(check: GridCheck) -> NDArray[np.uint8]:
    """Return the colour (P, 3) of each position: how many of its useful headings are accepted."""
    useful = check.useful
    share = np.clip(check.accepted / np.maximum(useful, 1), 0.0, 1.0)
    colors = np.column_stack([np.interp(share, [0.0, 1.0], channel) for channel in _HEAT.T])
    colors[check.accepted == 0] = _NONE_RGB
    colors[(useful == 0) & (check.accepted == 0)] = _UNSEEN_RGB
    colors[check.misled > 0] = _rgb(MISLED)
    return np.asarray(colors.round(), dtype=np.uint8)


def _tile_text(check: GridCheck, row: int | None) -> str | None:
    if row is None or row >= len(check.positions):
        return None
    x, y, z = check.positions[row]
    return (f'camera at x {x:.1f}, y {y:.1f}, z {z:.1f}: of {check.headings} headings, '
            f'{check.useful[row]} show 3 landmarks, {check.accepted[row]} are accepted, '
            f'{check.misled[row]} misled')


def _floor(places: Places) -> float:
    """Return the height of the floor: 0 where the landmarks begin a storey above it or less."""
    low = np.quantile([one.center[2] - one.semi_axes.max() for one in places.landmarks.values()],
                      0.03)
    return 0.0 if -_LIFT_M <= low < _STOREY_M else float(low)


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


class KeyframesPanel:
    """A switch for the layer, which is drawn when it is first shown.

    Parameters
    ----------
    server : viser.ViserServer
    layer : KeyframeLayer
    """

    def __init__(self, server: viser.ViserServer, layer: KeyframeLayer):
        self._scene, self._layer = server.scene, layer
        self._handles: list[Any] = []
        images = 'no images' if layer.images is None else 'small images'
        self._box = server.gui.add_checkbox(
            'Show keyframes', False,
            hint=f'{len(layer)} keyframes with {layer.offsets[-1]} points, {images}')
        self._box.on_update(lambda event: self._show())

    def _show(self) -> None:
        if self._box.value and not self._handles:
            self._handles = self._draw()
        for handle in self._handles:
            handle.visible = self._box.value

    def _draw(self) -> list[Any]:
        layer = self._layer
        shown = some_cameras(len(layer))
        lines = self._scene.add_line_segments(
            '/keyframes/cameras', frusta(layer.camera, layer.map_from_camera[shown], _FRUSTUM_M),
            _RGB, thickness=2.0, thickness_units='screen')
        points = some_points(layer)
        cloud = self._scene.add_point_cloud('/keyframes/points', points.astype(np.float32), _RGB,
                                            point_size=_POINT_M, point_shape='circle')
        return [lines, cloud]


def some_points(layer: KeyframeLayer) -> NDArray[np.float64]:
    """Return the points (n, 3) of all keyframes in the map, or every n-th of many [m]."""
    step = max(1, -(-int(layer.offsets[-1]) // _MOST_POINTS))
    return np.concatenate([layer.points_in_map(row)[::step] for row in range(len(layer))])
