# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folders of images with poses: TUM RGB-D, with or without depth, and 7-Scenes."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    is_rigid,
    make_transform,
)
from cliploc_ros.datasets.depth import MILLIMETRE, TUM_UNIT, DepthCamera
from cliploc_ros.datasets.frames import DepthFormat, Frames, ImageFile, folder_frames
from cliploc_ros.datasets.intrinsics import find_camera, read_camera
from cliploc_ros.datasets.poses import Poses, TimedPoses
from cliploc_ros.datasets.tum import TumSequence, read_image_list, read_tum
from cliploc_ros.errors import DatasetError
from cliploc_ros.units import NS_PER_S

# Colour images of 7-Scenes are not registered, and its authors give no intrinsics for them. These
# values make the edges of colour and depth agree best (measured for this project on RedKitchen).
_SEVEN_SCENES_COLOR = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
_SEVEN_SCENES_DEPTH = DepthCamera(585.0, 585.0, 320.0, 240.0,
                                  make_transform(np.eye(3), np.array([-0.025, 0.0, 0.0])))
_SEVEN_SCENES_NAME = re.compile(r'frame-(\d+)\.color\.(?:jpe?g|png)')
_SEVEN_SCENES_HZ = 30
_MAX_DEPTH_DELAY_NS = 20_000_000
_NO_CHANGE = DepthFormat()


@dataclass(frozen=True)
class FolderOptions:
    """What a folder does not say itself."""

    intrinsics: str | None = None  #: Name of a preset, or a camera.json; None: the folder's own
    trajectory: TimedPoses | None = None  #: Poses instead of the folder's own
    max_gap_ns: int = 0  #: Greatest gap between two poses to interpolate over [ns]
    #: (4, 4): how the camera is mounted on what the poses are of
    body_from_camera: NDArray[np.float64] | None = None
    depth: DepthFormat = _NO_CHANGE  #: What differs from the folder's usual format


def tum_frames(sequence: TumSequence, camera: Camera, options: FolderOptions | None = None
               ) -> Frames:
    """Return the frames of a TUM folder, taken by one camera; without depth.

    DatasetError: there are no poses, or they are of another time.
    """
    files = [ImageFile(stamp, path) for stamp, path in
             zip(sequence.stamps_ns, sequence.image_paths, strict=True)]
    return folder_frames(sequence.folder, files, _poses(sequence, options or FolderOptions()),
                         camera)


def rgbd_frames(folder: Path, options: FolderOptions) -> Frames:
    """Return the frames of a folder with depth: of 7-Scenes, or TUM RGB-D.

    DatasetError: the folder has neither layout, or poses and intrinsics are missing.
    """
    if not folder.is_dir():
        raise DatasetError(f'{folder}: no such folder')
    if not (folder / 'rgb.txt').exists():
        return _seven_scenes_frames(folder, options)
    sequence = read_tum(folder)
    if not (folder / 'depth.txt').exists():
        raise DatasetError(f'{folder}: has no depth.txt; map from it with --tum, without depth')
    stamps, paths = read_image_list(folder / 'depth.txt')
    times = np.array(stamps, dtype=np.int64)
    files = []
    for stamp, path in zip(sequence.stamps_ns, sequence.image_paths, strict=True):
        nearest = int(np.argmin(np.abs(times - stamp)))
        near = abs(stamps[nearest] - stamp) <= _MAX_DEPTH_DELAY_NS
        files.append(ImageFile(stamp, path, paths[nearest] if near else None))
    camera = find_camera(options.intrinsics, folder)[0]
    form = replace(options.depth, unit_m=options.depth.unit_m or TUM_UNIT)
    return folder_frames(folder, files, _poses(sequence, options), camera, form)


def _seven_scenes_frames(folder: Path, options: FolderOptions) -> Frames:
    """Return the frames of 7-Scenes, whose poses are the depth camera's."""
    images = {int(match[1]): path for path in folder.iterdir()
              if (match := _SEVEN_SCENES_NAME.fullmatch(path.name))}
    if not images:
        raise DatasetError(f'{folder}: has neither rgb.txt (TUM RGB-D) nor frame-000000.color.jpg '
                           '(7-Scenes); give a folder of one of these layouts')
    files, poses = [], {}
    form = DepthFormat(options.depth.unit_m or MILLIMETRE,
                       options.depth.camera or _SEVEN_SCENES_DEPTH)
    assert form.camera is not None
    depth_from_color = invert_transform(form.camera.color_from_depth)
    for number, path in sorted(images.items()):
        stem = path.name.partition('.')[0]
        depth, pose = folder / f'{stem}.depth.png', folder / f'{stem}.pose.txt'
        stamp = number * NS_PER_S // _SEVEN_SCENES_HZ
        files.append(ImageFile(stamp, path, depth if depth.exists() else None))
        map_from_depth = _read_pose(pose) if pose.exists() else None
        if map_from_depth is not None:
            poses[stamp] = map_from_depth @ depth_from_color
    camera = (_SEVEN_SCENES_COLOR if options.intrinsics is None
              else read_camera(options.intrinsics))
    if not poses:
        raise DatasetError(f'{folder}: no image has a valid .pose.txt beside it')
    return folder_frames(folder, files, _StampedPoses(poses), camera, form)


@dataclass(frozen=True)
class _StampedPoses:
    """Poses of the images themselves, which need no interpolation."""

    poses: dict[int, NDArray[np.float64]]

    @property
    def span_ns(self) -> tuple[int, int]:
        return min(self.poses), max(self.poses)

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        return self.poses.get(stamp_ns)


def _read_pose(path: Path) -> NDArray[np.float64] | None:
    """Return a pose (4, 4); None where tracking was lost, which is written as NaN or infinite."""
    try:
        pose = np.loadtxt(path, dtype=np.float64)
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: is no 4x4 matrix: {error}') from error
    if pose.shape != (4, 4):
        raise DatasetError(f'{path}: is no 4x4 matrix, its shape is {pose.shape}')
    if not np.isfinite(pose).all():
        return None
    if not is_rigid(pose, tolerance=1e-3):
        raise DatasetError(f'{path}: is no rigid transform (rotation and translation [m])')
    return pose


def _poses(sequence: TumSequence, options: FolderOptions) -> Poses:
    trajectory = sequence.trajectory if options.trajectory is None else options.trajectory
    if len(trajectory) == 0:
        raise DatasetError(f'{sequence.folder}: there are no poses: no groundtruth.txt here; give '
                           '--trajectory FILE')
    return replace(trajectory, max_gap_ns=options.max_gap_ns,
                   body_from_camera=options.body_from_camera)
