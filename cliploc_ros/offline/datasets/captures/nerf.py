# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transforms.json of nerfstudio, Instant-NGP and the original NeRF.

Camera axes are OpenGL's: x right, y up, z back. Fields that are not used here are ignored.
"""

import math
from pathlib import Path, PurePosixPath

import numpy as np

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.captures.capture import (
    Capture,
    FolderOptions,
    arrange,
    beside,
    size_of_image,
)
from cliploc_ros.offline.datasets.frames import NO_STAMP, ImageFile
from cliploc_ros.offline.datasets.parsing import Fields, camera_of

FILE = 'transforms.json'
_PERSPECTIVE = ('PINHOLE', 'SIMPLE_PINHOLE', 'SIMPLE_RADIAL', 'RADIAL', 'OPENCV', 'PERSPECTIVE')
_FISHEYE = ('OPENCV_FISHEYE', 'FISHEYE')
_INTRINSICS = ('w', 'h', 'fl_x', 'fl_y', 'cx', 'cy', 'camera_angle_x', 'k1', 'k2', 'k3', 'k4',
               'p1', 'p2', 'camera_model', 'is_fisheye')
_ENDINGS = ('.png', '.jpg', '.jpeg', '.JPG', '.PNG')


def read_nerf(folder: Path, options: FolderOptions) -> Capture:
    """Return the images that a transforms.json lists; the folder may be this file.

    The folder of images holds them by their names alone; None: they are where the file says.
    DatasetError: a field cannot be used; names it.
    """
    path = folder if folder.name.endswith('.json') else folder / FILE
    meta = Fields.of_file(path)
    frames = meta.entries('frames') if 'frames' in meta else []
    if not frames:
        raise DatasetError(f'{path}: lists no frames')
    scale = meta.number('applied_scale', 1.0)
    if scale <= 0.0:
        raise DatasetError(f'{path}: applied_scale is {scale:g}, not above 0')
    files, cameras, images = [], dict[str, Camera](), options.images
    for place, values in enumerate(frames):
        # a frame's own values come before those of all
        frame = Fields(values, f'{path}: frame {place}')
        both = Fields({**{name: value for name, value in meta.values.items() if name != 'frames'},
                       **frame.values}, frame.where)
        name = frame.text('file_path')
        color = path.parent / name if images is None else images / PurePosixPath(name).name
        # the original NeRF leaves the ending of an image away
        color = next((found for end in ('', *_ENDINGS)
                      if (found := beside(color.with_name(color.name + end))) is not None), color)
        shown = repr([both.values.get(name) for name in _INTRINSICS])
        if shown not in cameras:
            cameras[shown] = _camera(both, color)
        pose = both.numbers('transform_matrix', (-1, 4))
        if pose.shape[0] not in (3, 4):
            raise DatasetError(f'{frame.where}: transform_matrix has {pose.shape[0]} rows')
        full = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])[:4]
        full[:3, 3] /= scale
        depth = frame.text('depth_file_path', '')
        files.append(ImageFile(NO_STAMP, color, cameras[shown], full,
                               beside(path.parent / depth) if depth else None))
    arranged = arrange(files, path)
    # depth is in metres, and so are the poses that it goes with
    return Capture(arranged, 'opengl', is_metric=all(one.depth for one in arranged))


def _camera(values: Fields, image: Path) -> Camera:
    """Return the camera of a frame. Pixels are counted from the corner of the first one."""
    where = values.where
    model = values.text('camera_model', 'OPENCV')
    if 'w' in values and 'h' in values:
        width, height = values.size('w', 'h')
    else:
        size = size_of_image(image)
        if size is None:
            raise DatasetError(f'{where}: fields w and h are missing, and {image} cannot be read')
        width, height = size
    if 'fl_x' in values:
        fx = values.number('fl_x')
    elif 'camera_angle_x' in values:
        fx = 0.5 * width / math.tan(0.5 * values.number('camera_angle_x') or math.nan)
    else:
        raise DatasetError(f'{where}: has no intrinsics: neither fl_x nor camera_angle_x')
    fy = values.number('fl_y', fx)
    cx, cy = values.number('cx', 0.5 * width) - 0.5, values.number('cy', 0.5 * height) - 0.5
    k1, k2, k3, k4, p1, p2 = (values.number(name, 0.0)
                              for name in ('k1', 'k2', 'k3', 'k4', 'p1', 'p2'))
    if model in _FISHEYE or values.values.get('is_fisheye') is True:
        return camera_of(where, width, height, fx, fy, cx, cy, 'equidistant',
                         (k1, k2, k3, k4))
    if model not in _PERSPECTIVE or k4:
        raise DatasetError(f'{where}: camera_model {model} ' + ('with k4 ' if k4 else '')
                           + 'is not known here; undistort the images to PINHOLE')
    return camera_of(where, width, height, fx, fy, cx, cy, 'plumb_bob', (k1, k2, p1, p2, k3))
