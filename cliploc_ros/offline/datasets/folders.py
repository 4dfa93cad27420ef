# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folders of images with poses: the table of their layouts, and a reader for all layouts.

This module reads TUM RGB-D, with or without depth, and 7-Scenes; ``devices`` and ``colmap`` read
the others. It converts stored poses to poses in a map: camera axes, unit and vertical. The images
reveal a wrong choice of axes, see agreement.
"""

import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import MILLIMETRE, TUM_UNIT, DepthCamera
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import colmap, devices, frames, parsing
from cliploc_ros.offline.datasets.agreement import AXES, Reading, View, check_agreement, w_first
from cliploc_ros.offline.datasets.poses import TimedPoses, check_clock
from cliploc_ros.offline.datasets.tum import TumSequence, read_image_list, read_tum
from cliploc_ros.offline.mapping.tilt import find_levelling, tilt_note
from cliploc_ros.units import NS_PER_S

# Depth and colour of 7-Scenes are not registered, and its authors give no intrinsics for colour.
# These values align the edges of colour and depth best (measured for this project on RedKitchen).
_SEVEN_SCENES_COLOR = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
_SEVEN_SCENES_DEPTH = DepthCamera(
    585.0, 585.0, 320.0, 240.0,
    transforms.make_transform(np.eye(3), np.array([-0.025, 0.0, 0.0])))
_SEVEN_SCENES_NAME = re.compile(r'frame-(\d+)\.color\.(?:jpe?g|png)')
_SEVEN_SCENES_HZ = 30
# Rotations into a coordinate frame with z up, by the axis that points up.
_UP: Mapping[str, NDArray[np.float64]] = {
    'z': np.eye(3), 'y': np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}
# Greatest coordinate of a pose in a map [m].
_MOST_M = 1e7
# Number of images whose EXIF orientation is checked.
_ORIENTED = 3

_NO_OPTIONS = frames.FolderOptions()
# Bytes at the end of an image that distinguish images of equal size.
_END_BYTES = 4096
# Incomplete layouts: name, a file that identifies the layout, and the file that is missing.
_NEARLY = (('TUM RGB-D', 'groundtruth.txt', 'rgb.txt'), ('TUM RGB-D', 'depth.txt', 'rgb.txt'),
           ('Stray Scanner', 'camera_matrix.csv', 'odometry.csv'),
           ('ARKitScenes', 'lowres_wide', 'lowres_wide.traj'),
           ('7-Scenes', 'frame-*.pose.txt', 'frame-000000.color.jpg'),
           ('Record3D', 'rgbd', 'metadata.json'), ('Polycam', 'mesh_info.json', 'keyframes'),
           ('COLMAP', 'database.db', 'sparse/0 (run its mapper)'))


class Layout(NamedTuple):
    """A layout of folders, and its reader."""

    key: str
    name: str  #: Name in messages
    is_layout: Callable[[Path], bool]  #: Returns whether a folder has this layout
    read: Callable[[Path, frames.FolderOptions], frames.Capture]
    #: The options among intrinsics, trajectory, mount and images that the reader uses; the others
    #: are refused
    takes: tuple[str, ...] = ()


def read_folder(folder: Path, options: frames.FolderOptions = _NO_OPTIONS) -> frames.Frames:
    """Read a folder of any known layout, with poses in metres and OpenCV's camera axes.

    Images are checked against poses, to refuse a wrong choice of axes.

    Raises
    ------
    DatasetError
        The folder has no known layout, or cannot be used; the message gives a remedy.
    """
    layout = find_layout(folder, options.layout)
    if layout is None:
        nearly = next((f'it has {mark} as {name} does, but lacks {lacking}'
                       for name, mark, lacking in _NEARLY
                       if any(folder.glob(mark)) and not (folder / lacking).exists()), '')
        remedy = ('it is a recording: give it as `bag`' if (folder / 'metadata.yaml').is_file()
                  else 'unpack it' if folder.suffix in ('.r3d', '.zip') else nearly or
                  'write rgb.txt, groundtruth.txt and camera.json next to its images, as in TUM '
                  'RGB-D; images without poses need a pose estimator, such as COLMAP')
        known = ', '.join(sorted({layout.name for layout in LAYOUTS}))
        raise DatasetError(f'{folder}: has none of the known layouts ({known}); {remedy}')
    given = {'intrinsics': options.intrinsics, 'trajectory': options.trajectory,
             'mount': options.body_from_camera, 'images': options.images}
    for name, value in given.items():
        if value is not None and name not in layout.takes:
            able = sorted({other.name for other in LAYOUTS if name in other.takes})
            raise DatasetError(f'{folder}: {layout.name} takes no `{name}`: it is for '
                               f'{" and ".join(able)}')
    with parsing.naming(folder, OSError, what='cannot be read: '):
        return _placed(folder, layout, layout.read(folder, options), options)


def read_sequence(folder: Path, intrinsics: str | None) -> tuple[TumSequence, Camera, str]:
    """Read images and poses of a folder of one camera; also return the camera and its source.

    DatasetError: the folder has several cameras, a video, or poses of unknown unit.
    """
    layout = find_layout(folder)
    if layout is None or layout.key == 'rgbd':
        return read_tum(folder), *parsing.find_camera(intrinsics, folder)
    capture = layout.read(folder, frames.FolderOptions(intrinsics))
    cameras = {file.camera for file in capture.files}
    if len(cameras) > 1 or not capture.is_metric or any(
            file.number is not None for file in capture.files):
        raise DatasetError(f'{folder}: {layout.name} with {len(cameras)} cameras: a recording '
                           'needs image files of one camera, and poses in metres')
    files = _place_images(capture.files, capture.axes, map_from_stored=_UP[capture.up or 'z'])
    posed = {file.stamp_ns: file.pose for file in files if file.pose is not None}
    trajectory = TimedPoses.from_samples(
        list(posed), [[*pose[:3, 3], *transforms.quaternion_from_transform(pose)]
                      for pose in posed.values()], str(folder))
    return (TumSequence(folder, tuple(file.stamp_ns for file in files),
                        tuple(file.color for file in files), trajectory), cameras.pop(),
            intrinsics or f'those of {layout.name}')


def find_layout(folder: Path, key: str = '') -> Layout | None:
    """Return the layout of a key, or the first one whose files exist; None if there is none.

    DatasetError: the folder does not exist.
    """
    if not os.path.exists(folder):  # noqa: PTH110 - never raises
        raise DatasetError(f'{folder}: no such folder')
    return next((layout for layout in LAYOUTS
                 if layout.key == key or (not key and layout.is_layout(folder))), None)


def _placed(folder: Path, layout: Layout, capture: frames.Capture, options: frames.FolderOptions
            ) -> frames.Frames:
    """Return the frames of a capture, in the map's coordinate frame."""
    if capture.trajectory is not None:
        if not len(capture.trajectory):
            raise DatasetError(f'{folder}: there are no poses: groundtruth.txt is missing; give '
                               'a `trajectory`')
        check_clock(capture.trajectory, capture.files[0].stamp_ns, capture.files[-1].stamp_ns,
                    str(folder))
    axes, scale, turn = options.axes or capture.axes, options.scale, _UP[capture.up or 'z']
    files = _place_images(capture.files, axes)
    notes = [f'read as {layout.name}: {sum(file.pose is not None for file in files)} of '
             f'{max(len(files), capture.images)} images have poses', *capture.notes,
             check_axes(capture.files, axes, folder)]
    if options.known_distance is not None:
        scale = _find_scale(files, *options.known_distance, folder)
        notes.append(f'a unit is {scale:.5g} m by the known distance')
    if scale is None and not capture.is_metric and not options.any_unit:
        raise DatasetError(f'{folder}: the unit of {layout.name} is unknown: give `scale` (1 for '
                           'metres), a `known_distance` or an `object_size`')
    files = _place_images(capture.files, axes, scale or 1.0, turn)
    poses = np.array([file.pose for file in files if file.pose is not None]).reshape(-1, 4, 4)
    if options.level:
        with parsing.naming(folder, DatasetError):
            rotation, note = find_levelling(poses, True)
        files = _place_images(capture.files, axes, scale or 1.0, rotation @ turn)
        notes.append(note)
    elif not capture.up:
        notes.append(tilt_note(poses))
    form = replace(capture.depth, unit_m=options.depth.unit_m or capture.depth.unit_m,
                   camera=options.depth.camera or capture.depth.camera)
    if not capture.is_metric:  # depth has the unit of the poses
        form = replace(form, scale=1.0 if options.depth.unit_m else form.scale * (scale or 1.0))
    found = frames.folder_frames(folder, files, form)
    flat = sum(file.depth is None for file in files)
    if 0 < flat < len(files):
        notes.append(f'{flat} of {len(files)} images have no depth image taken with them')
    posed = [(file, file.pose) for file in files if file.pose is not None]
    digest = ' '.join(hashlib.sha256(repr(known).encode()).hexdigest()[:12] for known in (
        [(file.color.name, file.stamp_ns, file.camera, _end_of(file.color)) for file, _ in posed],
        [(np.round(pose, 6).tolist(), file.depth and _end_of(file.depth))
         for file, pose in posed]))
    return replace(found, digest=digest, notes=(*filter(None, notes), *found.notes),
                   is_metric=capture.is_metric or scale is not None)


def _end_of(file: Path) -> tuple[int, bytes]:
    """Return the size and the last bytes of an image, which depend on all of its content."""
    try:
        with file.open('rb') as content:
            size = content.seek(0, os.SEEK_END)
            content.seek(max(0, size - _END_BYTES))
            return size, content.read()
    except OSError:  # reported when the image is read
        return 0, b''


def rgbd_frames(folder: Path, options: frames.FolderOptions) -> frames.Frames:
    """Return the frames of a folder with depth: 7-Scenes or TUM RGB-D.

    DatasetError: the folder has neither layout, or poses or intrinsics are missing.
    """
    is_tum = (folder / 'rgb.txt').exists()
    if is_tum and not (folder / 'depth.txt').exists():
        raise DatasetError(f'{folder}: has no depth.txt; map from it as `tum`, without depth')
    return read_folder(folder, replace(options, layout='rgbd' if is_tum else '7scenes'))


def _place_images(files: Sequence[frames.ImageFile], axes: str, scale: float = 1.0,
                 map_from_stored: NDArray[np.float64] = _UP['z']) -> tuple[frames.ImageFile, ...]:
    """Replace the stored poses of images by map_from_camera.

    Parameters
    ----------
    axes : str
        One of AXES.
    scale : float
        Metres per stored unit.
    map_from_stored : ndarray (3, 3)

    Raises
    ------
    DatasetError
        A pose is too far from the origin; the message names its image.
    """
    placed = tuple(file if file.pose is None else file._replace(pose=transforms.move_poses(
        np.array(AXES[axes](file.pose))[None], scale, map_from_stored)[0]) for file in files)
    for file in placed:
        if file.pose is not None and (far := np.abs(file.pose[:3, 3]).max()) > _MOST_M:
            raise DatasetError(f'pose of {file.color} is {far:.3g} m from the origin')
    return placed


def _find_scale(files: Sequence[frames.ImageFile], first: str, second: str, metres: float,
                where: object) -> float:
    """Compute the metres per unit of the poses from the distance between two cameras [m].

    `first` and `second` are the names of the two images. DatasetError: an image is unknown, or
    both were taken at the same place.
    """
    places = []
    for name in (first, second):
        found = [file.pose[:3, 3] for file in files
                 if file.pose is not None and str(file.color).endswith(f'/{name}')]
        if len(found) != 1:
            posed = [file for file in files if file.pose is not None]
            shown = ', '.join(file.color.name for file in posed[:3])
            raise DatasetError(f'{where}: {len(found) or "no"} images with a pose are named {name}'
                               f'; the first images are {shown}')
        places.append(found[0])
    distance = float(np.linalg.norm(places[1] - places[0]))
    if distance < 1e-6:
        raise DatasetError(f'{where}: {first} and {second} were taken at the same place; name two '
                           'images at a known distance')
    return metres / distance


def check_axes(files: Sequence[frames.ImageFile], axes: str, where: object) -> str:
    """Return a note if images and stored poses do not fit; see check_agreement.

    DatasetError: they fit well under another convention; the message names it.
    """
    readings = {name: Reading(f'give `axes` {name}', AXES[name])
                for name in sorted(AXES, key=lambda name: name != axes)}
    readings['quaternions w x y z'] = Reading(
        'name the columns in the first line, such as `# timestamp tx ty tz qw qx qy qz`',
        lambda pose: AXES[axes](w_first(pose)))
    stored = [file for file in files if file.number is None][::max(1, len(files) // _ORIENTED)]
    has_orientation = any(not np.array_equal(
        frames.read_color(file)[0], frames.read_color(file, True)[0]) for file in stored)
    if has_orientation:
        readings['turned by EXIF'] = Reading(
            'rotate the pixels, for example with mogrify -auto-orient', AXES[axes], upright=True)
    note = check_agreement([View(file.pose, partial(frames.read_color, file),
                                 partial(frames.read_color, file, True)) for file in files],
                           readings, where)
    return note or ('the EXIF orientation of the images is ignored: poses and intrinsics must '
                    'refer to the stored pixels' if has_orientation else '')


def _tum(folder: Path, options: frames.FolderOptions, with_depth: bool = True) -> frames.Capture:
    """Read a TUM folder; each image gets the depth image nearest in time."""
    sequence, camera = read_tum(folder), parsing.find_camera(options.intrinsics, folder)[0]
    depths: dict[int, Path] = {}
    if with_depth and (folder / 'depth.txt').exists():
        stamps, paths = read_image_list(folder / 'depth.txt')
        times = np.array(stamps, dtype=np.int64)
        for stamp in sequence.stamps_ns:
            nearest = int(np.argmin(np.abs(times - stamp)))
            if abs(stamps[nearest] - stamp) <= options.tolerance_ns:
                depths[stamp] = paths[nearest]
    trajectory = replace(
        sequence.trajectory if options.trajectory is None else options.trajectory,
        max_gap_ns=options.max_gap_ns, body_from_camera=options.body_from_camera,
        tolerance_ns=options.tolerance_ns)
    return frames.Capture(tuple(
        frames.ImageFile(stamp, path, camera, trajectory.pose_at(stamp), depths.get(stamp))
        for stamp, path in zip(sequence.stamps_ns, sequence.image_paths, strict=True)),
        depth=frames.DepthFormat(TUM_UNIT), trajectory=trajectory)


def _seven_scenes(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read a folder of 7-Scenes; its poses are those of the depth camera."""
    camera = (_SEVEN_SCENES_COLOR if options.intrinsics is None
              else parsing.read_camera(options.intrinsics))
    images = {int(match[1]): path for path in folder.iterdir()
              if (match := _SEVEN_SCENES_NAME.fullmatch(path.name))}
    if not images:
        raise DatasetError(f'{folder}: has neither rgb.txt (TUM RGB-D) nor frame-000000.color.jpg '
                           '(7-Scenes); give a folder of one of these layouts')
    files = []
    depth_camera = options.depth.camera or _SEVEN_SCENES_DEPTH
    depth_from_color = transforms.invert_transform(depth_camera.color_from_depth)
    for number, path in sorted(images.items()):
        stem = path.name.partition('.')[0]
        depth, pose = folder / f'{stem}.depth.png', folder / f'{stem}.pose.txt'
        stamp = number * NS_PER_S // _SEVEN_SCENES_HZ
        map_from_depth = _read_pose(pose) if pose.exists() else None
        files.append(frames.ImageFile(
            stamp, path, camera, None if map_from_depth is None
            else map_from_depth @ depth_from_color, depth if depth.exists() else None))
    if all(file.pose is None for file in files):
        raise DatasetError(f'{folder}: no image has a valid .pose.txt beside it')
    return frames.Capture(tuple(files), depth=frames.DepthFormat(MILLIMETRE, depth_camera))


def _read_pose(path: Path) -> NDArray[np.float64] | None:
    """Read a pose (4, 4); None where tracking was lost: the file has NaN or infinite numbers."""
    rows = [parsing.parse_all(line.partition('#')[0].split(), float, where)
            for where, line in parsing.read_lines(path)]
    if [len(row) for row in rows] != [4] * 4:
        raise DatasetError(f'{path}: is not a 4x4 matrix')
    pose = np.array(rows)
    if not np.isfinite(pose).all():
        return None
    if not transforms.is_rigid(pose, tolerance=1e-3):
        raise DatasetError(f'{path}: is not a rigid transform (rotation and translation [m])')
    return pose


_TUM_TAKES = 'intrinsics', 'trajectory', 'mount'
#: The first layout whose files exist is read. `tum` (TUM RGB-D without depth) is only read if
#: requested.
LAYOUTS = (
    Layout('rgbd', 'TUM RGB-D', lambda folder: (folder / 'rgb.txt').is_file(), _tum, _TUM_TAKES),
    Layout('7scenes', '7-Scenes', lambda folder: any(folder.glob('frame-*.color.*')),
           _seven_scenes, ('intrinsics',)),
    Layout('polycam', 'Polycam', lambda folder: (folder / 'keyframes').is_dir(),
           devices.read_polycam),
    Layout('stray', 'Stray Scanner', lambda folder: (folder / 'odometry.csv').is_file(),
           devices.read_stray),
    Layout('record3d', 'Record3D', lambda folder: bool(devices.metadata_of_record3d(folder)),
           devices.read_record3d),
    Layout('arkitscenes', 'ARKitScenes', lambda folder: (folder / 'lowres_wide.traj').is_file(),
           devices.read_arkitscenes),
    # the output of StreamRecorder, a sample of HoloLens2ForCV
    Layout('hololens', 'HoloLens 2', lambda folder: any(folder.glob('*_pv.txt')),
           devices.read_hololens),
    Layout('nerf', 'transforms.json', lambda folder: folder.name.endswith('.json') or
           (folder / devices.TRANSFORMS).is_file(), devices.read_nerf, ('images',)),
    Layout('colmap', 'COLMAP model', lambda folder: bool(colmap.models_of(folder)),
           colmap.read_colmap, ('images',)),
    Layout('tum', 'TUM RGB-D', lambda folder: False, partial(_tum, with_depth=False),
           _TUM_TAKES))
