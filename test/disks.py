# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A small disk that only one process sees."""

import subprocess

import pytest

_MOUNT = ['unshare', '--map-root-user', '--mount', 'sh', '-c',
          'mount -t tmpfs -o size=64k tmpfs "$0" && exec "$@"']


def small_disk(folder) -> list[str]:
    """Return the prefix of a command that runs it with a disk of 64 KiB mounted on a folder.

    The command gets a mount namespace of its own, which needs no privileges; the test is skipped
    where the system forbids that.
    """
    command = [*_MOUNT, str(folder)]
    tried = subprocess.run([*command, 'true'], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f'no mount namespaces here: {tried.stderr.strip()}')
    return command
