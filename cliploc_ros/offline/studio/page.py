# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page: the scene in three dimensions, and the one loop that redraws it and the desk.

viser shows the scene, in a frame of our own page: its widgets have no image to zoom and draw on,
no rows with buttons, and no place for them but one column. The pages send messages, viser calls
back from many threads. Each holds the document's lock for its action. One thread redraws, at most
20 times a second, and reads the studio under the same lock. So all browsers show the same state,
and a slow one delays no edit.
"""

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.studio import edits, viewpoint
from cliploc_ros.offline.studio.context import draw_lines
from cliploc_ros.offline.studio.desk import Desk
from cliploc_ros.offline.studio.panels import Actions
from cliploc_ros.offline.studio.scene import Answers, Ellipsoids, Labels, ViewImage, draw_recording
from cliploc_ros.offline.studio.scene_panel import ScenePanel
from cliploc_ros.offline.studio.studio import SELECTED_RGB, Studio
from cliploc_ros.offline.studio.web import Board, Content, Gate

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LiveRelocalizer

_REDRAW_INTERVAL_S = 0.05
_BLANK = 70
_GIZMO_PX = 90.0
# The selection is drawn around its landmarks, so much larger.
_AROUND = 1.03


class Page:
    """The studio in the browser."""

    def __init__(self, studio: Studio, server: viser.ViserServer,
                 live: 'LiveRelocalizer | None' = None):
        self._studio, self._server = studio, server
        self._actions = Actions(studio, server)
        self._stopped = threading.Event()
        self._drag = 0
        self._shown_view = -1
        self._recorded: list[Any] = []
        self._build_scene()
        for note in studio.document.notes:
            self._actions.log('done', note)
        self.board = Board()
        self.desk = Desk(self._actions, self._client_of, live)
        self._redrawer = threading.Thread(target=self._redraw_always, daemon=True)
        self._redrawer.start()
        self._actions.changed.set()

    def stop(self) -> None:
        """Stop the searches, the film, and redrawing."""
        self.desk.stop()
        self._scene_panel.stop()
        self._stopped.set()
        self._actions.changed.set()
        self._redrawer.join()

    def _client_of(self, person: str) -> viser.ClientHandle | None:
        """Return the scene's client of a person, whom the path of its connection names."""
        connections = self._server._websock_server._live_connections
        for number, client in self._server.get_clients().items():
            one = connections.get(number)
            if one is not None and one.request is not None and one.request.path.strip(
                    '/') == f'scene/{person}':
                return client
        return None

    # ---- building -------------------------------------------------------------------------------

    def _build_scene(self) -> None:
        scene, recording = self._server.scene, self._studio.recording
        extent = self._studio.extent()
        scene.set_up_direction(extent.up)
        draw_lines(scene, extent)
        self._all = Ellipsoids(scene, '/landmarks', self._clicked_landmark, 0.2,
                               has_outlines=True)
        self._selected = Ellipsoids(scene, '/selection', self._clicked_landmark, 0.6, _AROUND)
        self._labels = Labels(self._server, extent.up)
        # of the same size at any distance, and visible inside large landmarks
        self._gizmo = scene.add_transform_controls('/gizmo', scale=_GIZMO_PX, fixed=True,
                                                   depth_test=False, visible=False)
        self._gizmo.on_update(self._dragged_gizmo)
        if recording is not None:
            self._recorded = draw_recording(
                scene, recording.detections,
                lambda event, view: self._actions.act(lambda: self._studio.show_view(view)))
            self._answers = Answers(scene, recording.detections)
            self._image = ViewImage(scene)
        camera = self._server.initial_camera
        camera.fov, camera.up = viewpoint.FOV_RAD, tuple(extent.up)
        camera.look_at = tuple(extent.middle)
        camera.position = tuple(viewpoint.overview(extent, viewpoint.USUAL_ASPECT))
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.gui.set_panel_label('Layers and viewpoints')
        self._server.gui.main_panel.minimize()
        self._scene_panel = ScenePanel(self._actions, self._labels, self._recorded)

    # ---- what a person does in the scene --------------------------------------------------------

    def _clicked_landmark(self, event: Any, landmark_id: str) -> None:
        if self._scene_panel.is_double(event, landmark_id):
            self._actions.look_at_selection(event.client)
        elif event.modifier == 'shift':
            self._actions.act(lambda: self._studio.toggle(landmark_id))
        else:
            self._actions.act(lambda: self._studio.document.select([landmark_id]))

    def _dragged_gizmo(self, event: Any) -> None:
        # Callbacks may overtake one another: each takes the gizmo's present pose, not its own.
        if event.client is None:
            return
        if event.phase == 'start':
            self._drag += 1

        def take_pose() -> None:
            document = self._studio.document
            if document.selected is not None:
                landmark_id, _ = document.selected
                document.edit(edits.set_fields, [landmark_id], center=self._gizmo.position,
                              orientation=np.roll(self._gizmo.wxyz, -1),
                              gesture=('gizmo', self._drag, landmark_id))

        self._actions.act(take_pose)

    # ---- redrawing ------------------------------------------------------------------------------

    def _redraw_always(self) -> None:
        while not self._stopped.is_set():
            self._actions.changed.wait()
            self._actions.changed.clear()
            with self._studio.document.lock, self._server.atomic():
                self._redraw()
            self._stopped.wait(_REDRAW_INTERVAL_S)

    def _redraw(self) -> None:
        document = self._studio.document
        shown = self._studio.shown()
        chosen = [key for key in document.selection if key in shown]
        # all of them: a second click comes with the number that the first one's picture has
        self._all.show(list(shown.items()), self._studio.color_of)
        self._selected.show([(key, shown[key]) for key in chosen], lambda class_id: SELECTED_RGB)
        self._labels.show(shown, chosen)
        self._show_gizmo()
        self._scene_panel.show()
        self.desk.places.show()
        if self.desk.robot is not None:
            self.desk.robot.show()
        self.board.show(self.desk.parts())
        if self._studio.recording is not None:
            self._answers.show(self._studio.answers)
            self._show_view()

    def _show_gizmo(self) -> None:
        selected = self._studio.document.selected
        is_shown = selected is not None and not selected[1].marks.is_locked
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

    def _show_view(self) -> None:
        studio = self._studio
        if studio.view == self._shown_view:
            return
        self._shown_view = studio.view
        image: NDArray[np.uint8] | None = None
        try:
            image = studio.image(studio.view)
        except CliplocError as error:
            self._actions.log('refused', str(error))
        camera = studio.camera
        self._image.show(np.full((camera.height, camera.width, 3), _BLANK, dtype=np.uint8)
                         if image is None else image, camera, studio.map_from_camera)


@contextmanager
def serve_studio(studio: Studio, host: str, port: int, live: 'LiveRelocalizer | None' = None
                 ) -> Iterator[tuple[str, viser.ViserServer]]:
    """Serve the page of a studio for as long as the block lasts; yield the URL and the server.

    The port is the next free one from this on; 0: any. Beyond the loopback interface, the URL
    holds a token. ``live`` is the running relocalizer, to show it, too.
    """
    gate, pages = Gate(host), list[Page]()

    def answer(path: str) -> Content | None:
        return pages[0].desk.picture(path) if pages else None

    async def talk(connection: Any, person: str) -> None:
        if not pages:
            return
        desk = pages[0].desk
        try:
            await pages[0].board.serve(connection, lambda message: desk.do(person, message))
        finally:
            desk.show_mode(person, '')

    with gate.guard(answer, talk), redirect_stdout(io.StringIO()):  # viser prints another URL
        server = viser.ViserServer(host, port, verbose=False)
    # viser would open a tunnel to a server on the Internet for any browser that asks
    server.request_share_url = lambda *args, **options: None  # type: ignore[method-assign]
    pages.append(page := Page(studio, server, live))
    try:
        shown_host = f'[{host}]' if ':' in host else host
        yield f'http://{shown_host}:{server.get_port()}{gate.path}', server
    finally:
        page.stop()
        server.stop()
