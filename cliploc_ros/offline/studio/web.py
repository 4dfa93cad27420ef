# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Access control, and the content of the port: our page, its images, and viser's scene.

viser 1.1 admits everyone who reaches its port. On the loopback interface these are all users of
this machine, and every page open in its browsers, because a browser opens WebSockets to any host.
Therefore each request needs the token that the studio prints, a request to this machine needs a
loopback name as host, and a WebSocket needs the studio's page as origin.

Below the token, ``/`` is the page, ``/scene/PERSON`` is viser's scene, ``/socket/PERSON`` is the
page's WebSocket, and ``/image`` and ``/crop`` are pictures. PERSON is a random word of each page.
"""

import asyncio
import hmac
import http
import json
import logging
import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request, Response

from cliploc_ros.errors import OptionsError
from cliploc_ros.files.storage import parse_json, unfinished

LOOPBACK_NAMES = ('127.0.0.1', 'localhost', '::1')
FILES = Path(__file__).parent / 'web'
_NAMES = ('studio.html', 'studio.css', 'studio.js', 'scene.css')
_TYPES = {'.html': 'text/html; charset=utf-8', '.css': 'text/css; charset=utf-8',
          '.js': 'text/javascript; charset=utf-8', '.jpg': 'image/jpeg'}
# The page may only load its own files, and other pages may not embed it in a frame.
_POLICY = ("default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; "
           "frame-ancestors 'self'")


class Content(NamedTuple):
    """The content of a file, and the suffix of its name."""

    content: bytes
    suffix: str
    is_kept: bool  #: Whether the browser may cache it


class Board:
    """The content of all open pages: parts by name, as JSON. Only changed parts are sent.

    ``on_change`` is called when a page is opened or closed.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._parts: dict[str, str] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self.pages: set[asyncio.Event] = set()  #: An event of each open page

    def show(self, parts: dict[str, Any]) -> None:
        """Show the given parts; may be called in any thread."""
        texts = {name: json.dumps([name, value]) for name, value in parts.items()}
        # an unchanged part stays the same object
        self._parts = {name: self._parts[name] if self._parts.get(name) == text else text
                       for name, text in texts.items()}
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for event in self.pages:
            event.set()

    async def serve(self, connection: Any, do: Callable[[dict[str, Any]], None]) -> None:
        """Send parts to a page until it closes, and process its messages one by one."""
        self._loop, event, sent = asyncio.get_running_loop(), asyncio.Event(), dict[str, str]()
        self.pages.add(event)
        event.set()
        self._on_change()

        async def send() -> None:
            while True:
                await event.wait()
                event.clear()
                parts = self._parts
                news = [text for name, text in parts.items() if sent.get(name) is not text]
                sent.update(parts)
                if news:
                    await connection.send(f'[{",".join(news)}]')

        sender = asyncio.create_task(send())
        try:
            async for text in connection:
                message = parse_json(text)
                if isinstance(message, dict):
                    await asyncio.to_thread(do, message)
        except (ConnectionClosed, ValueError):
            pass
        finally:
            self.pages.discard(event)
            sender.cancel()
            self._on_change()


@contextmanager
def private_page(url: str, beside: Path) -> Iterator[Path]:
    """Yield a page that leads to `url`, and that no other user can read; it is removed at the end.

    It is for the command line of a browser, which all users of the machine can read. It lies
    beside another file, because packaged browsers have a temporary folder of their own.
    OptionsError: it cannot be written.
    """
    with ExitStack() as written:
        try:
            page = written.enter_context(unfinished(
                beside.with_suffix('.html'), partial(Path.touch, mode=0o600)))
            page.write_text('<meta name="color-scheme" content="light dark">'
                            f'<meta http-equiv="refresh" content="0;url={url}">')
        except OSError as error:
            raise OptionsError(f'{beside.parent}: cannot be written to: {error.strerror}; make '
                               'room, or give --no-browser') from error
        yield page


class Gate:
    """Access control of a server that listens at an address."""

    def __init__(self, host: str):
        self.is_local = host in LOOPBACK_NAMES
        self.token = secrets.token_urlsafe(24)

    @property
    def path(self) -> str:
        """The path of the page."""
        return f'/{self.token}/'

    def admit(self, request: Request) -> str | None:
        """Return the path below the token, None for a refused request."""
        try:
            host, origin = request.headers.get('Host', ''), request.headers.get('Origin')
            name, their_host = urlsplit(f'//{host}').hostname, urlsplit(origin or '').netloc
            is_socket = request.headers.get('Upgrade', '').lower() == 'websocket'
        except (LookupError, ValueError):  # a header is repeated, or has no host
            return None
        if ((self.is_local and name not in LOOPBACK_NAMES)
                or (origin is not None and their_host != host) or (is_socket and origin is None)):
            return None
        first, _, rest = request.path.partition('?')[0].lstrip('/').partition('/')
        # websockets decodes non-ASCII bytes as surrogates
        is_known = hmac.compare_digest(first.encode(errors='surrogateescape'), self.token.encode())
        return f'/{rest}' if is_known else None

    @contextmanager
    def guard(self, answer: Callable[[str], Content | None],
              talk: Callable[[Any, str], Any]) -> Iterator[None]:
        """Guard a viser server that is started while this context is open.

        ``answer`` returns the picture at a path, ``talk`` serves the WebSocket of a user's page.
        viser 1.1.1 has no option for either. It looks up ``websockets.asyncio.server.serve`` when
        it starts, so that function is replaced while the context is open.
        """
        serve = websockets.asyncio.server.serve
        logging.getLogger('websockets.server').addFilter(_is_fault)

        def guarded(handler: Callable[[Any], Any], *args: Any,
                    process_request: Callable[..., Any], **options: Any) -> Any:
            async def handle(connection: Any) -> None:
                kind, _, person = connection.request.path.lstrip('/').partition('/')
                await (talk(connection, person) if kind == 'socket' else handler(connection))

            async def process(connection: Any, request: Request) -> Any:
                path = self.admit(request)
                if path is None:
                    return _response(http.HTTPStatus.FORBIDDEN, Content(
                        b'refused: use the address that the studio printed\n', '', False))
                request.path = path
                if request.headers.get('Upgrade', '').lower() == 'websocket':
                    return None
                if path.startswith('/scene/'):
                    request.path = '/'
                    return process_request(connection, request)
                # pages of other sites must not even find out which pictures exist
                is_foreign = request.headers.get('Sec-Fetch-Site') == 'cross-site'
                name = path.lstrip('/') or 'studio.html'
                found = (Content((FILES / name).read_bytes(), Path(name).suffix, False)
                         if name in _NAMES else None if is_foreign
                         else await asyncio.to_thread(answer, path))
                if found is None:
                    return _response(http.HTTPStatus.NOT_FOUND, Content(b'not found\n', '', False))
                return _response(http.HTTPStatus.OK, found)

            return serve(handle, *args, process_request=process, **options)

        websockets.asyncio.server.serve = guarded  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _is_fault(record: logging.LogRecord) -> bool:
    """Return whether a record of websockets is not of a connection that a browser dropped.

    Chromium opens connections that it may need, and closes them without a request.
    """
    return record.exc_info is None or not isinstance(
        record.exc_info[1], InvalidHandshake | ConnectionError | EOFError)


def _response(status: http.HTTPStatus, answer: Content) -> Response:
    headers = Headers({
        'Content-Type': _TYPES.get(answer.suffix, 'text/plain'),
        'Content-Length': str(len(answer.content)), 'Content-Security-Policy': _POLICY,
        'X-Content-Type-Options': 'nosniff',
        'Cache-Control': 'private, max-age=3600' if answer.is_kept else 'no-store'})
    return Response(status, status.phrase, headers, answer.content)
