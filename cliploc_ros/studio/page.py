# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page: the scene and the panels, the one loop that redraws them, and who may open it.

viser calls back from many threads. Each callback holds the document's lock for its action. One
thread redraws, at most 20 times a second, and reads the studio under the same lock. So all
browsers show the same state, and a slow one delays no edit.

viser 1.1 lets everyone in who reaches its port. On the loopback interface these include every
page that this machine's browsers show, since a browser opens WebSockets to any host. So a request
needs a loopback name as its host, a WebSocket needs the studio's own page as its origin, and
beyond the loopback interface each request needs the token that the studio prints.
"""

import hmac
import http
import io
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import viser
import websockets.asyncio.server
from scipy.spatial.transform import Rotation
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from cliploc_ros.errors import CliplocError
from cliploc_ros.studio import edits, viewpoint
from cliploc_ros.studio.context import draw_lines
from cliploc_ros.studio.images import SELECTED_RGB
from cliploc_ros.studio.panels import Actions, LandmarkPanel, MapPanel, TablePanel, ViewPanel
from cliploc_ros.studio.recording import MIN_BOX_PX
from cliploc_ros.studio.scene import Answers, Ellipsoids, Labels, ViewImage, draw_recording
from cliploc_ros.studio.scene_panel import ScenePanel
from cliploc_ros.studio.studio import Studio
from cliploc_ros.studio.tool_panels import LivePanel, PlacesPanel

if TYPE_CHECKING:
    from cliploc_ros.studio.live import LiveRelocalizer

_REDRAW_INTERVAL_S = 0.05
_GIZMO_PX = 90.0
# The selection is drawn around its landmarks, so much larger.
_AROUND = 1.03
_LOOPBACK_NAMES = ('127.0.0.1', 'localhost', '::1')


class Page:
    """The studio in the browser."""

    def __init__(self, studio: Studio, server: viser.ViserServer,
                 live: 'LiveRelocalizer | None' = None):
        self._studio, self._server = studio, server
        self._actions = Actions(studio, server)
        self._stopped = threading.Event()
        self._drag = 0
        self._shown_picture: object = None
        self._recorded: list[Any] = []
        self._build_scene()
        self._build_panels(live)
        self._redrawer = threading.Thread(target=self._redraw_always, daemon=True)
        self._redrawer.start()
        self._actions.changed.set()

    def stop(self) -> None:
        """Stop the search of places, the film, and redrawing."""
        self._places.search.stop()
        self._scene_panel.stop()
        self._stopped.set()
        self._actions.changed.set()
        self._redrawer.join()

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
                scene, recording.detections, lambda event, view: self._actions.act(
                    event, lambda: self._studio.show_view(view)))
            self._answers = Answers(scene, recording.detections)
            self._image = ViewImage(scene, self._clicked_image, self._dragged_image)
        camera = self._server.initial_camera
        camera.fov, camera.up = viewpoint.FOV_RAD, tuple(extent.up)
        camera.look_at = tuple(extent.middle)
        camera.position = tuple(viewpoint.overview(extent, viewpoint.USUAL_ASPECT))

    def _build_panels(self, live: 'LiveRelocalizer | None') -> None:
        gui, actions = self._server.gui, self._actions
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='large')
        gui.main_panel.dock_right()
        self._panels: list[Any] = [MapPanel(actions), LandmarkPanel(actions)]
        self._table = TablePanel(actions)
        self._panels.append(self._table)
        tools = gui.add_panel()
        if self._studio.recording is not None:
            with tools.add_tab('View'):
                self._view = ViewPanel(actions)
        with tools.add_tab('Scene'):
            self._scene_panel = ScenePanel(actions, self._labels, self._recorded)
            self._panels.append(self._scene_panel)
        with tools.add_tab('Places'):
            self._places = PlacesPanel(actions)
            self._panels.append(self._places)
        if live is not None:
            with tools.add_tab('Robot'):
                self._panels.append(LivePanel(actions, live))
        tools.dock_left()

    # ---- what a person does in the scene --------------------------------------------------------

    def _clicked_landmark(self, event: Any, landmark_id: str) -> None:
        if self._scene_panel.is_double(event, landmark_id):
            self._actions.look_at_selection(event)
            return
        self._actions.select(event, landmark_id,
                             event.modifier == 'shift' or self._table.selects_several)

    def _clicked_image(self, event: Any) -> None:
        origin = np.array(event.ray_origin)
        pixel = self._image.pixel(origin, origin + np.array(event.ray_direction))
        action = self._studio.take_box if self._view.is_drawing else self._studio.select_at
        self._actions.act(event, lambda: action(pixel))

    def _dragged_image(self, event: Any) -> None:
        if not self._view.is_drawing or event.phase == 'start':
            return
        eye = event.client.camera.position
        corner = self._image.pixel(eye, event.start_position)
        other = self._image.pixel(eye, event.end_position)

        is_end = event.phase == 'end'

        def draw() -> str | None:
            message = self._studio.draw_box(corner, other)
            return message if is_end else None

        if is_end or np.abs(other - corner).min() >= MIN_BOX_PX:
            self._actions.act(event if is_end else None, draw)

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
                document.apply(edits.place(document.landmarks, landmark_id, self._gizmo.position,
                                           np.roll(self._gizmo.wxyz, -1)),
                               gesture=('gizmo', self._drag, landmark_id))

        self._actions.act(event, take_pose)

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
        # all of them: a second click comes with the number that the first one's picture has
        self._all.show(list(document.landmarks.items()), self._studio.color_of)
        self._selected.show([(key, document.landmarks[key]) for key in document.selection],
                            lambda class_id: SELECTED_RGB)
        self._labels.show(document.landmarks, document.selection)
        self._show_gizmo()
        for panel in self._panels:
            panel.show()
        if self._studio.recording is not None:
            self._answers.show(self._studio.answers)
            self._show_view()

    def _show_gizmo(self) -> None:
        selected = self._studio.document.selected
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

    def _show_view(self) -> None:
        studio = self._studio
        key = studio.document.revision, studio.view, studio.drawn.get(studio.view)
        if key == self._shown_picture:
            return
        self._shown_picture = key
        try:
            picture = studio.picture()
        except CliplocError as error:
            self._actions.notify(None, 'No image', str(error), 'red')
            return
        self._image.show(picture, studio.camera, studio.map_from_camera)
        self._view.show(picture)


# ---- who may open it ----------------------------------------------------------------------------

class Gate:
    """The check of a server that listens at an address."""

    def __init__(self, host: str):
        self.is_local = host in _LOOPBACK_NAMES
        self.token = '' if self.is_local else secrets.token_urlsafe(24)

    @property
    def path(self) -> str:
        """The path of the page: the token, if one is needed."""
        return f'/{self.token}/' if self.token else '/'

    def admit(self, request: Request) -> str | None:
        """Return the path that viser shall see; None where the request is refused."""
        host = request.headers.get('Host', '')
        origin = request.headers.get('Origin')
        if self.is_local and urlsplit(f'//{host}').hostname not in _LOOPBACK_NAMES:
            return None
        if origin is not None and urlsplit(origin).netloc != host:
            return None
        if request.headers.get('Upgrade', '').lower() == 'websocket' and origin is None:
            return None
        if not self.token:
            return request.path
        first, _, rest = request.path.partition('?')[0].lstrip('/').partition('/')
        is_known = hmac.compare_digest(first.encode(), self.token.encode())
        return f'/{rest}' if is_known else None

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Let servers that start inside of the block ask this gate first.

        viser 1.1.1 has no option for it. It looks up ``websockets.asyncio.server.serve`` when it
        starts, so that name leads to the check for as long as the block lasts.
        """
        serve = websockets.asyncio.server.serve

        def guarded(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
            def process(connection: Any, request: Request) -> Any:
                path = self.admit(request)
                if path is None:
                    return Response(http.HTTPStatus.FORBIDDEN, 'Forbidden', Headers(),
                                    b'refused: use the address that the studio printed\n')
                request.path = path
                return process_request(connection, request)
            return serve(*args, process_request=process, **options)

        websockets.asyncio.server.serve = guarded  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


@contextmanager
def serve_studio(studio: Studio, host: str, port: int, live: 'LiveRelocalizer | None' = None
                 ) -> Iterator[tuple[str, viser.ViserServer]]:
    """Serve the page of a studio for as long as the block lasts; yield the URL and the server.

    The port is the next free one from this on; 0: any. Beyond the loopback interface, the URL
    holds a token. ``live`` is the running relocalizer, to show it, too.
    """
    gate = Gate(host)
    with gate.guard(), redirect_stdout(io.StringIO()):  # viser prints a URL without the token
        server = viser.ViserServer(host, port, verbose=False)
    # viser would open a tunnel to a server on the Internet for any browser that asks
    server.request_share_url = lambda *args, **options: None  # type: ignore[method-assign]
    page = Page(studio, server, live)
    try:
        shown_host = f'[{host}]' if ':' in host else host
        yield f'http://{shown_host}:{server.get_port()}{gate.path}', server
    finally:
        page.stop()
        server.stop()
