# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page: the 3D scene, and the loop that redraws the scene and the other parts.

viser shows the scene in a frame of our page: its widgets have no image for zooming and drawing, no
rows with buttons, and only a single column. Data flows in one direction: pages send messages,
viser calls back from many threads, and the desk runs the actions with the document locked. One
thread redraws at most 20 times a second, and reads the studio under the same lock. Thus all
browsers show the same state, and a slow browser delays no edit.
"""

import io
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.studio import edits, viewpoint
from cliploc_ros.offline.studio.cloud import Cloud, draw_cloud, find_cloud
from cliploc_ros.offline.studio.desk import Desk
from cliploc_ros.offline.studio.layers import (
    Layers,
    draw_answers,
    draw_cameras,
    draw_keyframes,
    draw_robot,
)
from cliploc_ros.offline.studio.parts import parts_of, picture_of
from cliploc_ros.offline.studio.scene import Ellipsoids, Gizmo, Labels, draw_floor, draw_image
from cliploc_ros.offline.studio.studio import Rgb, Studio
from cliploc_ros.offline.studio.walls import draw_walls
from cliploc_ros.offline.studio.web import Board, Content, Gate

if TYPE_CHECKING:
    from cliploc_ros.offline.studio.live import LiveRelocalizer

_REDRAW_INTERVAL_S = 0.05
_BLANK = 70
# Scales of the shapes around selected and missing landmarks. The latter are visible through them.
_SELECTED_RGB: Rgb = (255, 220, 0)
_AROUND = 1.03
_MISSING_RGB: Rgb = (220, 0, 0)
_MISSING_SCALE = 1.3
# Greatest time between the clicks of a double click [s].
_DOUBLE_CLICK_S = 0.6

logger = logging.getLogger(__name__)


class Page:
    """The studio in the browser."""

    def __init__(self, studio: Studio, server: viser.ViserServer):
        self._studio, self._server = studio, server
        self.desk, self.board = Desk(studio, server), Board(studio.changed.set)
        self._stopped = threading.Event()
        self._drag = 0
        self._clicked: tuple[object, float] = None, 0.0
        self._cloud: Cloud | None = None
        scene, extent = server.scene, self.desk.extent()
        scene.set_up_direction(extent.up)
        draw_floor(scene, extent)
        self._layers = Layers(scene)
        self._all = Ellipsoids(scene, '/landmarks', self._click, 0.2, has_outlines=True)
        self._selected = Ellipsoids(scene, '/selection', self._click, 0.6, _AROUND)
        self._missing = Ellipsoids(scene, '/live/missing', self._click, 0.5, _MISSING_SCALE)
        self._labels = Labels(scene, extent.up)
        self._gizmo = Gizmo(scene, self._drag_gizmo)
        camera = server.initial_camera
        camera.fov, camera.up = viewpoint.FOV_RAD, tuple(extent.up)
        camera.look_at = tuple(extent.middle)
        camera.position = tuple(viewpoint.overview(extent, viewpoint.USUAL_ASPECT))
        self.desk.layers = {
            name: is_shown for name, what, is_shown in (
                ('Cameras', studio.recording, True), ('Keyframes', studio.layer, False),
                ('Walls', studio.walls, True)) if what is not None}
        for note in studio.document.notes:
            self.desk.log('done', note)
        self._draw_cameras = draw_cameras(lambda view: self.desk.act(
            lambda: studio.show_view(view)))
        self._redrawer = threading.Thread(target=self._redraw_always, daemon=True)
        self._redrawer.start()
        threading.Thread(target=self._load_cloud, args=(extent,), daemon=True).start()

    def stop(self) -> None:
        """Stop redrawing, which starts searches, and then the searches."""
        self._stopped.set()
        self._studio.changed.set()
        self._redrawer.join()
        self.desk.stop()

    def _load_cloud(self, extent: viewpoint.Bounds) -> None:
        """Read the surfaces in the background, which takes seconds."""
        studio = self._studio
        try:
            self._cloud = find_cloud(studio.recording, studio.layer, extent)
        except CliplocError as error:
            self.desk.log('refused', f'no surfaces: {error}')
        if self._cloud is not None:
            with studio.document.lock:
                self.desk.layers = {**self.desk.layers, 'Surfaces': True}
            studio.changed.set()

    # ---- actions in the scene -------------------------------------------------------------------

    def _click(self, event: Any, landmark_id: str) -> None:
        """Select a landmark; the second click of a double click flies to it."""
        key, now = (event.client_id, landmark_id), time.monotonic()
        before, self._clicked = self._clicked, (key, now)
        if before[0] == key and now - before[1] < _DOUBLE_CLICK_S:
            self.desk.look(event.client, 'fly')
        else:
            self.desk.act(lambda: self._studio.select(landmark_id, event.modifier == 'shift'))

    def _drag_gizmo(self, event: Any) -> None:
        # Callbacks may arrive out of order, so each uses the gizmo's current pose, not its own.
        if event.client is None:
            return
        if event.phase == 'start':
            self._drag += 1

        def take_pose() -> None:
            document, handle = self._studio.document, self._gizmo.handle
            if document.selected is not None:
                key, _ = document.selected
                document.edit(edits.set_fields, [key], center=handle.position,
                              orientation=np.roll(handle.wxyz, -1),
                              gesture=('gizmo', self._drag, key))

        self.desk.act(take_pose)

    # ---- redrawing ------------------------------------------------------------------------------

    def _redraw_always(self) -> None:
        while not self._stopped.is_set():
            try:
                with self._studio.document.lock, self._server.atomic():
                    self._redraw()
            except Exception:
                logger.exception('the page was not redrawn')  # the next change redraws it
            self._stopped.wait(_REDRAW_INTERVAL_S)
            self._studio.changed.wait()
            self._studio.changed.clear()

    def _redraw(self) -> None:
        studio, show, is_on = self._studio, self._layers.show, self.desk.layers.get
        document, shown = studio.document, studio.shown()
        chosen = {key: shown[key] for key in document.selection if key in shown}
        # also the selected landmarks: both clicks of a double click must have the same index
        self._all.show(shown, studio.color_of)
        self._selected.show(chosen, lambda class_id: _SELECTED_RGB)
        self._labels.show(chosen)
        selected = None if document.selected is None else document.selected[1]
        self._gizmo.show(None if selected is None or selected.is_locked else selected)
        recording = None if studio.recording is None else studio.recording.detections
        show('Surfaces', self._cloud, draw_cloud, is_on('Surfaces', True))
        show('Walls', studio.walls, draw_walls, is_on('Walls', True))
        show('Cameras', recording, self._draw_cameras, is_on('Cameras', True))
        show('Keyframes', studio.layer, draw_keyframes, is_on('Keyframes', True))
        show('Answers', studio.answers or None, draw_answers)
        if studio.live is not None:
            state = studio.live.state
            self._missing.show({key: document.landmarks[key] for key in state.missing
                                if key in document.landmarks}, lambda class_id: _MISSING_RGB)
            is_here = state.pose is not None and state.pose.frame_id == document.frame_id
            show('Robot', state if is_here else None, draw_robot)
        # before the image of the scene, which takes time
        self.board.show({**parts_of(self.desk), 'people': self.board.people})
        if recording is not None:
            show('Image', studio.view, self._draw_image)

    def _draw_image(self, scene: viser.SceneApi, view: int) -> list[Any]:
        camera, image = self._studio.camera, None
        try:
            image = self._studio.seen().image(view)
        except CliplocError as error:
            self.desk.log('refused', str(error))
        if image is None:
            image = np.full((camera.height, camera.width, 3), _BLANK, dtype=np.uint8)
        return draw_image(scene, image, camera, self._studio.map_from_camera)

    def picture(self, path: str) -> Content | None:
        """Return the picture at a path; None without a picture."""
        try:
            return picture_of(self._studio, path)
        except CliplocError as error:
            self.desk.log('refused', str(error))
            return None


@contextmanager
def serve_studio(studio: Studio, host: str, port: int, live: 'LiveRelocalizer | None' = None
                 ) -> Iterator[tuple[str, viser.ViserServer]]:
    """Serve the page of a studio while the context is open; yield the URL and the server.

    The first free port from ``port`` on is used; 0: any port. The URL contains a token. ``live``
    is the connection to the running relocalizer, if it is to be shown.
    """
    gate, pages = Gate(host), list[Page]()

    def answer(path: str) -> Content | None:
        return pages[0].picture(path) if pages else None

    async def talk(connection: Any, person: str) -> None:
        if pages:
            desk = pages[0].desk
            await pages[0].board.serve(connection, lambda message: desk.do(person, message))

    with gate.guard(answer, talk), redirect_stdout(io.StringIO()):  # viser prints another URL
        server = viser.ViserServer(host, port, verbose=False)
    # disabled, because viser would open a tunnel to a public server at any browser's request
    server.request_share_url = lambda *args, **options: None  # type: ignore[method-assign]
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    if live is not None:
        studio.live = live
        live.subscribe(studio.changed.set)
    pages.append(page := Page(studio, server))
    try:
        shown_host = f'[{host}]' if ':' in host else host
        yield f'http://{shown_host}:{server.get_port()}{gate.path}', server
    finally:
        page.stop()
        server.stop()
