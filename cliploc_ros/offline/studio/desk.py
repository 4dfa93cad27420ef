# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the actions that the messages of a page name, and logs their results.

A message names an action and its values. An action is a method of the desk, the studio, its
document, its review or its new landmark, and stands in the ACTIONS of its class. Each change wakes
the page's redrawer.
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

# Lines of the log, and characters of each.
_MAX_LINES, _MAX_TEXT = 60, 600
# How long stopping waits for an action that takes long.
_GRACE_S = 2.0
# After these, the camera of the person flies to the selection.
_BRING_ANOTHER = ('step', 'accept', 'discard', 'create', 'select')

logger = logging.getLogger(__name__)


class Desk:
    """The actions of the people at the page.

    Attributes
    ----------
    lines : tuple of tuple of str
        The log, the newest line last: done, refused or error, and a text.
    is_old : bool
        Whether a person did something after the newest line.
    running : dict of str to Thread
        The actions that take long and go on.
    layers : dict of str to bool
        Whether each layer of the scene is shown, by name.
    modes : dict of str to str
        The mode of each person's page.
    """

    ACTIONS = ('show_layer', 'export')
    LOOKS = ('fly', 'overview', 'from_above', 'look_through', 'look_at_robot', 'flatten')

    def __init__(self, studio: Studio, server: viser.ViserServer):
        self.studio, self.server = studio, server
        self.lines: tuple[tuple[str, str], ...] = ()
        self.is_old = False
        self.running: dict[str, threading.Thread] = {}
        self.layers: dict[str, bool] = {}
        self.modes: dict[str, str] = {}
        self._lock = threading.Lock()

    def stop(self) -> None:
        """Stop the actions that take long."""
        self.studio.stop()
        for thread in list(self.running.values()):
            thread.join(_GRACE_S)

    # ---- messages -------------------------------------------------------------------------------

    def do(self, person: str, message: dict[str, Any]) -> None:
        """Do what a message of a person's page says: its key 'do' names an action."""
        values = dict(message)
        name = str(values.pop('do', ''))
        if name in self.LOOKS:
            self.look(self._client_of(person), name, values.get('is_flat') is True)
        elif name == 'mode':
            self.show_mode(person, str(values.get('mode')))
        else:
            # a page shows the best view of a selection by itself: nobody did anything else
            self.act(lambda: self._start(name, values), name != 'show_view')
            if name in _BRING_ANOTHER and not values.get('joins'):
                self.look(self._client_of(person), 'fly')

    def show_mode(self, person: str, mode: str) -> None:
        """Take the mode of a person's page, '' once it is closed."""
        with self._lock:
            others = {key: one for key, one in self.modes.items() if key != person}
            self.modes = {**others, person: mode} if mode else others
        self.studio.changed.set()

    def _start(self, name: str, values: dict[str, Any]) -> str | None:
        """Do an action; one that takes long goes on in a thread."""
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
            if name == 'search_places':
                studio.allow_search()  # before the thread begins: it may be stopped at once
            thread = threading.Thread(target=self._run, args=(name, action), daemon=True)
            with self._lock:
                self.running = {**self.running, name: thread}
            thread.start()
            return None
        raise EditError(f"the studio cannot '{name:.60}'"
                        + ('' if studio.new else ': there are no views to draw boxes in'))

    def _run(self, name: str, action: Callable[[], str | None]) -> None:
        self.ask(action)
        with self._lock:
            self.running = {key: one for key, one in self.running.items() if key != name}
        self.studio.changed.set()

    def act(self, action: Callable[[], str | None], makes_old: bool = True) -> None:
        """Do something with the studio locked; the last result is old then, or stays new."""
        def locked() -> str | None:
            with self.studio.document.lock:
                return action()

        self.ask(locked, makes_old)

    def ask(self, action: Callable[[], str | None], makes_old: bool = True) -> None:
        """Do something that locks the studio itself, if at all."""
        try:
            message = action()
            self.is_old |= makes_old
            if message:
                self.log('done', message)
        except CliplocError as error:
            self.log('refused', str(error))
        except Exception as error:
            self.log('error', f'internal error: {error}; the terminal has more')
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
        """Write the scene as one page that opens without a server."""
        path = self.studio.document.path.with_suffix('.html')
        write_text(path, self.server.scene.as_html())
        return f'wrote {path.name}; open it in a browser'

    def extent(self) -> Bounds:
        """Return the bounds of the landmarks and of the cameras that saw them."""
        studio = self.studio
        source = studio.layer if studio.recording is None else studio.recording.detections
        return extent_of([landmark.center for landmark in studio.document.landmarks.values()],
                         None if source is None else source.map_from_camera)

    def look(self, client: viser.ClientHandle | None, name: str, is_flat: bool = False) -> None:
        """Move the camera of a person, which takes part of a second, in a thread."""
        if client is not None:
            threading.Thread(target=self._look, args=(client, name, is_flat), daemon=True).start()

    def _look(self, client: viser.ClientHandle, name: str, is_flat: bool) -> None:
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
        elif name == 'flatten':
            viewpoint.set_flat(client, is_flat)

    def _client_of(self, person: str) -> viser.ClientHandle | None:
        """Return the scene's client of a person, whom the path of its connection names."""
        connections = self.server._websock_server._live_connections
        for number, client in self.server.get_clients().items():
            one = connections.get(number)
            if one is not None and one.request is not None and one.request.path.strip(
                    '/') == f'scene/{person}':
                return client
        return None
