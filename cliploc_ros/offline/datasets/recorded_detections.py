# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read recorded detections from a JSON file."""

import json
import math
from decimal import Decimal
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.tum import parse_stamp_ns


def read_recorded_detections(path: str | Path, image_size: tuple[int, int] | None = None
                             ) -> dict[int, Detections]:
    """Read recorded detections; return them by exact stamp [ns].

    The form is ``{"image_size": [w, h], "frames": [{"timestamp": "1341847980.722988",
    "detections": [{"class_id": "book", "score": 0.58, "bbox_xyxy": [173, 138, 219, 208]}]}]}``;
    ``image_size`` is optional. A frame without detections has an empty entry.

    `image_size` is the expected width and height of the images [px]. DatasetError: the message
    names file, frame and field.
    """
    path = Path(path)

    def refuse(name: str) -> NoReturn:
        raise DatasetError(f'{path}: contains {name}; expected finite numbers')
    try:
        # Decimal keeps a timestamp's digits; a float would round them to 0.2 us.
        content = json.loads(path.read_text(encoding='utf-8'), parse_float=Decimal,
                             parse_constant=refuse)
    except FileNotFoundError:
        raise DatasetError(f'{path}: no such file of recorded detections') from None
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read as JSON: {error}') from error
    if not isinstance(content, dict):
        raise DatasetError(f'{path}: expected a mapping with frames')
    recorded = content.get('image_size')
    if None not in (recorded, image_size) and recorded != list(image_size or ()):
        raise DatasetError(
            f'{path}: image_size is {recorded}, but the images are {list(image_size or ())}')
    detections: dict[int, Detections] = {}
    for index, frame in enumerate(_field(content, 'frames', list, str(path))):
        where = f'{path}: frame {index}'
        timestamp = _field(frame, 'timestamp', (str, int, Decimal), where)
        stamp_ns = parse_stamp_ns(str(timestamp), where)
        if stamp_ns in detections:
            raise DatasetError(f'{where}: timestamp {timestamp} is a repetition')
        found = [_parse_detection(item, f'{where}, detection {number}') for number, item
                 in enumerate(_field(frame, 'detections', list, where))]
        detections[stamp_ns] = Detections(
            np.array([box for box, _, _ in found], dtype=np.float64).reshape(-1, 4),
            tuple(class_id for _, class_id, _ in found),
            np.array([score for _, _, score in found], dtype=np.float64))
    return detections


def _parse_detection(item: Any, where: str) -> tuple[list[float], str, float]:
    """Return box, class and score."""
    class_id = _field(item, 'class_id', str, where)
    score = float(_field(item, 'score', (int, Decimal), where))
    if not 0 <= score <= 1:
        raise DatasetError(f'{where}: score is {score}, outside 0 to 1')
    values = _field(item, 'bbox_xyxy', list, where)
    if len(values) != 4 or not all(isinstance(value, int | Decimal) and not isinstance(value, bool)
                                   for value in values):
        raise DatasetError(f'{where}: bbox_xyxy is not four numbers')
    box = [float(value) for value in values]
    if not all(map(math.isfinite, box)) or box[0] >= box[2] or box[1] >= box[3]:
        raise DatasetError(f'{where}: bbox_xyxy {box} is not left, top, right, bottom')
    return box, class_id, score


def _field(mapping: Any, name: str, kind: type | tuple[type, ...], where: str) -> Any:
    if not isinstance(mapping, dict) or name not in mapping:
        raise DatasetError(f'{where}: field {name!r} is missing')
    value = mapping[name]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise DatasetError(f'{where}: field {name!r} has the wrong type: {value!r:.60}')
    return value
