# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Environments for single processes: a small or read-only disk."""

import subprocess

import pytest

_MOUNT = ['unshare', '--map-root-user', '--mount', 'sh', '-c',
          'mount -t tmpfs -o "$0" tmpfs "$1" && shift && exec "$@"']


def small_disk(folder) -> list[str]:
    """Return the prefix of a command that runs it with a disk of 64 KiB mounted on a folder.

    The command gets a separate mount namespace, which needs no privileges; the test is skipped if
    the system forbids that.
    """
    return allowed([*_MOUNT, 'size=64k', str(folder)])


def read_only_disk(folder) -> list[str]:
    """Return the prefix of a command that runs it with an empty read-only disk on a folder."""
    return allowed([*_MOUNT, 'ro', str(folder)])


def allowed(command: list[str]) -> list[str]:
    """Return the prefix of a command; skip the test if the system forbids its namespaces."""
    tried = subprocess.run([*command, 'true'], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f'no namespaces here: {tried.stderr.strip()}')
    return command
