# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read what each image of a synthetic room shows, as its generator recorded it."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

#: A detector need not find a box that shows less of its object than this share.
LEAST_VISIBILITY = 0.3


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
