# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Queries, which hold everything that an answer depends on except map and options.

A case is a recorded request: its queries, oldest first, and a report of its answer. A localizer
with the same map and options that answers these queries in order reproduces the answer bit by bit.
"""

import json
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings, Similarities
from cliploc_ros.core.observation import Detections, Observation, Region, SeenTags
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.files.arrays import Arrays, Field, Offsets, Schema
from cliploc_ros.files.storage import parse_json


@dataclass(frozen=True)
class Query:
    """The frames of one instant, with mount, vertical and prior."""

    #: One frame of each camera, with equal stamps and different names; the camera to localize is
    #: last. odom_from_camera links the cameras of an instant, and the instants of one run.
    frames: tuple[Observation, ...]
    #: (h, w, 3) uint8: RGB image of each frame; empty if images are not needed
    images: tuple[NDArray[np.uint8], ...] = ()
    #: Number of the run of odometry; None: this instant is not linked to others
    run: int | None = 0
    #: Maximum number of instants to fuse, including this instant, and their maximum age [s]
    limit: int = 1
    length_s: float = 0.0
    by_keyframes: bool = True  #: Whether there is time for keyframes
    #: Whether to search keyframes thoroughly if the result of the fast search is refused
    is_thorough: bool = True
    #: Evidence of earlier looks about the cameras; None: use that of the localizer
    cameras: CameraCheck | None = None
    #: Number of crops of the last frame in the first search, and the maximum number of crops added
    #: for each further search, 0 when time was up. Empty: as the options and the time allow.
    rooms: tuple[int, ...] = ()

    @property
    def newest(self) -> Observation:
        """Return the frame of the camera to localize."""
        return self.frames[-1]


@dataclass(frozen=True)
class Case:
    """The queries of a request, oldest first, and a report of its answer."""

    queries: tuple[Query, ...]
    report: Mapping[str, Any]

    @property
    def options(self) -> RelocalizerOptions:
        """Return the options of the case, without a time limit; DatasetError: they are invalid."""
        defaults = vars(RelocalizerOptions())
        try:
            given: dict[str, Any] = {
                name: tuple(map(float, value)) if isinstance(defaults[name], tuple)
                else type(defaults[name])(value)
                for name, value in self.report['options'].items() if name in defaults}
            return RelocalizerOptions(**given | {'time_budget_s': math.inf})
        except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError,
                CliplocError) as error:
            raise DatasetError(f'the options of this case are invalid: {error}') from error


# Limit of the coordinates, pixels and times of a case.
_MOST = 1e9

CASE = Schema('case', {
    'about': Field('uint8', ('t',)),  # JSON: report and queries, without images and crops
    'images': Field('uint8', ('b',)),  # PNG of each frame that has an image
    'image_offsets': Field('integers', ('f',), (Offsets('images', 'bytes'),)),
    'crops': Field('float32', ('c', 'd')),  # embeddings or similarities
    'crop_offsets': Field('integers', ('g',), (Offsets('crops', 'crops'),)),
}, DatasetError, 'store the request again with ~/record', {'f': 'images', 'g': 'frames'})


def case_arrays(case: Case) -> Arrays:
    """Convert a case to the arrays of its file, see CASE."""
    images, crops = list[NDArray[np.uint8]](), list[NDArray[np.float32]]()
    for query in case.queries:
        images += [cv2.imencode('.png', cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].ravel()
                   for image in query.images]
        # embeddings, or similarities if the embeddings are unknown
        crops += [frame.similarities.crops if isinstance(frame.similarities, CropSimilarities)
                  else frame.similarities for frame in query.frames
                  if frame.similarities is not None]
    about = {'report': case.report, 'queries': [{
        **{name: getattr(query, name) for name in
           ('run', 'limit', 'length_s', 'by_keyframes', 'is_thorough', 'rooms')},
        'cameras': None if query.cameras is None else query.cameras.fields(),
        'has_images': bool(query.images),
        'frames': [asdict(replace(frame, similarities=None)) | {'crops': (
            '' if frame.similarities is None else 'embeddings' if isinstance(
                frame.similarities, CropSimilarities) else 'similarities')}
            for frame in query.frames]} for query in case.queries]}
    return {
        # NumPy arrays and scalars become lists and numbers
        'about': np.frombuffer(json.dumps(about, default=lambda value: value.tolist()).encode(),
                               dtype=np.uint8),
        'image_offsets': np.cumsum([0, *map(len, images)]),
        'images': np.concatenate([np.empty(0, np.uint8), *images]),
        'crop_offsets': np.cumsum([0, *map(len, crops)]),
        'crops': np.concatenate(crops) if crops else np.empty((0, 0), np.float32)}


def read_case(path: Path) -> Case:
    """Read a case; DatasetError: the message states what is missing or damaged.

    Similarities from embeddings have no labels. A localizer compares them with the labels of its
    map.
    """
    arrays = CASE.read(path)
    try:
        about = parse_json(arrays['about'].tobytes())
        images, crops = _parts(arrays, 'image'), _parts(arrays, 'crop')
        first, *others = (_query_of(fields, images, crops) for fields in about['queries'])
        _expect(not [*images, *crops], 'the numbers of images and crops')
        report = dict(about['report'])
        _expect(isinstance(report.get('parameters', {}), dict), 'parameters')
        return Case((first, *others), report)
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError,
            RuntimeError, cv2.error, CliplocError) as error:  # next() in a generator
        raise CASE.invalid(path, f'is damaged: {error!r}') from error


def _parts(arrays: Arrays, name: str) -> Iterator[NDArray[Any]]:
    return (arrays[f'{name}s'][first:last] for first, last in pairwise(arrays[f'{name}_offsets']))


def _query_of(about: Mapping[str, Any], images: Iterator[NDArray[np.uint8]],
              crops: Iterator[NDArray[np.float32]]) -> Query:
    """Return the query of JSON fields; any Python error means that they are damaged."""
    frames = tuple(_frame_of(fields, crops) for fields in about['frames'])
    decoded = tuple(_decoded(next(images), frame.camera)
                    for frame in frames if about['has_images'])
    run, rooms, cameras = about['run'], tuple(map(_count, about['rooms'])), about['cameras']
    _expect(bool(frames) and (not rooms or frames[-1].compared is not None), 'frames')
    return Query(frames, decoded, None if run is None else _count(run),
                 1 + _count(about['limit'] - 1), float(_numbers(about['length_s'])),
                 bool(about['by_keyframes']), bool(about.get('is_thorough')),
                 None if cameras is None else CameraCheck.of_fields(cameras), rooms)


def _frame_of(about: Mapping[str, Any], crops: Iterator[NDArray[np.float32]]) -> Observation:
    """Return the frame of JSON fields; any Python error means that they are damaged."""
    known = dict(about)
    camera, seen, region = dict(known['camera']), known['detections'], known['region']
    camera |= {name: _count(camera[name]) for name in ('width', 'height')}
    camera['distortion'] = tuple(camera['distortion'])
    boxes = np.reshape(_numbers(seen['bboxes_xyxy'], None), (-1, 4))
    count, class_ids = len(boxes), tuple(seen['class_ids'])
    _expect(all(isinstance(name, str) for name in (known['camera_name'], *class_ids)), 'names')
    _expect(len(class_ids) == count, 'class_ids')
    poses = [known['odom_from_camera']]
    if region is not None:
        poses.append(region['camera_from_body'])
        region = Region(region['frame_id'], _numbers(region['mean'], 3),
                        _numbers(region['covariance'], 3, 3), float(region['probability']),
                        _numbers(region['camera_from_body'], 4, 4))
    for pose in poses:
        _expect(pose is None or is_rigid(_numbers(pose, 4, 4)), 'poses')
    compared = known['compared']
    if compared is not None:
        compared = np.array([*map(_count, compared)], dtype=np.int64)
        _expect(len({*compared.tolist()}) == len(compared), 'compared')
        _expect(bool((compared < count).all()), 'compared')
    similarities: Similarities | None = None
    if kind := known.pop('crops'):
        rows = next(crops)
        _expect(len(rows) == (count if compared is None else len(compared)), 'crops')
        _expect(bool(np.isfinite(rows).all()), 'crops')
        similarities = rows if kind == 'similarities' else CropSimilarities(rows, LabelEmbeddings(
            np.empty((0, rows.shape[1]), np.float32), np.empty(0, np.int64)))
    up, odom, depths, base_up = (None if known.get(name) is None else _numbers(
        known[name], *shape, nan=name == 'depths') for name, shape in (
            ('up_in_camera', (3,)), ('odom_from_camera', (4, 4)), ('depths', (count,)),
            ('base_up_in_camera', (3,))))
    tags = known.get('tags')
    if tags is not None:
        tags = SeenTags(names := tuple(map(str, tags['names'])), _numbers(np.reshape(
            tags['corners_px'], (-1, 4, 2)), len(names), 4, 2))
    return Observation(
        Camera(**camera), Detections(boxes, class_ids, _numbers(seen['scores'], count)),
        similarities, _count(known['stamp_ns']), known['camera_name'], up, odom,
        float(_numbers(known['odom_way_m'])), compared, depths, region, base_up, tags)


def _decoded(image_png: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """Decode a PNG image to RGB (h, w, 3); ValueError: its size is not that of its camera."""
    # a small file may declare a huge size, for which decoding would allocate memory
    _expect(image_png[16:24].tobytes() == struct.pack('>II', camera.width, camera.height), 'image')
    image = cv2.imdecode(image_png, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _numbers(value: Any, *shape: int | None, nan: bool = False) -> NDArray[np.float64]:
    """Return numbers as an array; None in the shape stands for any length.

    Raises
    ------
    ValueError, TypeError
        The shape differs, or there are values that are not numbers or too large.
    """
    found = np.array(value, dtype=np.float64)
    if None not in shape:
        _expect(found.shape == shape, 'the shape of numbers')
    _expect(bool((np.abs(found[~np.isnan(found)] if nan else found) < _MOST).all()), 'numbers')
    return found


def _count(value: Any) -> int:
    """Return a non-negative integer; ValueError: the value is something else."""
    _expect(isinstance(value, int) and 0 <= value < 2**63, 'whole numbers')
    return int(value)


def _expect(is_right: bool, what: str) -> None:
    if not is_right:
        raise ValueError(f'{what} are invalid')
