# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A case of queries repeats its answer bit by bit from its file; crops on demand."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from scene import BY_CLASS, CAMERA, MAP_FROM_CAMERA, ROOM, SEEN

from cliploc_ros.core.acceptance.camera_check import CameraCheck
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.localizer import (
    BATCH,
    Crops,
    Localizer,
    informative_first,
    localize_on_demand,
    repeat,
)
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.core.observation import Detections, Observation, Region, SeenTags
from cliploc_ros.core.options import NEVER, RelocalizerOptions
from cliploc_ros.core.query import CASE, Case, Query, case_arrays, read_case
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import DatasetError, OptionsError
from cliploc_ros.models.observer import Observer

IMAGE = np.random.default_rng(0).integers(0, 255, (CAMERA.height, CAMERA.width, 3), np.uint8)
LABELS = LabelEmbeddings.of(np.linalg.qr(np.random.default_rng(1).normal(
    size=(16, 16)))[0][:len(ROOM)].astype(np.float32))


class Encoder:
    """Embeds crops by their mean colours, and counts them."""

    def __init__(self):
        self.count = 0

    def encode_crops(self, image_rgb, bboxes_xyxy):
        self.count += len(bboxes_xyxy)
        found = [np.random.default_rng(int(image_rgb[int(top):, int(left):].sum())).normal(
            size=16) for left, top, _, _ in np.maximum(bboxes_xyxy, 0.0)]
        rows = np.array(found, dtype=np.float32).reshape(-1, 16)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def query(**changes):
    return Query((replace(Observation(CAMERA, SEEN, stamp_ns=5, odom_from_camera=np.eye(4)),
                          **changes),), (IMAGE,))


def stored(queries, options, path):
    CASE.write(path, case_arrays(Case(tuple(queries), {'options': vars(options)})), compress=True)
    return read_case(path)


def equal(one, other):
    np.testing.assert_array_equal(one.map_from_camera, other.map_from_camera)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert (one.evidence, one.reason) == (other.evidence, other.reason)


@pytest.mark.parametrize(('changes', 'count'), [
    ({}, len(SEEN)), ({'min_confidence': 0.5}, 0),
    ({'crops': 'all', 'min_confidence': 0.5}, len(SEEN)),
    ({'algorithm': 'prosac', 'iterations': 50}, len(SEEN)), ({'matching': 'class'}, 0)])
def test_the_crops_that_were_compared_are_compared_again(changes, count, tmp_path):
    options = RelocalizerOptions(**{'min_confidence': 1.0} | changes)
    encoder = Encoder()
    localizer = Localizer(Relocalizer(ROOM, options))
    found = localizer.answer(query(), Observer(encoder, LABELS))
    assert encoder.count == count
    case = stored([localizer.query], options, tmp_path / 'case.npz')
    encoder = Encoder()
    again = repeat(case, Localizer(Relocalizer(ROOM, case.options)), Observer(encoder, LABELS))
    assert encoder.count == 0, 'embeddings are stored'
    equal(again, found)


def test_crops_end_where_time_ended(tmp_path):
    options = RelocalizerOptions(min_confidence=1.0)
    localizer = Localizer(Relocalizer(ROOM, options))
    observer = Observer(Encoder(), LABELS)
    rooms = iter([2, 3])
    observer.crops_within = lambda left_s: next(rooms, 0)
    found = localizer.answer(query(), observer, 1e9)
    assert localizer.query.rooms == (0, 2, 3, 0)
    assert found.refusal_kind == 'not_all_crops' or len(localizer.query.newest.compared) == 5
    equal(repeat(stored([localizer.query], options, tmp_path / 'case.npz'), Localizer(
        Relocalizer(ROOM, options)), Observer(Encoder(), LABELS)), found)


def test_another_map_has_labels_of_its_own(tmp_path):
    """A case is also answered with a part of its map."""
    options = RelocalizerOptions(min_confidence=1.0, k=2)
    localizer = Localizer(Relocalizer(ROOM, options))
    localizer.answer(query(), Observer(Encoder(), LABELS))
    case = stored([localizer.query], options, tmp_path / 'case.npz')
    rows, encoder = list(range(8)), Encoder()
    labels = LabelEmbeddings.of(np.asarray(LABELS)[rows])
    again = repeat(case, Localizer(Relocalizer(ROOM.select(rows), options)),
                   Observer(encoder, labels))
    assert encoder.count == 0
    assert pose_error(again.map_from_camera, MAP_FROM_CAMERA)[0] < 0.05
    # given similarities need no crops
    given = query(similarities=np.eye(12, dtype=np.float32))
    Localizer(Relocalizer(ROOM, options)).answer(given, Observer(encoder, LABELS))
    assert encoder.count == 0
    with pytest.raises(OptionsError):
        Localizer(Relocalizer(ROOM, options)).answer(query())


def test_all_that_is_known_comes_back(tmp_path):
    region = Region('map', np.array([0.1, 0.2, 0.3]), np.diag([1.0, 2.0, 3.0]), 0.7)
    pose = make_transform(np.eye(3), np.array([0.1, 0.0, 1e-17]))
    first = query(up_in_camera=np.array([0.0, -1.0, 0.0]), odom_from_camera=pose, odom_way_m=0.1,
                  stamp_ns=7, region=region, base_up_in_camera=np.array([0.0, 0.0, 1.0]),
                  depths=np.where(np.arange(len(SEEN)) % 2, 1.0 / 3.0, np.nan),
                  similarities=CropSimilarities(np.eye(12, 16, dtype=np.float32)[:2], LABELS),
                  compared=np.array([3, 1]), camera_name='front',
                  tags=SeenTags(('tag36h11_1',), np.arange(8.0).reshape(1, 4, 2)))
    first = replace(first, run=3, limit=5, length_s=2.5, by_keyframes=False, rooms=(1, 1, 0))
    second = Query((Observation(CAMERA, SEEN.select(np.empty(0, np.int64))),), run=None)
    case = stored([first, second], RelocalizerOptions(height_range_m=(0.5, 2.0)),
                  tmp_path / 'case.npz')
    assert case.options == RelocalizerOptions(height_range_m=(0.5, 2.0))
    found, empty = case.queries
    assert (found.run, found.limit, found.length_s, found.by_keyframes, found.rooms) == (
        3, 5, 2.5, False, (1, 1, 0))
    np.testing.assert_array_equal(found.images[0], IMAGE)
    one, other = (asdict(replace(each, similarities=None)) for each in (
        found.newest, first.newest))
    np.testing.assert_equal(one, other)
    default = vars(Observation(CAMERA, SEEN))
    left_out = [name for name, value in one.items()
                if value is None or (np.isscalar(value) and value == default[name])]
    assert left_out == ['similarities'], 'set every other field in this test'
    np.testing.assert_array_equal(found.newest.similarities.crops, first.newest.similarities.crops)
    assert empty.run is None and empty.images == () and len(empty.newest.detections) == 0


VIEWS = [[np.eye(4).tolist()], [1], [np.eye(7).tolist()], [[0.0] * 7], [1.0]]


@pytest.mark.parametrize(('name', 'value'), [
    ('about', lambda about: about[:-3]), ('about', lambda about: about[:0]), ('crops', 'x'),
    ('images', lambda images: images[:-9]), ('images', lambda images: 0 * images),
    ('image_offsets', lambda offsets: offsets[:1]), ('crop_offsets', lambda offsets: offsets[1:]),
    ('odom_from_camera', [[0.0] * 4] * 4), ('class_ids', [[]]), ('scores', 'x'), ('limit', 0),
    ('bboxes_xyxy', [[1e308] * 4]), ('depths', [1.0]), ('compared', [99]), ('compared', [1, 1]),
    ('views', [*VIEWS[:4], [1.0, 1.0]]), ('views', [VIEWS[0], [[1, 2]], *VIEWS[2:]]),
    ('views', [*VIEWS, [1.0]]), ('image_offsets', lambda offsets: offsets[[0, 1, 1]]),
    ('stamp_ns', 2**70), ('width', 10), ('rooms', [1]), ('frames', []), ('cameras', [1])])
def test_a_case_with_a_wrong_value_is_named(name, value, tmp_path):
    cameras = CameraCheck.of_fields({'': {
        'camera': asdict(CAMERA), 'boxes': [], 'since': [[], [], [], [], []],
        'views': VIEWS}})
    arrays = dict(case_arrays(Case((replace(query(), run=1, cameras=cameras),),
                                   {'parameters': {}})))

    def put(node):
        for key, inner in [*node.items()] if isinstance(node, dict) else enumerate(node):
            if key == name:
                node[key] = value
            elif isinstance(inner, dict | list):
                put(inner)
    if callable(value):
        arrays[name] = value(arrays[name])
    else:
        about = json.loads(arrays['about'].tobytes())
        put(about)
        arrays['about'] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
    np.savez(tmp_path / 'case.npz', **arrays)
    with pytest.raises(DatasetError, match=r'case\.npz'):
        read_case(tmp_path / 'case.npz')


@pytest.mark.parametrize('wrong', ['options', {'k': 'x'}, {'k': None}, {
    'mount_deviation': [1e160, 1]}, {'height_range_m': [10**400, 1]}])
def test_options_of_a_case_are_checked(wrong):
    with pytest.raises(DatasetError, match='options'):
        _ = Case((query(),), {'options': wrong}).options


# ---- crops on demand: their order, when comparing stops, and its cost
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
    by_class = Relocalizer(ROOM, BY_CLASS).relocalize([VIEW])
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
