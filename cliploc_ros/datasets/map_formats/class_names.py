# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the classes that a file gives by their index."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from cliploc_ros.datasets.map_formats.files import read_bytes
from cliploc_ros.errors import DatasetError

COCO = (
    'person', 'bicycle', 'car', 'motorcycle', 'airplane', 'bus', 'train', 'truck', 'boat',
    'traffic light', 'fire hydrant', 'stop sign', 'parking meter', 'bench', 'bird', 'cat', 'dog',
    'horse', 'sheep', 'cow', 'elephant', 'bear', 'zebra', 'giraffe', 'backpack', 'umbrella',
    'handbag', 'tie', 'suitcase', 'frisbee', 'skis', 'snowboard', 'sports ball', 'kite',
    'baseball bat', 'baseball glove', 'skateboard', 'surfboard', 'tennis racket', 'bottle',
    'wine glass', 'cup', 'fork', 'knife', 'spoon', 'bowl', 'banana', 'apple', 'sandwich',
    'orange', 'broccoli', 'carrot', 'hot dog', 'pizza', 'donut', 'cake', 'chair', 'couch',
    'potted plant', 'bed', 'dining table', 'toilet', 'tv', 'laptop', 'mouse', 'remote',
    'keyboard', 'cell phone', 'microwave', 'oven', 'toaster', 'sink', 'refrigerator', 'book',
    'clock', 'vase', 'scissors', 'teddy bear', 'hair drier', 'toothbrush')
_MAX_LENGTH = 1000
# A map file holds four decimals of a weight. A class with less means nothing.
_LEAST_SHARE = 0.001


def read_class_names(path: Path) -> tuple[str, ...]:
    """Read a text file with one class name in each line.

    Raises
    ------
    DatasetError
        Names the file and the line to correct.
    """
    try:
        lines = read_bytes(path).decode('utf-8-sig').splitlines()
    except UnicodeDecodeError as error:
        raise DatasetError(f'{path}: not a text file in UTF-8') from error
    names = tuple(line.strip() for line in lines)
    for number, name in enumerate(names, 1):
        if not name or len(name) > _MAX_LENGTH:
            raise DatasetError(f'{path}: line {number} must be a class name, one in each line')
    return names


def class_name(names: Sequence[str], index: int) -> str:
    """Return the name of a class.

    Raises
    ------
    DatasetError
        The list of names has no such index.
    """
    if not 0 <= index < len(names):
        raise DatasetError(f'class index {index} is not among {len(names)} names; name the '
                           'classes that the map was made with: --class-names FILE')
    return names[index]


def shares(weights: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """Return classes with their shares, the greatest first; those below a thousandth go."""
    least = _LEAST_SHARE * sum(weights.values())
    ranked = sorted(((name, weight) for name, weight in weights.items() if weight > least),
                    key=lambda pair: -pair[1])
    total = sum(weight for _, weight in ranked)
    return tuple((name, weight / total) for name, weight in ranked)
