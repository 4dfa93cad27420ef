# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Downloads that never hang: in a child process, ended when no more bytes arrive.

No timeout of an HTTP library bounds a name lookup, a connection whose packets are dropped and
the library's own retries together. A process can be ended whatever it waits for.
"""

import contextlib
import importlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import cliploc_ros
from cliploc_ros.errors import ModelError

# A child may import torch before it asks for a byte: on a small board that takes its time.
_START_LIMIT_S = 120.0
_POLL_S = 0.2
_LOG_PERIOD_S = 10.0

logger = logging.getLogger(__name__)


def download(
    fetcher: str,
    arguments: Sequence[str],
    folder: Path,
    what: str,
    remedy: str,
    stall_timeout_s: float,
) -> Path:
    """Download a file with a library's own function, in a process of its own.

    Parameters
    ----------
    fetcher : str
        'module:function' to run in the child; it takes the arguments and the folder as strings,
        calls `announce_start` before its first request and returns the path of the file.
    arguments : sequence of str
        What to fetch, in the fetcher's terms.
    folder : Path
        Where the file goes; its growth is what counts as progress.
    what : str
        Name of what is downloaded, for the log and the error.
    remedy : str
        What the user can do without a network, for the error.
    stall_timeout_s : float
        Give up when the folder has not grown for so long [s].

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModelError
        When the download fails or stalls.
    """
    logger.info('downloading %s into %s', what, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ModelError(f'cannot download {what}: {folder} cannot be made '
                         f'({error.strerror}). {remedy}') from error
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_download_') as desk:
        report = Path(desk) / 'report.json'
        failure = _run_child([fetcher, desk, *arguments, str(folder)], report, folder,
                             stall_timeout_s)
        result = json.loads(report.read_text()) if report.exists() else {'error': failure}
    if 'path' not in result:
        raise ModelError(f'cannot download {what}: {result["error"].rstrip(".")}. {remedy}')
    return Path(result['path'])


def announce_start() -> None:
    """Tell the parent that the imports are done and the first request goes out (in the child)."""
    (Path(os.environ['CLIPLOC_ROS_DOWNLOAD_DESK']) / 'started').touch()


def child_environment() -> dict[str, str]:
    """Return the environment for a child that imports this package from where it was found here.

    That may be the working directory, which no child inherits as a path.
    """
    paths = [str(Path(cliploc_ros.__file__).parents[1]), os.environ.get('PYTHONPATH', '')]
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, paths))}


def _run_child(
    arguments: list[str], report: Path, folder: Path, stall_timeout_s: float
) -> str:
    """Run the child until it ends or stalls; return why there may be no report."""
    # Plain HTTP writes into the watched folder; Xet would fill a cache elsewhere first.
    environment = {'HF_HUB_DISABLE_XET': '1', 'HF_HUB_DISABLE_TELEMETRY': '1',
                   **child_environment(), 'CLIPLOC_ROS_DOWNLOAD_DESK': str(report.parent)}
    log = report.with_name('log')
    with log.open('wb') as sink:
        child = subprocess.Popen(
            [sys.executable, '-m', __name__, *arguments], env=environment,
            stdin=subprocess.PIPE, stdout=sink, stderr=subprocess.STDOUT)
    try:
        if not _wait_while_it_grows(child, report.with_name('started'), folder, stall_timeout_s):
            return f'no byte arrived for {stall_timeout_s:g} s'
    finally:
        child.kill()
        child.wait()
        if child.stdin is not None:
            child.stdin.close()
    lines = log.read_text(errors='replace').strip().splitlines() or ['it gave no reason']
    return f'the download ended with code {child.returncode}: {lines[-1]}'


def _wait_while_it_grows(
    child: subprocess.Popen[bytes], started: Path, folder: Path, stall_timeout_s: float
) -> bool:
    """Return True when the child has ended, False when it has stalled."""
    deadline = time.monotonic() + _START_LIMIT_S
    next_log = time.monotonic() + _LOG_PERIOD_S
    before, size = _folder_bytes(folder), None
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_POLL_S)
            return True
        now = time.monotonic()
        if started.exists() and size != (size := _folder_bytes(folder)):
            deadline = now + stall_timeout_s
        if now > deadline:
            return False
        if size is not None and now > next_log:
            next_log = now + _LOG_PERIOD_S
            logger.info('downloaded %.0f MB so far', (size - before) / 1e6)


def _folder_bytes(folder: Path) -> int:
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # files come and go while a download runs
                total += (Path(parent) / name).lstat().st_size
    return total


def _end_with_parent() -> None:
    """End this process when the other end of its standard input is closed."""
    sys.stdin.buffer.read()
    os._exit(1)


def _main(fetcher: str, desk: str, *arguments: str) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    module, _, function = fetcher.partition(':')
    try:
        path = getattr(importlib.import_module(module), function)(*arguments)
        result = {'path': str(path)}
    except Exception as error:
        lines = str(error).strip().splitlines() or ['']
        result = {'error': f'{type(error).__name__}: {lines[0]}'}
    (Path(desk) / 'report.json').write_text(json.dumps(result))


if __name__ == '__main__':
    _main(*sys.argv[1:])
