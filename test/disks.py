# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A disk of its own for one process: so small that it is full, and seen by nobody else."""

import subprocess

import pytest

_MOUNT = ['unshare', '--map-root-user', '--mount', 'sh', '-c',
          'mount -t tmpfs -o size=64k tmpfs "$0" && exec "$@"']


def small_disk(folder) -> list[str]:
    """Return what runs a command with a disk of 64 KiB in place of a folder.

    In a mount namespace of its own, which asks for no privileges; where the system forbids these
    the test is skipped.
    """
    command = [*_MOUNT, str(folder)]
    tried = subprocess.run([*command, 'true'], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f'no mount namespaces here: {tried.stderr.strip()}')
    return command
