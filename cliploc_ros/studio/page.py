# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page: what a person sees and does goes to the studio; what the studio holds is shown.

viser calls back from many threads. Each callback holds the document's lock for its action. One
thread redraws, at most 20 times a second, and reads the studio under the same lock. So all
browsers show the same state, and a slow one delays no edit.
"""

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import CliplocError, MapError
from cliploc_ros.files.storage import replace_file
from cliploc_ros.studio import edits
from cliploc_ros.studio.keyframes_panel import KeyframesPanel
from cliploc_ros.studio.live_panel import LivePanel
from cliploc_ros.studio.panels import LandmarkPanel, MapPanel, TablePanel, ViewPanel
from cliploc_ros.studio.picture import SELECTED_RGB
from cliploc_ros.studio.places_panel import PlacesPanel
from cliploc_ros.studio.scene import (
    Answers,
    Ellipsoids,
    Labels,
    ViewImage,
    draw_recording,
    selection_parts,
    wxyz_of,
)
from cliploc_ros.studio.studio import Studio

if TYPE_CHECKING:
    from cliploc_ros.studio.live import LiveRelocalizer

_REDRAW_INTERVAL_S = 0.05
_GRID_M = 20.0
_GIZMO = 0.4


class Page:
    """The studio in the browser.

    Parameters
    ----------
    studio : Studio
    server : viser.ViserServer
    live : LiveRelocalizer, optional
    """

    def __init__(self, studio: Studio, server: viser.ViserServer,
                 live: 'LiveRelocalizer | None' = None):
        self.studio, self.server = studio, server
        self.is_drawing = False
        self._changed, self._stopped = threading.Event(), threading.Event()
        self._drag = 0
        self._shown_picture: object = None
        self._build(live)
        studio.document.subscribe(self._changed.set)
        if studio.finder is not None:
            studio.finder.subscribe(self._changed.set)
        self._redrawer = threading.Thread(target=self._redraw_always, daemon=True)
        self._redrawer.start()
        self._changed.set()

    def redraw_soon(self) -> None:
        """Show what has changed; any thread may call this."""
        self._changed.set()

    def stop(self) -> None:
        """Stop what runs, and redrawing."""
        self._places.search.stop()
        self._stopped.set()
        self._changed.set()
        self._redrawer.join()

    # ---- building -------------------------------------------------------------------------------

    def _build(self, live: 'LiveRelocalizer | None') -> None:
        server, recording = self.server, self.studio.recording
        server.gui.configure_theme(show_logo=False, show_share_button=False,
                                   control_width='large')
        server.gui.main_panel.dock_right()
        server.scene.add_grid('/floor', width=_GRID_M, height=_GRID_M, cell_size=0.5)
        self._rest = Ellipsoids(server.scene, '/landmarks', self._clicked_landmark)
        self._selected = Ellipsoids(server.scene, '/selection', self._clicked_landmark, 0.7)
        self._labels = Labels(server.scene)
        self._gizmo = server.scene.add_transform_controls('/gizmo', scale=_GIZMO, visible=False)
        self._gizmo.on_update(self._dragged_gizmo)
        self._map_panel = MapPanel(self)
        self._landmark_panel = LandmarkPanel(self)
        self._table_panel = TablePanel(self)
        tools = server.gui.add_panel()
        self._image: ViewImage | None = None
        self._view_panel: ViewPanel | None = None
        if recording is not None:
            draw_recording(server.scene, recording.detections, self._clicked_camera)
            self._answers = Answers(server.scene, recording.detections)
            self._image = ViewImage(server.scene, recording.detections.camera)
            self._image.handle.on_click(self._clicked_image)
            self._image.handle.on_drag('left')(self._dragged_image)
            self._view_panel = ViewPanel(self, tools)
        with tools.add_tab('Places'):
            self._places = PlacesPanel(self)
            if self.studio.layer is not None:
                KeyframesPanel(server, self.studio.layer)
        self._tools: list[PlacesPanel | LivePanel] = [self._places]
        if live is not None:
            with tools.add_tab('Robot'):
                self._tools.append(LivePanel(self, live))
        tools.dock_left()
        self._place_camera()

    def _place_camera(self) -> None:
        centers = np.array([one.center for one in self.studio.document.landmarks.values()])
        middle = np.median(centers, axis=0) if len(centers) else np.zeros(3)
        spread = float(np.abs(centers - middle).max()) if len(centers) else 2.0
        camera = self.server.initial_camera
        camera.look_at = tuple(middle)
        camera.position = tuple(middle + np.array([-0.6, -0.6, 0.6]) * max(1.0, spread))

    # ---- actions --------------------------------------------------------------------------------

    def act(self, event: Any, action: Callable[[], str | None]) -> None:
        """Do something with the studio locked, and tell the person who did it the outcome."""
        def locked() -> str | None:
            with self.studio.document.lock:
                return action()

        self.ask(event, locked)

    def ask(self, event: Any, action: Callable[[], str | None]) -> None:
        """Do something that takes long and only reads the document; tell the outcome."""
        client = getattr(event, 'client', None)
        try:
            message = action()
        except CliplocError as error:
            self._notify(client, 'Not done', str(error), 'red')
            return
        except Exception as error:
            self._notify(client, 'Internal error', f'{error}; the terminal has more', 'red')
            raise
        finally:
            self._changed.set()
        if message:
            self._notify(client, 'Done', message, None)

    def _notify(self, client: viser.ClientHandle | None, title: str, text: str,
                color: Any) -> None:
        for one in [client] if client is not None else self.server.get_clients().values():
            one.add_notification(title, text, auto_close_seconds=8, color=color)

    def export(self) -> str:
        """Write the scene as one page that opens without a server.

        Raises
        ------
        MapError
            The page cannot be written.
        """
        path = self.studio.document.path.with_suffix('.html')
        try:
            with replace_file(path) as partial:
                partial.write_text(self.server.scene.as_html(), encoding='utf-8')
        except OSError as error:
            raise MapError(f'{path}: cannot be written: {error.strerror}') from error
        return f'wrote {path.name}; open it in a browser'

    def look_at_selection(self, event: Any) -> None:
        """Let the camera of whoever selected orbit the selection."""
        with self.studio.document.lock:
            selected = self.studio.document.selected
        if event.client is not None and selected is not None:
            event.client.camera.look_at = selected[1].center

    def look_through(self, event: Any) -> None:
        """Put the camera of whoever asks where the selected view was taken."""
        if event.client is None or self.studio.recording is None:
            return
        with self.studio.document.lock:
            pose = self.studio.map_from_camera
        intrinsics = self.studio.recording.detections.camera
        camera = event.client.camera
        with event.client.atomic():
            camera.position = pose[:3, 3]
            camera.look_at = pose[:3, 3] + pose[:3, 2]
            camera.up_direction = -pose[:3, 1]
            camera.wxyz = wxyz_of(pose)
            # the whole image, also where the panels leave a narrow gap
            half = max(intrinsics.height / intrinsics.fy,
                       intrinsics.width / intrinsics.fx / max(camera.aspect, 0.1)) / 2.0
            camera.fov = 2.0 * float(np.arctan(1.1 * half))

    def _clicked_landmark(self, event: Any, landmark_id: str) -> None:
        self.select(event, landmark_id,
                    event.modifier == 'shift' or self._table_panel.selects_several)

    def select(self, event: Any, landmark_id: str, joins: bool) -> None:
        """Select a landmark, alone or together with those that are selected."""
        if joins:
            self.act(event, lambda: self.studio.toggle(landmark_id))
        else:
            self.act(event, lambda: self.studio.document.select([landmark_id]))
        self.look_at_selection(event)

    def _clicked_camera(self, event: Any, view: int) -> None:
        self.act(event, lambda: self.studio.show_view(view))

    def _clicked_image(self, event: Any) -> None:
        assert self._image is not None
        origin = np.array(event.ray_origin)
        pixel = self._image.pixel(origin, origin + np.array(event.ray_direction))
        studio = self.studio
        self.act(event, lambda: studio.take_box(pixel) if self.is_drawing
                 else studio.select_at(pixel))

    def _dragged_image(self, event: Any) -> None:
        if not self.is_drawing or event.phase == 'start':
            return
        assert self._image is not None
        eye = event.client.camera.position
        corner = self._image.pixel(eye, event.start_position)
        other = self._image.pixel(eye, event.end_position)
        if event.phase == 'end':
            self.act(event, lambda: self.studio.draw_box(corner, other))
        elif np.abs(other - corner).min() >= 4.0:
            self.act(None, lambda: self._draw_silently(corner, other))

    def _draw_silently(self, corner: Any, other: Any) -> None:
        self.studio.draw_box(corner, other)

    def _dragged_gizmo(self, event: Any) -> None:
        # Callbacks may overtake one another: each takes the gizmo's present pose, not its own.
        if event.client is None:
            return
        if event.phase == 'start':
            self._drag += 1
        self.act(event, self._take_gizmo)

    def _take_gizmo(self) -> None:
        document = self.studio.document
        if document.selected is not None:
            landmark_id, _ = document.selected
            document.apply(edits.place(document.landmarks, landmark_id, self._gizmo.position,
                                       np.roll(self._gizmo.wxyz, -1)),
                           gesture=('gizmo', self._drag, landmark_id))

    # ---- redrawing ------------------------------------------------------------------------------

    def _redraw_always(self) -> None:
        while not self._stopped.is_set():
            self._changed.wait()
            self._changed.clear()
            with self.studio.document.lock, self.server.atomic():
                self._redraw()
            self._stopped.wait(_REDRAW_INTERVAL_S)

    def _redraw(self) -> None:
        rest, selected = selection_parts(self.studio)
        self._rest.show(rest, None)
        self._selected.show(selected, SELECTED_RGB)
        self._labels.show(self.studio)
        self._show_gizmo()
        self._map_panel.show()
        self._landmark_panel.show()
        self._table_panel.show()
        for tool in self._tools:
            tool.show()
        if self._view_panel is not None and self._image is not None:
            self._answers.show(self.studio.answers)
            key = (self.studio.document.revision, self.studio.view,
                   self.studio.drawn.get(self.studio.view))
            if key != self._shown_picture:
                self._shown_picture = key
                try:
                    picture = self.studio.picture()
                except CliplocError as error:
                    self._notify(None, 'No image', str(error), 'red')
                    return
                self._image.show(picture, self.studio.map_from_camera)
                self._view_panel.show(picture)

    def _show_gizmo(self) -> None:
        selected = self.studio.document.selected
        is_shown = selected is not None and not selected[1].is_locked
        if self._gizmo.visible != is_shown:
            self._gizmo.visible = is_shown
        if selected is None:
            return
        _, one = selected
        if np.abs(self._gizmo.position - one.center).max() > 1e-5:
            self._gizmo.position = one.center
        turned = Rotation.from_quat(np.roll(self._gizmo.wxyz, -1)).inv() * Rotation.from_quat(
            one.quat_xyzw)
        if turned.magnitude() > 1e-4:
            self._gizmo.wxyz = np.roll(one.quat_xyzw, 1)
