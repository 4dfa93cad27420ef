# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start modules of the package as processes, and wait for conditions."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import cache
from importlib import import_module
from multiprocessing import forkserver
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
# Time limit of a wait. Only a failing test takes this long.
PATIENCE_S = 60.0
# These imports take most of the start-up time.
_IMPORTS = ['cliploc_ros.cli.replay', 'cliploc_ros.nodes.detector',
            'cliploc_ros.nodes.relocalizer', 'cliploc_ros.ros.clients']


@cache
def _forked():
    """Return a context that forks processes from a server with the imports done."""
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload(_IMPORTS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(PROJECT)  # so that it imports the source tree
        forkserver.ensure_running()
    return context


def _run(module, arguments, log):
    with log.open('w') as output:
        os.dup2(output.fileno(), sys.__stdout__.fileno())
        os.dup2(output.fileno(), sys.__stderr__.fileno())
    sys.argv = [module, *arguments]
    sys.exit(import_module(f'cliploc_ros.{module}').main())


class Fork:
    """A forked process with the interface of subprocess.Popen."""

    def __init__(self, module, arguments, log):
        self._process = _forked().Process(target=_run, args=(module, arguments, log), daemon=True)
        self._process.start()
        self.pid = self._process.pid
        self.kill = self._process.kill

    def poll(self):
        return self._process.exitcode

    def wait(self, timeout=None):
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout)
        return self.poll()


class Process:
    """A module of the package in a separate process, with its output in a file.

    By default it is forked from a server with the imports done. With ``fresh``, or with
    environment variables, it starts in a new interpreter, as for a user.
    """

    def __init__(self, module, arguments, log, fresh=False, **environment):
        self.log = log
        log.touch()
        arguments = [*map(str, arguments)]
        if fresh or environment:
            with log.open('w') as output:
                self._process = subprocess.Popen(
                    [sys.executable, '-m', f'cliploc_ros.{module}', *arguments],
                    stdout=output, stderr=subprocess.STDOUT, cwd=PROJECT,
                    env=os.environ | environment)
        else:
            self._process = Fork(module, arguments, log)

    @property
    def alive(self):
        return self._process.poll() is None

    def output(self):
        return self.log.read_text()

    def wait_for_output(self, text):
        wait_for(lambda: text in self.output() or not self.alive,
                 f'{text!r} in the output:\n{self.output()[-2000:]}')
        assert text in self.output(), self.output()[-2000:]

    def _proc(self, name):
        return Path(f'/proc/{self._process.pid}/{name}')

    def memory_mib(self, field='VmRSS'):
        """Return the resident memory, or with VmHWM its peak [MiB]."""
        return int(self._proc('status').read_text().split(f'{field}:')[1].split()[0]) / 1024

    def descriptors(self):
        """Return the number of open file descriptors."""
        return len(list(self._proc('fd').iterdir()))

    def threads(self):
        """Return the number of threads."""
        return len(list(self._proc('task').iterdir()))

    def send(self, number):
        """Send a signal."""
        os.kill(self._process.pid, number)

    def stop(self, signal_number=signal.SIGINT):
        """Signal the process; return its exit code and the time until it ended [s]."""
        start = time.monotonic()
        if self.alive:
            self.send(signal_number)
        try:
            code = self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        return code, time.monotonic() - start


def wait_for(condition, what, patience_s=PATIENCE_S, work=lambda: time.sleep(0.02)):
    """Wait until a condition holds; fail at the time limit."""
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, f'waited {patience_s:g} s for {what}'
        work()
