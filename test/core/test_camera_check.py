# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A camera_info or boxes with an error common to all objects: looks detect it, poses are refused.

The room is simulated and seen from many places."""

import json
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from scene import CAMERA, boxes_of, make_room, see_room
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.acceptance.camera_check import CameraCheck, CameraLook, Extent, Views
from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.detector_check import DetectorCheck
from cliploc_ros.core.fit.camera_fit import ERRORS, corrected, fit_camera
from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN
from cliploc_ros.offline.posed_query import PosedQuery
from studies import wrong_sensors

ROOM = make_room()
RELOCALIZER = Relocalizer(ROOM, RelocalizerOptions(matching='class', tilt_deviation_deg=0.0))
SIZE = np.array([CAMERA.width, CAMERA.height])
LOOKS = 16


def place(rng):
    """Return a pose in front of the room, from which most of it is visible."""
    x, y, z = rng.uniform((-1.0, -0.8, -1.5), (1.0, 0.8, 0.5))
    turn = Rotation.from_euler('yxz', [np.arctan2(-x, 4.5 - z), np.arctan2(y, 4.5 - z), 0.0])
    return make_transform((turn * Rotation.from_rotvec(rng.normal(0.0, 0.08, 3))).as_matrix(),
                          np.array([x, y, z]))


def query(rng, noise_px=1.0, pose=None):
    """Return a query at a place, with boxes cut at the border of the image."""
    pose = place(rng) if pose is None else pose
    boxes = boxes_of(ROOM, pose)
    boxes = np.clip(boxes + rng.normal(0.0, noise_px, boxes.shape), 0.0, [*SIZE, *SIZE])
    rows = np.nonzero((boxes[:, 2:] - boxes[:, :2] > 8.0).all(axis=1))[0]
    return PosedQuery(0, Observation(CAMERA, Detections(
        boxes[rows], tuple(ROOM.class_ids[row] for row in rows), np.full(len(rows), 0.9))), pose)


def localized(localizer, queries):
    return [localizer.answer(Query((query.observation,), run=None)) for query in queries]


def matches(boxes, map_from_camera):
    """Return the rows of residuals_of for known matches, and the pose (3, 3), (3,)."""
    left, top, right, bottom = CAMERA.normalize_bboxes(boxes).T
    half_x, half_y = (right - left) / 2, (bottom - top) / 2
    pairs = np.column_stack([(left + right) / 2, (top + bottom) / 2, half_x, half_y, ROOM.centers,
                             ROOM.shapes, 0.06 * (half_x + half_y) + 0.003,
                             np.zeros((len(boxes), 2))])
    pose = invert_transform(map_from_camera)
    return pairs, np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy()


@pytest.mark.parametrize('errors', [
    (0.4, 0.0, 0.1, -0.05, 0.0, 0.0, 0.0), (-0.4, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, -0.3, 0.2, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3)])
def test_errors_of_a_camera_are_found_with_the_pose(errors, rng):
    errors, information, vector = np.array(errors), np.zeros((ERRORS, ERRORS)), np.zeros(ERRORS)
    for _ in range(12):
        pose = place(rng)
        right, rotation, translation = matches(boxes_of(ROOM, pose), pose)
        # the uncorrected boxes of these corrected ones
        pairs = right.copy()
        for axis, scale in enumerate(np.exp(errors[0] + errors[1] * np.array([0.5, -0.5]))):
            pairs[:, axis] = scale * (right[:, axis] + 2.0 * errors[4 + axis]
                                      * right[:, 2 + axis]) + errors[2 + axis]
            pairs[:, 2 + axis] = scale * np.exp(errors[6]) * right[:, 2 + axis]
        np.testing.assert_allclose(corrected(pairs, errors)[:, :4], right[:, :4], atol=1e-12)
        pairs[:, :4] += rng.normal(0.0, 0.002, (len(pairs), 4))
        fit = fit_camera(pairs, np.ones((len(pairs), 4), dtype=bool), VERTICAL_UNKNOWN, rotation,
                         translation, np.full(ERRORS, 1.0))
        information += fit.information
        vector += fit.information @ fit.errors + fit.errors
    np.testing.assert_allclose(np.linalg.solve(information + np.eye(ERRORS), vector), errors,
                               atol=0.03)


@pytest.mark.parametrize(('focal', 'noise_px'), [(1.0, 0.5), (1.03, 1.0), (0.97, 2.0)])
def test_a_right_camera_is_verified(focal, noise_px, rng):
    queries = wrong_sensors.scaled_focal([query(rng, noise_px) for _ in range(LOOKS)], focal)
    localizer = Localizer(RELOCALIZER)
    for found, asked in zip(localized(localizer, queries), queries, strict=True):
        assert found.accepted
        assert pose_error(found.map_from_camera, asked.map_from_camera)[0] < 0.5
        assert localizer.cameras.faults == []
    # evidence on the camera from earlier looks makes a pose more certain
    assert found.evidence.camera > 0.99
    strict = Localizer(Relocalizer(ROOM, replace(RELOCALIZER.options, min_confidence=0.9999)))
    found, = localized(strict, queries[:1])
    assert found.cameras and not found.accepted, 'a likely pose is evidence about the camera'


WRONG = {
    'K of half the size': lambda some: wrong_sensors.scaled_camera(some, 0.5),
    'focal length': lambda some: wrong_sensors.scaled_focal(some, 1.3),
    'principal point': lambda some: wrong_sensors.shifted_center(some, 0.2),
    'a middle crop of 416 px': lambda some: wrong_sensors.middle_crop(some, 416.0),
    'half the resolution': lambda some: wrong_sensors.scaled_boxes(some, 0.5),
    'a shift': lambda some: wrong_sensors.shifted_boxes(some, 0.15),
    'corners taken for centre and sides': lambda some: wrong_sensors.of_convention(some, 1)}


@pytest.mark.parametrize('what', WRONG)
def test_a_wrong_camera_is_refused_with_the_cause(what, rng):
    localizer = Localizer(RELOCALIZER)
    found = localized(localizer, WRONG[what]([query(rng) for _ in range(LOOKS)]))
    wrong = [result.refusal_kind is RefusalKind.WRONG_CAMERA for result in found]
    refused = [not result.accepted for result in found]
    assert all(refused[LOOKS // 2:])
    assert sum(wrong[LOOKS // 2:]) > 0 or not any(result.accepted for result in found)


@pytest.mark.parametrize(('change', 'level', 'is_wrong'), [
    (wrong_sensors.scaled_focal, 1.0, False), (wrong_sensors.scaled_camera, 0.5, True),
    (wrong_sensors.letterboxed, 416.0, True), (wrong_sensors.scaled_camera, 1.4, True)])
def test_on_a_rough_map_only_a_wrong_camera_is_called_wrong(change, level, is_wrong, rng):
    """Errors of each object's sizes and centre are in all looks, like those of the camera."""
    rough = replace(ROOM, semi_axes=ROOM.semi_axes * np.exp(rng.normal(0.0, 0.15, (len(ROOM), 3))),
                    centers=ROOM.centers + rng.normal(0.0, 0.04, (len(ROOM), 3)))
    localizer = Localizer(Relocalizer(rough, RELOCALIZER.options))
    found = localized(localizer, change([query(rng) for _ in range(LOOKS)], level))
    assert bool(localizer.cameras.faults) == is_wrong
    assert any(result.cameras and not result.accepted for result in found) == is_wrong


def look_at(position, focal, size=400.0, careful=1.0):
    """Return a look from a position [m] by which the focal length is off."""
    information = size * np.eye(ERRORS)
    return CameraLook('', True, make_transform(np.eye(3), np.array(position, dtype=float)),
                      information, information[0] * focal, careful, np.zeros((6, ERRORS)))


def views_of(count, focal=0.2, **fields):
    """Return views a metre apart."""
    return reduce(Views.with_look, (look_at((number, 0, 0), focal, **fields)
                                    for number in range(count)), Views())


def test_errors_of_the_map_do_not_average_out_over_many_views():
    few, most = int(CALIBRATION.camera.independent), int(CALIBRATION.camera.most_views)
    log_odds = [views_of(count, 0.11, size=300.0).odds().log_odds
                for count in (few // 2, few, most)]
    assert 0.0 < log_odds[0] < log_odds[1] < CALIBRATION.camera.sure
    assert log_odds[2] == pytest.approx(log_odds[1])


def test_poor_fits_name_a_wrong_camera_and_do_not_verify_a_right_one():
    assert views_of(4, careful=0.1).odds().is_wrong
    looks = [look_at((0, 0, 0), focal, careful=careful)._replace(moves=100.0 * np.eye(6, ERRORS))
             for focal in (0.0, 0.3) for careful in (0.01, 1.0)]
    poor, good, *wrong = (CameraCheck().judge([look], np.eye(6))[0] for look in looks)
    assert poor < 0.8 * good and wrong[0] == wrong[1] < good


def test_a_doubted_camera_gives_no_pose_and_a_wrong_one_is_mended_by_several_places(rng):
    check, doubts = CameraCheck(), []
    check.see(query(rng).observation)
    for number in range(12):
        look = look_at((number, 0, 0), 0.12, size=300.0)
        doubts.append(check.judge([look], np.eye(6))[2])
        check.add([look])
    assert not any(doubts[:8]) and doubts[-1] and not check.faults
    check.add([look_at((number, 0, 0), 0.2) for number in range(6)])
    check.add([look_at((0, 1, 0.1 * number), 0.0) for number in range(4)])
    assert check.faults, 'poses at one place may fit by chance'
    check.add([look_at((5, 5, number), 0.0) for number in range(4)])
    assert not check.faults


def test_the_covariance_has_the_errors_of_a_camera_until_it_is_verified(rng):
    first, *queries = [query(rng) for _ in range(LOOKS)]
    for change, level in ((wrong_sensors.scaled_camera, 1.2), (wrong_sensors.scaled_focal, 0.8)):
        found, = localized(Localizer(RELOCALIZER), change([first], level))
        assert normalized_square(found.map_from_camera, found.covariance,
                                 first.map_from_camera) < chi2.ppf(0.95, 6)
    localizer = Localizer(RELOCALIZER)
    before, = localized(localizer, [first])
    localized(localizer, queries)
    after, = localized(localizer, [first])
    sizes = [np.linalg.eigvalsh(found.covariance).max() for found in (before, after)]
    assert sizes[1] < 0.9 * sizes[0]
    # what verified cameras may still be off by
    share, covariance, _ = localizer.cameras.judge(after.cameras, np.eye(6))
    assert share > 0.99
    assert (np.linalg.eigvalsh(covariance - np.eye(6)) > -1e-9).all()


def test_looks_from_one_view_count_once(rng):
    localizer, pose = Localizer(RELOCALIZER), place(rng)
    looks = wrong_sensors.scaled_focal([query(rng, pose=pose) for _ in range(30)], 1.3)
    found = localized(localizer, looks)
    assert localizer.cameras.faults == []
    alone = [Views().with_look(look).odds().log_odds for one in found for look in one.cameras]
    assert len(alone) == 30 and max(alone) < CALIBRATION.camera.view + 0.1
    views = views_of(4)
    for number in range(3):
        views = views.with_look(found[number].cameras[0]._replace(vector=np.full(ERRORS, number)))
    assert views.counts.tolist()[1:] == [1, 1, 1, 3]
    np.testing.assert_allclose(views.vectors[-1], 1.0, err_msg='their mean')
    for off_m in (0.2, 0.1):  # beside the last view, and between both
        views = views.with_look(found[0].cameras[0]._replace(
            map_from_camera=views.poses[4] @ make_transform(np.eye(3), np.full(3, off_m))))
    assert views.counts.tolist()[4:] == [4, 1]


@pytest.mark.parametrize('mended', ['camera_info', 'detector'])
def test_a_mended_camera_is_accepted_again(mended, rng):
    localizer, queries = Localizer(RELOCALIZER), [query(rng) for _ in range(LOOKS)]
    localized(localizer, wrong_sensors.scaled_focal(queries, 1.4) if mended == 'camera_info'
              else wrong_sensors.scaled_boxes(queries, 0.7))
    assert localizer.cameras.faults
    found = localized(localizer, [query(rng) for _ in range(LOOKS)])
    assert localizer.cameras.faults == []
    accepted = [result.accepted for result in found]
    assert all(accepted if mended == 'camera_info' else accepted[LOOKS // 2:])


def drawn(rng, count, low, high):
    """Return boxes of randomly placed objects, cut at a rectangle from low (2,) to high (2,)."""
    sides = rng.uniform(40.0, 160.0, (count, 2))
    corners = rng.uniform(np.subtract(low, sides), high)
    boxes = np.hstack([corners, corners + sides])
    return np.clip(boxes, np.tile(low, 2), np.tile(high, 2))


@pytest.mark.parametrize(('low', 'high', 'is_other'), [
    ((0.0, 0.0), SIZE, False), ((0.0, 0.0), (300.0, 300.0), True),
    ((0.0, 140.0), (640.0, 340.0), True), ((-200.0, 0.0), SIZE, True)])
def test_boxes_end_at_the_border_of_their_image(low, high, is_other, rng):
    extent = Extent()
    for _ in range(8):
        extent = extent.with_boxes(drawn(rng, 8, low, high))
    evidence = extent.log_odds(CAMERA)
    assert evidence == CALIBRATION.camera.extent if is_other else evidence < 1.0


def test_the_check_hears_of_boxes_and_goes_on_with_slightly_other_intrinsics(rng):
    check = CameraCheck()

    def see(camera, high):
        boxes = drawn(rng, 8, (0.0, 0.0), high)
        check.see(Observation(camera, Detections(boxes, ('a',) * 8, np.full(8, 0.9))))
        return len(check.faults)
    assert [see(CAMERA, (300.0, 300.0)) for _ in range(8)][-1] == 1
    verified = check.copied()
    verified.add([look_at((number, 0, number), 0.0, size=4000.0) for number in range(9)])
    for _ in range(8):
        verified.see(Observation(CAMERA, Detections(
            drawn(rng, 8, (0.0, 0.0), SIZE), ('a',) * 8, np.full(8, 0.9))))
    assert float(verified.values['camera check'].split()[0]) < 0.0, 'boxes reach the border'
    focused = replace(CAMERA, fx=1.005 * CAMERA.fx, fy=1.005 * CAMERA.fy)
    assert see(focused, (300.0, 300.0)) == 1
    for focal in (0.2, 0.0):
        check.add([look_at((number, number // 3, number % 3), focal) for number in range(9)])
    assert see(focused, (300.0, 300.0)) == 1, 'boxes still end at a line: it is not mended'
    assert see(replace(CAMERA, cx=CAMERA.cx + 20.0), (300.0, 300.0)) == 0, 'another camera'


def test_a_view_that_stays_the_same_has_no_border(rng):
    """The robot stands; all objects before it are completely within the image."""
    corners = rng.uniform(100.0, 250.0, (8, 2))
    extent, boxes = Extent(), np.hstack([corners, corners + rng.uniform(40.0, 160.0, (8, 2))])
    for _ in range(50):
        extent = extent.with_boxes(boxes + rng.normal(0.0, 0.5, boxes.shape))
    assert extent.log_odds(CAMERA) < 1.0


def test_nothing_is_known_of_a_new_camera():
    share, covariance, fault = CameraCheck().judge([], np.eye(6))
    assert (share, fault) == (1.0, '') and (covariance == np.eye(6)).all()
    moves = np.zeros((6, ERRORS))
    # the camera moves by 1 m if the focal length, or the ratio of fx to fy, changes by 1 %
    moves[0, 0] = moves[1, 1] = 100.0
    share, covariance, fault = CameraCheck().judge([CameraLook(
        '', True, np.eye(4), np.zeros((ERRORS, ERRORS)), np.zeros(ERRORS), 1.0, moves)], np.eye(6))
    terms = CALIBRATION.camera
    factors = np.exp(np.random.default_rng(0).normal(0.0, terms.wrong_focal, 10**6))
    expected = np.diag([*(1.0 + terms.wrong * 100.0**2 * square for square in (
        np.square(factors - 1.0).mean(), terms.wrong_aspect**2)), *[1.0] * 4])
    np.testing.assert_allclose(covariance, expected, rtol=0.01)
    # a right camera, whose errors are in the covariance, remains
    assert 1.0 - terms.wrong < share < 0.6 and not fault


@pytest.mark.parametrize(('error', 'size', 'said'), [
    (0, 0.3, 'boxes fit fx 675 fy 675 '), (1, 0.2, 'boxes fit fx 553 fy 452 '),
    (5, 0.4, 'off by +0.00 of their widths and +0.40'), (6, 0.6, '1.82 times as large')])
def test_the_error_of_a_wrong_camera_is_named(error, size, said, rng):
    check, information = CameraCheck(), 1e4 * np.eye(ERRORS)
    check.see(query(rng).observation)
    looks = [CameraLook('', True, place(rng), information, information[error] * size,
                        1.0, np.zeros((6, ERRORS))) for _ in range(12)]
    check.add([look._replace(is_new=False) for look in looks])
    assert not check.faults, 'these frames were seen before'
    check.add(looks)
    (fault,) = check.faults
    assert said in fault
    assert check.judge([], np.eye(6))[2] == fault, 'whatever the next pose depends on'


def test_edges_at_the_border_of_the_image_do_not_count(rng):
    seen = query(rng).observation
    inside = ((seen.detections.bboxes_xyxy > 3.0)
              & (seen.detections.bboxes_xyxy < [*SIZE - 3.0, *SIZE - 3.0])).all(axis=1)
    seen = replace(seen, detections=seen.detections.select(np.nonzero(inside)[0]))
    looks = [localized(Localizer(RELOCALIZER), [PosedQuery(0, replace(
        seen, camera=replace(CAMERA, width=width, height=height)), np.eye(4))])[0].cameras[0]
        for width, height in ((640, 480), (2000, 2000))]
    np.testing.assert_allclose(looks[0].information, looks[1].information, rtol=1e-6)


def test_each_camera_of_a_rig_may_be_wrong(rng):
    moves = np.zeros((6, ERRORS))
    moves[0, 0] = 100.0
    looks = [CameraLook(name, True, np.eye(4), np.zeros((ERRORS, ERRORS)), np.zeros(ERRORS),
                        1.0, errors)
             for name, errors in (('front', moves), ('back', 0.0 * moves))]
    alone, both = (CameraCheck().judge(some, np.eye(6)) for some in (looks[:1], looks))
    assert both[0] == alone[0] < 0.6
    np.testing.assert_array_equal(both[1], alone[1])


@pytest.mark.parametrize('focal', [1.0, 1.3])
def test_with_what_was_known_before_the_same_answer_comes_again(focal, rng):
    """Answer again from a file, as evaluate repeats a recorded request."""
    localizer = Localizer(RELOCALIZER)
    queries = wrong_sensors.scaled_focal([query(rng) for _ in range(LOOKS)], focal)
    for one in queries:
        found = localizer.answer(Query((one.observation,), run=None))
        again = Localizer(RELOCALIZER)
        repeated = again.answer(replace(localizer.query, cameras=CameraCheck.of_fields(json.loads(
            json.dumps(localizer.query.cameras.fields())))))
        assert repeated.evidence == found.evidence
        assert repeated.refusal_kind == found.refusal_kind
    assert again.cameras.faults == localizer.cameras.faults
    assert bool(again.cameras.faults) == (focal != 1.0)
    older = localizer.cameras.fields()
    for record in older.values():
        record |= {some: record[some][:4] for some in ('views', 'since')}
    assert CameraCheck.of_fields(older).values == localizer.cameras.values
    for part, rows, factor in ((0, 1, 1), (1, LOOKS, 0), (2, LOOKS, -1e9), (3, LOOKS, 1e9)):
        older[''] = record | {'views': [*map(np.array, record['views'])]}
        older['']['views'][part] = factor * older['']['views'][part][:rows]
        with pytest.raises(ValueError, match=r'views|definite'):
            CameraCheck.of_fields(older)


NOTHING_FOUND = Relocalization(False, '5 detections are too few; turn the camera to more objects',
                               refusal_kind=RefusalKind.TOO_FEW_OBJECTS)
BOX = [10.0, 20.0, 60.0, 90.0]


def detections(class_id='a', score=0.9, box=BOX, count=5):
    return Detections(np.tile(np.array(box, dtype=np.float64), (count, 1)), (class_id,) * count,
                      np.full(count, score))


def checked(*frames, by_class=True):
    check = DetectorCheck(make_room(), by_class)
    for given in frames:
        check.add(given, given.usable(CAMERA.width, CAMERA.height, 50))
    return check


@pytest.mark.parametrize(('given', 'said'), [
    (detections('62'), '62, which are'), (detections(''), 'no name'),
    (detections('A'), "did you mean 'a'"), (detections('zebra\n[FATAL]' * 9), 'zebra [FATAL]'),
    (detections(score=np.nan), '5 scores'), (detections(score=np.inf), '5 scores'),
    (detections(box=[0.1, 0.2, 0.3, 0.4]), '0.2 x 0.2 px'),
    (detections(box=[60.0, 20.0, 10.0, 90.0]), '-50 x 70 px'),
    (detections(box=[np.nan] * 4), 'nan'), (detections(box=[900.0, 900.0, 950.0, 950.0]), '900')])
def test_detections_of_no_use_are_the_cause_of_a_refusal(given, said):
    check = checked(given)
    assert [fault.is_certain for fault in check.faults] == [True]
    found = check.explain(NOTHING_FOUND)
    assert found.refusal_kind is RefusalKind.WRONG_DETECTIONS
    assert said in found.reason and 'turn the camera' not in found.reason
    assert '\n' not in found.reason and len(found.reason) < 300


@pytest.mark.parametrize('check', [
    checked(), checked(detections('a')), checked(see_room(make_room())),
    checked(detections(count=0)), checked(detections('zebra'), by_class=False),
    checked(detections('zebra'), detections('a')),
    checked(detections(score=np.nan), detections(count=0))])
def test_other_refusals_stay(check):
    assert check.explain(NOTHING_FOUND) == NOTHING_FOUND


def test_a_fault_shows_over_frames_that_have_a_box_each():
    check = checked(*[detections('zebra', count=1)] * 2)
    assert check.faults == []
    check.add(*[detections('62', count=1)] * 2)
    assert check.faults[0].is_certain and '62' in check.faults[0].text
    assert check.explain(NOTHING_FOUND).refusal_kind is RefusalKind.WRONG_DETECTIONS


@pytest.mark.parametrize('score', [87.0, -0.5])
def test_odd_scores_are_doubted_and_used(score):
    check = checked(detections(score=score))
    assert [(fault.is_certain, f'{score:g}' in fault.text) for fault in check.faults] == [
        (False, True)]
    assert check.explain(NOTHING_FOUND) == NOTHING_FOUND


def test_an_accepted_pose_is_left_alone():
    """Keyframes without objects may recognize a place."""
    accepted = Relocalization(True, '')
    assert checked(detections('zebra')).explain(accepted) == accepted
