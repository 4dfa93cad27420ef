# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The evidence for a pose, its confidence and covariance, and the reasons of refusals."""

import importlib.util
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scene as scenes
import yaml
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.confidence import (
    Setting,
    Support,
    _of_group,
    confidences,
    none_right,
    objects_utility,
    tilt_handicaps,
    utilities,
)
from cliploc_ros.core.acceptance.genuine import Motion, Signs, chance_genuine
from cliploc_ros.core.acceptance.look_alikes import lead_over_twin, turned_about_axis
from cliploc_ros.core.acceptance.looks import EarlierLook
from cliploc_ros.core.acceptance.verdict import Evidence, RefusalKind, Rival, refusal
from cliploc_ros.core.calibration import CALIBRATION, FILE
from cliploc_ros.core.fit.covariance import (
    moved_pose,
    normalized_square,
    odometry_deviations,
    shares_within,
)
from cliploc_ros.core.fit.succession import Answered, follow
from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.evaluation.trials import make_queries
from studies.acceptance.troubles import exchange_landmarks


def at(x=0.0):
    return scenes.rigid((x, 0.0, 0.0))


OPTIONS = RelocalizerOptions()
SURE = Evidence(inliers=9, likely=0.99)
GENUINE = Signs(math.log(30), 0.8, 0.0, 0.0, 1.0, 0.5, 0.0)
SMALL = GENUINE._replace(reach=0.3, confirmed=0.4)
RECOGNIZED = RecognizedPlace(np.eye(4), np.eye(6), np.eye(6), 200, 0.9)


def looks(*confidences, doubted=0.0, same_view=0.0):
    """Return earlier looks with these confidences, by default from other views."""
    return tuple(EarlierLook(confidence, doubted, same_view) for confidence in confidences)


LACKING = {'inliers': 0, 'coverage': 0.1, 'tried': 3, 'meetings': 0.0}
# What the evidence lacks, and the kind of refusal that names it; None: the pose is accepted.
WEAK = {
    'nothing': ({}, None), 'nothing, with keyframes': (
        {'signs': GENUINE, 'recognized': RECOGNIZED}, None),
    'rival': ({'likely': 0.5, 'rival': Rival(0.49, (9.0, 9.0, 9.0))}, RefusalKind.AMBIGUOUS),
    'weak rival': ({'likely': 0.5, 'rival': Rival(0.1, (9.0, 9.0, 9.0))}, RefusalKind.UNEXPLAINED),
    'other source': ({'likely': 0.5, 'rival': Rival(0.49, (9.0, 9.0, 9.0), '', True)},
                     RefusalKind.CONTRADICTION),
    'unexplained': ({'likely': 0.5, 'unexplained': 12.0}, RefusalKind.UNEXPLAINED),
    'distinct': ({'distinct': 0.5, 'twin': (2.3, 2.3, 1.2)}, RefusalKind.LOOK_ALIKE),
    'near': ({'near': 0.5, 'deviation_m': 1.23}, RefusalKind.UNCERTAIN_POSITION),
    'genuine': ({'signs': SMALL, 'recognized': RECOGNIZED}, RefusalKind.CHANGED),
    'parted': ({'recognized': RECOGNIZED._replace(parted=0.3)}, RefusalKind.CHANGED),
    'hardly parted': ({'recognized': RECOGNIZED._replace(parted=0.05)}, None),
    'mirror': ({'not_mirrored': 0.5}, RefusalKind.AMBIGUOUS),
    'keyframes': ({'uncontradicted': 0.1, 'rival': Rival(0.01, (9.0, 9.0, 9.0))},
                  RefusalKind.CONTRADICTION),
    'found': ({'meetings': 0.1, 'coverage': 0.5, 'tried': 700}, RefusalKind.SEARCH_CUT_SHORT),
    'tried': ({'coverage': 0.5, 'tried': 499}, RefusalKind.SEARCH_CUT_SHORT),
    'enough tried': ({'coverage': 0.5, 'tried': 500}, None),
    'looks': ({'earlier': looks(*[0.1] * 9)}, RefusalKind.FRAMES_DISAGREE),
    'one good look': ({'earlier': looks(0.0, 0.99, 0.0)}, RefusalKind.FRAMES_DISAGREE),
    'a bad look': ({'earlier': looks(0.0, 0.99)}, None),
    'same view': ({'earlier': looks(0.9, 0.9, doubted=0.6, same_view=1.0)},
                  RefusalKind.FRAMES_DISAGREE),
    'same view, once unknown': ({'earlier': looks(0.9, same_view=1.0)}, None),
    'linked': ({'linked': 0.5}, RefusalKind.FRAMES_DISAGREE),
    'crops': ({'likely': 0.95, 'crops_left': 12}, RefusalKind.NOT_ALL_CROPS),
    'inliers': ({'inliers': 2}, RefusalKind.TOO_FEW_OBJECTS),
    'leaning': ({'tilt_deg': 59.0}, None), 'lying': ({'tilt_deg': 61.0}, RefusalKind.WRONG_MOUNT),
    'vertical': ({'likely': 0.1, 'rival': Rival(0.9, (9.0, 9.0, 9.0), is_tilted=True)},
                 RefusalKind.WRONG_MOUNT),
    # keyframes that are sure replace what objects lack
    'points': (LACKING | {'by_points': 0.99, 'camera_fault': 'boxes'}, None),
    'few points': (LACKING | {'by_points': 0.89}, RefusalKind.SEARCH_CUT_SHORT)}


@pytest.mark.parametrize('what', WEAK)
def test_a_refusal_names_the_evidence_that_decided(what):
    fields, kind = WEAK[what]
    refused = refusal(replace(SURE, **fields), OPTIONS)
    assert (refused and refused.kind) == kind
    assert not refused or len(f'refused: {refused.reason}') <= 120, 'a service answers in one line'


@pytest.mark.parametrize(('fields', 'options', 'kind'), [
    ({'inliers': 3}, {'min_inliers': 4}, RefusalKind.TOO_FEW_OBJECTS), ({'inliers': 3}, {}, None),
    ({'likely': 0.98}, {'min_confidence': 0.99}, RefusalKind.UNEXPLAINED),
    ({'coverage': 0.5, 'tried': 5000}, {'algorithm': 'bf'}, RefusalKind.SEARCH_CUT_SHORT),
    ({'meetings': 0.1}, {'algorithm': 'ransac'}, RefusalKind.SEARCH_CUT_SHORT),
    ({'tilt_deg': 180.0}, {'tilt_deviation_deg': 0.0}, None),
    ({}, {'iterations': 499, 'algorithm': 'b-prosac'}, RefusalKind.SEARCH_CUT_SHORT)])
def test_options_decide_what_a_pose_needs(fields, options, kind):
    refused = refusal(replace(SURE, **fields), RelocalizerOptions(**options))
    assert (refused and refused.kind) == kind


def test_a_picture_needs_motion_to_be_told_from_the_place_and_motion_tells():
    in_doubt = GENUINE._replace(reach=0.6)
    assert chance_genuine(SMALL) < chance_genuine(in_doubt) < chance_genuine(GENUINE)
    assert chance_genuine(SMALL._replace(contradicted=2.0)) < chance_genuine(SMALL)
    moved_like_the_place, moved_like_a_picture = Motion(2.0, 50.0), Motion(60.0, 2.0)
    only_turned = Motion(2.0, 2.0)
    assert chance_genuine(in_doubt, moved_like_the_place) > chance_genuine(in_doubt)
    assert chance_genuine(in_doubt, only_turned) == chance_genuine(in_doubt)
    assert chance_genuine(GENUINE, moved_like_a_picture) < 1e-6
    assert chance_genuine(SMALL, Motion(0.0, 1e4)) < 1.0 - 1e-6, 'the keyframes may be wrong'


def test_the_confidence_counts_the_published_covariance(verified_camera):
    found = Relocalizer(scenes.ROOM, scenes.BY_CLASS).relocalize(
        [scenes.observe(scenes.ROOM, rows=range(4))])
    assert found.evidence.near < 1.0
    assert found.evidence.near == shares_within(
        RIGHT_M, CALIBRATION.covariance.caution * found.covariance[None, :3, :3])


def mirrored(observation):
    seen, camera = observation.detections, observation.camera
    boxes = seen.bboxes_xyxy[:, [2, 1, 0, 3]] * (-1, 1, -1, 1) + (camera.width, 0) * 2
    return replace(observation, detections=replace(seen, bboxes_xyxy=boxes),
                   camera=replace(camera, cx=camera.width - camera.cx))


@pytest.mark.parametrize('algorithm', ['auto', 'ransac'])
def test_the_true_pose_of_a_mirrored_image_is_a_rival(office_map, queries, algorithm):
    """It is far from all reflections of the wrong pose, which explains five objects or more."""
    relocalizer = Relocalizer(office_map, replace(scenes.BY_CLASS, algorithm=algorithm))
    asked = make_queries(queries, office_map, every_frame=True)
    for number in (176, 200):
        observation = next(query for query in asked if query.number == number).observation
        found = relocalizer.relocalize([observation])
        assert found.accepted, found.reason
        assert found.evidence.not_mirrored > 0.95
        wrong = relocalizer.relocalize([mirrored(observation)])
        assert wrong.evidence.likely > 0.9 and wrong.evidence.not_mirrored < 0.4


def test_each_number_states_its_unit_and_meaning_and_the_command_that_fits_it():
    for section in yaml.safe_load(FILE.read_text()).values():
        if section['command'] != 'by definition':
            module, study = re.fullmatch(r'python -m ([\w.]+)(?: (\w+))?',
                                         section['command']).groups()
            spec = importlib.util.find_spec(module)
            if spec.submodule_search_locations:
                spec = importlib.util.find_spec(f'{module}.__main__')
            program = Path(spec.origin).read_text()
            assert "__name__ == '__main__'" in program
            assert study is None or re.search(rf"'{study}'", program), section['command']
            assert bool(study) == ('add_subparsers' in program or "'study'" in program), module
        assert all({*entry} == {'value', 'unit', 'meaning'} for entry in section['terms'].values())


WRONG_MOUNT = CALIBRATION.attitude.wrong_mount


def turned(axis, degrees):
    """Return poses (m, 4, 4) of a level camera, turned about one of its axes."""
    return np.array([scenes.level() @ scenes.rigid(axis=axis, degrees=angle) for angle in degrees])


@pytest.mark.parametrize('axis', ['x', 'z'])
def test_the_more_a_camera_is_tilted_the_more_speaks_against_it(axis):
    against = tilt_handicaps(turned(axis, np.arange(0, 181, 15)), 40.0)
    assert (np.diff(against) >= 0.0).all()
    # handheld and downward cameras lose no confidence, cameras upside down all of it
    assert (against[:5] == 0.0).all()
    assert 0.0 < against[6] < 2.0
    assert against[-1] == WRONG_MOUNT
    assert (tilt_handicaps(turned(axis, np.arange(0, 181, 15)), 0.0) == 0.0).all()
    assert (tilt_handicaps(turned('y', np.arange(0, 360, 30)), 40.0) == 0.0).all(), 'the heading'


@pytest.mark.parametrize('deviations_m', [(0.3, 0.3, 0.3), (0.5, 0.1, 0.02), (2.0, 1.0, 0.1),
                                          (0.4, 0.4, 0.01)])
def test_the_share_within_a_distance_is_that_of_drawn_positions(deviations_m, rng):
    turn = Rotation.random(random_state=1).as_matrix()
    covariance = turn @ np.diag(np.square(deviations_m)) @ turn.T
    drawn = rng.normal(size=(200_000, 3)) * deviations_m
    share = (np.linalg.norm(drawn, axis=1) < 1.0).mean()
    assert shares_within(1.0, covariance[None]) == pytest.approx(share, abs=0.04)


@pytest.mark.once
@pytest.mark.parametrize('matching', ['hybrid', 'class'])
def test_another_place_is_hardly_ever_accepted(matching, office_map, queries, thresholds):
    """Queries in the map with all objects exchanged: every pose is wrong."""
    asked = make_queries(queries, office_map, every_frame=True)[::3]
    accepted, options = [], RelocalizerOptions(matching=matching)
    for seed in range(2):
        elsewhere, _ = exchange_landmarks(office_map, asked, 1.0, np.random.default_rng(seed))
        relocalizer = Relocalizer(elsewhere, options)
        accepted += [relocalizer.relocalize([query.observation]).accepted for query in asked]
    print(f'\n{matching}: {sum(accepted)} of {len(accepted)} accepted in another place')
    assert np.mean(accepted) <= thresholds['trust']['accepted_elsewhere'][matching]


def poses_at(*positions):
    return np.array([at(x) for x in positions])


STRONG, FORTY = Support(7, 5.0, 10.0, 14.0, 14.0), Setting(40)


def share(supports, poses, setting):
    """Return the confidences of poses with given support of objects."""
    return confidences(utilities(supports), poses, none_right(setting))


def test_confidence_is_shared_by_poses_that_differ():
    alone = share([STRONG], poses_at(0), FORTY)[0]
    first, second = share([STRONG, STRONG], poses_at(0, 5), FORTY)
    assert alone > 0.99
    assert first == pytest.approx(second)
    assert 0.45 < first <= 0.5


def test_poses_that_agree_speak_for_each_other():
    assert share([STRONG, STRONG], poses_at(0, 0.6), FORTY).min() > 0.99
    turned = np.array([at(), scenes.rigid((0.6, 0.0, 0.0), degrees=90.0)])
    assert share([STRONG, STRONG], turned, FORTY).max() <= 0.5


def test_a_large_map_takes_confidence_and_a_known_vertical_gives_some():
    fair = Support(4, 3.0, 8.0, 6.0, 8.0)
    small, large, upright, vague = (share([fair], poses_at(0), setting)[0] for setting in (
        Setting(20), Setting(2000), Setting(2000, 1.0), Setting(2000, 45.0)))
    assert large < upright < small
    assert vague == large
    # a better vertical than in the fit has the same effect as the best one in the fit
    assert (share([fair], poses_at(0), Setting(2000, 0.01))
            == share([fair], poses_at(0), Setting(2000, 0.5)))


OWN = np.diag([0.04, 0.01, 0.02, 0.001, 0.002, 0.003])


def answered(truth, error=0.0, odom=None, **kwargs):
    """Return an answer with an error (6,)."""
    return Answered(truth if odom is None else odom, moved_pose(truth, np.zeros(6) + error), OWN,
                    **kwargs)


def test_a_robot_at_rest_becomes_as_certain_as_the_shared_errors_and_no_more():
    track, fused = None, []
    for _ in range(200):
        track = follow(track, answered(at()))
        fused.append(np.linalg.inv(track.for_filter))
    np.testing.assert_allclose(track.covariance, 0.4 * OWN, rtol=0.01)
    # a filter that takes the answers as independent is as certain as the track
    np.testing.assert_allclose(np.linalg.inv(sum(fused)), track.covariance, rtol=0.02)


def test_tracks_are_consistent_with_white_shared_and_odometry_errors():
    rng, root, squares = np.random.default_rng(1), np.sqrt(OWN), []
    motion = scenes.rigid((0.2, 0.1, 0.0), degrees=6.0)
    for _ in range(60):
        track, truth, odom, shared = None, at(), at(), rng.normal(size=6)
        for number in range(20):
            odom = odom @ motion
            truth = moved_pose(truth @ motion, odometry_deviations(motion) * rng.normal(size=6))
            error = root @ (math.sqrt(0.6) * rng.normal(size=6) + math.sqrt(0.4) * shared)
            track = follow(track, answered(truth, error, odom))
            # a rough answer changes nothing, whatever the precise ones share with it
            rough = follow(track, Answered(odom, moved_pose(truth, 5.0 * root @ shared),
                                           25.0 * OWN))
            assert number < 3 or np.allclose(rough.covariance, track.covariance)
        squares.append(normalized_square(track.map_from_camera, track.covariance, truth))
    assert 4.5 < np.mean(squares) < 7.5


def test_a_robot_that_drove_on_gets_all_of_an_answer_wherever_the_map_begins():
    given = []
    for start in (0.0, 30.0):
        track = follow(None, answered(at(start)))
        given.append([follow(track, answered(at(start + way))).for_filter for way in (0.5, 50.0)])
    np.testing.assert_allclose(*given, rtol=1e-6, atol=1e-9)
    near, far = given[0]
    assert near[0, 0] > 1.5 * OWN[0, 0]
    assert far[0, 0] < 1.2 * OWN[0, 0]


def test_a_contradiction_waits_for_the_next_answer():
    track, odom = follow(follow(None, answered(at())), answered(at())), at()
    doubted = follow(track, Answered(odom, at(3.0), OWN))
    assert doubted.contradicting is not None
    np.testing.assert_array_equal(doubted.map_from_camera, track.map_from_camera)
    assert doubted.for_filter[0, 0] > 5.0 * OWN[0, 0], 'an outlier hardly moves a filter'
    for x in (3.0, 0.0):
        refused = Answered(odom, at(x), OWN, 0.8, False)
        assert follow(doubted, refused).contradicting is not None
    assert follow(doubted, Answered(odom, at(0.1), OWN)).contradicting is None
    elsewhere = follow(doubted, Answered(odom, at(-3.0), OWN))
    assert elsewhere.contradicting.map_from_camera[0, 3] == -3.0, 'no two answers agree'
    carried = follow(doubted, Answered(odom, at(3.1), OWN))
    assert carried.contradicting is None
    assert carried.map_from_camera[0, 3] == 3.1


def test_a_refused_pose_counts_if_it_agrees_with_the_track():
    assert follow(None, answered(at(), is_accepted=False)) is None
    track = follow(None, answered(at()))
    near, far, unlikely = (follow(track, Answered(at(), at(x), OWN, confidence, False))
                           for x, confidence in ((0.1, 0.5), (2.0, 0.5), (0.1, 0.01)))
    assert 0.0 < near.map_from_camera[0, 3] < 0.05
    assert far.map_from_camera[0, 3] == unlikely.map_from_camera[0, 3] == 0.0
    np.testing.assert_array_equal(near.for_filter, track.for_filter)


def support_of(landmark_map, detections, similarities=None, frames=1):
    frame = Observation(scenes.CAMERA, detections, similarities, odom_from_camera=np.eye(4))
    options = scenes.BY_CLASS if similarities is None else OPTIONS
    return Relocalizer(landmark_map, options).relocalize([frame] * frames).hypotheses[0].support


def test_labels_and_classes_support_a_pose():
    """A class is as common as in a typical building, if that is more than in the map."""
    room = replace(scenes.ROOM, class_ids=('chair', *scenes.ROOM.class_ids[1:]))
    seen = replace(scenes.SEEN, class_ids=room.class_ids)
    found, by_class = (support_of(room, seen, similarities) for similarities in (
        np.eye(12, dtype=np.float32), None))
    shares = np.array([room.class_ids.count(name) / 12 for name in room.class_ids])
    shares[0] = CALIBRATION.common['chair']
    assert found.rarity == pytest.approx(-np.log(shares).sum())
    assert found.likeness == pytest.approx(12 * np.sqrt(11), rel=1e-4)
    assert (found.unlabelled, by_class.unlabelled, by_class.likeness) == (0, 12, 0.0)


def test_one_thing_under_two_class_names_counts_once():
    """The map has each landmark also under a second class, and the image each box or a part."""
    renamed = tuple(f'also {name}' for name in scenes.ROOM.class_ids)
    both = replace(scenes.doubled_room(np.zeros(3)), class_ids=scenes.ROOM.class_ids + renamed)
    alone = support_of(scenes.ROOM, scenes.SEEN)
    twice = support_of(both, scenes.with_boxes(scenes.SEEN, scenes.SEEN.bboxes_xyxy, renamed))
    assert (twice.inliers, twice.score) == pytest.approx((alone.inliers, alone.score), abs=0.2)
    assert twice.unlabelled == pytest.approx(alone.unlabelled, abs=0.2)
    part = scenes.SEEN.bboxes_xyxy[:1].copy()
    part[0, 2] = part[0, [0, 2]] @ [0.6, 0.4]
    best = support_of(scenes.ROOM, scenes.with_boxes(scenes.SEEN, part, 'a'))
    assert (best.inliers, best.score) == pytest.approx(
        (alone.inliers, alone.score)), 'a part of a box on the same landmark'


def test_a_second_box_of_an_explained_thing_is_not_unexplained():
    """Its class is another one in the map; a box elsewhere is unexplained."""
    def unexplained(boxes, frames=1):
        more = scenes.with_boxes(scenes.SEEN, boxes, scenes.ROOM.class_ids[1:2] * len(boxes))
        return support_of(scenes.ROOM, more, frames=frames).unexplained

    base, elsewhere = support_of(scenes.ROOM, scenes.SEEN).unexplained, [[2.0, 400.0, 60.0, 470.0]]
    assert unexplained(scenes.SEEN.bboxes_xyxy[:1]) == pytest.approx(base, abs=0.01)
    assert unexplained(elsewhere) == pytest.approx(base + 1.0)
    assert unexplained(elsewhere * 2) == pytest.approx(base + 1.0)
    assert unexplained(elsewhere, 2) == pytest.approx(base + 1.0), 'in two frames'


def arrangement(off_m):
    """Return things above each other, with every second one off the axis by a distance [m]."""
    rows = np.arange(6)
    return scenes.map_of([f'thing {row}' for row in rows], np.c_[
        off_m * (rows % 2) * np.array([1, 1, 1, -1, 1, 1]), np.zeros(6), 0.4 * rows],
        (0.12, 0.12, 0.15))


def test_a_turn_about_an_axis_that_all_objects_share_is_a_rival():
    """Things on one axis leave the turn about it open; things off the axis determine it."""
    camera = scenes.level(0.0, -2.5, 90.0)
    on_axis, spread = arrangement(0.06), arrangement(0.8)
    rows = np.arange(6)
    turned = turned_about_axis(arrangement(0.0), camera, rows)
    away = np.linalg.norm(turned[:, None, :3, 3] - arrangement(0.0).centers, axis=2)
    np.testing.assert_allclose(away, np.tile(away[0], (len(turned), 1)), atol=1e-9)
    assert len(turned) >= 7
    assert len(turned_about_axis(scenes.ROOM, camera, np.arange(12))) == 0
    # a camera that is not verified yet also lowers the confidence
    options = RelocalizerOptions(matching='class', min_confidence=0.75)
    found = [Relocalizer(room, options).relocalize(
        [Observation(scenes.CAMERA, scenes.see_room(room, camera), up_in_camera=camera[2, :3])])
        for room in (on_axis, spread)]
    assert [pose.accepted for pose in found] == [False, True]
    assert found[0].evidence.distinct < 0.8 and found[1].evidence.distinct > 0.95


def of_things(things):
    """Return a map of things of known class and place, z up."""
    sizes = {'tv': (0.25, 0.05, 0.2), 'keyboard': (0.2, 0.07, 0.02), 'mouse': (0.03, 0.05, 0.02)}
    return scenes.map_of([name for name, *_ in things], [place for _, *place in things],
                         [sizes.get(name, (0.2, 0.2, 0.3)) for name, *_ in things])


DESK = [('tv', 0.0, 0.3, 1.0), ('tv', 0.6, 0.3, 1.0), ('keyboard', 0.2, -0.1, 0.75),
        ('mouse', 0.55, -0.1, 0.75)]
OFFICE = of_things([*DESK, ('cup', 0.4, 0.0, 0.75), ('chair', 0.3, 1.6, 0.4),
                    ('potted plant', -1.2, 1.5, 0.5), ('oven', 4.0, -3.0, 0.5)])


def test_four_things_of_one_desk_are_less_evidence_than_things_of_the_room(rng):
    """An image may show a desk that the map lacks; its things stand 5 to 10 cm otherwise."""
    terms, camera = CALIBRATION.group, scenes.level(0.3, -1.8, 90.0, 1.2)

    def ask(seen):
        found = Relocalizer(OFFICE, scenes.BY_CLASS).relocalize(
            [Observation(scenes.CAMERA, seen, up_in_camera=camera[2, :3])])
        return found.hypotheses[0].support.group, found.accepted

    room = scenes.see_room(OFFICE, camera)
    assert ask(room.select(np.arange(4))) == (pytest.approx(terms.unmapped), True)
    assert ask(room.select(np.arange(5))) == (0.0, True), 'more than four'
    assert ask(room.select(np.array([0, 2, 3, 6]))) == (0.0, True), 'the rest of the room'
    turns, off_m = rng.uniform(0.0, 2.0 * np.pi, (20, 4)), rng.uniform(0.05, 0.1, (20, 4))
    shifts = np.stack([off_m * np.cos(turns), off_m * np.sin(turns), 0.0 * turns], axis=2)
    desk = of_things(DESK)
    groups = [ask(scenes.see_room(replace(desk, centers=desk.centers + shift), camera))[0]
              for shift in shifts]
    assert min(groups) >= terms.unmapped and np.sum(np.array(groups) > 1.0) >= 3
    # soft inliers between four and five
    assert [_of_group(np.zeros((4, 3)), inliers, terms.fits * inliers + more)
            for inliers, more in ((4.0, -1.0), (4.5, 0.0), (4.0, 1.0))] == pytest.approx(
                [terms.unmapped, terms.unmapped / 2.0, terms.unmapped + terms.misfit])
    most = CALIBRATION.keyframes.most_objects
    assert objects_utility(Support(99.0)) == objects_utility(Support(most))


@pytest.mark.parametrize('table', [[], [('table', 0.0, 0.0, 0.4)]])
def test_a_turn_about_a_table_that_takes_chairs_to_chairs_is_a_rival(table):
    """The axis is the table's, or the middle of the chairs; a turn by 45 degrees fits no chair."""
    room = of_things([*table, *(('chair', x, y, 0.4) for x, y in (
        (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)))])
    camera = scenes.level(0.0, -3.0, 90.0, 1.4)
    turned = turned_about_axis(room, camera, np.arange(len(room)))
    np.testing.assert_allclose(turned[:3, :3, 3], [[3, 0, 1.4], [0, 3, 1.4], [-3, 0, 1.4]],
                               atol=1e-9)


def shown(counts, likenesses, first=0):
    """Return the support of a pose that explains some boxes, starting with the first."""
    rows = {(0, first + row): np.array([count, count, 0.0, likeness, 0.0, 0.0, 0.0])
            for row, (count, likeness) in enumerate(zip(counts, likenesses, strict=True))}
    return Support(sum(counts), sum(counts), likeness=sum(likenesses), shown=rows)


def test_labels_tell_places_apart_and_what_one_place_lacks_does_not():
    pose = shown([1] * 6, [2.0] * 6)
    assert lead_over_twin(pose, pose) == pytest.approx(0.0)
    # labels of places that look alike have common errors
    assert 2.0 < lead_over_twin(pose, shown([1] * 6, [0.0] * 6)) < 2.5
    # the twin lacks two of the objects: the same as one place of two that is out of date
    assert 0.0 < lead_over_twin(pose, shown([1] * 4, [2.0] * 4)) < 1.4
    # a pose elsewhere that explains one of them: each other object counts by its label
    assert lead_over_twin(pose, shown([1], [2.0])) == pytest.approx(5 * 0.88, abs=0.01)
    # the same, but the landmarks around look alike: the objects in the image have moved
    assert lead_over_twin(pose, shown([1], [2.0]), 0.7) < 1.4


def test_within_a_room_a_twin_that_explains_fewer_objects_is_a_rival_of_the_search():
    """One map shows both places, so neither is out of date alone."""
    pose = shown([1] * 10, [0.0] * 10)
    utility = (1.0 + CALIBRATION.objects.slope) * CALIBRATION.objects.score
    leads = [lead_over_twin(pose, shown([1] * count, [0.0] * count), 0.5, is_room=False)
             for count in (3, 6, 9)]
    assert leads[:2] == pytest.approx([7 * utility, 4 * utility])
    assert leads[2] == pytest.approx(0.0), 'nearly the same objects: alike'
    assert lead_over_twin(pose, shown([1] * 6, [0.0] * 6), 0.5) < 1.4, 'a room of its own'
    better = shown([1] * 12, [0.0] * 12, first=20)
    assert lead_over_twin(pose, better, 0.5, is_room=False) == pytest.approx(0.0), 'never below'
