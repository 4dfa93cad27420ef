# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What only one process sees: a small disk, numbers of processes."""

import subprocess

import pytest

_MOUNT = ['unshare', '--map-root-user', '--mount', 'sh', '-c',
          'mount -t tmpfs -o size=64k tmpfs "$0" && exec "$@"']


def small_disk(folder) -> list[str]:
    """Return the prefix of a command that runs it with a disk of 64 KiB mounted on a folder.

    The command gets a mount namespace of its own, which needs no privileges; the test is skipped
    where the system forbids that.
    """
    return _tried([*_MOUNT, str(folder)])


def own_numbers() -> list[str]:
    """Return the prefix of a command that runs it as the first process of a container."""
    return _tried(['unshare', '--map-root-user', '--pid', '--fork'])


def _tried(command: list[str]) -> list[str]:
    tried = subprocess.run([*command, 'true'], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f'no namespaces here: {tried.stderr.strip()}')
    return command
