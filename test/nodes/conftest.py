# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: nodes as processes, and the test's node that exchanges messages with them."""

import pytest
import rclpy
from processes import Process
from scene import make_room, write_map
from tester import Tester, class_matching


@pytest.fixture(scope='session')
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture(scope='module')
def tester(ros):
    node = Tester()
    yield node
    node.destroy_node()


@pytest.fixture(autouse=True)
def forget(tester):
    tester.forget()


@pytest.fixture(scope='session')
def room_map(tmp_path_factory):
    path = tmp_path_factory.mktemp('room') / 'map.yaml'
    write_map(make_room(), path)
    return path


def starter(folder):
    """Return a function that starts modules as processes, and the list of these processes."""
    started = []

    def run(module, *arguments, parameters=None, **options):
        ros_arguments = ['--ros-args'] if parameters is not None else []
        for name, value in (parameters or {}).items():
            ros_arguments += ['-p', f'{name}:={value}']
        process = Process(module, [*arguments, *ros_arguments],
                          folder / f'{module}_{len(started)}.log', **options)
        started.append(process)
        return process
    return run, started


@pytest.fixture
def start(tmp_path):
    """Start modules of the package as processes; stop them at the end of the test."""
    run, started = starter(tmp_path)
    yield run
    for process in started:
        process.stop()


@pytest.fixture(scope='module')
def start_shared(tmp_path_factory):
    """Start modules as processes that the tests of a module share."""
    run, started = starter(tmp_path_factory.mktemp('shared'))
    yield run
    for process in started:
        process.stop()


@pytest.fixture(scope='module')
def relocalizer(start_shared, tester, room_map):
    """Return a relocalizer that matches by class in the simulated room, ready for requests."""
    process = start_shared('nodes.relocalizer', parameters=class_matching(room_map))
    process.wait_for_output('ready after')
    tester.connect()
    yield process
    assert process.alive, process.output()
    assert 'Traceback' not in process.output()


@pytest.fixture
def own_relocalizer(start, tester, room_map):
    """Start a relocalizer with the test's parameters; wait until it is ready or logs an error."""
    def run(*arguments, expect='ready after', fresh=False, **parameters):
        process = start('nodes.relocalizer', *arguments, fresh=fresh,
                        parameters=class_matching(room_map, **parameters))
        process.wait_for_output(expect)
        tester.connect()
        return process
    return run
