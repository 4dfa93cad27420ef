# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the demo's processes, which all end with the demo, even if it is killed."""

import itertools
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from cliploc_ros.errors import CliplocError

_GRACE_S = 5.0
_POLL_S = 0.05


class DemoError(CliplocError):
    """The demo cannot continue; the message says why."""


class Process:
    """A running process whose output goes to a file."""

    def __init__(self, command: Sequence[object], log: Path) -> None:
        arguments = [str(argument) for argument in command]
        self._name, self._log = Path(arguments[0]).name, log
        with log.open('wb') as output:
            # If the demo is killed, the kernel ends its processes. A preexec_fn would do the same,
            # but may deadlock, because the demo has threads that hold locks while it forks.
            self._popen = subprocess.Popen(
                ['setpriv', '--pdeathsig', 'TERM', *arguments],
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)

    def wait_for_output(self, text: str, patience_s: float) -> None:
        """Wait until the output contains a text.

        DemoError: the process reports an error, ends, or takes longer than patience_s; the message
        quotes its last line.
        """
        deadline = time.monotonic() + patience_s
        while text not in (output := self._log.read_text(errors='replace')):
            if '[ERROR]' in output or time.monotonic() > deadline:
                raise DemoError(f'the {self._name} did not become ready: {self._last_line()}')
            self.check()
            time.sleep(_POLL_S)

    def check(self) -> None:
        """Raise a DemoError if the process has ended."""
        code = self._popen.poll()
        if code is not None:
            raise DemoError(f'the {self._name} ended with exit code {code}: {self._last_line()}')

    def wait(self) -> None:
        """Wait until the process ends."""
        self._popen.wait()

    def end(self) -> None:
        """Terminate the process; kill it after a grace period."""
        self._popen.terminate()
        try:
            self._popen.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()

    def _last_line(self) -> str:
        lines = self._log.read_text(errors='replace').splitlines()
        errors = [line for line in lines if '[ERROR]' in line]
        return f'{(errors or lines or ["no output"])[-1]} (log: {self._log})'


@contextmanager
def running(command: Sequence[object], log: Path) -> Iterator[Process]:
    """Run a program and its arguments inside a with statement; its output goes to a file."""
    process = Process(command, log)
    try:
        yield process
    finally:
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # against a second Ctrl-C
        process.end()
        signal.signal(signal.SIGINT, handler)


def node_command(name: str, parameters: Mapping[str, object]) -> list[object]:
    """Return the command line of an installed node with parameters."""
    settings = [('-p', f'{parameter}:={value}') for parameter, value in parameters.items()]
    return [find_executable(name), '--ros-args', *itertools.chain(*settings)]


def find_executable(name: str) -> Path:
    """Find an executable of the package in the sourced workspace, or in install/.

    DemoError: the package is not installed.
    """
    prefixes = [Path(__file__).parents[1] / 'install']
    try:
        from ament_index_python import get_package_prefix
        prefixes.insert(0, Path(get_package_prefix('cliploc_ros')))
    except (ImportError, LookupError, OSError):
        pass  # no workspace is sourced, or this package is not in it
    for prefix in prefixes:
        if os.access(file := prefix / 'lib' / 'cliploc_ros' / name, os.X_OK):
            return file
    raise DemoError(f'the executable {name} is not installed: run script/setup, then source '
                    'script/env')


def build_map(*arguments: object, **networks: Path) -> None:
    """Build a map with the installed executable, as a user does; DemoError: it fails."""
    command = ['build_map', *map(str, arguments)]
    for name, file in networks.items():
        command += [f'--{name.replace("_", "-")}', str(file)]
    print('$ ' + ' '.join(command), flush=True)
    done = subprocess.run([str(find_executable('build_map')), *command[1:]], check=False)
    if done.returncode:
        raise DemoError(f'build_map ended with exit code {done.returncode}; its message is above')


@contextmanager
def own_ros_domain() -> Iterator[int]:
    """Move this process and its children to a ROS domain of their own; yield the domain.

    A bound port reserves the domain (1 to 101), as in ROS's own ``domain_coordinator``. The
    reservation ends with this process, even if it is killed.
    """
    for attempt in range(101):
        domain, reservation = (os.getpid() + attempt) % 101 + 1, socket.socket()
        try:
            reservation.bind(('', 32768 + domain))
            break
        except OSError:
            reservation.close()
    else:
        raise DemoError('all ROS domains of this machine are in use: end another demo or test run')
    with reservation:
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        # The older name of this variable: with both set, ROS warns.
        os.environ.pop('ROS_LOCALHOST_ONLY', None)
        yield domain
