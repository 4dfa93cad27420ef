# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs what a person does on the page, and keeps the log of what came of it."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import viser

from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.studio import viewpoint
from cliploc_ros.offline.studio.studio import Studio

_MAX_LINES = 200

logger = logging.getLogger(__name__)


class Line(NamedTuple):
    """A line of the log."""

    number: int
    kind: str  #: done, refused or error
    text: str


class Actions:
    """Runs the actions of the people at the page, and logs the outcome of each.

    Attributes
    ----------
    changed : Event
        Set by any thread when there is something to redraw.
    lines : tuple of Line
        The log, the newest line last.
    running : tuple of str
        What takes long and goes on.
    """

    def __init__(self, studio: Studio, server: viser.ViserServer):
        self.studio, self.server = studio, server
        self.changed = threading.Event()
        self.lines: tuple[Line, ...] = ()
        self.running: tuple[str, ...] = ()
        self._lock = threading.Lock()
        studio.document.subscribe(self.changed.set)
        if studio.finder is not None:
            studio.finder.subscribe(self.changed.set)

    def act(self, action: Callable[[], str | None]) -> None:
        """Do something with the studio locked."""
        def locked() -> str | None:
            with self.studio.document.lock:
                return action()

        self.ask(locked)

    def ask(self, action: Callable[[], str | None]) -> None:
        """Do something that locks the studio itself, if at all."""
        try:
            message = action()
        except CliplocError as error:
            self.log('refused', str(error))
            return
        except Exception as error:
            self.log('error', f'internal error: {error}; the terminal has more')
            logger.exception('an action of the page failed')
            return
        finally:
            self.changed.set()
        if message:
            self.log('done', message)

    def log(self, kind: str, text: str) -> None:
        """Add a line to the log."""
        with self._lock:
            number = self.lines[-1].number + 1 if self.lines else 1
            self.lines = (*self.lines, Line(number, kind, text))[-_MAX_LINES:]
        self.changed.set()

    @contextmanager
    def busy(self, what: str) -> Iterator[None]:
        """Show that something takes long for as long as the block lasts."""
        with self._lock:
            self.running += (what,)
        self.changed.set()
        try:
            yield
        finally:
            with self._lock:
                rest = list(self.running)
                rest.remove(what)
                self.running = tuple(rest)
            self.changed.set()

    def look_at_selection(self, client: viser.ClientHandle | None) -> None:
        """Let a person's camera fly to the selected landmark."""
        with self.studio.document.lock:
            selected, up = self.studio.document.selected, self.studio.extent().up
        if client is not None and selected is not None:
            viewpoint.fly_to(client, selected[1].center, selected[1].semi_axes.max(), up)

    def look_at_all(self, client: viser.ClientHandle | None, is_from_above: bool) -> None:
        """Let a person's camera fly to where it sees the whole map."""
        with self.studio.document.lock:
            extent = self.studio.extent()
        if client is not None:
            position = viewpoint.overview(extent, client.camera.aspect, is_from_above)
            viewpoint.fly(client, position, extent.middle, extent.up)


def show_props(handle: Any, **props: Any) -> None:
    """Set properties that differ: viser sends each that is set to all browsers."""
    for name, value in props.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)
