# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of phones and headsets: Polycam, Record3D, Stray Scanner, ARKitScenes, HoloLens 2.

Their trackers measure in metres and know the vertical: ARKit and HoloLens have y up.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.depth_image import MILLIMETRE
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.captures.capture import (
    IMAGES,
    Capture,
    Fields,
    Shot,
    arrange,
    beside,
    camera_of,
    pose_of,
    read_rows,
    read_text,
)
from cliploc_ros.offline.datasets.frames import DepthFormat
from cliploc_ros.offline.datasets.poses import TimedPoses
from cliploc_ros.units import NS_PER_S

_IN_MILLIMETRES = DepthFormat(MILLIMETRE)
# HoloLens counts 100 ns from 1601, ROS from 1970.
_TICK_NS, _TICKS_TO_1970 = 100, 116_444_736_000_000_000
# ARKitScenes rounds the times of its files to a millisecond.
_ROUNDING_S = 0.001
# Its poses come at 10 Hz, its images up to 60 Hz.
_MAX_GAP_NS = 200_000_000


def is_polycam(folder: Path) -> bool:
    """Return whether a folder is Polycam's raw data."""
    return (folder / 'keyframes').is_dir()


def read_polycam(folder: Path) -> Capture:
    """Return the keyframes of Polycam's raw data, the optimized ones where there are any."""
    root, kind = folder / 'keyframes', 'corrected_'
    if not ((root / 'corrected_images').is_dir() and (root / 'corrected_cameras').is_dir()):
        kind = ''
    shots = []
    for path in sorted((root / f'{kind}cameras').glob('*.json')):
        fields = Fields.of_file(path)
        pose = np.eye(4)
        pose[:3] = [[fields.number(f't_{row}{column}') for column in range(4)]
                    for row in range(3)]
        camera = camera_of(str(path), *fields.size('width', 'height'), *(
            fields.number(name) for name in ('fx', 'fy', 'cx', 'cy')))
        depth = beside(root / 'depth' / f'{path.stem}.png')
        shots.append(Shot(
            root / f'{kind}images' / f'{path.stem}.jpg', camera, pose, 1000 * int(path.stem)
            if path.stem.isdecimal() and len(path.stem) < 20 else None, depth,
            depth and beside(root / 'confidence' / f'{path.stem}.png')))
    files, poses = arrange(shots, str(root))
    notes = () if kind else ('its poses are not optimized: they drift as ARKit does',)
    return Capture(files, poses, 'opengl', _IN_MILLIMETRES, 'y', notes=notes)


def is_record3d(folder: Path) -> bool:
    """Return whether a folder is an unpacked .r3d file, or an export of Record3D."""
    return _metadata(folder) is not None and any(
        (folder / name).is_dir() for name in ('rgbd', 'rgb'))


def read_record3d(folder: Path) -> Capture:
    """Return the images of Record3D. Its depth is compressed in a way that is not read here."""
    path = _metadata(folder)
    assert path is not None
    meta = Fields.of_file(path)
    size = meta.size('w', 'h')
    matrix = meta.numbers('K', (-1,), [])
    rows = meta.numbers('poses', (-1, 7))
    own = (meta.numbers('perFrameIntrinsicCoeffs', (-1, 4))
           if meta.values.get('perFrameIntrinsicCoeffs') else None)
    if own is None:
        if len(matrix) != 9:
            raise DatasetError(f'{path}: has no intrinsics: K has {len(matrix)} numbers, not 9')
        own = np.tile(matrix[[0, 4, 6, 7]], (len(rows), 1))  # K is column after column
    times = meta.numbers('frameTimestamps', (-1,), [])
    images = folder / ('rgbd' if (folder / 'rgbd').is_dir() else 'rgb')
    shots = []
    for place, (pose, (fx, fy, cx, cy)) in enumerate(zip(rows, own, strict=False)):
        color = next((found for end in IMAGES if (found := beside(images / f'{place}{end}'))),
                     images / f'{place}.jpg')
        where = f'{path}: frame {place}'
        shots.append(Shot(
            color, camera_of(where, *size, float(fx), float(fy), float(cx), float(cy)),
            pose_of(pose[4:], pose[:4], where),
            _stamp_ns(times[place]) if place < len(times) else None))
    files, poses = arrange(shots, str(path))
    return Capture(files, poses, 'opengl', up='y', notes=(
        'the depth of Record3D is not read: it is compressed by LZFSE or EXR',))


def _metadata(folder: Path) -> Path | None:
    return beside(folder / 'metadata') or beside(folder / 'metadata.json')


def is_stray(folder: Path) -> bool:
    """Return whether a folder is of Stray Scanner."""
    return (folder / 'odometry.csv').is_file()


def read_stray(folder: Path) -> Capture:
    """Return the images of Stray Scanner: of its video, or of rgb/, where they were unpacked to.

    Its quaternions are of OpenCV's camera axes.
    """
    table, path = read_rows(folder / 'odometry.csv', 9, ',', header=1), folder / 'odometry.csv'
    matrix = read_rows(folder / 'camera_matrix.csv', 3, ',')
    if len(matrix) != 3:
        raise DatasetError(f'{folder}/camera_matrix.csv has {len(matrix)} rows, expected 3')
    video = beside(folder / 'rgb.mp4')
    camera = camera_of(str(folder / 'camera_matrix.csv'), *_size_of(folder, video),
                       matrix[0][0], matrix[1][1], matrix[0][2], matrix[1][2])
    shots = []
    for place, (time_s, frame, *numbers) in enumerate(table):
        stem = f'{frame:06.0f}'
        image = next((found for end in IMAGES
                      if (found := beside(folder / 'rgb' / f'{stem}{end}'))), None)
        depth = beside(folder / 'depth' / f'{stem}.png')
        shots.append(Shot(
            image or video or folder / 'rgb' / f'{stem}.jpg', camera,
            pose_of(numbers[:3], numbers[3:7], f'{path}: row {place}'), _stamp_ns(time_s), depth,
            depth and beside(folder / 'confidence' / f'{stem}.png'),
            place if image is None and video is not None else None))
    files, poses = arrange(shots, str(path))
    return Capture(files, poses, 'opencv', _IN_MILLIMETRES, 'y')


def _size_of(folder: Path, video: Path | None) -> tuple[int, int]:
    """Return width and height of the images of Stray Scanner, which no file tells."""
    first = next((one for one in sorted((folder / 'rgb').glob('*.*'))
                  if one.suffix in IMAGES), None)
    image = None
    if first is not None:
        image = cv2.imread(str(first), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    elif video is not None:
        image = cv2.VideoCapture(str(video)).read()[1]
    if image is None:
        raise DatasetError(f'{folder}: has no images that can be read: neither rgb.mp4 nor rgb/')
    return image.shape[1], image.shape[0]


def is_arkitscenes(folder: Path) -> bool:
    """Return whether a folder is a scan of ARKitScenes."""
    return (folder / 'lowres_wide.traj').is_file()


def read_arkitscenes(folder: Path) -> Capture:
    """Return a scan of ARKitScenes: camera_from_map of OpenCV's axes as axis and angle, z up."""
    path = folder / 'lowres_wide.traj'
    rows = np.array([row[:7] for row in read_rows(path, 7)]).reshape(-1, 7)
    if not np.isfinite(rows).all():
        raise DatasetError(f'{path}: has numbers that are not finite')
    poses = [invert_transform(make_transform(Rotation.from_rotvec(row[1:4]).as_matrix(), row[4:]))
             for row in rows]
    known = TimedPoses.from_samples(
        [_stamp_ns(row[0]) or 0 for row in rows],
        [[*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in poses],
        str(path))
    known = replace(known, max_gap_ns=_MAX_GAP_NS)
    kind = 'vga_wide' if (folder / 'vga_wide').is_dir() else 'lowres_wide'
    shots = []
    for color in sorted((folder / kind).glob('*.png')):
        scan, _, time = color.stem.rpartition('_')
        stamp = _stamp_ns(float(time)) if time.replace('.', '', 1).isdecimal() else None
        camera = _pincam(folder / f'{kind}_intrinsics', scan, float(time)
                         ) if stamp is not None else None
        if stamp is None or camera is None:
            continue
        depth = beside(folder / 'lowres_depth' / color.name)
        shots.append(Shot(color, camera, known.pose_at(stamp), stamp, depth,
                          depth and beside(folder / 'confidence' / color.name)))
    files, stamped = arrange(shots, str(folder))
    return Capture(files, stamped, 'opencv', _IN_MILLIMETRES, 'z')


def _pincam(folder: Path, scan: str, time_s: float) -> Camera | None:
    """Return the camera of an image; None without its file, whose time may be rounded."""
    for shift_s in (0.0, -_ROUNDING_S, _ROUNDING_S):
        path = beside(folder / f'{scan}_{time_s + shift_s:.3f}.pincam')
        if path is not None:
            rows = read_rows(path, 6)
            if not rows or not np.isfinite(rows[0]).all():
                raise DatasetError(f'{path}: expected width height fx fy cx cy')
            width, height, *intrinsics = rows[0][:6]
            return camera_of(str(path), round(width), round(height), *intrinsics)
    return None


def is_hololens(folder: Path) -> bool:
    """Return whether a folder is of HoloLens2ForCV's StreamRecorder."""
    return next(folder.glob('*_pv.txt'), None) is not None


def read_hololens(folder: Path) -> Capture:
    """Return the images of the photo-video camera, unpacked and converted to PNG by the sample.

    Its long-throw depth needs a table of rays and is not read here.
    """
    path = min(folder.glob('*_pv.txt'))
    images = folder / ('PV' if (folder / 'PV').is_dir() else 'rgb')
    header, *rows = read_rows(path, 4, ',') or [[]]
    if not rows or not np.isfinite(header).all():
        raise DatasetError(f'{path}: expected cx,cy,width,height and a row for each image')
    cx, cy, width, height = header[:4]
    # a float does not hold their 18 digits, which name the images
    times = [line.partition(',')[0].strip() for line in read_text(path).splitlines()
             if line.strip()][1:]
    shots = []
    for place, (time, row) in enumerate(zip(times, rows, strict=True), start=2):
        if len(row) < 19 or not (time.isdecimal() and len(time) < 20):
            raise DatasetError(f'{path}: row {place}: expected time, fx, fy and the 16 numbers of '
                               'the pose')
        camera = camera_of(f'{path}: row {place}', round(width), round(height), row[1], row[2],
                           cx, cy)
        pose = np.array(row[3:19]).reshape(4, 4)
        shots.append(Shot(images / f'{time}.png', camera, pose if pose.any() else None,
                          _TICK_NS * (int(time) - _TICKS_TO_1970)))
    files, poses = arrange(shots, str(path))
    return Capture(files, poses, 'opengl', up='y', notes=(
        'the depth of the HoloLens is not read: it needs its table of rays',))


def _stamp_ns(time_s: float) -> int | None:
    """Return a time [s] in nanoseconds; None where it is none."""
    return round(time_s * NS_PER_S) if abs(time_s) < 1e15 else None
