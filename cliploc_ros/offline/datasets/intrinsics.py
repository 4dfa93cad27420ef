# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera intrinsics: presets of the TUM sequences, or a camera.json of the user."""

import re
from collections.abc import Mapping
from pathlib import Path

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.parsing import Fields, camera_of


def _tum_camera(fx: float, fy: float, cx: float, cy: float, *distortion: float) -> Camera:
    return Camera(640, 480, fx, fy, cx, cy, 'plumb_bob', distortion)


#: The published values of the dataset (ROS calibration of the colour cameras).
PRESETS: Mapping[str, Camera] = {
    'fr1': _tum_camera(517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    'fr2': _tum_camera(520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    'fr3': _tum_camera(535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}

_SEQUENCE_NAME = re.compile(r'(?<![a-z])(?:freiburg|fr)([123])(?![0-9])', re.IGNORECASE)


def find_camera(choice: str | None, folder: Path) -> tuple[Camera, str]:
    """Return the camera of a sequence, and the source of its intrinsics, as a text for the user.

    DatasetError: neither choice nor folder determines the camera, or the file is invalid.

    Parameters
    ----------
    choice : str or None
        A preset's name (fr1, fr2, fr3), a camera.json, or None for the folder's
        ``camera.json`` or, without one, the TUM camera that the folder's name contains.
    folder : Path
        The sequence's folder.
    """
    if choice is not None and choice in PRESETS:
        return PRESETS[choice], f'preset {choice}'
    if choice is not None:
        return read_camera(choice), choice
    if (folder / 'camera.json').exists():
        return read_camera(folder / 'camera.json'), str(folder / 'camera.json')
    match = _SEQUENCE_NAME.search(folder.resolve().name)
    if match is None:
        raise DatasetError(f'{folder}: has no camera.json, and its name contains no TUM '
                           'camera; put a camera.json there, or give `intrinsics`: a '
                           'camera.json, or fr1, fr2, fr3')
    return PRESETS[f'fr{match[1]}'], f"preset fr{match[1]}, from the folder's name"


def read_camera(path: str | Path) -> Camera:
    """Read a camera.json.

    The file is a mapping of ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` [px] and, for a
    lens with distortion, ``distortion_model`` and its coefficients ``d``. DatasetError: a field is
    missing, unknown or invalid; the message names file and field.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f'{path}: no such camera file; give fr1, fr2, fr3 or a camera.json')
    fields = Fields.of_file(path)
    numbers = ('fx', 'fy', 'cx', 'cy')
    if unknown := sorted(set(fields.values) - {
            'width', 'height', *numbers, 'distortion_model', 'd'}):
        raise DatasetError(f'{path}: unknown field {unknown[0]!r}')
    return camera_of(str(path), *fields.size('width', 'height'), *map(fields.number, numbers),
                     fields.text('distortion_model', 'plumb_bob'),
                     tuple(fields.numbers('d', (-1,), []).tolist()))
