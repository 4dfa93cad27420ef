# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo's processes: each ends with the demo, however that ends."""

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from cliploc_ros.errors import CliplocError

_GRACE_S = 5.0
_POLL_S = 0.05
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class DemoError(CliplocError):
    """The demo cannot go on; the message says why."""


class Process:
    """A running process whose output goes to a file."""

    def __init__(self, name: str, popen: 'subprocess.Popen[bytes]', log: Path) -> None:
        self.name = name
        self._popen, self._log = popen, log

    def wait_for_output(self, text: str, patience_s: float) -> None:
        """Wait until a text stands in the output.

        Raises
        ------
        DemoError
            The process reports an error, ends, or takes longer; what it said last is quoted.
        """
        deadline = time.monotonic() + patience_s
        while text not in (output := self._log.read_text(errors='replace')):
            if '[ERROR]' in output or time.monotonic() > deadline:
                raise DemoError(f'the {self.name} does not become ready: {self._last_words()}')
            self.check()
            time.sleep(_POLL_S)

    def check(self) -> None:
        """Raise a DemoError if the process has ended."""
        code = self._popen.poll()
        if code is not None:
            raise DemoError(f'the {self.name} ended with exit code {code}: {self._last_words()}')

    def wait(self) -> None:
        """Wait until the process ends by itself."""
        self._popen.wait()

    def end(self) -> None:
        """Ask the process to end, and make it end if it does not."""
        self._popen.terminate()
        try:
            self._popen.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()

    def _last_words(self) -> str:
        lines = self._log.read_text(errors='replace').splitlines()
        errors = [line for line in lines if '[ERROR]' in line]
        return f'{(errors or lines or ["it said nothing"])[-1]} (its output: {self._log})'


@contextmanager
def running(command: Sequence[object], log: Path) -> Iterator[Process]:
    """Run a program for the length of a with statement.

    Parameters
    ----------
    command : sequence
        Program and arguments.
    log : Path
        The file for its output.
    """
    arguments = [str(argument) for argument in command]
    with log.open('wb') as output:
        # Killed itself, the demo could end nothing any more: then the kernel does.
        popen = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=output,
                                 stderr=subprocess.STDOUT,
                                 preexec_fn=_end_with_parent)
    process = Process(Path(arguments[0]).name, popen, log)
    try:
        yield process
    finally:
        impatient = signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C
        process.end()
        signal.signal(signal.SIGINT, impatient)


def _end_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def node_command(name: str, parameters: Mapping[str, object]) -> list[object]:
    """Return the command line of an installed node with parameters.

    Raises
    ------
    DemoError
        The package is not installed.
    """
    arguments: list[object] = [_find_executable(name), '--ros-args']
    for parameter, value in parameters.items():
        arguments += ['-p', f'{parameter}:={value}']
    return arguments


def installed_share() -> Path:
    """Return the folder of what the package installs beside its code."""
    return _find_executable('detector').parents[2] / 'share' / 'cliploc_ros'


def _find_executable(name: str) -> Path:
    """Find an executable beside the running one, or in the sourced workspace."""
    folders = [Path(sys.argv[0]).resolve().parent]
    try:
        from ament_index_python import get_package_prefix
        folders.append(Path(get_package_prefix('cliploc_ros')) / 'lib' / 'cliploc_ros')
    except (ImportError, LookupError, OSError):
        pass  # no workspace is sourced, or this package is not in it
    for folder in folders:
        if os.access(folder / name, os.X_OK):
            return folder / name
    raise DemoError(f'the executable {name} is not installed: run script/setup, then source '
                    'script/env')


@contextmanager
def own_ros_domain() -> Iterator[int]:
    """Keep this process and its children away from every other node, and yield the domain.

    A domain (1 to 101) is reserved by a bound port, as ROS's own ``domain_coordinator`` does it:
    the reservation ends with this process, however that ends.
    """
    domain, reservation = _reserve_domain()
    with reservation:
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        # The older name of the same; where both are set, ROS warns.
        os.environ.pop('ROS_LOCALHOST_ONLY', None)
        yield domain


def _reserve_domain() -> tuple[int, socket.socket]:
    for attempt in range(101):
        domain = (os.getpid() + attempt) % 101 + 1
        reservation = socket.socket()
        try:
            reservation.bind(('', 32768 + domain))
        except OSError:
            reservation.close()
        else:
            return domain, reservation
    raise DemoError('all ROS domains of this machine are taken: end other demos or test runs')
