# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A query: all that an answer depends on but map and options; and queries in a file.

A case is a request: its queries, the oldest first, and a report of its answer. A localizer with
the same map and options that answers all of them in their order repeats the answer bit by bit.
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
from cliploc_ros.core.observation import Detections, Observation, Region
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.files.arrays import Arrays, Field, Offsets, Schema
from cliploc_ros.files.storage import parse_json


@dataclass(frozen=True)
class Query:
    """The frames of one instant, with mount, vertical and prior."""

    #: One of each camera, with one stamp and a camera_name each; the camera to localize is last.
    #: odom_from_camera links the cameras of an instant, and the instants of one run.
    frames: tuple[Observation, ...]
    #: (h, w, 3) uint8, red first: of each frame; empty if nothing is read from images
    images: tuple[NDArray[np.uint8], ...] = ()
    #: Number of the run of odometry; None: this instant is linked to no other
    run: int | None = 0
    #: The most instants to fuse, this one included, and how old they may be [s]
    limit: int = 1
    length_s: float = 0.0
    by_keyframes: bool = True  #: Whether there is time for keyframes
    is_thorough: bool = True  #: Whether to search them thoroughly where a fast pass is refused
    #: Evidence of earlier looks about the cameras; None: the localizer knows it
    cameras: CameraCheck | None = None
    #: How many crops of the last frame the first search had, and how many each further search was
    #: given room for: 0 where time ended. Empty: as the options and the time allow.
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
        """Return the options of the case; no clock cuts the search. DatasetError: they are bad."""
        defaults = vars(RelocalizerOptions())
        try:
            given: dict[str, Any] = {
                name: tuple(map(float, value)) if isinstance(defaults[name], tuple)
                else type(defaults[name])(value)
                for name, value in self.report['options'].items() if name in defaults}
            return RelocalizerOptions(**given | {'time_budget_s': math.inf})
        except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError,
                CliplocError) as error:
            raise DatasetError(f'the options of this case are broken: {error}') from error


# No coordinate, pixel or time of a case is greater.
_MOST = 1e9

CASE = Schema('case', {
    'about': Field('uint8', ('t',)),  # JSON: report and queries, without what follows
    'images': Field('uint8', ('b',)),  # PNG, of each frame that has one
    'image_offsets': Field('integers', ('f',), (Offsets('images', 'bytes'),)),
    'crops': Field('float32', ('c', 'd')),  # embeddings or similarities
    'crop_offsets': Field('integers', ('g',), (Offsets('crops', 'crops'),)),
}, DatasetError, 'store the request again with ~/record', {'f': 'images', 'g': 'frames'})


def case_arrays(case: Case) -> Arrays:
    """Return the arrays of a file of a case, see CASE."""
    images, crops = list[NDArray[np.uint8]](), list[NDArray[np.float32]]()
    for query in case.queries:
        images += [cv2.imencode('.png', cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].ravel()
                   for image in query.images]
        # embeddings, or where these are unknown, similarities
        crops += [one.similarities.crops if isinstance(one.similarities, CropSimilarities)
                  else one.similarities for one in query.frames if one.similarities is not None]
    about = {'report': case.report, 'queries': [_fields_of(query) for query in case.queries]}
    return {
        # arrays and numbers of NumPy as JSON has them
        'about': np.frombuffer(json.dumps(about, default=lambda value: value.tolist()).encode(),
                               dtype=np.uint8),
        'image_offsets': np.cumsum([0, *map(len, images)]),
        'images': np.concatenate([np.empty(0, np.uint8), *images]),
        'crop_offsets': np.cumsum([0, *map(len, crops)]),
        'crops': np.concatenate(crops) if crops else np.empty((0, 0), np.float32)}


def read_case(path: Path) -> Case:
    """Read a case; DatasetError: the message names what is missing or broken.

    Similarities from embeddings have no labels: a localizer compares them with those of its map.
    """
    arrays = CASE.read(path)
    try:
        about = parse_json(arrays['about'].tobytes())
        images, crops = _parts(arrays, 'image'), _parts(arrays, 'crop')
        first, *others = (_query_of(one, images, crops) for one in about['queries'])
        report = dict(about['report'])
        _expect(isinstance(report.get('parameters', {}), dict), 'parameters')
        return Case((first, *others), report)
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError,
            RecursionError, cv2.error, CliplocError) as error:
        raise CASE.invalid(path, f'is broken: {error!r}') from error


def _parts(arrays: Arrays, name: str) -> Iterator[NDArray[Any]]:
    return (arrays[f'{name}s'][first:last] for first, last in pairwise(arrays[f'{name}_offsets']))


def _fields_of(query: Query) -> dict[str, Any]:
    """Return the fields of a query for JSON."""
    return {
        **{name: getattr(query, name) for name in
           ('run', 'limit', 'length_s', 'by_keyframes', 'is_thorough', 'rooms')},
        'cameras': None if query.cameras is None else query.cameras.fields(),
        'has_images': bool(query.images),
        'frames': [asdict(replace(frame, similarities=None)) | {'crops': (
            '' if frame.similarities is None else 'embeddings' if isinstance(
                frame.similarities, CropSimilarities) else 'similarities')}
            for frame in query.frames]}


def _query_of(about: Mapping[str, Any], images: Iterator[NDArray[np.uint8]],
              crops: Iterator[NDArray[np.float32]]) -> Query:
    """Return a query; ValueError, or another error of Python: it is broken."""
    frames = tuple(_frame_of(one, crops) for one in about['frames'])
    decoded = tuple(_decoded(next(images), one.camera) for one in frames if about['has_images'])
    run, rooms, cameras = about['run'], tuple(map(_count, about['rooms'])), about['cameras']
    _expect(bool(frames) and (not rooms or frames[-1].compared is not None), 'frames')
    return Query(frames, decoded, None if run is None else _count(run), _count(about['limit']),
                 float(_numbers(about['length_s'])), bool(about['by_keyframes']),
                 bool(about.get('is_thorough')),
                 None if cameras is None else CameraCheck.of_fields(cameras), rooms)


def _frame_of(about: Mapping[str, Any], crops: Iterator[NDArray[np.float32]]) -> Observation:
    """Return a frame; ValueError, or another error of Python: it is broken."""
    known = dict(about)
    camera, seen, region = dict(known['camera']), known['detections'], known['region']
    camera |= {name: _count(camera[name]) for name in ('width', 'height')}
    camera['distortion'] = tuple(camera['distortion'])
    boxes = np.reshape(_numbers(seen['bboxes_xyxy'], None), (-1, 4))
    count, class_ids = len(boxes), tuple(seen['class_ids'])
    _expect(all(isinstance(one, str) for one in (known['camera_name'], *class_ids)), 'names')
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
    up, odom, depths, spreads = (None if known[name] is None else _numbers(
        known[name], *shape, nan=name.startswith('depth')) for name, shape in (
            ('up_in_camera', (3,)), ('odom_from_camera', (4, 4)), ('depths', (count,)),
            ('depth_deviations', (count,))))
    return Observation(
        Camera(**camera), Detections(boxes, class_ids, _numbers(seen['scores'], count)),
        similarities, _count(known['stamp_ns']), known['camera_name'], up, odom,
        float(_numbers(known['odom_way_m'])), compared, depths, spreads, region)


def _decoded(image_png: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """Return an image (h, w, 3), red first; ValueError: it is none of its camera."""
    # a small file may declare any size, and decoding takes the memory of it
    _expect(image_png[16:24].tobytes() == struct.pack('>II', camera.width, camera.height), 'image')
    image = cv2.imdecode(image_png, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _numbers(value: Any, *shape: int | None, nan: bool = False) -> NDArray[np.float64]:
    """Return numbers of a shape, None for any length. ValueError, TypeError: they differ."""
    found = np.array(value, dtype=np.float64)
    if None not in shape:
        _expect(found.shape == shape, 'the shape of numbers')
    _expect(bool((np.abs(found[~np.isnan(found)] if nan else found) < _MOST).all()), 'numbers')
    return found


def _count(value: Any) -> int:
    """Return a whole number, 0 or more; ValueError: it is none."""
    _expect(isinstance(value, int) and 0 <= value < 2**63, 'whole numbers')
    return int(value)


def _expect(is_right: bool, what: str) -> None:
    if not is_right:
        raise ValueError(f'{what} are out of place')
