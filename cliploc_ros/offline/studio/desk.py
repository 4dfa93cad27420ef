# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the actions that the messages of a page request, and log their results.

A message names an action and its arguments. An action is a method of the desk, the studio, its
document, its review or its new landmark, and is listed in ACTIONS of its class. Each change wakes
the thread that redraws the page.
"""

import logging
import threading
from collections.abc import Callable
from inspect import signature
from typing import Any

import viser

from cliploc_ros.errors import CliplocError
from cliploc_ros.files.storage import write_text
from cliploc_ros.offline.studio import viewpoint
from cliploc_ros.offline.studio.edits import EditError
from cliploc_ros.offline.studio.studio import Studio
from cliploc_ros.offline.studio.viewpoint import Bounds, extent_of

# Greatest number of lines in the log, and of characters in a line.
_MAX_LINES, _MAX_TEXT = 60, 600
# Longest wait for a slow action when the studio stops.
_GRACE_S = 2.0
# Actions after which the user's camera flies to the new selection.
_BRING_ANOTHER = ('step', 'accept', 'discard', 'create', 'select')

logger = logging.getLogger(__name__)


class Desk:
    """The actions of the users of the page.

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
    LOOKS = ('fly', 'overview', 'from_above', 'look_through', 'look_at_robot')

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
                self.look(self._client_of(person), 'fly')

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
                        + ('' if studio.new else ': there are no views to draw boxes in'))

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
        write_text(path, self.server.scene.as_html())
        return f'wrote {path.name}; open it in a browser'

    def extent(self) -> Bounds:
        """Return the bounds of the landmarks and of the cameras."""
        studio = self.studio
        source = studio.layer if studio.recording is None else studio.recording.detections
        return extent_of([landmark.center for landmark in studio.document.landmarks.values()],
                         None if source is None else source.map_from_camera)

    def look(self, client: viser.ClientHandle | None, name: str) -> None:
        """Move the camera of a user in a thread, because it takes a fraction of a second."""
        if client is not None:
            threading.Thread(target=self._look, args=(client, name), daemon=True).start()

    def _look(self, client: viser.ClientHandle, name: str) -> None:
        studio = self.studio
        with studio.document.lock:
            extent, selected = self.extent(), studio.document.selected
        pose = None if studio.live is None else studio.live.state.pose
        if name == 'fly' and selected is not None:
            viewpoint.fly_to(client, selected[1].center, selected[1].semi_axes.max(), extent.up)
        elif name in ('overview', 'from_above'):
            position = viewpoint.overview(extent, client.camera.aspect, name == 'from_above')
            viewpoint.fly(client, position, extent.middle, extent.up)
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
