# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build maps from simulated walks with known landmarks, with depth, and of a real office."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import walk
import yaml

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.errors import DatasetError, MappingError, ModelError
from cliploc_ros.offline.datasets.frames import Frames
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.association import find_overlaps, ious_with
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.evidence import explained_boxes
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.make_map import find_labeller, make_map, update_map
from cliploc_ros.offline.mapping.options import MappingOptions, PoseErrors
from cliploc_ros.offline.mapping.views import make_views
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions

TABLE = walk.make_table()


def test_every_landmark_is_found_where_it_is():
    built = build_map(walk.see(TABLE, walk.walk_around()))
    assert len(built.landmark_map) == len(TABLE)
    assert walk.nearest_errors(built.landmark_map, TABLE).max() < 0.003
    assert built.report.explained == 1.0 and built.report.median_iou > 0.97
    assert built.report.left_out == ()
    assert set(np.unique(built.shown)) == set(range(len(TABLE)))
    for center, axes in zip(TABLE.centers, TABLE.semi_axes, strict=True):
        row = np.linalg.norm(built.landmark_map.centers - center, axis=1).argmin()
        assert np.sort(built.landmark_map.semi_axes[row]) == pytest.approx(np.sort(axes), abs=.015)


def test_many_views_leave_an_uncertainty_that_all_share():
    few, many = (build_map(walk.see(TABLE, walk.walk_around(frames), noise_px=3.0)).landmark_map
                 for frames in (20, 180))
    # with independent errors in each view, it would be a third of that
    assert 0.6 < np.median(many.position_sigmas) / np.median(few.position_sigmas) < 1.0


def test_equal_seed_and_input_give_an_equal_map():
    detections = walk.see(TABLE, walk.walk_around(), noise_px=3.0)
    first, second = build_map(detections), build_map(detections)
    assert (first.landmark_map.centers == second.landmark_map.centers).all()
    assert (first.shown == second.shown).all() and first.report == second.report


def test_what_a_short_walk_shows_from_one_side_is_left_out_with_the_reason():
    poses = walk.walk_around(frames=12, turn_deg=12.0)
    for options in (None, MappingOptions(refine_mount=True)):
        with pytest.raises(MappingError, match='one side only'):
            build_map(walk.see(TABLE, poses), options)
    eager = MappingOptions(min_baseline_deg=8.0, max_position_sigma_m=1.0)
    built = build_map(walk.see(TABLE, poses), eager)
    assert walk.nearest_errors(built.landmark_map, TABLE).max() < 0.05


def test_an_object_that_was_taken_away_is_left_out_with_the_reason():
    table, poses, taken = TABLE, walk.walk_around(frames=120), 2
    seen = walk.see(table, poses)
    later = walk.see(walk.without(table, taken), poses)
    both = walk.merged(seen.select_boxes(seen.frames < 30),
                       later.select_boxes(later.frames >= 30))
    built = build_map(both, MappingOptions(min_seen_ratio=0.4))
    assert len(built.landmark_map) == len(table) - 1
    (left_out,) = built.report.left_out
    assert left_out.class_id == table.class_ids[taken]
    assert left_out.center == pytest.approx(table.centers[taken], abs=0.02)
    assert 'or moved' in left_out.reason


def test_joint_refinement_corrects_poses_and_landmarks():
    poses = walk.walk_around(frames=150)
    seen = walk.see(TABLE, poses, noise_px=2.0)
    errors = walk.draw_errors(seen.stamps_s, PoseErrors(0.05, 1.0, 3.0))
    detections = walk.disturb(seen, errors)
    plain = build_map(detections)
    joint = build_map(detections, MappingOptions(pose_errors=PoseErrors(0.05, 1.0, 3.0)))
    assert len(joint.landmark_map) == len(TABLE)
    left_m = walk.shape_error_m(joint.landmark_map, TABLE)
    assert left_m < 0.4 * walk.shape_error_m(plain.landmark_map, TABLE) and left_m < 0.01
    left = joint.map_from_camera[:, :3, 3] - poses[:, :3, 3]
    assert left.std(axis=0).mean() < 0.6 * errors[:, :3].std(axis=0).mean()
    assert joint.report.pose_change_m > 0.03
    assert plain.report.pose_change_m == 0.0


@pytest.mark.parametrize(('change', 'message'), [
    (lambda one: one.select_frames([3]), 'took 1 viewpoint,'),
    (lambda one: one.select_boxes(np.zeros(len(one.classes), dtype=np.bool_)),
     'have no detections'),
    # a base whose x axis points forward like the camera's z axis
    (lambda one: one.with_poses(one.map_from_camera @ np.array(
        [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])),
     'poses and stamps|good enough'),
])
def test_input_without_a_map_says_what_to_correct(change, message):
    for errors in (None, PoseErrors(0.05, 1.0, 3.0)):
        with pytest.raises(MappingError, match=message):
            build_map(change(walk.see(TABLE, walk.walk_around())), MappingOptions(
                pose_errors=errors))


def test_doubtful_input_is_noted():
    detections = walk.see(TABLE, walk.walk_around())
    poses = detections.map_from_camera.copy()
    poses[20, :3, 3] += (50.0, 0.0, 0.0)
    built = build_map(detections.with_poses(poses))
    assert any('jump 2 times' in note for note in built.report.notes)
    only = replace(detections, class_names=('cup',), classes=np.zeros_like(detections.classes))
    assert any("of the class 'cup'" in note for note in build_map(only).report.notes)


def test_boxes_cut_by_the_image_border_do_not_shrink_a_landmark():
    table = walk.make_table(count=1)
    table = replace(table, semi_axes=np.array([[0.3, 0.3, 0.3]]))
    # the object lies half outside the image in most frames
    poses = np.array([walk.look_at(np.array([1.6 * np.cos(a), 1.6 * np.sin(a), 1.2]),
                                   (0.45 * np.sin(7 * a), -0.45 * np.sin(5 * a), 0.8))
                      for a in np.linspace(0.0, 5.0, 60)])
    detections = walk.see(table, poses)
    cut = ((detections.bboxes_xyxy <= 0.0)
           | (detections.bboxes_xyxy >= [walk.CAMERA.width, walk.CAMERA.height] * 2)).any(axis=1)
    assert cut.mean() > 0.3
    built = build_map(detections).landmark_map
    assert len(built) == 1
    assert built.semi_axes[0] == pytest.approx(np.full(3, 0.3), abs=0.01)
    assert walk.CLASSES[detections.classes[0]] == built.class_ids[0]


def test_a_long_recording_gives_one_landmark_for_each_object():
    poses = walk.walk_around(frames=240, turn_deg=1100.0)
    detections = walk.see(TABLE, poses, noise_px=2.0, missed=0.3)
    built = build_map(replace(detections, stamps_s=2.0 * np.arange(240))).landmark_map
    assert len(built) == len(TABLE)
    assert walk.nearest_errors(built, TABLE).max() < 0.01
    for details in built.details:
        assert 0.3 < details.seen_ratio < 0.9
        assert details.baseline_deg > 90.0 and details.position_sigma < 0.02


def test_a_map_is_made_written_and_updated(tmp_path):
    file = tmp_path / 'map.yaml'
    detections = walk.see(TABLE, walk.walk_around())
    stages, labeller = [], find_labeller(detections, None)
    made = make_map(detections, labeller,
                    progress=lambda stage, share: stages.append(stage))
    write_map(file, made.landmark_map, made.report.lines()[:1], made.embeddings)
    assert walk.nearest_errors(LandmarkMap.from_file(file), TABLE).max() < 0.003
    assert made.layer is None and stages[-1] == 'done'
    blind = Frames(tmp_path / 'walk', 0, lambda wanted: iter(()))
    assert 'of 0 images, none' in make_map(detections, labeller, None, blind, LayerOptions()).note
    with pytest.raises(MappingError, match='no detections'):
        make_map(detections.select_boxes(np.zeros(len(detections.classes), bool)), labeller, None,
                 blind, LayerOptions())
    again = update_map(file, detections, labeller, MappingOptions())
    assert again.landmark_map.landmark_ids == made.landmark_map.landmark_ids
    assert not again.report.new


def test_labels_are_class_names_where_clip_is_missing(tmp_path):
    detections = walk.see(TABLE, walk.walk_around())
    assert 'class names' in find_labeller(detections, None).note
    words = Path(tmp_path / 'our.yaml')
    words.write_text('cup: [our cup]')
    with pytest.raises(ModelError, match='no_clip'):
        find_labeller(detections, None, words)


def test_depth_replaces_parallax():
    poses = walk.walk_around(frames=12, turn_deg=12.0)
    boxes = walk.see(TABLE, poses, noise_px=1.0)
    with pytest.raises(MappingError, match='good enough'):
        build_map(boxes)
    built = build_map(walk.measure_depth(boxes, TABLE, holes=0.2)).landmark_map
    errors = walk.nearest_errors(built, TABLE)
    assert np.sum(errors < 0.12) >= 7
    assert np.median(errors) < 0.06


def test_with_parallax_boxes_decide_and_an_error_of_scale_is_corrected():
    boxes = walk.see(TABLE, walk.walk_around(), noise_px=1.0)
    built = build_map(walk.measure_depth(boxes, TABLE, scale=1.15))
    note, = (note for note in built.report.notes if 'depth' in note)
    assert ' is 1.1' in note and 'corrected' in note
    assert len(built.landmark_map) == len(TABLE)
    assert walk.nearest_errors(built.landmark_map, TABLE).max() < 0.01


def test_depth_in_another_unit_is_refused():
    boxes = walk.see(TABLE, walk.walk_around(frames=30))
    with pytest.raises(DatasetError, match=r'depth is 0\.2.* `depth_unit`'):
        build_map(walk.measure_depth(boxes, TABLE, scale=0.2))


def test_far_landmarks_are_passed_over_without_a_loss():
    """A walk around one table, then around another table 12 m away."""
    away_m, there = np.array([12.0, 0.0, 0.0]), walk.walk_around()
    floor = walk.join_maps(TABLE, replace(TABLE, centers=TABLE.centers + away_m))
    there[:, :3, 3] += away_m
    views = make_views(walk.see(floor, np.concatenate([walk.walk_around(), there]), noise_px=2.0))
    landmarks = landmarks_of_map(floor, walk.CLASSES)
    landmarks.classes[7] = -1  # with a class that the recording does not have
    boxes, numbers, _ = find_overlaps(views, landmarks, 0.2)
    expected = [
        (row, number) for number in range(len(landmarks.centers))
        for row in np.nonzero((views.classes == landmarks.classes[number]) & (ious_with(
            views, np.arange(len(views.classes)), landmarks.centers[number],
            landmarks.bases[number]) > 0.2))[0]]
    assert list(zip(boxes.tolist(), numbers.tolist(), strict=True)) == sorted(expected)
    assert len(expected) > 900
    assert len(find_overlaps(views.between(0, 0), landmarks, 0.2)[0]) == 0


# ---- maps of a real office, compared with the limits in test/thresholds.yaml
REQUIRED = yaml.safe_load((Path(__file__).parents[1] / 'thresholds.yaml').read_text())['mapping']


@pytest.fixture(scope='module')
def office(shared_data):
    """Return the observations of the office, and their splits."""
    folder = shared_data / 'tum_fr3_office'
    return (load_observations(folder / 'observations.npz'),
            json.loads((folder / 'splits.json').read_text()))


@pytest.fixture(scope='module')
def even(office):
    """Return the mapped frames of the even split, and their map."""
    observations, splits = office
    frames = observations.select_frames(splits['even']['map'])
    return frames, build_map(frames).landmark_map


@pytest.mark.parametrize('name', ['even', *(pytest.param(name, marks=pytest.mark.full)
                                           for name in ('block0', 'block1'))])
def test_other_frames_are_explained(office, even, name):
    observations, split = office[0], office[1][name]
    built = even[1] if name == 'even' else build_map(
        observations.select_frames(split['map'])).landmark_map
    views = make_views(observations.select_frames(sorted({row[2] for row in split['queries']})))
    held_out = explained_boxes(views, landmarks_of_map(built, observations.class_names))
    print(f'{name}: {len(built)} landmarks, explained {held_out.explained:.3f}, median IoU '
          f'{held_out.median_iou:.3f}')
    assert held_out.explained >= REQUIRED[name]['explained']
    assert held_out.median_iou >= REQUIRED[name]['median_iou']


@pytest.mark.full
def test_joint_refinement_makes_up_for_slow_pose_errors(even):
    (frames, even_map), given = even, PoseErrors(0.05, 1.0, 3.0)
    noisy = walk.disturb(frames, walk.draw_errors(frames.stamps_s, given, seed=0))

    def median_offset(built):
        """Return the distances of landmarks to those of true poses [m]."""
        return float(np.median(walk.nearest_errors(built.landmark_map, even_map)))

    plain = build_map(noisy)
    joint = build_map(noisy, MappingOptions(pose_errors=given))
    print(f'plain: {len(plain.landmark_map)} landmarks, off by {median_offset(plain):.3f} m; '
          f'joint: {len(joint.landmark_map)}, off by {median_offset(joint):.3f} m')
    assert median_offset(joint) <= REQUIRED['joint_share'] * median_offset(plain)
    assert len(joint.landmark_map) < len(plain.landmark_map)
