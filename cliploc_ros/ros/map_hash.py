# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The hash that names a map in answers and diagnostics: which one a robot of a fleet has."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from rclpy.node import Node

from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError
from cliploc_ros.ros.map_parameters import load_map

_DIGITS = 12
# A file that is replaced while it is read is read again.
_ATTEMPTS = 3


def load_hashed_map(node: Node, files: Sequence[str]) -> tuple[LandmarkMap, str]:
    """Load one map or several and return them with their hash.

    The hash is the beginning of what `cat FILE... | sha256sum` prints. A map in parameters has
    the hash of its landmarks.

    Raises
    ------
    MapError
        See load_map; or a file changes again and again.
    """
    for _ in range(_ATTEMPTS):
        before = _hash_of(files)
        landmark_map = load_map(node, files)
        if not files:
            content = b''.join([
                repr((landmark_map.frame_id, landmark_map.landmark_ids, landmark_map.labels,
                      landmark_map.class_ids)).encode(),
                landmark_map.centers.tobytes(), landmark_map.semi_axes.tobytes(),
                landmark_map.quats_xyzw.tobytes()])
            return landmark_map, _hash(content)
        if before == _hash_of(files):
            return landmark_map, before
    raise MapError(f'{", ".join(files)}: changes while it is read: write another file and '
                   'rename it')


def _hash_of(files: Sequence[str]) -> str:
    """Return the hash of files; empty where load_map says what is wrong."""
    try:
        return _hash(b''.join(Path(file).read_bytes() for file in files))
    except (OSError, ValueError):
        return ''


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
