# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a check."""

import json
import math
from pathlib import Path
from typing import Any

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.evaluation.map_check.page import make_page
from cliploc_ros.evaluation.map_check.pictures import draw_pictures
from cliploc_ros.files.storage import write_text
from cliploc_ros.mapping.checking.report import CheckReport

PAGE, DATA = 'check.html', 'check.json'


def write_report(folder: Path, name: str, landmark_map: LandmarkMap, report: CheckReport) -> None:
    """Write the page and the JSON file of a check, each in one step.

    Parameters
    ----------
    folder : Path
        It exists.
    name : str
        Of the map, for the title.

    Raises
    ------
    OptionsError
        A file cannot be written; the old one stays.
    """
    data = {'map': name, **report.as_dict()}
    write_text(folder / DATA, json.dumps(_finite(data), indent=1, allow_nan=False))
    write_text(folder / PAGE, make_page(name, report, draw_pictures(landmark_map, report)))


def _finite(value: Any) -> Any:
    """Return a tree with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
