# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Modules of the package as processes of their own, and waiting for what they do."""

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
# How long a test waits for what must come; only failures take so long.
PATIENCE_S = 60.0
# What takes nearly all of a start: two seconds, nine with PyTorch.
_IMPORTS = ['torch', 'torchvision', 'open_clip', 'cliploc_ros.cli.replay',
            'cliploc_ros.nodes.detector', 'cliploc_ros.nodes.relocalizer']


@cache
def _forked():
    """Return what forks processes from one that has imported, and done nothing else."""
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload(_IMPORTS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(PROJECT)  # whose modules these are
        patch.setenv('OMP_WAIT_POLICY', 'PASSIVE')  # run_node's, which PyTorch reads when loaded
        forkserver.ensure_running()
    return context


def _run(module, arguments, log):
    with log.open('w') as output:
        os.dup2(output.fileno(), sys.__stdout__.fileno())
        os.dup2(output.fileno(), sys.__stderr__.fileno())
    sys.argv = [module, *arguments]
    sys.exit(import_module(f'cliploc_ros.{module}').main())


class Fork:
    """A forked process, used as one of subprocess is."""

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
    """A module of the package in its own process, with its output in a file.

    Most are forked from a server that has imported what they import. A fresh one is started as
    its user does, as are those within another command or with an environment of their own.
    """

    def __init__(self, module, arguments, log, fresh=False, within=(), **environment):
        self.log = log
        log.touch()
        arguments = [*map(str, arguments)]
        if fresh or within or environment:
            with log.open('w') as output:
                self._process = subprocess.Popen(
                    [*within, sys.executable, '-m', f'cliploc_ros.{module}', *arguments],
                    stdout=output, stderr=subprocess.STDOUT, cwd=PROJECT,
                    env=os.environ | environment)
        else:
            self._process = Fork(module, arguments, log)

    @property
    def alive(self):
        return self._process.poll() is None

    def output(self):
        return self.log.read_text()

    def sees(self, path):
        """Return where a path of the process, which may have disks of its own, is for others."""
        return self._proc(f'root{path}')

    def wait_for_output(self, text):
        wait_for(lambda: text in self.output() or not self.alive,
                 f'{text!r} in the output:\n{self.output()[-2000:]}')
        assert text in self.output(), self.output()[-2000:]

    def _proc(self, name):
        return Path(f'/proc/{self._process.pid}/{name}')

    def memory_mib(self, field='VmRSS'):
        """Resident memory now, or with VmHWM at its peak [MiB]."""
        return int(self._proc('status').read_text().split(f'{field}:')[1].split()[0]) / 1024

    def descriptors(self):
        """Return how many files, sockets and the like are open."""
        return len(list(self._proc('fd').iterdir()))

    def threads(self):
        """Return how many threads run."""
        return len(list(self._proc('task').iterdir()))

    def wait_for_import(self, library):
        """Wait until a part of a library is in memory: its loading has begun."""
        wait_for(lambda: not self.alive or f'/{library}/' in self._proc('maps').read_text(),
                 f'{library} to be loaded')
        assert self.alive, self.output()

    def cpu_s(self):
        """Processor time used so far [s]."""
        fields = self._proc('stat').read_text().rsplit(')', 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def stop(self, signal_number=signal.SIGINT):
        """Signal the process; return its exit code and how long it took to end [s]."""
        start = time.monotonic()
        if self.alive:
            os.kill(self._process.pid, signal_number)
        try:
            code = self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        return code, time.monotonic() - start


def wait_for(condition, what, patience_s=PATIENCE_S, work=lambda: time.sleep(0.02)):
    """Wait until a condition holds; fail after a time limit."""
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, f'waited {patience_s:g} s for {what}'
        work()
