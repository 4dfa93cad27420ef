# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures and options of all tests: shared data, one ROS domain per process, the summary."""

import faulthandler
import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import hypothesis
import numpy as np
import pytest

PROJECT = Path(__file__).resolve().parents[1]
SHARED_DATA = PROJECT.parent / 'shared' / 'data'
# Order of the folders. pytest-xdist gives each worker an equal run of tests; an idle worker takes
# half of another worker's remaining tests.
LONGEST_FIRST = ('nodes', 'demo', 'models', 'studies', 'evaluation', 'mapping', 'cli', 'core')
# Time limit of a test or fixture. The longest take a minute on a busy machine, and several minutes
# in a niced process, which gets a tenth of a core there.
PATIENCE_S = 650 if os.nice(0) else 300
#: Tests that are not run here, by the Python module they need.
NOT_RUN = pytest.StashKey[dict[str, list[str]]]()

# Equal runs draw equal examples. No deadline, since the first call of a kernel compiles it.
hypothesis.settings.register_profile('cliploc_ros', deadline=None, derandomize=True)
hypothesis.settings.load_profile('cliploc_ros')


def reserve_ros_domain() -> tuple[int, socket.socket]:
    """Find a domain (1 to 101) that no other test process on this machine uses.

    The reservation is a bound port, with the port numbers of ROS's own ``domain_coordinator``.
    The system frees it when this process ends, even if it is killed.
    """
    for attempt in range(101):
        domain = (os.getpid() + attempt) % 101 + 1
        reservation = socket.socket()
        try:
            reservation.bind(('', 32768 + domain))
        except OSError:
            reservation.close()
        else:
            return domain, reservation
    raise RuntimeError('other test processes use all ROS domains, 1 to 101')


def pytest_addoption(parser):
    parser.addoption('--no-skips', action='store_true', help='fail the run if a test is skipped')
    parser.addoption('--quick', action='store_true',
                     help='leave out the tests that are marked full or clock, and do not import '
                          'the files that are marked full')
    parser.addoption('--first-cases', action='store_true',
                     help='run only the first case of each parametrized test')


def pytest_ignore_collect(collection_path, config):
    """Leave out a file that is marked full: it may import modules that are not installed."""
    if config.getoption('--quick') and collection_path.suffix == '.py' and re.search(
            r'^pytestmark = .*mark\.full\b', collection_path.read_text(), re.MULTILINE):
        return True
    return None


def pytest_configure(config):
    """Isolate the nodes of the tests from all others; processes inherit this environment."""
    config.stash[NOT_RUN] = {}
    # A shell's background jobs ignore SIGINT, and the processes of the tests would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    domain, config.ros_domain_reservation = reserve_ros_domain()
    os.environ['ROS_DOMAIN_ID'] = str(domain)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    # The older variable for this setting: ROS warns if both are set.
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    # The outputs of networks of an earlier run of the tests are of other code.
    config.recordings = tempfile.TemporaryDirectory()
    os.environ['CLIPLOC_RECORDINGS'] = config.recordings.name
    # As in the nodes: waiting threads of PyTorch sleep instead of spinning.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Deselect tests that need a missing module; sort the others by expected duration."""
    others = {'full', 'clock'} if config.getoption('--quick') else {'brief'}
    wanted = [item for item in items if not others & {mark.name for mark in item.iter_markers()}]
    if config.getoption('--first-cases'):
        first = {item.nodeid.partition('[')[0]: item for item in wanted[::-1]}
        wanted = [*first.values()][::-1]
    config.hook.pytest_deselected(items=[item for item in items if item not in wanted])
    items[:] = wanted
    left_out = [item for item in items if missing_module(item)]
    for item in left_out:
        config.stash[NOT_RUN].setdefault(missing_module(item), []).append(item.nodeid)
    config.hook.pytest_deselected(items=left_out)
    items[:] = sorted((item for item in items if not missing_module(item)), key=place)


def fail_slow_test(_number, _frame):
    faulthandler.dump_traceback(sys.__stderr__)  # dump the stacks of all threads
    pytest.fail(f'the test hangs: it took more than {PATIENCE_S} s')


@pytest.hookimpl(wrapper=True)
def limit_time(item):
    """Stop a test that hangs, so that the others run."""
    signal.signal(signal.SIGALRM, fail_slow_test)
    signal.alarm(PATIENCE_S)
    try:
        return (yield)
    finally:
        signal.alarm(0)


pytest_runtest_setup = pytest_runtest_call = limit_time


def missing_module(item: pytest.Item) -> str | None:
    """Return the first module or program in the test's ``needs`` that is not installed."""
    needed = [name for marker in item.iter_markers('needs') for name in marker.args]
    return next((name for name in needed if importlib.util.find_spec(name) is None
                 and shutil.which(name) is None), None)


def place(item: pytest.Item) -> int:
    folder = item.path.parent.name
    return LONGEST_FIRST.index(folder) if folder in LONGEST_FIRST else len(LONGEST_FIRST)


def pytest_sessionfinish(session, exitstatus):
    config = session.config
    if hasattr(config, 'workeroutput'):  # a worker of pytest-xdist: pytest_testnodedown reads this
        config.workeroutput['not_run'] = config.stash[NOT_RUN]
        return
    reporter = config.pluginmanager.get_plugin('terminalreporter')
    if config.getoption('--no-skips') and count(reporter, 'skipped'):
        reporter.write_line('\nskipped tests fail this run (--no-skips)', red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    """Adopt a worker's list of tests that are not run; every worker has the same list."""
    node.config.stash[NOT_RUN] |= getattr(node, 'workeroutput', {}).get('not_run', {})


def count(reporter, *outcomes: str) -> int:
    return sum(len(reporter.stats.get(outcome, [])) for outcome in outcomes)


def pytest_terminal_summary(terminalreporter, config):
    """Print measurements, the tests not run, and the counts."""
    measured = [report for report in terminalreporter.stats.get('passed', [])
                if report.when == 'call' and report.capstdout.strip()]
    if measured:
        terminalreporter.section('measured')
    for report in measured:
        terminalreporter.write_line(report.nodeid)
        for line in report.capstdout.strip().splitlines():
            terminalreporter.write_line(f'    {line}')
    for report in terminalreporter.stats.get('rerun', []):
        terminalreporter.write_line(f'ran again: {report.nodeid}\n{report.longreprtext}')
    for module, tests in sorted(config.stash[NOT_RUN].items()):
        terminalreporter.write_line(f'not run, {module} is not installed: {", ".join(tests)}')
    passed = count(terminalreporter, 'passed', 'xpassed')
    failed = count(terminalreporter, 'failed', 'error', 'xfailed')
    terminalreporter.write_line(
        f'ran {passed + failed}: {passed} passed, {failed} failed, '
        f'{count(terminalreporter, "skipped")} skipped, {count(terminalreporter, "rerun")} run '
        f'again (NumPy {np.__version__}, OpenCV {cv2.__version__})'
    )


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """Return the folder of recordings and weights beside the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f'the shared data folder is missing: {SHARED_DATA}')
    return SHARED_DATA


@pytest.fixture
def run_here(capsys):
    """Run the main function of an executable in this process, which has done the imports."""
    handler = signal.getsignal(signal.SIGTERM)

    def run(main, *arguments):
        code = main([*map(str, arguments)])
        return subprocess.CompletedProcess(arguments, code, *capsys.readouterr())
    yield run
    signal.signal(signal.SIGTERM, handler)


@pytest.fixture(scope='session')
def executables() -> Path:
    """Return the folder of the installed executables, in the sourced workspace or in install/."""
    from ament_index_python import get_package_prefix

    try:
        prefix = Path(get_package_prefix('cliploc_ros'))
    except (KeyError, OSError):  # no workspace is sourced, or none has the package
        prefix = PROJECT / 'install'
    folder = prefix / 'lib' / 'cliploc_ros'
    assert folder.is_dir(), f'{folder} is missing: run script/setup'
    return folder
