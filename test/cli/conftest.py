# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the executables' tests."""

import subprocess

import pytest
from executables import PROJECT, Listener, command, write_sequence

from cliploc_ros.offline.datasets.observations import load_observations, save_observations


@pytest.fixture
def start():
    """Start an executable in a separate process; kill it at the end if it is still running."""
    processes = []

    def start_process(module: str, *args: object, **options) -> subprocess.Popen:
        process = subprocess.Popen(command(module, *args), cwd=PROJECT, text=True,
                                   stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
        processes.append(process)
        return process

    yield start_process
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture
def make_sequence(tmp_path):
    """Write a small TUM folder."""
    return lambda **options: write_sequence(tmp_path / 'sequence', **options)


@pytest.fixture(scope='session')
def observations(shared_data, tmp_path_factory):
    """Return every sixteenth frame of the office: enough for a map, and fast."""
    whole = load_observations(shared_data / 'tum_fr3_office' / 'observations.npz')
    path = tmp_path_factory.mktemp('office') / 'office.npz'
    save_observations(path, whole.select_frames(range(0, len(whole), 16)))
    return path


@pytest.fixture
def listener():
    listener = Listener()
    yield listener
    listener.close()
