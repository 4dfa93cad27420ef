# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The server of the page."""

import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any, NamedTuple

import viser

from cliploc_ros.studio.gate import Gate
from cliploc_ros.studio.page import Page
from cliploc_ros.studio.studio import Studio

if TYPE_CHECKING:
    from cliploc_ros.studio.live import LiveRelocalizer


class Served(NamedTuple):
    """A server that runs, and the URL to open."""

    url: str
    server: viser.ViserServer


@contextmanager
def serve_studio(studio: Studio, host: str, port: int, live: 'LiveRelocalizer | None' = None
                 ) -> Iterator[Served]:
    """Serve the page of a studio for as long as the block lasts; yield where.

    Parameters
    ----------
    studio : Studio
    host : str
        The address to listen at. Beyond the loopback interface, the URL holds a token.
    port : int
        The next free one from this on; 0: any.
    live : LiveRelocalizer, optional
        The running relocalizer, to show it, too.
    """
    gate = Gate(host)
    with gate.guard(), redirect_stdout(io.StringIO()):  # viser prints a URL without the token
        server = viser.ViserServer(host, port, verbose=False)
    # viser would open a tunnel to a server on the Internet for any browser that asks
    server.request_share_url = _share_nothing  # type: ignore[method-assign]
    page = Page(studio, server, live)
    try:
        shown_host = f'[{host}]' if ':' in host else host
        yield Served(f'http://{shown_host}:{server.get_port()}{gate.path}', server)
    finally:
        page.stop()
        server.stop()


def _share_nothing(*args: Any, **options: Any) -> None:
    """Refuse to share: no request leaves the machine."""
