# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recording of a map: NAME.recording.json next to NAME.yaml.

``check_map`` and the studio use it to find observations and images. Its paths are relative to the
map, so that the folders can be moved together, unless they are in the cache folder.
"""

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cliploc_ros.core.geometry.transforms import is_rigid, make_transform
from cliploc_ros.core.map.parameter_file import check_set, set_of
from cliploc_ros.errors import DatasetError
from cliploc_ros.files import storage
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

# The comments at the head of a map are shorter than this [bytes].
_HEAD = 65_536
_PATHS = ('observations', 'source', 'images')


@dataclass(frozen=True)
class MapRecording:
    """The recording that a map was built from."""

    observations: Path
    source: Path | None = None  #: The bag or folder with the images; None if unknown
    #: For a bag: topics of image and camera_info, and whether images are rectified
    image: str = ''
    camera_info: str = ''
    rectified: bool = False
    #: For a folder: key of the layout, camera, and folder of the images
    layout: str = ''
    intrinsics: str | None = None
    images: Path | None = None
    #: The options that were given for the poses of a folder, see FolderOptions
    placing: dict[str, Any] = field(default_factory=dict)
    #: From poses of the observations to poses in the map: a factor of the positions, then a
    #: rotation (3, 3)
    scale: float = 1.0
    rotation: list[list[float]] = field(default_factory=lambda: np.eye(3).tolist())
    #: Of several recordings with joined observations: names of the cameras of this one, what was
    #: added to its stamps [s], and the further recordings
    cameras: tuple[str, ...] = ()
    later_s: float = 0.0
    others: tuple['MapRecording', ...] = ()
    is_update: bool = False  #: Whether the map was updated with it, and has older landmarks, too

    @property
    def is_moved(self) -> bool:
        """Return whether the poses of the map differ from those of the recording."""
        return self.scale != 1.0 or not np.array_equal(self.rotation, np.eye(3))

    def load(self) -> PosedDetections:
        """Read the observations, with poses in the map; DatasetError: they cannot be read."""
        return load_observations(self.observations).moved(self.scale, np.array(self.rotation))


def recordings_folder() -> Path:
    """Return the folder of the observation files that no option names."""
    named = os.environ.get('CLIPLOC_RECORDINGS')
    return Path(named or storage.resolve_cache_dir('') / 'recordings').resolve()


def recording_path(map_file: Path) -> Path:
    """Return the file that describes the recording of a map."""
    return map_file.with_suffix('.recording.json')


def save_recording(map_file: Path, recording: MapRecording, place: Path | None = None,
                   set_digest: str = '') -> None:
    """Write the recording of a map next to it, or to another file in the same folder.

    CliplocError: the file cannot be written.
    """
    folder = map_file.resolve().parent
    values: dict[str, Any] = asdict(recording) | ({'set': set_digest} if set_digest else {})
    for part in (values, *values['others']):
        for name in (name for name in _PATHS if part[name] is not None):
            path = part[name].resolve()
            part[name] = str(path) if path.is_relative_to(recordings_folder()) else (
                os.path.relpath(path, folder))
    storage.write_text(place or recording_path(map_file), json.dumps(values, indent=1))


def load_recording(map_file: Path) -> MapRecording | None:
    """Read the recording of a map; None if there is none, or if its observations are missing.

    Missing images are None. DatasetError: the file is damaged.
    """
    path, of_map = recording_path(map_file), ''
    try:
        if map_file.exists():
            with storage.open_file(map_file) as file:
                of_map = set_of(file.read(_HEAD).decode(errors='replace')).digest
            storage.finish_set(map_file, of_map)
        if not path.is_file():
            return None
        values = storage.parse_json(storage.read_file(path))
        check_set(str(values.pop('set', '')), of_map)
        for part in (*values.get('others', ()), values):
            for name in (name for name in _PATHS if part.get(name) is not None):
                place = map_file.resolve().parent / part[name]
                part[name] = place if place.exists() else None
        found = MapRecording(**values | {'others': tuple(
            MapRecording(**part) for part in values.get('others', ()))})
        turn = np.array(found.rotation, dtype=float)
        is_valid = turn.shape == (3, 3) and 0.0 < found.scale < np.inf and is_rigid(
            make_transform(turn, np.zeros(3)))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}; remove it') from error
    if not is_valid:
        raise DatasetError(f'{path}: has no valid scale and rotation; remove it')
    return None if found.observations is None else found
