# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Update maps of a simulated walk, with and without moved objects, and of a rendered room."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene import embeddings_of, map_of, rigid, unit_rows
from scipy.spatial.transform import Rotation
from walk import (
    CLASSES,
    disturb,
    draw_errors,
    join_maps,
    look_at,
    moved,
    see,
    see_rows,
    walk_around,
    without,
)

from cliploc_ros.cli import build_map
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import load_embeddings_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.options import MappingOptions, PoseErrors
from cliploc_ros.offline.mapping.update.updating import update_map
from demo import ASSETS

ENCODER = 'test:0'
POSES = walk_around(frames=60, turn_deg=320.0, radius=2.6)


def make_things(count=20, seed=5) -> LandmarkMap:
    """Return ellipsoids of three classes and different sizes on a grid of 50 cm."""
    rng = np.random.default_rng(seed)
    places = np.array([(0.5 * x - 1.0, 0.5 * y - 0.75) for x in range(5) for y in range(4)])
    centers = np.c_[places[:count] + rng.uniform(-0.06, 0.06, (count, 2)), np.full(count, 0.8)]
    quats = Rotation.from_euler('z', rng.uniform(0, np.pi, (count, 1))).as_quat()
    details = LandmarkDetails(position_sigma=0.02, support=50, seen_ratio=0.8, baseline_deg=90.0,
                              last_seen=1.0, source='test')
    return replace(
        map_of([CLASSES[row % 3] for row in range(count)], centers,
               rng.uniform(0.06, 0.12, (count, 3))), quats_xyzw=quats, details=(details,) * count)


THINGS, FEW = make_things(), make_things(12)


def ids(landmarks):
    return {landmark.landmark_id for landmark in landmarks}


def test_what_is_kept_of_a_landmark():
    details = list(THINGS.details)
    details[4] = LandmarkDetails(labels=(('a thing', 0.7), ('a cup', 0.3)), source='a person',
                                 class_weights=((THINGS.class_ids[4], 0.9), ('vase', 0.1)))
    old = replace(THINGS, details=tuple(details),
                  labels=(*THINGS.labels[:4], 'named by a person', *THINGS.labels[5:]))
    found = update_map(old, see(THINGS, POSES, noise_px=2.0)).landmark_map
    assert found.labels[4] == 'named by a person'
    kept = found.details[4]
    assert (kept.labels, kept.class_weights, kept.source) == (
        details[4].labels, details[4].class_weights, 'a person')
    # no position_sigma: a person placed it
    assert kept.position_sigma is None
    np.testing.assert_array_equal(found.centers[4], old.centers[4])
    assert kept.support > 40
    assert found.details[5].support > 50 + 40
    assert found.details[5].last_seen == pytest.approx(0.2 * (len(POSES) - 1))
    assert 0.8 < found.details[5].seen_ratio <= 1.0


def test_the_better_position_wins():
    """A landmark is refitted if the recording determines it better; otherwise it stays."""
    rng = np.random.default_rng(0)
    wrong = THINGS.centers + rng.normal(scale=0.03, size=THINGS.centers.shape)
    sigmas = [0.05] * 10 + [0.002] * 10
    old = replace(THINGS, centers=wrong, details=tuple(
        replace(detail, position_sigma=sigma)
        for detail, sigma in zip(THINGS.details, sigmas, strict=True)))
    updated = update_map(old, see(THINGS, POSES, noise_px=2.0))
    assert len(updated.report.confirmed) == len(THINGS)
    found = updated.landmark_map
    errors = np.linalg.norm(found.centers - THINGS.centers, axis=1)
    before = np.linalg.norm(wrong - THINGS.centers, axis=1)
    assert errors[:10].mean() < 0.4 * before[:10].mean()
    assert all(detail.position_sigma < 0.02 for detail in found.details[:10])
    kept = (found.centers[10:] == wrong[10:]).all(axis=1)
    assert kept.sum() >= 5  # the others differ by the amount that they were displaced


def test_what_a_new_object_hides_is_not_missing():
    hidden = 8
    poses = np.array([look_at(np.array([THINGS.centers[hidden, 0] + x, -3.0, 1.0]))
                      for x in np.linspace(-0.8, 0.8, 30)])
    later = without(THINGS, hidden)
    screen = replace(THINGS.select([hidden]), landmark_ids=('screen',), class_ids=('book',),
                     centers=THINGS.centers[[hidden]] - (0.0, 0.35, 0.0),
                     semi_axes=np.array([[0.3, 0.05, 0.3]]), quats_xyzw=np.array([[0, 0, 0, 1.0]]))
    both = join_maps(later, screen)
    assert 'thing_8' in ids(update_map(THINGS, see(later, poses)).report.missing)
    report = update_map(THINGS, see(both, poses)).report
    assert 'thing_8' in ids(report.not_observed)
    assert len(report.new) == 1


def test_what_was_not_in_view_stays_as_it_is():
    far = replace(THINGS, centers=THINGS.centers + np.array([0.0, 40.0, 0.0]))
    updated = update_map(join_maps(THINGS, far), see(THINGS, POSES, missed=0.2))
    assert ids(updated.report.not_observed) == {f'{name}_b' for name in far.landmark_ids}
    np.testing.assert_array_equal(updated.landmark_map.centers[20:], far.centers)
    assert updated.landmark_map.details[20:] == far.details


def test_what_a_wall_hides_is_not_missing():
    """No landmark beside or behind it is detected, so a wall may be in front."""
    old = moved(THINGS, {row: THINGS.centers[row] + (0.0, 3.0, 0.0) for row in range(16, 20)})
    poses = np.array([look_at(np.array([x, -2.2, 1.1]), (0.0, 0.0, 0.8))
                      for x in np.linspace(-1.0, 1.0, 40)])
    report = update_map(old, see(without(old, 16, 17, 18, 19), poses)).report
    assert {f'thing_{row}' for row in range(16, 20)} <= ids(report.not_observed)
    assert report.missing == ()


def test_one_missed_look_and_a_class_that_the_detector_never_finds_are_no_proof():
    old = replace(THINGS, class_ids=('teapot', *THINGS.class_ids[1:]))
    looks = np.array([look_at(np.array([2.4 * np.cos(a), 2.4 * np.sin(a), 1.4]))
                      for a in np.linspace(0.0, 1.2, 6)])
    few = update_map(THINGS, see(without(THINGS, 7), np.repeat(looks[:4], 5, axis=0))).report
    assert 'thing_7' in ids(few.not_observed)
    many = update_map(old, see(without(THINGS, 0, 7), POSES)).report
    assert ids(many.missing) == {'thing_7'} and ids(many.not_observed) == {'thing_0'}
    assert any('teapot' in note for note in many.notes)


def test_an_offset_of_the_coordinate_frame_is_corrected_and_noted():
    later = moved(THINGS, {12: (1.6, 0.1, 0.8)})
    offset = rigid((0.06, -0.04, 0.01), degrees=2.0)
    detections = see(later, POSES, noise_px=2.0).with_poses(offset @ POSES)
    updated = update_map(THINGS, detections)
    assert ids(updated.report.moved) == {'thing_12'}
    assert updated.report.missing == updated.report.new == ()
    assert updated.report.offset_m == pytest.approx(0.073, abs=0.02)
    assert updated.report.offset_deg == pytest.approx(2.0, abs=0.3)
    assert np.linalg.norm(updated.landmark_map.centers[12] - (1.6, 0.1, 0.8)) < 0.03
    assert np.abs(updated.map_from_camera[:, :3, 3] - POSES[:, :3, 3]).max() < 0.03


def test_noisy_poses_with_gaps_are_refined_against_the_map():
    """The verticals are as from the relocalizer: independent, and missing in some frames."""
    later = without(moved(THINGS, {12: (1.6, 0.1, 0.8)}), 6)
    seen, errors = see(later, POSES, noise_px=2.0), PoseErrors(0.05, 1.5, 0.0)
    kept = np.sort(np.random.default_rng(2).choice(len(POSES), 40, replace=False))
    detections = disturb(seen, draw_errors(seen.stamps_s, errors, 4)).select_frames(kept)
    with pytest.raises(MappingError, match='`pose_noise`'):
        update_map(THINGS, detections)
    joint = update_map(THINGS, detections,
                       MappingOptions(pose_errors=errors))
    assert ids(joint.report.missing) == {'thing_6'}
    assert ids(joint.report.moved) == {'thing_12'}
    assert joint.report.new == ()

    def error_m(poses):
        return np.median(np.linalg.norm(poses[:, :3, 3] - POSES[kept, :3, 3], axis=1))

    assert error_m(joint.map_from_camera) < 0.3 * error_m(detections.map_from_camera)
    assert joint.report.pose_change_m > 0.03


def draw_looks(count):
    return unit_rows(np.random.default_rng(0).normal(size=(count, 24)))


def seen_with_looks(later, looks):
    """Return simulated detections of objects, with embeddings near each object's look."""
    detections, truth = see_rows(later, POSES, noise_px=1.0)
    rows = looks[truth] + np.random.default_rng(0).normal(scale=0.1, size=(len(truth), 24))
    return replace(detections, encoder_key=ENCODER, embeddings=unit_rows(rows).astype(np.float16))


def equal_sizes(first, second):
    """Return twelve things; two of one class have one size."""
    sizes = FEW.semi_axes.copy()
    sizes[second] = sizes[first]
    return replace(FEW, semi_axes=sizes)


@pytest.mark.parametrize('alike', [False, True])
def test_two_objects_that_exchanged_places(alike):
    """Their looks distinguish them, unless they are identical."""
    first, second = 1, 7  # of one class
    things, looks = equal_sizes(first, second), draw_looks(len(FEW))
    if alike:
        looks[second] = looks[first]
    later = moved(things, {first: things.centers[second], second: things.centers[first]})
    updated = update_map(things, seen_with_looks(later, looks),
                         embeddings=embeddings_of(things.landmark_ids, looks, ENCODER))
    report = updated.report
    assert ids(report.moved) == (set() if alike else {'thing_1', 'thing_7'})
    assert report.missing == report.new == ()
    assert all('looks different' in landmark.evidence for landmark in report.moved)
    assert np.linalg.norm(updated.landmark_map.centers - (things if alike else later).centers,
                          axis=1).max() < 0.03
    assert updated.embeddings.landmark_ids == updated.landmark_map.landmark_ids


def test_looks_tell_a_moved_object_from_a_new_one():
    later = moved(FEW, {4: (1.7, 0.0, 0.8)})
    looks = draw_looks(len(FEW) + 1)
    same = update_map(FEW, seen_with_looks(later, looks),
                      embeddings=embeddings_of(FEW.landmark_ids, looks[:-1], ENCODER))
    assert ids(same.report.moved) == {'thing_4'}
    other_looks = looks.copy()
    other_looks[4] = looks[-1]
    other = update_map(FEW, seen_with_looks(later, other_looks),
                       embeddings=embeddings_of(FEW.landmark_ids, looks[:-1], ENCODER))
    assert other.report.moved == ()
    assert ids(other.report.missing) == {'thing_4'}
    assert len(other.report.new) == 1
    assert other.embeddings.means[other.first_new] @ looks[-1] > 0.9
    assert other.embeddings.means[0] @ looks[0] > 0.99


def test_an_object_that_could_be_either_of_two_says_so():
    things = equal_sizes(1, 7)
    later = without(moved(things, {1: (1.7, 0.0, 0.8)}), 7)
    report = update_map(things, see(later, POSES)).report
    (one,) = report.moved
    (gone,) = report.missing
    assert {one.landmark_id, gone.landmark_id} == {'thing_1', 'thing_7'}
    assert one.rivals == (gone.landmark_id,)


def test_new_ids_are_unused():
    old = without(replace(FEW, landmark_ids=('book_1', 'cup_1', *FEW.landmark_ids[2:])), 3)
    updated = update_map(old, see(FEW, POSES))
    (one,) = updated.report.new
    assert one.class_id == 'book' and one.landmark_id == 'book_2'


@pytest.mark.parametrize('details', [
    (),
    LandmarkDetails(position_sigma=1e6, support=10**9, seen_ratio=40.0, last_seen=1e300,
                    class_weights=(('dragon', 1.0), ('cup', 1e-9))),
])
def test_odd_fields_of_a_map_do_no_harm(details):
    old = replace(FEW, details=details and (details,) * len(FEW))
    updated = update_map(old, see(without(FEW, 5), POSES, noise_px=1.0))
    assert ids(updated.report.missing) <= {'thing_5'}
    assert len(updated.report.confirmed) >= 10
    assert np.isfinite(updated.landmark_map.centers).all()


@pytest.mark.parametrize(('change', 'message'), [
    (lambda one: replace(one, class_names=('a', 'b', 'c')), 'does not belong'),
    (lambda one: one.with_poses(one.map_from_camera[::-1].copy()), 'does not belong'),
])
def test_useless_recordings_say_what_to_correct(change, message):
    with pytest.raises(MappingError, match=message):
        update_map(THINGS, change(see(THINGS, POSES)))


def test_a_lost_landmark_beside_a_like_one_comes_back():
    """Its neighbour of the same class overlaps many of its boxes, and must not claim them."""
    pair = moved(replace(FEW, semi_axes=np.full_like(FEW.semi_axes, 0.12)),
                 {3: FEW.centers[0] + (0.26, 0.0, 0.0)})
    updated = update_map(without(pair, 3), see(pair, POSES, noise_px=2.0, missed=0.3))
    assert updated.report.moved == updated.report.missing == ()
    (one,) = updated.report.new
    assert one.center == pytest.approx(pair.centers[3], abs=0.03)
    assert len(updated.report.confirmed) == len(pair) - 1


def seen_in(ratios):
    """Return twelve things, each of them detected in a share of its views."""
    return replace(FEW, details=tuple(replace(detail, seen_ratio=ratio) for detail, ratio in zip(
        FEW.details, ratios, strict=True)))


def test_a_displaced_landmark_that_is_hard_to_see_comes_back_and_leaves_no_ghost():
    """Its low seen_ratio alone does not prove that it left its place in the map."""
    things = seen_in(np.linspace(0.1, 0.9, 12))
    wrong = moved(things, {0: things.centers[0] + (0.27, 0.25, 0.0)})
    report = update_map(wrong, see(things, POSES, noise_px=2.0, missed=0.4)).report
    (one,) = report.moved
    assert one.landmark_id == 'thing_0'
    assert one.center == pytest.approx(things.centers[0], abs=0.03)
    assert report.new == report.missing == ()


def test_a_landmark_that_is_never_seen_is_removed_or_named():
    """A landmark that is seen sometimes is reported, however rarely the old recording saw it."""
    things = seen_in(np.tile([0.1, 0.9], 6))
    walk, truth = see_rows(things, POSES, missed=0.4)
    assert ids(update_map(things, walk.select_boxes(truth != 0)).report.missing) == {'thing_0'}
    rarely = update_map(things, walk.select_boxes((truth != 0) | (walk.frames < 2)))
    (one,) = rarely.report.doubtful
    assert one.landmark_id == 'thing_0'
    assert 'it is kept' in one.evidence
    assert any(line.startswith('doubtful: thing_0') for line in rarely.report.lines())
    assert rarely.landmark_map.details[0].seen_ratio < 0.1
    # a new object of its class is the landmark within 1.5 m only
    for place, fate in (((0.16, 0.12, 0.8), 'moved'), ((0.32, 0.24, 0.8), 'doubtful')):
        walk, truth = see_rows(join_maps(things, moved(things.select([0]), {0: place})), POSES,
                               missed=0.4)
        report = update_map(things, walk.select_boxes((truth != 0) | (walk.frames < 2))).report
        assert ids(getattr(report, fate)) == {'thing_0'}


def test_an_object_that_comes_back_gets_its_id_back():
    """Also after another update and in another place; meanwhile no other landmark gets the id."""
    named = replace(FEW, labels=('named by a person', *FEW.labels[1:]))
    away = update_map(named, see(without(FEW, 0, 7), POSES, missed=0.2))
    assert away.removed.landmark_ids == ('thing_0', 'thing_7')
    still = update_map(away.landmark_map, see(without(FEW, 0, 7), POSES, missed=0.2, seed=1),
                       removed=away.removed)
    assert still.report.missing == still.report.new == ()
    assert still.removed.landmark_ids == away.removed.landmark_ids
    later = moved(FEW, {7: FEW.centers[7] + (1.2, 0.3, 0.0)})
    back = update_map(still.landmark_map, see(later, POSES, missed=0.2, seed=2),
                      removed=still.removed)
    found = back.landmark_map
    assert set(found.landmark_ids) == set(FEW.landmark_ids) and not len(back.removed)
    assert found.labels[found.landmark_ids.index('thing_0')] == 'named by a person'
    for row in (0, 7):
        assert found.centers[found.landmark_ids.index(f'thing_{row}')] == pytest.approx(
            later.centers[row], abs=0.03)
    assert sum('is back' in note for note in back.report.notes) == 2


@pytest.mark.parametrize(('sigma_m', 'noise'), [(0.02, (0.0, 0.0)), (0.05, (0.05, 1.0))])
def test_an_exact_map_hardly_moves_and_errors_of_poses_are_estimated(sigma_m, noise):
    old = replace(THINGS, details=tuple(replace(detail, position_sigma=sigma_m)
                                        for detail in THINGS.details))
    seen = see(THINGS, POSES, noise_px=2.0, missed=0.3)
    seen = disturb(seen, draw_errors(seen.stamps_s, PoseErrors(*noise, 0.0), seed=2))
    updated = update_map(old, seen, MappingOptions(estimate_pose_errors=True))
    assert updated.landmark_map.landmark_ids == THINGS.landmark_ids
    assert len(updated.report.confirmed) == len(THINGS) and not updated.report.moved
    ways = np.linalg.norm(updated.landmark_map.centers - THINGS.centers, axis=1)
    assert np.median(ways) < 0.01
    assert (updated.report.pose_change_m > 0.04) == (noise[0] > 0.0)
    assert any('estimated from' in note for note in updated.report.notes) == (
        noise[0] > 0.0)


ROOM = Path(__file__).parent / 'changed_room'
CHANGES = json.loads((ROOM / 'changes.json').read_text())
CLIP = ['--clip-pretrained', ASSETS / 'clip']


def update(folder, *options):
    """Update the map of a folder with the executable's function; return the exit code."""
    return build_map.main([str(argument) for argument in (
        '--observations', ROOM / 'after.npz', '--update', folder / 'map.yaml', '--no-check',
        '--out', folder / 'map.yaml', '--report', folder / 'report.json', *CLIP, *options)])


@pytest.fixture(scope='module')
def updated(tmp_path_factory):
    """Return the folder of a map that was updated in place, and the report."""
    folder = tmp_path_factory.mktemp('changed')
    for name in ('map.yaml', 'map.embeddings.npz'):
        shutil.copyfile(ROOM / name, folder / name)
    assert update(folder) == 0
    return folder, json.loads((folder / 'report.json').read_text())


def test_all_nine_changes_are_reported_and_nothing_else(updated):
    _, report = updated

    def names(kind):
        return {entry['landmark_id'] for entry in report[kind]}

    assert names('moved') == set(CHANGES['moved'])
    assert names('missing') == set(CHANGES['removed'])
    assert len(report['new']) == len(CHANGES['new']) == 3
    assert sorted(landmark['class_id'] for landmark in report['new']) == sorted(
        name.split('_')[0] for name in CHANGES['new'])
    assert len(report['confirmed']) == 60 - 4 - 2
    assert report['not_observed'] == []
    assert all(entry['rivals'] == [] and entry['distance_m'] > 1.0 for entry in report['moved'])


def test_the_map_holds_what_is_there_now(updated):
    folder, report = updated
    old, new = (LandmarkMap.from_file(where / 'map.yaml') for where in (ROOM, folder))
    kept = [name for name in old.landmark_ids if name not in CHANGES['removed']]
    assert new.landmark_ids[:len(kept)] == tuple(kept)
    # pairs have swapped places
    places = dict(zip(old.landmark_ids, old.centers, strict=True))
    for name in CHANGES['moved']:
        here = new.centers[new.landmark_ids.index(name)]
        way = min(np.linalg.norm((here - places[other])[:2])
                  for other in CHANGES['moved'] if other != name)
        assert way < 0.1
    # ellipsoids from a person stay
    stayed = [name for name in kept if name not in CHANGES['moved']]
    for name in stayed:
        np.testing.assert_array_equal(new.centers[new.landmark_ids.index(name)], places[name])
    assert {entry['landmark_id'] for entry in report['new']} == set(new.landmark_ids[len(kept):])


def test_new_landmarks_have_phrases_and_all_have_embeddings(updated):
    folder, report = updated
    new = LandmarkMap.from_file(folder / 'map.yaml')
    embeddings = load_embeddings_of_map(folder / 'map.yaml', new.landmark_ids)
    assert embeddings.is_known.all()
    old = load_embeddings_of_map(ROOM / 'map.yaml', new.landmark_ids)
    kept = old.is_known
    np.testing.assert_array_equal(embeddings.means[kept], old.means[kept])
    for landmark in report['new']:
        row = new.landmark_ids.index(landmark['landmark_id'])
        assert landmark['label'] == new.labels[row]
        assert len(new.details[row].labels) == 6 or landmark['label'] == landmark['class_id']


@pytest.mark.parametrize(('text', 'options', 'message'), [
    (None, (), 'no such file'), ('a: [1', (), 'map.yaml'),
    ((ROOM / 'map.yaml').read_text(), ('--refine-mount',), '--refine-mount')])
def test_an_unusable_old_map_and_wrong_options_are_refused_before_the_work(
        tmp_path, capsys, text, options, message):
    if text is not None:
        (tmp_path / 'map.yaml').write_text(text)
    assert update(tmp_path, *options) == 1
    assert message in capsys.readouterr().err.lower()
