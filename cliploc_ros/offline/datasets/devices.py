# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of phones and headsets, and the transforms.json of nerfstudio and Instant-NGP.

The devices are Polycam, Record3D, Stray Scanner, ARKitScenes and HoloLens 2. Their trackers
measure in metres and know the vertical; y is up for ARKit and HoloLens. A transforms.json has
OpenGL's camera axes: x right, y up, z backward. Unused fields are ignored.
"""

import math
from dataclasses import replace
from pathlib import Path, PureWindowsPath

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import MILLIMETRE
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import frames, parsing
from cliploc_ros.offline.datasets.poses import TimedPoses
from cliploc_ros.units import NS_PER_S

_IN_MILLIMETRES = frames.DepthFormat(MILLIMETRE)
# HoloLens counts ticks of 100 ns since 1601; ROS counts from 1970.
_TICK_NS, _TICKS_TO_1970 = 100, 116_444_736_000_000_000
# ARKitScenes rounds the times in its file names to a millisecond.
_ROUNDING_S = 0.001
# ARKitScenes has poses at 10 Hz, and images at up to 60 Hz.
_MAX_GAP_NS = 200_000_000


def read_polycam(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read the keyframes of Polycam's raw data, with optimized poses if there are any."""
    root, kind = folder / 'keyframes', 'corrected_'
    if not ((root / 'corrected_images').is_dir() and (root / 'corrected_cameras').is_dir()):
        kind = ''
    files = []
    for path in sorted((root / f'{kind}cameras').glob('*.json')):
        fields = parsing.Fields.of_file(path)
        pose = np.eye(4)
        pose[:3] = [[fields.number(f't_{row}{column}') for column in range(4)] for row in range(3)]
        camera = parsing.camera_of(str(path), *fields.size('width', 'height'), *(
            fields.number(name) for name in ('fx', 'fy', 'cx', 'cy')))
        is_stamp = path.stem.isdecimal() and len(path.stem) < 20
        files.append(_with_depth(
            frames.ImageFile(1000 * int(path.stem) if is_stamp else frames.NO_STAMP,
                             root / f'{kind}images' / f'{path.stem}.jpg', camera, pose),
            root / 'depth', root / 'confidence', path.stem))
    notes = () if kind else ('its poses are not optimized: they have the drift of ARKit',)
    return frames.Capture.of(files, root, 'opengl', _IN_MILLIMETRES, 'y', notes=notes)


def _with_depth(image: frames.ImageFile, depths: Path, confidences: Path, stem: str
                ) -> frames.ImageFile:
    """Add the depth and confidence images of a stem to an image, if they exist."""
    depth = frames.beside(depths / f'{stem}.png')
    return image._replace(depth=depth,
                          confidence=depth and frames.beside(confidences / f'{stem}.png'))


def read_record3d(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read the images of Record3D; its compressed depth is not supported."""
    path = metadata_of_record3d(folder)
    assert path is not None
    meta = parsing.Fields.of_file(path)
    size = meta.size('w', 'h')
    matrix = meta.numbers('K', (-1,), [])
    rows = meta.numbers('poses', (-1, 7))
    own = (meta.numbers('perFrameIntrinsicCoeffs', (-1, 4))
           if meta.values.get('perFrameIntrinsicCoeffs') else None)
    if own is None:
        if len(matrix) != 9:
            raise DatasetError(f'{path}: has no intrinsics: K has {len(matrix)} numbers, not 9')
        own = np.tile(matrix[[0, 4, 6, 7]], (len(rows), 1))  # K is stored by columns
    times = meta.numbers('frameTimestamps', (-1,), [])
    images = folder / ('rgbd' if (folder / 'rgbd').is_dir() else 'rgb')
    files = []
    for place, (pose, intrinsics) in enumerate(zip(rows, own, strict=False)):
        where = f'{path}: frame {place}'
        files.append(frames.ImageFile(
            _stamp_ns(times[place]) if place < len(times) else frames.NO_STAMP,
            frames.first_image(images, str(place)) or images / f'{place}.jpg',
            parsing.camera_of(where, *size, *intrinsics.tolist()),
            parsing.pose_of(pose[4:], pose[:4], where)))
    return frames.Capture.of(files, path, 'opengl', up='y', notes=(
        'the depth of Record3D is not read: it is compressed with LZFSE or EXR',))


def metadata_of_record3d(folder: Path) -> Path | None:
    """Return the metadata file of an unpacked .r3d or an export of Record3D; None if missing."""
    if not any((folder / name).is_dir() for name in ('rgbd', 'rgb')):
        return None
    return frames.beside(folder / 'metadata') or frames.beside(folder / 'metadata.json')


def read_stray(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read the images of Stray Scanner, from its video or from rgb/ if it was unpacked there.

    The quaternions refer to OpenCV's camera axes.
    """
    path, lens = folder / 'odometry.csv', folder / 'camera_matrix.csv'
    table = parsing.read_cells(path, 'timestamp frame x y z qx qy qz qw ...', header=1)
    matrix = parsing.read_numbers(lens, 'fx 0 cx ...')
    if len(matrix) != 3:
        raise DatasetError(f'{lens} has {len(matrix)} rows, expected 3')
    video = frames.beside(folder / 'rgb.mp4')
    camera = parsing.camera_of(str(lens), *_size_of(folder, video), matrix[0][0], matrix[1][1],
                               matrix[0][2], matrix[1][2])
    files = []
    for place, (where, cells) in enumerate(table):
        time_s, frame, *numbers = parsing.parse_all(cells, float, where)
        stem = f'{frame:06.0f}'
        image = frames.first_image(folder / 'rgb', stem)
        files.append(_with_depth(
            frames.ImageFile(
                _stamp_ns(time_s), image or video or folder / 'rgb' / f'{stem}.jpg', camera,
                parsing.pose_of(numbers[:3], numbers[3:7], where),
                number=place if image is None and video is not None else None),
            folder / 'depth', folder / 'confidence', stem))
    return frames.Capture.of(files, path, 'opencv', _IN_MILLIMETRES, 'y')


def _size_of(folder: Path, video: Path | None) -> tuple[int, int]:
    """Read width and height of Stray Scanner's images from the first image: no file has them."""
    first = next((file for file in sorted((folder / 'rgb').glob('*.*'))
                  if file.suffix in frames.IMAGES), None)
    size = None
    if first is not None:
        size = frames.size_of_image(first)
    elif video is not None and (image := cv2.VideoCapture(str(video)).read()[1]) is not None:
        size = image.shape[1], image.shape[0]
    if size is None:
        raise DatasetError(f'{folder}: has no readable images: neither rgb.mp4 nor rgb/')
    return size


def read_arkitscenes(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read a scan of ARKitScenes.

    The file of poses has camera_from_map as rotation vector and translation, with OpenCV's camera
    axes. z is up.
    """
    path = folder / 'lowres_wide.traj'
    lines = parsing.read_numbers(path, 'timestamp rx ry rz tx ty tz ...')
    rows = np.array([line[:7] for line in lines]).reshape(-1, 7)
    if not np.isfinite(rows).all():
        raise DatasetError(f'{path}: has numbers that are not finite')
    poses = [invert_transform(make_transform(Rotation.from_rotvec(row[1:4]).as_matrix(), row[4:]))
             for row in rows]
    known = TimedPoses.from_samples(
        [max(0, _stamp_ns(row[0])) for row in rows],
        [[*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in poses],
        str(path))
    known = replace(known, max_gap_ns=_MAX_GAP_NS)
    kind = 'vga_wide' if (folder / 'vga_wide').is_dir() else 'lowres_wide'
    files, without = [], list[Path]()
    for color in sorted((folder / kind).glob('*.png')):
        scan, _, time = color.stem.rpartition('_')
        if not time.replace('.', '', 1).isdecimal():
            continue
        stamp = _stamp_ns(float(time))
        camera = _pincam(folder / f'{kind}_intrinsics', scan, float(time))
        if camera is None:
            without.append(color)
        elif stamp != frames.NO_STAMP:
            files.append(_with_depth(frames.ImageFile(stamp, color, camera, known.pose_at(stamp)),
                                     folder / 'lowres_depth', folder / 'confidence', color.stem))
    return frames.Capture.of(files, folder, 'opencv', _IN_MILLIMETRES, 'z', notes=(
        [f'{len(without)} images have no file of intrinsics and are left out, such as '
         f'{without[0]}'] if without else []))


def _pincam(folder: Path, scan: str, time_s: float) -> Camera | None:
    """Read the camera of an image, from a file whose time may be rounded; None if missing."""
    for shift_s in (0.0, -_ROUNDING_S, _ROUNDING_S):
        path = frames.beside(folder / f'{scan}_{time_s + shift_s:.3f}.pincam')
        if path is not None:
            rows = parsing.read_numbers(path, 'width height fx fy cx cy ...')
            if not rows or not np.isfinite(rows[0]).all():
                raise DatasetError(f'{path}: expected width height fx fy cx cy')
            width, height, *intrinsics = rows[0][:6]
            return parsing.camera_of(str(path), round(width), round(height), *intrinsics)
    return None


def read_hololens(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read the images of the photo-video camera, unpacked and converted to PNG by the sample.

    Long-throw depth needs a table of rays and is not supported.
    """
    path = min(folder.glob('*_pv.txt'))
    images = folder / ('PV' if (folder / 'PV').is_dir() else 'rgb')
    lines = list(parsing.read_cells(path, 'cx cy width height ...'))
    header = parsing.parse_all(lines[0][1], float, lines[0][0]) if lines else []
    if len(lines) < 2 or not np.isfinite(header).all():
        raise DatasetError(f'{path}: expected cx,cy,width,height and a row for each image')
    cx, cy, width, height = header[:4]
    files = []
    for where, (time, *cells) in lines[1:]:
        row = parsing.parse_all(cells, float, where)
        # the time names the image; a float cannot hold its 18 digits
        if len(row) < 18 or not (time.isdecimal() and len(time) < 20):
            raise DatasetError(f'{where}: expected time, fx, fy and the 16 numbers of the pose')
        pose = np.array(row[2:18]).reshape(4, 4)
        files.append(frames.ImageFile(
            _TICK_NS * (int(time) - _TICKS_TO_1970), images / f'{time}.png',
            parsing.camera_of(where, round(width), round(height), row[0], row[1], cx, cy),
            pose if pose.any() else None))
    return frames.Capture.of(files, path, 'opengl', up='y', notes=(
        'the depth of the HoloLens is not read: it needs its table of rays',))


def _stamp_ns(time_s: float) -> int:
    """Convert a time [s] to nanoseconds; frames.NO_STAMP if it is out of range."""
    return round(time_s * NS_PER_S) if abs(time_s) < 1e15 else frames.NO_STAMP


TRANSFORMS = 'transforms.json'
_SAME_FOCAL = 1.02  # greatest ratio of the focal lengths in two fields, which are rounded
_PERSPECTIVE = ('PINHOLE', 'SIMPLE_PINHOLE', 'SIMPLE_RADIAL', 'RADIAL', 'OPENCV', 'PERSPECTIVE')
_FISHEYE = ('OPENCV_FISHEYE', 'FISHEYE')
_INTRINSICS = ('w', 'h', 'fl_x', 'fl_y', 'cx', 'cy', 'camera_angle_x', 'k1', 'k2', 'k3', 'k4',
               'p1', 'p2', 'camera_model', 'is_fisheye')
_IMAGE_FOLDERS = ('images', 'input', '.')
_ENDINGS = ('.png', '.jpg', '.jpeg', '.JPG', '.PNG')


def read_nerf(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read the images listed in a transforms.json; `folder` may be that file.

    The file is that of nerfstudio, Instant-NGP or the original NeRF. If a folder of images is
    given, they are looked up there by name; otherwise the paths of the file are used.
    DatasetError: a field is invalid; the message names it.
    """
    path = folder if folder.name.endswith('.json') else folder / TRANSFORMS
    meta = parsing.Fields.of_file(path)
    listed = meta.entries('frames') if 'frames' in meta else []
    if not listed:
        raise DatasetError(f'{path}: lists no frames')
    scale = meta.number('applied_scale', 1.0)
    if scale <= 0.0:
        raise DatasetError(f'{path}: applied_scale is {scale:g}, not above 0')
    files, cameras, images = [], dict[str, Camera](), options.images
    for place, values in enumerate(listed):
        # values of a frame override those of the file
        frame = parsing.Fields(values, f'{path}: frame {place}')
        both = parsing.Fields({**meta.values, 'frames': None, **frame.values}, frame.where)
        name = frame.text('file_path')
        color = _file_of(path.parent, name, images)
        shown = repr([both.values.get(name) for name in _INTRINSICS])
        if shown not in cameras:
            cameras[shown] = _camera(both, color)
        pose = both.numbers('transform_matrix', (-1, 4))
        if pose.shape[0] not in (3, 4):
            raise DatasetError(f'{frame.where}: transform_matrix has {pose.shape[0]} rows')
        full = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])[:4]
        full[:3, 3] /= scale
        depth = frame.text('depth_file_path', frame.text('depth_path', ''))
        files.append(frames.ImageFile(frames.NO_STAMP, color, cameras[shown], full,
                                      _file_of(path.parent, depth, None) if depth else None))
    # depth has the unit of the poses: metres, or the arbitrary unit of COLMAP; no field gives it
    unit = next((meta.number(name) for name in ('depth_unit_scale_factor', 'integer_depth_scale')
                 if name in meta), None)
    if unit is not None and unit <= 0.0:
        raise DatasetError(f'{path}: the unit of depth is {unit:g}, not above 0')
    return frames.Capture.of(files, path, 'opengl', frames.DepthFormat(unit, scale=1.0 / scale),
                             is_metric=False)


def _file_of(folder: Path, name: str, images: Path | None) -> Path:
    """Find the image file of a name in a transforms.json, which may be a path of Windows.

    If a folder of images is given, or the path does not exist, only the last part of the name is
    used.
    """
    alone = PureWindowsPath(name).name  # splits at / and at \\
    within = name.replace('\\', '/')
    paths = [folder / name, folder / within,
             *(folder / images_folder / alone for images_folder in _IMAGE_FOLDERS)]
    if images is not None:
        paths = [images / within, images / alone]
    # the original NeRF omits the endings of images
    endings = [Path(f'{path}{end}') for path in paths for end in ('', *_ENDINGS)]
    return next(filter(None, map(frames.beside, endings)), paths[0])


def _camera(values: parsing.Fields, image: Path) -> Camera:
    """Return the camera of a frame; the pixel origin of the file is a corner, not a centre."""
    where = values.where
    model = values.text('camera_model', 'OPENCV')
    if 'w' in values and 'h' in values:
        width, height = values.size('w', 'h')
    else:
        size = frames.size_of_image(image)
        if size is None:
            raise DatasetError(f'{where}: fields w and h are missing, and {image} cannot be read')
        width, height = size
    if 'fl_x' in values:
        fx = values.number('fl_x')
    elif 'camera_angle_x' in values:
        fx = 0.5 * width / math.tan(0.5 * values.number('camera_angle_x') or math.nan)
    else:
        raise DatasetError(f'{where}: has no intrinsics: neither fl_x nor camera_angle_x')
    fy = values.number('fl_y', fx) if math.isfinite(fx) else fx
    for name, side, focal_px in (('camera_angle_x', width, fx), ('camera_angle_y', height, fy)):
        angle = values.number(name, 0.0)
        by_angle = 0.5 * side / math.tan(0.5 * angle) if angle else focal_px
        if focal_px > 0.0 and not 1.0 / _SAME_FOCAL < by_angle / focal_px < _SAME_FOCAL:
            raise DatasetError(f'{where}: has two focal lengths: {focal_px:.5g} px, and '
                               f'{by_angle:.5g} px by {name}: correct or remove the wrong one')
    cx, cy = values.number('cx', 0.5 * width) - 0.5, values.number('cy', 0.5 * height) - 0.5
    k1, k2, k3, k4, p1, p2 = (values.number(name, 0.0)
                              for name in ('k1', 'k2', 'k3', 'k4', 'p1', 'p2'))
    if model in _FISHEYE or values.values.get('is_fisheye') is True:
        return parsing.camera_of(where, width, height, fx, fy, cx, cy, 'equidistant',
                                 (k1, k2, k3, k4))
    if model not in _PERSPECTIVE or k4:
        raise DatasetError(f'{where}: camera_model {model} ' + ('with k4 ' if k4 else '')
                           + 'is not supported; undistort the images to PINHOLE')
    return parsing.camera_of(where, width, height, fx, fy, cx, cy, 'plumb_bob',
                             (k1, k2, p1, p2, k3))
