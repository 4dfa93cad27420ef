# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A query: all that an answer depends on but map and options; and queries in a file.

A case is a request: its queries, the oldest first, and a report of its answer. A localizer with
the same map and options that answers all of them in their order repeats the answer bit by bit.
"""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings, Similarities
from cliploc_ros.core.observation import Detections, Observation, Region
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.files.arrays import Arrays, Field, Offsets, Schema


@dataclass(frozen=True)
class Query:
    """The frames of one instant, and what is known besides."""

    #: One of each camera, with one stamp and a camera_name each; the camera to localize is last.
    #: odom_from_camera links the cameras of an instant, and the instants of one run.
    frames: tuple[Observation, ...]
    #: (h, w, 3) uint8, red first: of each frame; empty where nothing is read from images
    images: tuple[NDArray[np.uint8], ...] = ()
    #: Number of the run of odometry; None: this instant is linked to no other
    run: int | None = 0
    #: The most instants to fuse, this one included, and how old they may be [s]
    limit: int = 1
    length_s: float = 0.0
    by_keyframes: bool = True  #: Whether there is time for keyframes
    #: What looks before said of the cameras; None: the localizer knows it
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
    """The queries of a request, the oldest first, and a report of its answer."""

    queries: tuple[Query, ...]
    report: Mapping[str, Any]

    @property
    def options(self) -> RelocalizerOptions:
        """Return the options of the case; no clock cuts the search. DatasetError: bad ones."""
        known = {field.name for field in fields(RelocalizerOptions)}
        try:
            given: dict[str, Any] = {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in self.report['options'].items() if name in known}
            return RelocalizerOptions(**given | {'time_budget_s': math.inf})
        except (AttributeError, KeyError, TypeError, CliplocError) as error:
            raise DatasetError(f'the options of this case are broken: {error}') from error


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
        about = json.loads(arrays['about'].tobytes())
        images, crops = _parts(arrays, 'image'), _parts(arrays, 'crop')
        first, *others = (_query_of(one, images, crops) for one in about['queries'])
        return Case((first, *others), dict(about['report']))
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError,
            cv2.error, CliplocError) as error:
        raise CASE.invalid(path, f'is broken: {error!r}') from error


def _parts(arrays: Arrays, name: str) -> Iterator[NDArray[Any]]:
    return (arrays[f'{name}s'][first:last] for first, last in pairwise(arrays[f'{name}_offsets']))


def _fields_of(query: Query) -> dict[str, Any]:
    """Return what JSON keeps of a query."""
    return {
        **{name: getattr(query, name) for name in
           ('run', 'limit', 'length_s', 'by_keyframes', 'rooms')},
        'cameras': None if query.cameras is None else query.cameras.fields(),
        'has_images': bool(query.images),
        'frames': [asdict(replace(one, similarities=None)) | {'crops': (
            '' if one.similarities is None else 'embeddings' if isinstance(
                one.similarities, CropSimilarities) else 'similarities')}
            for one in query.frames]}


def _query_of(about: Mapping[str, Any], images: Iterator[NDArray[np.uint8]],
              crops: Iterator[NDArray[np.float32]]) -> Query:
    frames = tuple(_frame_of(one, crops) for one in about['frames'])
    decoded = tuple(np.asarray(cv2.cvtColor(cv2.imdecode(
        next(images), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), dtype=np.uint8)
        for _ in frames if about['has_images'])
    cameras = about['cameras']
    return Query(frames, decoded, about['run'], about['limit'], about['length_s'],
                 about['by_keyframes'],
                 None if cameras is None else CameraCheck.of_fields(cameras),
                 tuple(about['rooms']))


def _frame_of(about: Mapping[str, Any], crops: Iterator[NDArray[np.float32]]) -> Observation:
    known = dict(about)
    similarities: Similarities | None = None
    if kind := known.pop('crops'):
        rows = next(crops)
        similarities = rows if kind == 'similarities' else CropSimilarities(rows, LabelEmbeddings(
            np.empty((0, rows.shape[1]), np.float32), np.empty(0, np.int64)))
    camera, seen, region = known['camera'], known['detections'], known['region']
    return Observation(**known | {
        name: None if known[name] is None else np.array(known[name])
        for name in ('up_in_camera', 'odom_from_camera', 'depths', 'depth_deviations')} | {
        'camera': Camera(**camera | {'distortion': tuple(camera['distortion'])}),
        'detections': Detections(np.array(seen['bboxes_xyxy'], np.float64).reshape(-1, 4),
                                 tuple(seen['class_ids']), np.array(seen['scores'], np.float64)),
        'similarities': similarities,
        'compared': None if known['compared'] is None else np.array(known['compared'], np.int64),
        'region': None if region is None else Region(**region | {
            name: np.array(region[name]) for name in ('mean', 'covariance', 'camera_from_body')})})
