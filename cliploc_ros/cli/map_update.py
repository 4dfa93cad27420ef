# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``build_map --update``: a new recording of a mapped place brings its map up to date."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from cliploc_ros.cli.map_labels import Labeller
    from cliploc_ros.core.maps.landmark_embeddings import LandmarkEmbeddings
    from cliploc_ros.core.maps.landmark_map import LandmarkMap
    from cliploc_ros.mapping.options import MappingOptions
    from cliploc_ros.mapping.posed_detections import PosedDetections
    from cliploc_ros.mapping.updating.updating import UpdatedMap


# Standard deviations of poses that a localizer gives [m] [deg]. Guesses; the map holds on to exact
# ones all the same.
_USUAL_NOISE = (0.05, 1.0)


@dataclass(frozen=True)
class OldMap:
    """A map to update, and the image embeddings next to it."""

    landmark_map: 'LandmarkMap'
    embeddings: 'LandmarkEmbeddings | None'


def read_old_map(path: Path) -> OldMap:
    """Read a map to update.

    Raises
    ------
    MapError
        The map or its embeddings are invalid.
    """
    from cliploc_ros.core.maps.landmark_embeddings import load_embeddings_of_map
    from cliploc_ros.core.maps.landmark_map import LandmarkMap

    landmark_map = LandmarkMap.from_file(path)
    return OldMap(landmark_map, load_embeddings_of_map(path, landmark_map.landmark_ids))


def with_usual_noise(mapping: 'MappingOptions') -> 'MappingOptions':
    """Return options with which poses are refined against the old map."""
    from cliploc_ros.mapping.options import PoseErrors

    return replace(mapping, pose_errors=PoseErrors(*_USUAL_NOISE))


def update_old_map(old: OldMap, detections: 'PosedDetections', mapping: 'MappingOptions',
                   labeller: 'Labeller') -> 'UpdatedMap':
    """Return the update of a map, its new landmarks labelled.

    Raises
    ------
    CliplocError
        The recording does not belong to the map, or the text tower cannot be loaded.
    """
    from cliploc_ros.mapping.updating.options import UpdateOptions
    from cliploc_ros.mapping.updating.updating import update_map

    updated = update_map(old.landmark_map, detections, UpdateOptions(mapping=mapping),
                         old.embeddings)
    return _label_new(updated, detections, labeller)


def _label_new(updated: 'UpdatedMap', detections: 'PosedDetections', labeller: 'Labeller'
               ) -> 'UpdatedMap':
    """Return the update with phrases as labels of its new landmarks; the others keep theirs."""
    landmark_map, first = updated.landmark_map, updated.first_new
    if first == len(landmark_map):
        return updated
    new, _ = labeller.describe(landmark_map.select(range(first, len(landmark_map))), detections,
                               np.where(updated.shown >= first, updated.shown - first, -1))
    labelled = replace(
        landmark_map, labels=landmark_map.labels[:first] + new.labels,
        details=landmark_map.details[:first] + new.details)
    texts = dict(zip(new.landmark_ids, new.labels, strict=True))
    report = replace(updated.report, new=tuple(
        replace(one, label=texts[one.landmark_id]) for one in updated.report.new))
    return replace(updated, landmark_map=labelled, report=report)
