# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read the ground truth of a synthetic room: its objects, and the boxes in each image."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cliploc_ros.core.geometry.ellipsoid import box_ious
from cliploc_ros.errors import DatasetError

#: A detector is not expected to find objects with a smaller visible share than this.
LEAST_VISIBILITY = 0.3
#: Boxes with a greater IoU show the same object.
SAME_OBJECT_IOU = 0.5


@dataclass(frozen=True)
class TrueObject:
    """An object of the room, and the ellipsoid around it [m]."""

    object_id: str
    class_id: str
    label: str
    center: npt.NDArray[np.float64]
    semi_axes: npt.NDArray[np.float64]
    orientation: npt.NDArray[np.float64]


@dataclass(frozen=True)
class TrueBox:
    """The box around the visible part of an object [px], and what the object is."""

    object_id: str
    class_id: str
    label: str
    bbox_xyxy: npt.NDArray[np.float64]
    visibility: float
    in_map: bool


@dataclass(frozen=True)
class TrueFrame:
    """An image of a world and the boxes in it."""

    image: Path
    timestamp: str
    boxes: tuple[TrueBox, ...]


def read_objects(world: Path) -> tuple[TrueObject, ...]:
    """Return all objects of a world, including those that its map lacks.

    DatasetError: truth.json is missing or lacks them.
    """
    file = world / 'truth.json'
    try:
        objects = tuple(TrueObject(item['id'], item['class_id'], item['label'], *(
            np.array(item[name], dtype=float) for name in ('center', 'semi_axes', 'orientation')))
            for item in json.loads(file.read_text())['objects'])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f'{file}: the objects of the room cannot be read ({error!r}); make it '
                           'with python -m demo.world.make_demo_world') from error
    if not objects:
        raise DatasetError(f'{file}: the room has no objects')
    return objects


def read_frames(world: Path, least_visibility: float = LEAST_VISIBILITY) -> Iterator[TrueFrame]:
    """Yield the images of a world with the boxes that show enough of their object."""
    truth = json.loads((world / 'truth.json').read_text())
    objects = {item['id']: item for item in truth['objects']}
    for frame in truth['frames']:
        yield TrueFrame(world / 'rgb' / f'{frame["timestamp"]}.jpg', frame['timestamp'], tuple(
            TrueBox(seen['object'], objects[seen['object']]['class_id'],
                    objects[seen['object']]['label'], np.array(seen['bbox_xyxy']),
                    seen['visibility'], objects[seen['object']]['in_map'])
            for seen in frame['boxes'] if seen['visibility'] >= least_visibility))


def true_ids(bboxes_xyxy: npt.NDArray[np.float64], true_boxes: Sequence[TrueBox]
             ) -> tuple[str, ...]:
    """Return the id of the object whose visible part matches each box (n, 4), or ''."""
    ids = []
    of_objects = np.array([box.bbox_xyxy for box in true_boxes]).reshape(-1, 4)
    for ious in box_ious(bboxes_xyxy, of_objects):
        ids.append(true_boxes[int(np.argmax(ious))].object_id
                   if ious.max(initial=0.0) > SAME_OBJECT_IOU else '')
    return tuple(ids)
