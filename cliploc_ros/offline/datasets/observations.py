# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Observation and query files: recorded boxes and camera poses.

The networks run once: mapping, evaluation and the map editor read the same observations. A query
file also holds the similarities to a map's labels, so that all methods get identical input.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import are_rigid
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.errors import CameraError, DatasetError
from cliploc_ros.files import arrays as npz
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.units import NS_PER_S

_NOT_NEGATIVE = npz.Check('is negative or infinite',
                          lambda values: (values < 0) | np.isinf(values))


def _check_stamps(name: str, arrays: npz.Arrays) -> None:
    seconds = arrays['timestamps']
    npz.Check('contradicts timestamps',
              lambda stamps_ns: np.abs(stamps_ns / NS_PER_S - seconds) > 1e-6)(name, arrays)


#: Fields of files of frames with boxes: F frames, n boxes.
FRAME_FIELDS = {
    'intrinsics_fx_fy_cx_cy': npz.Field('numbers', (4,), (npz.FINITE, npz.Check(
        'has a focal length that is not above 0',
        lambda numbers: (numbers <= 0) & (np.arange(4) < 2)))),
    'boxes_xyxy': npz.Field('numbers', ('n', 4), (npz.FINITE, npz.BOX)),
    'frame_offsets': npz.Field('integers', ('F+1',), (npz.Offsets('boxes_xyxy', 'boxes'),)),
    'class_ids': npz.Field('text', ('n',)),
    'scores': npz.Field('numbers', ('n',), (npz.FINITE, npz.SHARE)),
    'timestamps': npz.Field('numbers', ('F',), (npz.FINITE,)),
    'map_from_camera': npz.Field('numbers', ('F', 4, 4), (npz.FINITE, npz.Check(
        'is not a rigid transform', lambda poses: ~are_rigid(poses)))),
    # NaN where unknown [m]
    'depths': npz.Field('floats', ('n',), (npz.Check(
        'is not positive and finite', lambda depths: (depths <= 0.0) | np.isinf(depths)),),
        is_optional=True),
    # exact, unlike a float64 of seconds [ns]
    'stamps_ns': npz.Field('integers', ('F',), (_check_stamps,), is_optional=True),
}


def _check_truth(name: str, arrays: npz.Arrays) -> None:
    landmarks = len(arrays['landmark_ids'])
    npz.Check('is not a landmark', lambda rows: (rows < -1) | (rows >= landmarks))(name, arrays)


def _check_groups(name: str, arrays: npz.Arrays) -> None:
    groups = arrays['query_group']
    for group in np.unique(groups):
        mains = int(arrays[name][groups == group].sum())
        if mains != 1:
            raise npz.ArrayError(f'array {name} marks {mains} frames of query_group {group}, '
                                 'not 1')


# F frames, n boxes, L landmarks.
_QUERIES = npz.Schema('query file', {
    'landmark_ids': npz.Field('text', ('L',), (
        npz.UNIQUE, npz.Check('is empty', lambda ids: ids == ''))),
    **FRAME_FIELDS,
    'image_size': npz.Field('integers', (2,), (npz.Check(
        'is not above 0', lambda sides: sides <= 0),), is_optional=True),
    # half precision rounds some cosines to just above 1
    'similarities': npz.Field('numbers', ('n', 'L'), (npz.FINITE, npz.Check(
        'is not a cosine, outside -1 to 1', lambda rows: (np.abs(rows) > 1.001).any(axis=1)))),
    'true_landmark': npz.Field('integers', ('n',), (_check_truth,)),
    'timestamps': npz.Field('numbers', ('F',), (
        npz.FINITE, npz.Check('is negative', lambda seconds: seconds < 0))),
    'query_group': npz.Field('integers', ('F',)),
    'is_main': npz.Field('booleans', ('F',), (_check_groups,)),
}, DatasetError, not_empty={'F': 'frames', 'L': 'landmarks'}, others={
    'image_size': 'this is an observation file: make a query file with evaluate --save-queries'})


@dataclass(frozen=True)
class Queries:
    """The content of a query file."""

    landmark_ids: tuple[str, ...]  #: The landmark of each column of the similarities
    frames: tuple[PosedQuery, ...]  #: In the file's order; all have the same camera


def _stamps_ns(arrays: npz.Arrays) -> NDArray[np.int64]:
    """Return the exact stamps (F,) [ns]; without them, the float64 seconds rounded to 1 us.

    A float64 of today's seconds has a resolution of 0.24 us.
    """
    rounded = np.round(arrays['timestamps'].astype(np.float64) * 1e6).astype(np.int64) * 1000
    return arrays.get('stamps_ns', rounded).astype(np.int64)


def load_queries(path: str | Path) -> Queries:
    """Read and validate a query file; DatasetError: the message names file, array and error."""
    arrays = _QUERIES.read(Path(path))
    # files of older releases lack the size of the image
    size = 2 * arrays['intrinsics_fx_fy_cx_cy'][2:]
    camera = camera_from_numbers(arrays.get('image_size', size.round().clip(1)),
                                 arrays['intrinsics_fx_fy_cx_cy'])
    frames, stamps_ns = [], _stamps_ns(arrays)
    for index, (begin, end) in enumerate(pairwise(map(int, arrays['frame_offsets']))):
        rows = slice(begin, end)
        seen = Detections(arrays['boxes_xyxy'][rows].astype(np.float64),
                          tuple(map(str, arrays['class_ids'][rows])),
                          arrays['scores'][rows].astype(np.float64))
        frames.append(PosedQuery(
            index, Observation(
                camera, seen, arrays['similarities'][rows].astype(np.float32),
                int(stamps_ns[index]),
                depths=arrays['depths'][rows].astype(np.float64) if 'depths' in arrays else None),
            arrays['map_from_camera'][index].astype(np.float64),
            group=int(arrays['query_group'][index]), is_main=bool(arrays['is_main'][index]),
            true_landmark=arrays['true_landmark'][rows].astype(np.int64)))
    return Queries(tuple(map(str, arrays['landmark_ids'])), tuple(frames))


def save_queries(path: str | Path, queries: Queries) -> None:
    """Write a query file atomically; an existing one is replaced.

    DatasetError: the queries are invalid or the file cannot be written.
    """
    path, frames = Path(path), queries.frames
    seen = [frame.observation for frame in frames]
    if not frames:
        raise DatasetError(f'{path}: cannot be written: there are no frames')
    camera, boxes = seen[0].camera, [one.detections for one in seen]
    try:
        arrays = {
            'landmark_ids': np.array(queries.landmark_ids, dtype=np.str_),
            'intrinsics_fx_fy_cx_cy': np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            'image_size': np.array([camera.width, camera.height]),
            'frame_offsets': np.cumsum([0, *map(len, boxes)], dtype=np.int64),
            'boxes_xyxy': np.concatenate([one.bboxes_xyxy for one in boxes]),
            'class_ids': np.array([name for one in boxes for name in one.class_ids],
                                  dtype=np.str_),
            'scores': np.concatenate([one.scores for one in boxes]),
            'similarities': np.concatenate([np.asarray(one.similarities, dtype=np.float32)
                                            for one in seen]),
            'true_landmark': np.concatenate([
                np.full(len(one), -1) if frame.true_landmark is None else frame.true_landmark
                for frame, one in zip(frames, boxes, strict=True)]),
            'map_from_camera': np.array([frame.map_from_camera for frame in frames]),
            # Python's division of integers rounds once, NumPy's twice.
            'timestamps': np.array([one.stamp_ns / NS_PER_S for one in seen]),
            'query_group': np.array([frame.group for frame in frames], dtype=np.int64),
            'is_main': np.array([frame.is_main for frame in frames], dtype=np.bool_),
            'stamps_ns': np.array([one.stamp_ns for one in seen], dtype=np.int64),
        }
        if any(one.depths is not None for one in seen):
            arrays['depths'] = np.concatenate([
                np.full(len(one.detections), np.nan) if one.depths is None else one.depths
                for one in seen])
    except ValueError as error:  # arrays of different widths
        raise DatasetError(f'{path}: cannot be written: {error}') from error
    _QUERIES.write(path, arrays, compress=True)


_OF_CAMERAS = ('camera_names', 'camera_sizes', 'camera_intrinsics', 'camera_rows')


def _check_cameras(name: str, arrays: npz.Arrays) -> None:
    if missing := [field for field in _OF_CAMERAS if field not in arrays]:
        raise npz.ArrayError(f'array {missing[0]} is missing next to {name}')
    if name != 'camera_rows':
        return
    count = len(arrays['camera_names'])
    npz.Check(f'names none of the {count} cameras', lambda rows: (rows < 0) | (rows >= count)
              )(name, arrays)
    if unseen := sorted({*range(count)} - {*arrays[name].tolist()}):
        raise npz.ArrayError(f"no frame is of the camera '{arrays['camera_names'][unseen[0]]}'")


# F frames, n boxes, d numbers of an embedding, C cameras.
_OBSERVATIONS = npz.Schema('observation file', {
    **FRAME_FIELDS,
    'image_size': npz.Field('integers', (2,)),
    'depth_spreads': npz.Field('floats', ('n',), (_NOT_NEGATIVE,), is_optional=True),
    'open_edges': npz.Field('booleans', ('n', 4), is_optional=True),
    # large, and few rows are needed at a time
    'embeddings': npz.Field('floats', ('n', 'd'), (npz.FINITE,), is_optional=True),
    'encoder_key': npz.Field('text', is_optional=True),
    # a row without odometry is NaN
    'odom_from_camera': npz.Field('floats', ('F', 4, 4), (npz.Check(
        'is not a rigid transform',
        lambda poses: ~np.isnan(poses).all(axis=(1, 2)) & ~are_rigid(poses)),), is_optional=True),
    'image_counts': npz.Field('integers', (2,), (_NOT_NEGATIVE,), is_optional=True),
    # with several cameras: names, width and height, fx, fy, cx, cy, and the camera of each frame;
    # image_size and intrinsics_fx_fy_cx_cy are those of the first camera
    'camera_names': npz.Field('text', ('C',), (npz.UNIQUE, _check_cameras), is_optional=True),
    'camera_sizes': npz.Field('integers', ('C', 2), (_check_cameras,), is_optional=True),
    'camera_intrinsics': npz.Field('numbers', ('C', 4), (npz.FINITE, _check_cameras),
                                   is_optional=True),
    'camera_rows': npz.Field('integers', ('F',), (_check_cameras,), is_optional=True),
    'described': npz.Field('text', is_optional=True),
}, DatasetError, 'record the observations again', {'F': 'frames'},
    {'similarities': 'this is a query file: map from an observation file'})

# Optional fields of PosedDetections
_OPTIONAL = ('depths', 'depth_spreads', 'embeddings', 'odom_from_camera', 'open_edges',
             'stamps_ns')


def camera_from_numbers(size: NDArray[Any], intrinsics: NDArray[Any]) -> Camera:
    """Make a camera of width and height (2,), and fx, fy, cx, cy (4,) [px].

    CameraError: the values are invalid.
    """
    (width, height), (fx, fy, cx, cy) = map(int, size), map(float, intrinsics)
    return Camera(width, height, fx, fy, cx, cy)


def load_observations(path: str | Path) -> PosedDetections:
    """Read and validate an observation file.

    Frames are sorted by time. A frame may have no boxes. A file without any boxes is valid here,
    but mapping refuses it. DatasetError: the message names file, array, error and remedy.
    """
    arrays = _OBSERVATIONS.read(Path(path))
    try:
        cameras = tuple(camera_from_numbers(*numbers) for numbers in zip(
            arrays.get('camera_sizes', arrays['image_size'][None]),
            arrays.get('camera_intrinsics', arrays['intrinsics_fx_fy_cx_cy'][None]), strict=True))
    except CameraError as error:
        raise _OBSERVATIONS.invalid(Path(path), error) from error
    names, classes = np.unique(arrays['class_ids'], return_inverse=True)
    images, without_pose = arrays.get('image_counts', (len(arrays['timestamps']), 0))
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
        stamps_ns=_stamps_ns(arrays), images=int(images), without_pose=int(without_pose),
        described=str(arrays.get('described', '')), **{name: arrays.get(name) for name in (
            'depths', 'depth_spreads', 'embeddings', 'open_edges')})
    order = np.argsort(detections.stamps_s, kind='stable')
    return detections if (order[1:] > order[:-1]).all() else detections.select_frames(order)


def save_observations(path: str | Path, detections: PosedDetections) -> None:
    """Write an observation file atomically; an existing file is replaced.

    DatasetError: the detections are malformed, or the file cannot be written.
    """
    sizes = np.array([[camera.width, camera.height] for camera in detections.cameras])
    intrinsics = np.array([[camera.fx, camera.fy, camera.cx, camera.cy]
                           for camera in detections.cameras])
    names = np.array(detections.class_names, dtype=np.str_)
    arrays: dict[str, NDArray[Any]] = {
        'intrinsics_fx_fy_cx_cy': intrinsics[0], 'image_size': sizes[0],
        'frame_offsets': detections.frame_offsets,
        'boxes_xyxy': detections.bboxes_xyxy,
        'class_ids': names[detections.classes] if len(names) else np.empty(0, dtype=np.str_),
        'scores': detections.scores,
        'map_from_camera': detections.map_from_camera,
        'timestamps': detections.stamps_s,
    }
    for name in _OPTIONAL:
        if (values := getattr(detections, name)) is not None:
            arrays[name] = values
    if detections.camera_names != ('',):
        arrays |= {'camera_names': np.array(detections.camera_names), 'camera_sizes': sizes,
                   'camera_intrinsics': intrinsics, 'camera_rows': detections.frame_cameras}
    if detections.encoder_key:
        arrays['encoder_key'] = np.array(detections.encoder_key)
    if detections.described:
        arrays |= {'described': np.array(detections.described),
                   'image_counts': np.array([detections.images, detections.without_pose])}
    # compressing embeddings takes minutes and saves nothing
    _OBSERVATIONS.write(Path(path), arrays, compress='embeddings' not in arrays)
