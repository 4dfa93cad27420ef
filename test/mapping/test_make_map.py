# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapping as a library: from observations to a map file, and on to its update."""

from pathlib import Path

import pytest
from walk import make_table, nearest_errors, see, walk_around

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.errors import ModelError
from cliploc_ros.make_map import find_labeller, make_map, update_map
from cliploc_ros.mapping.options import MappingOptions


def test_a_map_is_made_written_and_updated(tmp_path):
    table, file = make_table(), tmp_path / 'map.yaml'
    detections = see(table, walk_around())
    stages = []
    made = make_map(detections, find_labeller(detections, None),
                    progress=lambda stage, share: stages.append(stage))
    write_map(file, made.landmark_map, made.report.lines()[:1], made.embeddings)
    assert nearest_errors(LandmarkMap.from_file(file), table).max() < 0.003
    assert made.layer is None and stages[-1] == 'done'
    labeller = find_labeller(detections, None)
    again = update_map(file, detections, labeller, MappingOptions())
    assert again.landmark_map.landmark_ids == made.landmark_map.landmark_ids
    assert not again.report.new


def test_labels_are_class_names_where_clip_is_missing(tmp_path):
    detections = see(make_table(), walk_around())
    assert find_labeller(detections, None).note.startswith('labels are class names')
    words = Path(tmp_path / 'our.yaml')
    words.write_text('cup: [our cup]')
    with pytest.raises(ModelError, match='no-clip'):
        find_labeller(detections, None, words)
