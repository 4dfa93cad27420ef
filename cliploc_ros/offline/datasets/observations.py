# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Observation files: what a detector said about a recording, and where the camera was.

Mapping, evaluation and the map editor read the same file, so that the networks run once.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import are_rigid
from cliploc_ros.errors import CameraError, DatasetError
from cliploc_ros.files.arrays import FINITE, UNIQUE, ArrayError, Arrays, Check, Field, Schema
from cliploc_ros.offline.datasets.queries import FRAME_FIELDS
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

_OF_CAMERAS = ('camera_names', 'camera_sizes', 'camera_intrinsics', 'camera_rows')


def _check_cameras(name: str, arrays: Arrays) -> None:
    if missing := [one for one in _OF_CAMERAS if one not in arrays]:
        raise ArrayError(f'array {missing[0]} is missing next to {name}')
    if name != 'camera_rows':
        return
    count = len(arrays['camera_names'])
    Check(f'names none of the {count} cameras', lambda rows: (rows < 0) | (rows >= count)
          )(name, arrays)
    if unseen := sorted({*range(count)} - {*arrays[name].tolist()}):
        raise ArrayError(f"no frame is of the camera '{arrays['camera_names'][unseen[0]]}'")


# F frames, n boxes, d numbers of an embedding, C cameras.
_SCHEMA = Schema('observation file', {
    **FRAME_FIELDS,
    'image_size': Field('integers', (2,)),
    'depth_spreads': Field('floats', ('n',), is_optional=True),
    'open_edges': Field('booleans', ('n', 4), is_optional=True),
    # large, and few of the rows are in use at once
    'embeddings': Field('floats', ('n', 'd'), (FINITE,), is_optional=True, stays=True),
    'encoder_key': Field('text', is_optional=True),
    # a row without odometry is NaN
    'odom_from_camera': Field('floats', ('F', 4, 4), (Check(
        'is no rigid transform',
        lambda poses: ~np.isnan(poses).all(axis=(1, 2)) & ~are_rigid(poses)),), is_optional=True),
    'image_counts': Field('integers', (2,), is_optional=True),
    # of several cameras: their names, width and height, fx, fy, cx, cy, and the camera of each
    # frame; image_size and intrinsics_fx_fy_cx_cy are the first one's
    'camera_names': Field('text', ('C',), (UNIQUE, _check_cameras), is_optional=True),
    'camera_sizes': Field('integers', ('C', 2), (_check_cameras,), is_optional=True),
    'camera_intrinsics': Field('numbers', ('C', 4), (FINITE, _check_cameras), is_optional=True),
    'camera_rows': Field('integers', ('F',), (_check_cameras,), is_optional=True),
    'described': Field('text', is_optional=True),
}, DatasetError, 'record the observations again', {'F': 'frames'},
    {'similarities': 'this is a query file: map from an observation file'})

# Of PosedDetections
_OPTIONAL = ('depths', 'depth_spreads', 'embeddings', 'odom_from_camera', 'open_edges')


@dataclass(frozen=True)
class Recorded:
    """Observations and how they came about: F frames."""

    detections: PosedDetections
    stamps_ns: NDArray[np.int64]  #: (F,): exact stamps [ns]
    #: (F,): time that the networks took [ms]; NaN where unknown
    detector_ms: NDArray[np.float64]
    clip_ms: NDArray[np.float64]
    #: Images of the source, and those of them without a pose
    images: int
    without_pose: int
    described: str  #: All that the observations depend on; '' where unknown


def camera_from_numbers(size: NDArray[Any], intrinsics: NDArray[Any]) -> Camera:
    """Return the camera of width and height (2,), and fx, fy, cx, cy (4,).

    CameraError: they are invalid.
    """
    (width, height), (fx, fy, cx, cy) = map(int, size), map(float, intrinsics)
    return Camera(width, height, fx, fy, cx, cy)


def load_observations(path: str | Path) -> PosedDetections:
    """Read and validate an observation file.

    Frames are put in the order of time. A frame may lack boxes; a file may lack frames with boxes
    only if mapping is told so later. DatasetError: the message names the file, the array, what is
    wrong with it, and what to do.
    """
    return load_recorded(path).detections


def load_recorded(path: str | Path) -> Recorded:
    """Read and validate an observation file, and how it came about; see load_observations."""
    arrays = _SCHEMA.read(Path(path))
    try:
        cameras = tuple(camera_from_numbers(*numbers) for numbers in zip(
            arrays.get('camera_sizes', arrays['image_size'][None]),
            arrays.get('camera_intrinsics', arrays['intrinsics_fx_fy_cx_cy'][None]), strict=True))
    except CameraError as error:
        raise _SCHEMA.invalid(Path(path), error) from error
    names, classes = np.unique(arrays['class_ids'], return_inverse=True)
    detections = PosedDetections(
        cameras=cameras, map_from_camera=arrays['map_from_camera'].astype(np.float64),
        stamps_s=arrays['timestamps'].astype(np.float64),
        frame_offsets=arrays['frame_offsets'].astype(np.int64),
        bboxes_xyxy=arrays['boxes_xyxy'].astype(np.float64),
        class_names=tuple(map(str, names)), classes=classes.astype(np.int64).reshape(-1),
        scores=arrays['scores'].astype(np.float64),
        encoder_key=str(arrays.get('encoder_key', '')),
        odom_from_camera=(arrays['odom_from_camera'].astype(np.float64)
                          if 'odom_from_camera' in arrays else None),
        camera_rows=arrays['camera_rows'].astype(np.int64) if 'camera_rows' in arrays else None,
        camera_names=tuple(map(str, arrays.get('camera_names', ('',)))),
        **{name: arrays.get(name) for name in _OPTIONAL if name != 'odom_from_camera'})
    order = np.argsort(detections.stamps_s, kind='stable')
    if (order != np.arange(len(order))).any():
        detections = detections.select_frames(order)
    frames = len(order)
    # a float64 of today's seconds resolves 0.24 us: microseconds are what it still knows
    rounded = np.round(arrays['timestamps'] * 1e6).astype(np.int64) * 1000
    detector_ms, clip_ms = (arrays.get(name, np.full(frames, np.nan)).astype(np.float64)[order]
                            for name in ('detector_ms', 'clip_ms'))
    images, without_pose = arrays.get('image_counts', (frames, 0))
    return Recorded(
        detections, arrays.get('stamps_ns', rounded).astype(np.int64)[order], detector_ms,
        clip_ms, int(images), int(without_pose), str(arrays.get('described', '')))


def save_observations(path: str | Path, detections: PosedDetections) -> None:
    """Write an observation file in one step: an existing file is replaced complete, or stays.

    DatasetError: the detections are malformed, or the file cannot be written.
    """
    _write(Path(path), detections, {})


def save_recorded(path: str | Path, recorded: Recorded) -> None:
    """Write an observation file that says how it came about; see save_observations."""
    _write(Path(path), recorded.detections, {
        'stamps_ns': recorded.stamps_ns, 'detector_ms': recorded.detector_ms,
        'clip_ms': recorded.clip_ms, 'described': np.array(recorded.described),
        'image_counts': np.array([recorded.images, recorded.without_pose])})


def _write(path: Path, detections: PosedDetections, more: Arrays) -> None:
    sizes = np.array([[one.width, one.height] for one in detections.cameras])
    intrinsics = np.array([[one.fx, one.fy, one.cx, one.cy] for one in detections.cameras])
    names = np.array(detections.class_names, dtype=np.str_)
    arrays: dict[str, NDArray[Any]] = {
        'intrinsics_fx_fy_cx_cy': intrinsics[0], 'image_size': sizes[0],
        'frame_offsets': detections.frame_offsets,
        'boxes_xyxy': detections.bboxes_xyxy,
        'class_ids': names[detections.classes] if len(names) else np.empty(0, dtype=np.str_),
        'scores': detections.scores,
        'map_from_camera': detections.map_from_camera,
        'timestamps': detections.stamps_s, **more,
    }
    for name in _OPTIONAL:
        if (values := getattr(detections, name)) is not None:
            arrays[name] = values
    if detections.camera_names != ('',):
        arrays |= {'camera_names': np.array(detections.camera_names), 'camera_sizes': sizes,
                   'camera_intrinsics': intrinsics, 'camera_rows': detections.frame_cameras}
    if detections.encoder_key:
        arrays['encoder_key'] = np.array(detections.encoder_key)
    # embeddings do not compress, and take minutes to try
    _SCHEMA.write(path, arrays, compress='embeddings' not in arrays)
