# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapped places: which images of a recording are mapped, which are queries, and what is built."""

import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.datasets.folders import FolderOptions, rgbd_frames, tum_frames
from cliploc_ros.datasets.frames import DepthFormat, Frames, RawFrame
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.evaluation.output import make_folder, write_file
from cliploc_ros.mapping.building import build_map
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.recording.networks import Look
from cliploc_ros.recording.recorder import record_every_frame

#: Weights of YOLO for rendered rooms.
ROOM_MODEL = Path(__file__).parents[2] / 'cliploc_ros' / 'demo' / 'assets' / 'yolo.pt'
_EVERY_IMAGE = LayerOptions(0.0, 0.0)
# Of a rendered room: what is mapped, what is asked, and where second looks come from.
_ROOM_WALKS = (('mapping', 'viewpoints', 'viewpoints_aside'),
               ('mapping', 'other_light', 'other_light_aside'),
               ('one_side', 'other_side', 'other_side'))

Raws = tuple[RawFrame, ...]


@dataclass(frozen=True)
class Place:
    """A part of a site that is mapped.

    Parameters
    ----------
    site, name : str
        The name is unique and begins with the site's.
    model : str
        Weights of YOLO.
    mapped, asked, seconds : tuple of RawFrame
        What map and layer are made of, the queries, and images for second looks of these.
    map_file : Path, optional
        None: the map is built of the mapped images.
    """

    site: str
    name: str
    model: str
    mapped: Raws
    asked: Raws
    seconds: Raws
    map_file: Path | None = None

    def build(self, folder: Path, detector: ObjectDetector) -> tuple[LandmarkMap, KeyframeLayer]:
        """Return map and layer; the first time, they are made and kept in a folder."""
        path = folder / f'{self.name.replace("/", ".")}.pickle'
        if not path.exists():
            frames = _frames(self.mapped, self.name)
            landmark_map = build_map(
                record_every_frame(frames, Look(detector)).detections, MappingOptions()
            ).landmark_map if self.map_file is None else LandmarkMap.from_file(self.map_file)
            built = landmark_map, build_layer(frames, landmark_map, _EVERY_IMAGE)
            make_folder(folder)
            write_file(path, lambda partial: partial.write_bytes(pickle.dumps(built)))
            print(f'{self.name}: {len(built[0])} landmarks, {len(built[1])} keyframes, '
                  f'{len(built[1].points)} points', flush=True)
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
            mapped, asked, seconds = (_walk(folder / walk) for walk in walks)
            yield Place(folder.name, f'{folder.name}/{walks[1]}', str(ROOM_MODEL), mapped, asked,
                        seconds, folder / 'map.yaml')
        return
    map_file = folder / 'map.yaml'
    raws = _walk(folder) if map_file.exists() else _upright(_posed(rgbd_frames(
        folder, FolderOptions(depth=DepthFormat(float(unit) if unit else None)))))
    rows = np.arange(len(raws))
    half = len(raws) // 2
    parts = {'interleaved': rows % 2 == 0, 'first half': rows < half,
             'second half': rows >= half}
    for size in blocks:
        parts |= {f'blocks of {size}, {which}': rows // size % 2 == rest
                  for rest, which in enumerate(('even', 'odd'))}
    for part, is_mapped in parts.items():
        mapped = tuple(raws[row] for row in rows[is_mapped])
        asked = tuple(raws[row] for row in rows[~is_mapped])
        yield Place(folder.name, f'{folder.name}/{part}', model, mapped, asked, asked,
                    map_file if map_file.exists() else None)


def _walk(folder: Path) -> Raws:
    """Return the images of a TUM folder, without depth."""
    return _posed(tum_frames(read_tum(folder), find_camera(None, folder)[0]))


def _posed(frames: Frames) -> Raws:
    return tuple(frames.read_raw(lambda place, stamp_ns, pose: pose is not None))


def _frames(raws: Raws, name: str) -> Frames:
    return Frames(Path(name), len(raws), lambda is_wanted: (
        raw for raw in raws if is_wanted(raw.place, raw.stamp_ns, raw.map_from_camera)))


def _upright(raws: Raws) -> Raws:
    """Return images with their poses turned as a whole, until the z axis is up.

    People hold cameras level: the vertical is the direction that the x axes of all cameras have
    least of. The kitchen's own axes are those of its first camera.
    """
    poses = np.array([raw.map_from_camera for raw in raws])
    _, _, axes = np.linalg.svd(poses[:, :3, 0])
    up = -axes[2] * np.sign(axes[2] @ poses[:, :3, 1].mean(axis=0))
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    # made exactly rigid: text files round
    rotations = (turn * Rotation.from_matrix(poses[:, :3, :3])).as_matrix()
    return tuple(replace(raw, map_from_camera=make_transform(rotation, turn.apply(pose[:3, 3])))
                 for raw, pose, rotation in zip(raws, poses, rotations, strict=True))
