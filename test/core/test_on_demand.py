# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Crops on demand: their order, when comparing stops, and its cost."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, make_room, see_room

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.localizer import (
    BATCH,
    Crops,
    Localizer,
    informative_first,
    localize_on_demand,
)
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import NEVER, RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer

ROOM = make_room()
SEEN = see_room(ROOM)
OPTIONS = RelocalizerOptions(crops='on_demand')
SURE = np.where(np.eye(len(ROOM)), 0.3, 0.15).astype(np.float32)
VIEW = Observation(CAMERA, SEEN, SURE)


def localize(options):
    localizer = Localizer(Relocalizer(ROOM, options))
    found = localizer.answer(Query((VIEW,), run=None))
    return localizer.query.newest, found


class Searches(Relocalizer):
    """A relocalizer that keeps the observations of its searches."""

    seen = ()

    def search(self, observation, deadline=NEVER):
        self.seen = (*self.seen, observation)
        return super().search(observation, deadline)


def searches(crops):
    """Return the observations of each search of a frame that no search accepts."""
    relocalizer = Searches(ROOM, replace(OPTIONS, min_confidence=1.0))
    frame, found = localize_on_demand(relocalizer, (), VIEW, crops)
    assert not found.accepted and frame.observation is relocalizer.seen[-1]
    return relocalizer.seen


def test_the_crops_that_say_most_come_first():
    lone = replace(ROOM, class_ids=('a', *'b' * 11))
    boxes = np.array([[0, 0, 90, 90], [0, 0, 90, 90], [0, 0, 40, 40], [0, 0, 99, 99.0]])
    seen = Observation(CAMERA, Detections(boxes, ('a', 'b', 'b', 'unknown'), np.ones(4)))
    # classes with many landmarks and large boxes come first; an unmapped class does not help
    assert informative_first(lone, seen).tolist() == [1, 2, 0, 3]


def test_each_stage_has_more_crops_and_the_last_one_all():
    stages = searches(Crops(lambda rows: SURE[rows], np.array([5])))
    assert [len(stage.compared) for stage in stages] == [1, 1 + BATCH, 1 + 2 * BATCH, len(SEEN)]
    assert stages[0].compared.tolist() == [5], 'known similarities cost nothing'
    assert sorted(stages[-1].compared) == list(range(len(SEEN)))
    for stage in stages:
        assert np.array_equal(stage.similarities, SURE[stage.compared])
        rows = stage.similarity_rows
        assert np.array_equal(np.nonzero(rows >= 0)[0], np.sort(stage.compared))
        assert np.array_equal(stage.compared[rows[rows >= 0]], np.nonzero(rows >= 0)[0])


@pytest.mark.parametrize('embedded', [False, True])
def test_no_crop_is_class_matching_and_all_crops_are_hybrid(embedded):
    """Similarities are those of an array, or of embeddings."""
    unit = np.eye(len(ROOM), dtype=np.float32)
    labels = LabelEmbeddings.of(unit)
    *_, last = stages = searches(Crops(lambda rows: CropSimilarities(
        unit[rows], labels) if embedded else unit[rows]))
    hybrid = Relocalizer(ROOM, RelocalizerOptions())
    by_class = Relocalizer(ROOM, RelocalizerOptions(matching='class')).relocalize([VIEW])
    none = hybrid.relocalize([stages[0]])
    assert np.array_equal(none.map_from_camera, by_class.map_from_camera)
    assert none.confidence == by_class.confidence
    whole = hybrid.relocalize([replace(VIEW, similarities=unit)])
    found = hybrid.relocalize([last])
    assert pose_error(found.map_from_camera, whole.map_from_camera)[0] < 1e-6
    assert found.confidence == pytest.approx(whole.confidence)


def test_an_early_stop_is_surer_than_the_last_one():
    """A pose that is accepted by class, but with doubt, is compared with all crops."""
    sure = localize(OPTIONS)[1].confidence
    asked = replace(OPTIONS, min_confidence=1.0 - 3.0 * (1.0 - sure))
    seen, found = localize(asked)
    assert found.accepted and len(seen.compared) > 0
    seen, found = localize(replace(asked, min_confidence=1.0 - 10.0 * (1.0 - sure)))
    assert found.accepted and len(seen.compared) == 0
    seen, found = localize(replace(OPTIONS, min_confidence=1.0))
    assert not found.accepted and len(seen.compared) == len(SEEN)


def test_without_time_for_all_crops_a_pose_must_be_as_sure():
    sure = localize(OPTIONS)[1].confidence
    options = replace(OPTIONS, min_confidence=1.0 - 3.0 * (1.0 - sure))
    crops = Crops(lambda rows: SURE[rows], room=lambda: 0)
    _, found = localize_on_demand(Relocalizer(ROOM, options), (), VIEW, crops)
    # one camera: comparing all crops does not change its evidence, except for rounding
    assert found.confidence == pytest.approx(sure, abs=1e-7) and sure > options.min_confidence
    assert not found.accepted and found.refusal_kind == 'not_all_crops'
