# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reading worlds on disk: what each image shows, as the generator knows it."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cliploc_ros.errors import DatasetError

#: Boxes that show less of their object are nobody's fault to miss.
LEAST_VISIBILITY = 0.3


@dataclass(frozen=True)
class TrueBox:
    """A box about what is visible of an object [px], and what the object is."""

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


def find_worlds(folder: Path) -> list[Path]:
    """Find the worlds below a folder, in order.

    Raises
    ------
    DatasetError
        If there are fewer than two: one must be held out.
    """
    worlds = sorted(path.parent for path in folder.glob('*/truth.json'))
    if len(worlds) < 2:
        raise DatasetError(f'{folder} holds {len(worlds)} worlds, at least 2 are needed: make '
                           f'some with python -m cliploc_ros.demo.make_worlds {folder}')
    return worlds


def hold_out(worlds: list[Path]) -> tuple[list[Path], list[Path]]:
    """Split worlds into those to train on and the last tenth, to score on."""
    held_out = max(1, len(worlds) // 10)
    return worlds[:-held_out], worlds[-held_out:]


def read_frames(world: Path, least_visibility: float = LEAST_VISIBILITY) -> Iterator[TrueFrame]:
    """Read the images of a world with the boxes of which enough is visible."""
    truth = json.loads((world / 'truth.json').read_text())
    objects = {item['id']: item for item in truth['objects']}
    for frame in truth['frames']:
        yield TrueFrame(world / 'rgb' / f'{frame["timestamp"]}.jpg', frame['timestamp'], tuple(
            TrueBox(seen['object'], objects[seen['object']]['class_id'],
                    objects[seen['object']]['label'], np.array(seen['bbox_xyxy']),
                    seen['visibility'], objects[seen['object']]['in_map'])
            for seen in frame['boxes'] if seen['visibility'] >= least_visibility))
