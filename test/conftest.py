# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What all tests share: the data beside the project, a ROS domain of their own, the counts."""

import os
import signal
import socket
from pathlib import Path

import cv2
import hypothesis
import numpy as np
import pytest

PROJECT = Path(__file__).resolve().parents[1]
SHARED_DATA = PROJECT.parent / 'shared' / 'data'

# Equal runs draw equal examples; the first call of a compiled kernel would break any deadline.
hypothesis.settings.register_profile('cliploc_ros', deadline=None, derandomize=True)
hypothesis.settings.load_profile('cliploc_ros')


def reserve_ros_domain() -> tuple[int, socket.socket]:
    """Find a domain (1 to 101) that no other test run on this machine uses.

    The reservation is a bound port, as in ROS's own ``domain_coordinator``, whose port numbers
    these are: it ends with this process, however that ends.
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
    raise RuntimeError('all ROS domains are taken by other test runs')


def pytest_addoption(parser):
    parser.addoption('--no-skips', action='store_true', help='a skipped test fails the run')


def pytest_configure(config):
    """Keep the tests' nodes, which inherit the environment, away from every other node."""
    # A shell lets what it runs in the background ignore Ctrl-C, and so would our processes.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    domain, config.ros_domain_reservation = reserve_ros_domain()
    os.environ['ROS_DOMAIN_ID'] = str(domain)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    # The older name of the same; where both are set, ROS warns.
    os.environ.pop('ROS_LOCALHOST_ONLY', None)


def count(reporter, *outcomes: str) -> int:
    return sum(len(reporter.stats.get(outcome, [])) for outcome in outcomes)


def pytest_terminal_summary(terminalreporter):
    """Print what tests measured, and one line of counts, which script/test repeats at its end."""
    measured = [report for report in terminalreporter.stats.get('passed', [])
                if report.when == 'call' and report.capstdout.strip()]
    if measured:
        terminalreporter.section('measured')
    for report in measured:
        terminalreporter.write_line(report.nodeid)
        for line in report.capstdout.strip().splitlines():
            terminalreporter.write_line(f'    {line}')
    passed = count(terminalreporter, 'passed', 'xpassed')
    failed = count(terminalreporter, 'failed', 'error', 'xfailed')
    terminalreporter.write_line(
        f'ran {passed + failed}: {passed} passed, {failed} failed, '
        f'{count(terminalreporter, "skipped")} skipped '
        f'(NumPy {np.__version__}, OpenCV {cv2.__version__})'
    )


def pytest_sessionfinish(session, exitstatus):
    reporter = session.config.pluginmanager.get_plugin('terminalreporter')
    if session.config.getoption('--no-skips') and count(reporter, 'skipped'):
        reporter.write_line('\nskipped tests fail this run (--no-skips)', red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """The folder of real recordings and weights beside the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f'needs the shared data folder, {SHARED_DATA} is absent')
    return SHARED_DATA


@pytest.fixture(scope='session')
def executables() -> Path:
    """The folder of the installed executables: of the sourced workspace, or what setup left."""
    from ament_index_python import get_package_prefix

    try:
        prefix = Path(get_package_prefix('cliploc_ros'))
    except (KeyError, OSError):  # not in any sourced workspace; none sourced
        prefix = PROJECT / 'install'
    folder = prefix / 'lib' / 'cliploc_ros'
    assert folder.is_dir(), f'{folder} is missing: run script/setup'
    return folder
