# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page: the 3D scene, the other parts as JSON, its pictures, its actions, and the redrawing.

viser shows the scene in a frame of our page: its widgets have no image for zooming and drawing, no
rows with buttons, and only a single column. Data flows in one direction: pages send messages,
viser calls back from many threads, and the desk runs the actions with the document locked. A
message names an action and its arguments. An action is a method of the desk, the studio, its
document, its review or its new landmark, and is listed in ACTIONS of its class. One thread redraws
at most 20 times a second, and reads the studio under the same lock. Thus all browsers show the
same state, and a slow browser delays no edit.
"""

import io
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import CliplocError
from cliploc_ros.files.storage import write_text
from cliploc_ros.offline import page as html
from cliploc_ros.offline.studio import edits, scene, viewpoint
from cliploc_ros.offline.studio.edits import EditError, Landmark, shape_fields
from cliploc_ros.offline.studio.room import Cloud, draw_cloud, draw_walls, find_cloud
from cliploc_ros.offline.studio.studio import NO_VIEWS, Rgb, Studio
from cliploc_ros.offline.studio.web import FILES, Board, Content, Gate

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
# Greatest number of outlines: more hide the image and delay a drag.
_MAX_OUTLINES = 200
_CROP_PX = 160
# Greatest number of answers in the list after a run over the recording.
_MAX_ANSWERS = 100
# Greatest number of lines in the log, and of characters in a line.
_MAX_LINES, _MAX_TEXT = 60, 600
# Longest wait for a slow action when the studio stops.
_GRACE_S = 2.0
# Actions after which the user's camera moves to the new selection.
_BRING_ANOTHER = ('step', 'accept', 'discard', 'create', 'select')

logger = logging.getLogger(__name__)


class Desk:
    """The actions of the users of the page, and the log of their results.

    Attributes
    ----------
    lines : tuple of tuple of str
        The log, newest line last: done, refused or error, and a text.
    is_old : bool
        Whether a user acted after the newest line.
    running : dict of str to Thread
        The slow actions that are running.
    layers : dict of str to bool
        Whether each layer of the scene is visible, by name.
    """

    ACTIONS = ('show_layer', 'export')
    LOOKS = ('look_at_landmark', 'overview', 'from_above', 'look_through', 'look_at_robot')

    def __init__(self, studio: Studio, server: viser.ViserServer):
        self.studio, self.server = studio, server
        self.lines: tuple[tuple[str, str], ...] = ()
        self.is_old = False
        self.running: dict[str, threading.Thread] = {}
        self.layers: dict[str, bool] = {}
        self._lock = threading.Lock()

    def stop(self) -> None:
        """Stop the slow actions."""
        self.studio.stop()
        for thread in list(self.running.values()):
            thread.join(_GRACE_S)

    # ---- messages -------------------------------------------------------------------------------

    def do(self, person: str, message: dict[str, Any]) -> None:
        """Run the action that a message of a user's page names under the key 'do'."""
        values = dict(message)
        name = str(values.pop('do', ''))
        if name in self.LOOKS:
            self.look(self._client_of(person), name)
        else:
            # show_view is no action of the user: pages send it after each selection
            self.act(lambda: self._start(name, values), name != 'show_view')
            if name in _BRING_ANOTHER and not values.get('joins'):
                self.look(self._client_of(person), 'look_at_landmark')

    def _start(self, name: str, values: dict[str, Any]) -> str | None:
        """Run an action; slow actions run in a thread."""
        studio = self.studio
        owners: tuple[Any, ...] = self, studio, studio.document, studio.review, studio.new
        for owner in owners:
            is_slow = name in getattr(owner, 'SLOW_ACTIONS', ())
            if not is_slow and name not in getattr(owner, 'ACTIONS', ()):
                continue
            action: Callable[..., str | None] = getattr(owner, name)
            try:
                signature(action).bind(**values)
            except TypeError as error:
                raise EditError(f"the page's message '{name}': {error}") from error
            if not is_slow:
                return action(**values)
            if name in self.running:
                raise EditError(f"'{name.replace('_', ' ')}' is already running")
            if name == 'check_map':
                studio.allow_check()  # before the thread starts, which may be stopped at once
            thread = threading.Thread(target=self._run, args=(name, action), daemon=True)
            with self._lock:
                self.running = {**self.running, name: thread}
            thread.start()
            return None
        raise EditError(f"the studio has no action '{name:.60}'"
                        + ('' if studio.new else f': {NO_VIEWS}'))

    def _run(self, name: str, action: Callable[[], str | None]) -> None:
        self.ask(action)
        with self._lock:
            self.running = {key: thread for key, thread in self.running.items() if key != name}
        self.studio.changed.set()

    def act(self, action: Callable[[], str | None], makes_old: bool = True) -> None:
        """Run an action with the document locked; see `ask`."""
        def locked() -> str | None:
            with self.studio.document.lock:
                return action()

        self.ask(locked, makes_old)

    def ask(self, action: Callable[[], str | None], makes_old: bool = True) -> None:
        """Run an action and log its result. `makes_old` marks earlier results as old.

        The action locks the document where it needs to.
        """
        try:
            message = action()
            self.is_old |= makes_old
            if message:
                self.log('done', message)
        except CliplocError as error:
            self.log('refused', str(error))
        except Exception as error:
            self.log('error', f'internal error: {error}; see the traceback in the terminal')
            logger.exception('an action of the page failed')
        self.studio.changed.set()

    def log(self, kind: str, text: str) -> None:
        """Add a line to the log."""
        with self._lock:
            self.lines = (*self.lines, (kind, text[:_MAX_TEXT]))[-_MAX_LINES:]
            self.is_old = False
        self.studio.changed.set()

    # ---- the scene ------------------------------------------------------------------------------

    def show_layer(self, name: str, is_shown: bool) -> None:
        """Show or hide a layer of the scene."""
        name = str(name)
        if name not in self.layers:
            raise EditError(f"the scene has no layer '{name:.60}'")
        self.layers = {**self.layers, name: is_shown is True}

    def export(self) -> str:
        """Write the scene as an HTML file that can be opened without a server."""
        path = self.studio.document.path.with_suffix('.html')
        style = (FILES / 'scene.css').read_text()
        write_text(path, self.server.scene.as_html().replace(
            '</head>', f'<style>{style}</style></head>', 1))
        return f'wrote {path.name}; open it in a browser'

    def extent(self) -> viewpoint.Bounds:
        """Return the bounds of the landmarks and of the cameras."""
        studio = self.studio
        source = studio.layer if studio.recording is None else studio.recording.detections
        return viewpoint.extent_of(
            [landmark.center for landmark in studio.document.landmarks.values()],
            None if source is None else source.map_from_camera)

    def look(self, client: viser.ClientHandle | None, name: str) -> None:
        """Move the camera of a user, unless the user's scene is not open yet."""
        if client is not None:
            self.act(lambda: self._look(client, name), makes_old=False)

    def _look(self, client: viser.ClientHandle, name: str) -> None:
        studio, extent, selected = self.studio, self.extent(), self.studio.document.selected
        pose = None if studio.live is None else studio.live.state.pose
        if name == 'look_at_landmark' and selected is not None:
            viewpoint.look_at(client, selected[1].center, selected[1].semi_axes.max(), extent.up)
        elif name in ('overview', 'from_above'):
            position = viewpoint.overview(extent, client.camera.aspect, name == 'from_above')
            viewpoint.move_to(client, position, extent.middle, extent.up)
        elif name == 'look_through' and studio.recording is not None:
            viewpoint.look_through(client, studio.map_from_camera, studio.camera)
        elif name == 'look_at_robot' and pose is not None:
            client.camera.look_at = pose.map_from_body[:3, 3]

    def _client_of(self, person: str) -> viser.ClientHandle | None:
        """Return the scene's client of a user, by the path of its connection."""
        connections = self.server._websock_server._live_connections
        for number, client in self.server.get_clients().items():
            request = getattr(connections.get(number), 'request', None)
            if request is not None and request.path.strip('/') == f'scene/{person}':
                return client
        return None


class Page:
    """The studio in the browser."""

    def __init__(self, studio: Studio, server: viser.ViserServer):
        self._studio, self._server = studio, server
        self.desk, self.board = Desk(studio, server), Board(studio.changed.set)
        self._stopped = threading.Event()
        self._drag = 0
        self._clicked: tuple[object, float] = None, 0.0
        self._cloud: Cloud | None = None
        canvas, extent = server.scene, self.desk.extent()
        canvas.set_up_direction(extent.up)
        scene.draw_floor(canvas, extent)
        self._layers = scene.Layers(canvas)
        self._all = scene.Ellipsoids(canvas, '/landmarks', self._click, 0.2, has_outlines=True)
        self._selected = scene.Ellipsoids(canvas, '/selection', self._click, 0.6, _AROUND)
        self._missing = scene.Ellipsoids(canvas, '/live/missing', self._click, 0.5, _MISSING_SCALE)
        self._labels = scene.Labels(canvas, extent.up)
        self._gizmo = scene.Gizmo(canvas, self._drag_gizmo)
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
        self._draw_cameras = scene.draw_cameras(lambda view: self.desk.act(
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
        """Select a landmark; the second click of a double click moves to it."""
        key, now = (event.client_id, landmark_id), time.monotonic()
        before, self._clicked = self._clicked, (key, now)
        if before[0] == key and now - before[1] < _DOUBLE_CLICK_S:
            self.desk.look(event.client, 'look_at_landmark')
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
        show('Keyframes', studio.layer, scene.draw_keyframes, is_on('Keyframes', True))
        show('Answers', studio.answers or None, scene.draw_answers)
        if studio.live is not None:
            state = studio.live.state
            self._missing.show({key: document.landmarks[key] for key in state.missing
                                if key in document.landmarks}, lambda class_id: _MISSING_RGB)
            is_here = state.pose is not None and state.pose.frame_id == document.file.frame_id
            show('Robot', state if is_here else None, scene.draw_robot)
        # before the image of the scene, which takes time
        self.board.show({**parts_of(self.desk), 'people': len(self.board.pages)})
        if recording is not None:
            show('Image', studio.view, self._draw_image)

    def _draw_image(self, canvas: viser.SceneApi, view: int) -> list[Any]:
        camera, image = self._studio.camera, None
        try:
            image = self._studio.seen().image(view)
        except CliplocError as error:
            self.desk.log('refused', str(error))
        if image is None:
            image = np.full((camera.height, camera.width, 3), _BLANK, dtype=np.uint8)
        return scene.draw_image(canvas, image, camera, self._studio.map_from_camera)

    def picture(self, path: str) -> Content | None:
        """Return the picture at a path; None without a picture."""
        try:
            return picture_of(self._studio, path)
        except CliplocError as error:
            self.desk.log('refused', str(error))
            return None


# ---- the content, part by part -----------------------------------------------------------------

def parts_of(desk: Desk) -> dict[str, Any]:
    """Return the parts of the page by name."""
    studio, document = desk.studio, desk.studio.document
    review = studio.review
    found = {
        'file': {
            'name': document.path.name, 'frame': document.file.frame_id,
            'is_saved': document.is_saved, 'notes': document.notes, 'undo': document.to_undo,
            'redo': document.to_redo, 'conflict': document.has_conflict, 'views': studio.views,
            'has_boxes': review.has_boxes, 'no_views': NO_VIEWS,
            'images': studio.recording is not None and studio.recording.images is not None,
            'classes': sorted({landmark.class_id for landmark in document.landmarks.values()})},
        'rows': [[key, one.label, one.class_id, one.is_locked, one.is_hidden,
                  review.severity(key), one.decision,
                  '#{:02x}{:02x}{:02x}'.format(*studio.color_of(one.class_id))]
                 for key in review.order if (one := document.landmarks.get(key))],
        'selection': {'ids': document.selection, 'one': _selected_part(studio)},
        'review': {**review.counts(), 'running': list(desk.running)},
        'log': {'lines': desk.lines, 'is_old': desk.is_old},
        'layers': desk.layers,
        'test': {
            'share': round(studio.share, 2), 'running': list(desk.running),
            'is_stale': studio.is_stale, 'has_page': bool(studio.check_page),
            'answers': [[view, one.verdict, None if one.error_m is None else round(one.error_m, 2),
                         one.reason] for view, one in list(studio.answers.items())[:_MAX_ANSWERS]],
            'robot': None if studio.live is None else studio.live.lines(document)}}
    if studio.recording is not None:
        found |= _view_parts(studio)
    return found


def _selected_part(studio: Studio) -> dict[str, Any] | None:
    if studio.document.selected is None:
        return None
    key, one = studio.document.selected
    check, sightings = studio.review.checks.get(key), studio.sightings(key)
    return {
        'id': key, 'label': one.label, 'class_id': one.class_id,
        'is_locked': one.is_locked, 'decision': one.decision,
        'center': one.center.tolist(), 'semi_axes': one.semi_axes.tolist(),
        'angles': [round(float(angle), 3) + 0.0 for angle in Rotation.from_quat(
            one.quat_xyzw).as_euler('xyz', degrees=True)],
        'phrases': studio.phrases(key), 'is_checked': check is not None,
        'faults': () if check is None else check.faults,
        'support': None if check is None else check.support,
        'seen': None if check is None else check.seen,
        'expected': None if check is None else check.expected,
        'sightings': sightings and [
            [one.view, *one.bbox_xyxy.round(1).tolist(), one.is_detected] for one in sightings]}


def _view_parts(studio: Studio) -> dict[str, Any]:
    """Return the parts of the selected view and of the new landmark."""
    new, recording, view = studio.new, studio.recording, studio.view
    assert recording is not None and new is not None
    selection, seen = studio.document.selection, recording.detections.detections_of(view)
    outlines = enumerate(recording.outlines(studio.shown(), view).items())
    guess = {} if new.fit is None else {'': Landmark(shape_fields(new.fit.center, new.fit.basis))}
    return {
        'view': {
            'view': view, 'camera': recording.detections.name_of(view),
            'size': [studio.camera.width, studio.camera.height],
            'boxes': [[*box, name] for box, name in zip(
                seen.bboxes_xyxy.round(1).tolist(), seen.class_ids, strict=True)],
            'outlines': [[key, *_axes_of(ellipse)] for number, (key, ellipse) in outlines
                         if number < _MAX_OUTLINES or key in selection],
            'guess': [*map(_axes_of, recording.outlines(guess, view).values())],
            'guide': new.guide(view).round(1).tolist()},
        'new': {'boxes': sorted(new.boxes.items()), 'class_id': new.class_id, 'doubt': new.doubt}}


def _axes_of(ellipse: NDArray[np.float64]) -> list[float]:
    """Return an outline's centre and semi-axes [px], and the angle of the first axis [deg]."""
    cx, cy, exx, exy, eyy = ellipse
    mean, apart = 0.5 * (exx + eyy), np.hypot(0.5 * (exx - eyy), exy)
    axes = np.sqrt(np.maximum([mean + apart, mean - apart], 0.0))
    return [round(float(value), 1) for value in (
        cx, cy, *axes, np.degrees(0.5 * np.arctan2(2.0 * exy, exx - eyy)))]


def picture_of(studio: Studio, path: str) -> Content | None:
    """Return an image, a crop or the last check: /image/ANY/VIEW, /crop/ANY/VIEW/X,Y,X,Y, /check.

    CliplocError: an image cannot be read.
    """
    kind, *words = path.strip('/').split('/')
    if kind == 'check' and studio.check_page:
        return Content(studio.check_page.encode(), '.html', False)
    if studio.recording is None or kind not in ('image', 'crop'):
        return None
    try:
        view = int(words[1])
        image = studio.recording.image(view) if kind == 'image' else studio.recording.crop(
            view, np.array([float(word) for word in words[2].split(',')]).reshape(4))
    except (ValueError, IndexError):
        return None
    if image is None:
        return None
    return Content(html.jpeg_of(image, _CROP_PX if kind == 'crop' else None), '.jpg', True)


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
        live.on_change = studio.changed.set
    pages.append(page := Page(studio, server))
    try:
        shown_host = f'[{host}]' if ':' in host else host
        yield f'http://{shown_host}:{server.get_port()}{gate.path}', server
    finally:
        page.stop()
        server.stop()
