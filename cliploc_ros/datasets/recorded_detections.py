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
from cliploc_ros.datasets.tum import parse_stamp_ns
from cliploc_ros.errors import DatasetError


def read_recorded_detections(
    path: str | Path, image_size: tuple[int, int] | None = None
) -> dict[int, Detections]:
    """Read recorded detections.

    The form is ``{"image_size": [w, h], "frames": [{"timestamp": "1341847980.722988",
    "detections": [{"class_id": "book", "score": 0.58, "bbox_xyxy": [173, 138, 219, 208]}]}]}``;
    ``image_size`` is optional.

    Parameters
    ----------
    path : str or Path
        The JSON file.
    image_size : (int, int), optional
        Expected width and height of the images [px].

    Returns
    -------
    dict of int to Detections
        By exact stamp [ns]. A frame without detections has an empty entry.

    Raises
    ------
    DatasetError
        If the file is invalid; the message names file, frame and field.
    """
    path = Path(path)
    content = _load(path)
    _check_size(content, image_size, path)
    detections: dict[int, Detections] = {}
    for index, frame in enumerate(_field(content, 'frames', list, str(path))):
        where = f'{path}: frame {index}'
        timestamp = _field(frame, 'timestamp', (str, int, Decimal), where)
        stamp_ns = parse_stamp_ns(str(timestamp), where)
        if stamp_ns in detections:
            raise DatasetError(f'{where}: timestamp {timestamp} is a repetition')
        detections[stamp_ns] = _parse_frame(_field(frame, 'detections', list, where), where)
    return detections


def _load(path: Path) -> Any:
    try:
        # Decimal keeps a timestamp's digits; a float would round them to 0.2 us.
        return json.loads(
            path.read_text(encoding='utf-8'),
            parse_float=Decimal,
            parse_constant=lambda name: _refuse(path, name),
        )
    except FileNotFoundError:
        raise DatasetError(f'{path}: no such file of recorded detections') from None
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read as JSON: {error}') from error


def _refuse(path: Path, name: str) -> NoReturn:
    raise DatasetError(f'{path}: contains {name}; expected finite numbers')


def _check_size(content: Any, image_size: tuple[int, int] | None, path: Path) -> None:
    if not isinstance(content, dict):
        raise DatasetError(f'{path}: expected a mapping with frames')
    recorded = content.get('image_size')
    if recorded is None or image_size is None:
        return
    if recorded != list(image_size):
        raise DatasetError(
            f'{path}: image_size is {recorded}, but the images are {list(image_size)}'
        )


def _parse_frame(items: list[Any], where: str) -> Detections:
    class_ids, scores, boxes = [], [], []
    for index, item in enumerate(items):
        place = f'{where}, detection {index}'
        class_ids.append(_field(item, 'class_id', str, place))
        scores.append(_parse_score(_field(item, 'score', (int, Decimal), place), place))
        boxes.append(_parse_box(_field(item, 'bbox_xyxy', list, place), place))
    return Detections(
        bboxes_xyxy=np.array(boxes, dtype=np.float64).reshape(-1, 4),
        class_ids=tuple(class_ids),
        scores=np.array(scores, dtype=np.float64),
    )


def _parse_score(value: Any, where: str) -> float:
    score = float(value)
    if not 0 <= score <= 1:
        raise DatasetError(f'{where}: score is {score}, outside 0 to 1')
    return score


def _parse_box(values: list[Any], where: str) -> list[float]:
    numbers = all(
        isinstance(value, int | Decimal) and not isinstance(value, bool) for value in values
    )
    if len(values) != 4 or not numbers:
        raise DatasetError(f'{where}: bbox_xyxy is not four numbers')
    box = [float(value) for value in values]
    if not all(math.isfinite(value) for value in box) or box[0] >= box[2] or box[1] >= box[3]:
        raise DatasetError(f'{where}: bbox_xyxy {box} is not left, top, right, bottom')
    return box


def _field(mapping: Any, name: str, kind: type | tuple[type, ...], where: str) -> Any:
    if not isinstance(mapping, dict) or name not in mapping:
        raise DatasetError(f'{where}: field {name!r} is missing')
    value = mapping[name]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise DatasetError(f'{where}: field {name!r} has the wrong type: {value!r:.60}')
    return value
