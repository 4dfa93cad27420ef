# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapped places: which images of a recording are mapped, which are queries, and what is built."""

import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.datasets.folders import FolderOptions, rgbd_frames, tum_frames
from cliploc_ros.datasets.frames import DepthFormat, Frames, RawFrame
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.demo import ASSETS
from cliploc_ros.evaluation.output import make_folder, write_file
from cliploc_ros.mapping.building import build_map
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.recording.networks import Look
from cliploc_ros.recording.recorder import record_every_frame

# Of a rendered room: what is mapped, what is asked, and where second looks come from.
_ROOM_WALKS = (('mapping', 'viewpoints', 'viewpoints_aside'),
               ('mapping', 'other_light', 'other_light_aside'),
               ('one_side', 'other_side', 'other_side'))

Floats = NDArray[np.float64]
Raws = tuple[RawFrame, ...]


@dataclass(frozen=True)
class Place:
    """A part of a site that is mapped, and images of the rest: queries, and their second looks."""

    site: str
    name: str  # begins with the site's
    model: str  # weights of YOLO
    mapped: Raws
    asked: Raws
    seconds: Raws
    map_file: Path | None = None  # None: the map is built of the mapped images

    def build(self, folder: Path, detector: ObjectDetector) -> tuple[LandmarkMap, KeyframeLayer]:
        """Return map and layer; the first time, they are made and kept in a folder."""
        path = folder / f'{self.name.replace("/", ".")}.pickle'
        if not path.exists():
            frames = Frames(Path(self.name), len(self.mapped), lambda is_wanted: (
                raw for raw in self.mapped
                if is_wanted(raw.place, raw.stamp_ns, raw.map_from_camera)))
            if self.map_file is None:
                boxes = record_every_frame(frames, Look(detector)).detections
                landmark_map = build_map(boxes, MappingOptions()).landmark_map
            else:
                landmark_map = LandmarkMap.from_file(self.map_file)
            layer = build_layer(frames, landmark_map, LayerOptions(0.0, 0.0))
            print(f'{self.name}: {len(landmark_map)} landmarks, {len(layer)} keyframes, '
                  f'{len(layer.points)} points', flush=True)
            content = pickle.dumps((landmark_map, layer))
            make_folder(folder)
            write_file(path, lambda partial: partial.write_bytes(content))
        landmark_map, layer = pickle.loads(path.read_bytes())
        return landmark_map, layer


def read_places(where: str, model: str, blocks: Sequence[int]) -> Iterator[Place]:
    """Yield the places of a site.

    Parameters
    ----------
    where : str
        A folder that make_keyframe_rooms made; a TUM folder with a map.yaml, which is mapped
        without depth; or an RGB-D folder. ``DIR@METRES`` gives a TUM folder's unit of depth.
    model : str
        Weights of YOLO for real images.
    blocks : sequence of int
        Besides the interleaved images and the halves, parts of so many images in turn.
    """
    path, _, unit = where.partition('@')
    folder = Path(path)
    if (folder / 'mapping').is_dir():
        for walks in _ROOM_WALKS:
            yield Place(folder.name, f'{folder.name}/{walks[1]}', str(ASSETS / 'yolo.pt'),
                        _walk(folder / walks[0]), _walk(folder / walks[1]),
                        _walk(folder / walks[2]), folder / 'map.yaml')
        return
    map_file = folder / 'map.yaml' if (folder / 'map.yaml').exists() else None
    raws = _walk(folder) if map_file else _upright(_posed(rgbd_frames(
        folder, FolderOptions(depth=DepthFormat(float(unit) if unit else None)))))
    rows = np.arange(len(raws))
    parts = {'interleaved': rows % 2 == 0, 'first half': rows < len(raws) // 2,
             'second half': rows >= len(raws) // 2}
    for size in blocks:
        parts |= {f'blocks of {size}, {which}': rows // size % 2 == rest
                  for rest, which in enumerate(('even', 'odd'))}
    for part, is_mapped in parts.items():
        mapped, asked = (tuple(raws[row] for row in rows[chosen])
                         for chosen in (is_mapped, ~is_mapped))
        yield Place(folder.name, f'{folder.name}/{part}', model, mapped, asked, asked, map_file)


def pose_of(frame: RawFrame) -> Floats:
    """Return map_from_camera (4, 4) of a frame that has one."""
    assert frame.map_from_camera is not None
    return frame.map_from_camera


def _walk(folder: Path) -> Raws:
    """Return the images of a TUM folder, without depth."""
    return _posed(tum_frames(read_tum(folder), find_camera(None, folder)[0]))


def _posed(frames: Frames) -> Raws:
    return tuple(frames.read_raw(lambda place, stamp_ns, pose: pose is not None))


def _upright(raws: Raws) -> Raws:
    """Return images with their poses turned as a whole, until the z axis is up.

    People hold cameras level: the vertical is the direction that the x axes of all cameras have
    least of. The kitchen's own axes are those of its first camera.
    """
    poses = np.array([pose_of(raw) for raw in raws])
    _, _, axes = np.linalg.svd(poses[:, :3, 0])
    up = -axes[2] * np.sign(axes[2] @ poses[:, :3, 1].mean(axis=0))
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    # made exactly rigid: text files round
    rotations = (turn * Rotation.from_matrix(poses[:, :3, :3])).as_matrix()
    return tuple(replace(raw, map_from_camera=make_transform(rotation, turn.apply(pose[:3, 3])))
                 for raw, pose, rotation in zip(raws, poses, rotations, strict=True))
