# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The server of the page, and who may open it: a check of each request before viser sees it.

viser 1.1 lets everyone in who reaches its port. On the loopback interface these include every
page that this machine's browsers show, since a browser opens WebSockets to any host. So a request
needs a loopback name as its host, a WebSocket needs the studio's own page as its origin, and
beyond the loopback interface each request needs the token that the studio prints.
"""

import hmac
import http
import io
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from cliploc_ros.studio.page import Page
from cliploc_ros.studio.studio import Studio

if TYPE_CHECKING:
    from cliploc_ros.studio.live import LiveRelocalizer

_LOOPBACK_NAMES = ('127.0.0.1', 'localhost', '::1')


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
    server.request_share_url = lambda *args, **options: None  # type: ignore[method-assign]
    page = Page(studio, server, live)
    try:
        shown_host = f'[{host}]' if ':' in host else host
        yield Served(f'http://{shown_host}:{server.get_port()}{gate.path}', server)
    finally:
        page.stop()
        server.stop()
