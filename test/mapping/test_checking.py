# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Findings of the check of a map, on a simulated walk with known landmarks."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene import ROOM, level, make_layer, map_of, rigid
from scipy.spatial.transform import Rotation
from walk import CAMERA, join_maps, make_table, moved, see, walk_around

from cliploc_ros.cli.check_map import main
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.evaluation.check_page import CHECK, CHECK_DATA, write_check
from cliploc_ros.offline.mapping.check import findings, relocalization
from cliploc_ros.offline.mapping.check.checking import check_map, give_advice
from cliploc_ros.offline.mapping.check.report import MEASURES, VERDICTS, Measure, in_reach
from cliploc_ros.offline.mapping.fitting import fit_ellipsoid
from cliploc_ros.offline.mapping.options import CheckOptions, Thresholds
from cliploc_ros.offline.mapping.systematic import Correction, find_corrections
from cliploc_ros.offline.mapping.triangulation import add_depths
from cliploc_ros.offline.mapping.views import make_views
from cliploc_ros.offline.simulation import EDGE_SIGMA_PX, EDGE_SIGMA_SHARE
from cliploc_ros.offline.vocabulary.vocabulary import size_of_class

NOUNS = ('apple', 'brick', 'candle', 'drum', 'engine', 'flag', 'globe', 'hammer', 'iron')
TABLE = replace(make_table(), labels=NOUNS)
QUICK = CheckOptions(relocalizer=RelocalizerOptions(iterations=300), frames=12, max_positions=9,
                     headings=4, spacing_m=2.0)


def witness_of(table, detections):
    views = make_views(detections)
    return views, findings.hear_witness(views, table, detections.class_names)


@pytest.fixture(scope='module')
def detections():
    return see(TABLE, walk_around(frames=120), noise_px=1.0)


@pytest.fixture(scope='module')
def report(detections):
    return check_map(TABLE, detections, options=QUICK)


@pytest.fixture(scope='module')
def rooms_report():
    """Return a map of two identical rooms, 10 m apart."""
    other = replace(TABLE, centers=TABLE.centers + np.array([10.0, 0.0, 0.0]))
    return check_map(join_maps(TABLE, other), options=QUICK)


def test_a_true_map_has_no_fault_and_its_frames_are_accepted(report):
    assert all(landmark.faults == () for landmark in report.landmarks)
    assert any('set `height_range_m` to [' in note for note in report.notes)
    recording, grid = report.recording, report.grid
    assert recording.held_out.explained == 1.0
    assert 0.9 < recording.held_out.median_iou < 1.0
    assert not any(correction.is_significant for correction in recording.corrections)
    assert report.overlaps == report.look_alikes == ()
    verdicts = Counter(trial.verdict for trial in recording.trials)
    assert len(recording.trials) == 12 and verdicts['accepted'] >= 9 and not verdicts['misled']
    assert all(trial.error_m < 0.1 for trial in recording.trials if trial.verdict == 'accepted')
    assert len(grid.trials) == 4 * len(grid.positions) <= 4 * QUICK.max_positions
    assert report.verdict == 'passed' and not grid.by_keyframes.any()
    blind = [trial for trial in grid.trials if trial.landmarks == 0]
    assert {trial.verdict for trial in blind} == {'refused'}


def test_equal_seed_and_input_give_an_equal_report(report, detections, tmp_path):
    again = check_map(TABLE, detections, options=QUICK)
    written = []
    for one in (report, again):
        write_check(tmp_path, 'map', TABLE, one)
        written.append((tmp_path / CHECK_DATA).read_text())
    assert written[0] == written[1]


def test_a_moved_landmark_is_the_worst(detections):
    higher = moved(TABLE, {4: TABLE.centers[4] + (0.0, 0.0, 0.45)})
    report = check_map(higher, detections, options=QUICK)
    worst, second, *_ = report.landmarks
    assert (worst.landmark_id, worst.support, second.severity) == ('thing_4', 0, 0.0)
    assert worst.expected > 50 and 'never detected' in worst.faults[0]
    assert any(text.startswith('thing_4 ') for text in report.advice)


@pytest.mark.parametrize('is_recorded', [False, True])
def test_a_misspelt_class_is_named_with_the_right_one(detections, is_recorded):
    right = TABLE.class_ids[4]
    wrong = replace(TABLE, class_ids=(*TABLE.class_ids[:4], f'{right}k', *TABLE.class_ids[5:]))
    _, witness = witness_of(wrong, detections) if is_recorded else (None, None)
    worst, *others = findings.check_landmarks(wrong, witness, [])
    assert worst.landmark_id == 'thing_4'
    (fault,) = worst.faults
    assert f"'{right}k'" in fault and f"mean '{right}'?" in fault
    assert ('misspelt' in fault) != is_recorded
    assert all(other.severity == 0.0 for other in others)


def test_boxes_that_leave_a_place_open_do_not_say_that_a_landmark_moved(detections):
    """The image cuts three sides of the boxes, so they fit anywhere along their rays."""
    _, witness = witness_of(TABLE, detections)
    own = np.nonzero(witness.shown == 4)[0]
    boxes = detections.bboxes_xyxy.copy()
    boxes[own, 0], boxes[own, 1], boxes[own, 2] = 0.0, 0.0, 640.0
    _, witness = witness_of(TABLE, replace(detections, bboxes_xyxy=boxes))
    (one,) = [checked for checked in findings.check_landmarks(TABLE, witness, [])
              if checked.landmark_id == 'thing_4']
    assert not any(' cm away' in fault for fault in one.faults)


def test_a_shifted_landmark_is_told_its_offset(detections):
    shifted = moved(TABLE, {4: TABLE.centers[4] + (0.12, 0.0, 0.0)})
    _, witness = witness_of(shifted, detections)
    assert np.linalg.norm(witness.fitted.centers[4] - TABLE.centers[4]) < 0.01
    worst, *_ = findings.check_landmarks(shifted, witness, [])
    assert worst.landmark_id == 'thing_4'
    assert worst.offset_m == pytest.approx(0.12, abs=0.01)
    assert any('is 12 cm away' in fault for fault in worst.faults)
    # a map states how uncertain it is
    sure = replace(shifted, details=(LandmarkDetails(position_sigma=0.07),) * len(TABLE))
    checked = findings.check_landmarks(sure, witness, [])
    assert {check.position_sigma_m for check in checked} == {0.07}


@pytest.mark.parametrize('turn_deg', [0.0, -120.0])
def test_identical_rooms_look_alike(turn_deg):
    turn = Rotation.from_euler('z', turn_deg, degrees=True)
    other = replace(TABLE, centers=turn.apply(TABLE.centers) + np.array([10.0, -3.0, 0.0]))
    (found,) = findings.find_look_alikes(join_maps(TABLE, other))
    assert found.share == 1.0
    assert {(first.removesuffix('_b'), second.removesuffix('_b'))
            for first, second in found.matched} == {(name, name) for name in TABLE.landmark_ids}
    assert abs(found.turn_deg) == pytest.approx(abs(turn_deg), abs=1.0)
    assert found.same_labels == 9


def test_identical_rooms_fail_the_check(rooms_report):
    assert rooms_report.verdict == 'failed' and rooms_report.failures
    assert 'nothing tells them apart' in rooms_report.advice[0]
    # more objects would not help
    assert not any('map more objects' in text for text in rooms_report.advice)
    assert sum(trial.verdict == 'accepted' for trial in rooms_report.grid.trials) == 0


@pytest.mark.parametrize('least', [0.0, 1.0])
def test_limits_decide(least):
    report = check_map(TABLE, options=QUICK, thresholds=Thresholds(
        min_localized=least, min_by_objects=0.0))
    assert [text.partition(' (')[0] for text in report.failures] == [
        '4 of 9 views are localized'] * (least > 0.0)
    assert report.passed == (least == 0.0)


def mount(x=0.0, roll=0.0):
    return rigid((x, 0.0, 0.0), degrees=roll)


@pytest.mark.parametrize(('spoil', 'name', 'value', 'tolerance'), [
    (lambda one: replace(one, cameras=(replace(CAMERA, fx=500 / 1.03, fy=500 / 1.03),)),
     'focal length fx', 3.0, 0.8),
    (lambda one: replace(one, bboxes_xyxy=one.bboxes_xyxy + np.tile([0, 6], 2)),
     'principal point cy', 6.0, 1.0),
    (lambda one: one.with_poses(one.map_from_camera @ mount(0.05)), 'mount x (right)', -5.0, 0.7),
    (lambda one: one.with_poses(one.map_from_camera @ mount(roll=2.0)), 'mount rotation about z',
     -2.0, 0.2),
    (lambda one: one.with_poses(np.roll(one.map_from_camera, -1, axis=0)),
     'stamps of the images', -200.0, 5.0),
], ids=['focal length', 'principal point', 'mount', 'roll', 'stamps'])
def test_systematic_errors_are_measured(spoil, name, value, tolerance):
    # back on another circle: on a single circle, a late clock looks like a turned table
    poses = [walk_around(frames=60), walk_around(frames=60, radius=1.6)[::-1]]
    spoilt = spoil(see(TABLE, np.concatenate(poses), noise_px=1.0))
    views, witness = witness_of(TABLE, spoilt)
    found = {fix.name: fix for fix in find_corrections(spoilt, views, witness.fitted,
                                                       witness.shown)}
    assert found[name].is_significant
    assert found[name].value == pytest.approx(value, abs=tolerance)
    # a turned mount looks almost like a shifted principal point
    assert found[name].explained > 0.8 * max(result.explained for result in found.values())


def test_a_walk_that_passes_each_object_once_is_judged(detections):
    # each object is detected in one stretch of 4 s only
    _, witness = witness_of(TABLE, detections)
    once = detections.select_boxes(witness.shown % 6 == detections.frames // 20)
    report = check_map(TABLE, once, options=QUICK)
    assert len(report.recording.trials) == QUICK.frames and report.recording.held_out.boxes > 30
    # a landmark at a wrong place explains none of its boxes, and is reported
    moved = replace(TABLE, centers=TABLE.centers + np.array([0.4, 0.0, 0.0]))
    report = check_map(moved, detections, options=QUICK)
    assert sum(landmark.severity >= 1.0 for landmark in report.landmarks) > 4
    assert any('cm away' in text or 'never' in text for text in report.advice)


def test_stretches_without_landmarks_become_advice(detections):
    # from 4 to 8 s nothing is detected
    gap = detections.select_boxes(~np.isin(detections.frames, np.arange(20, 41)))
    report = check_map(TABLE, gap, options=QUICK)
    (text,) = [text for text in report.advice if text.startswith('record this side')]
    assert re.search(r': \d views at [456] s', text), text


def test_too_few_views_are_named_as_the_cause(detections):
    # two of nine objects are not in the map
    part = TABLE.select(range(7))
    few = check_map(part, detections.select_frames(range(0, 120, 12)), options=QUICK)
    assert 'more views: 10 frames' in few.advice[0] and '22%' in few.advice[0]
    many = check_map(part, detections, options=QUICK)
    assert not any('more views' in text for text in many.advice)


@pytest.mark.parametrize('of_folder', [False, True])
def test_advice_fits_the_recording(report, detections, of_folder):
    mount = Correction('mount', 'mount z (forward)', 'cm', -2.6, 0.4, 3.0, True, 0.1)
    spoiled = replace(report, recording=replace(report.recording, corrections=(mount,)))
    assert any('mounted on the robot' in one.text
               for one in give_advice(spoiled, of_folder)) != of_folder
    turn = Rotation.from_euler('x', 29.0, degrees=True).as_matrix()
    turned = replace(TABLE, centers=TABLE.centers @ turn.T)
    first = check_map(turned, detections.moved(1.0, turn),
                      options=replace(QUICK, of_folder=of_folder)).advice[0]
    assert ' 29 degrees' in first and ('--level' in first) == of_folder


def test_detector_has_the_misses_and_noise_of_the_recording():
    detections = see(TABLE, walk_around(frames=200), noise_px=4.0, missed=0.4)
    views, witness = witness_of(TABLE, detections)
    model = relocalization.measure_detector(TABLE, detections, views, witness)
    rng, poses = np.random.default_rng(0), detections.map_from_camera
    counts = [len(model.detect(pose, rng)[1]) for pose in poses]
    assert np.mean(counts) == pytest.approx(len(detections.classes) / 200, rel=0.1)
    small = np.hypot(EDGE_SIGMA_PX, EDGE_SIGMA_SHARE * 50.0)
    assert model.edge_scale * small == pytest.approx(4.0, rel=0.25)


def test_what_was_never_detected_is_never_simulated(detections):
    false = moved(TABLE, {4: TABLE.centers[4] + (0.0, 0.0, 1.0)})
    views, witness = witness_of(false, detections)
    model = relocalization.measure_detector(false, detections, views, witness)
    assert all(4 not in model.in_view(pose)[0] for pose in detections.map_from_camera)


@pytest.mark.parametrize(('table', 'named'), [
    (replace(TABLE, class_ids=('lamp',) * 9), 'classes'),
    (replace(TABLE, centers=TABLE.centers + 50.0), 'coordinate frame')])
def test_a_recording_of_another_place_is_refused(detections, table, named):
    with pytest.raises(MappingError, match=named):
        check_map(table, detections, options=QUICK)


@pytest.mark.parametrize(('option', 'value'), [('--folds', '1'), ('--headings', '361')])
def test_options_are_checked(option, value, capsys):
    with pytest.raises(SystemExit):
        main(['map.yaml', option, value])
    assert option in capsys.readouterr().err


def test_page_escapes_hostile_names_and_asks_for_nothing(tmp_path, detections):
    hostile = '<script>alert(1)</script>&"\'$\\frac{$'
    doubled = join_maps(TABLE, replace(TABLE, centers=TABLE.centers + 0.01))
    named = replace(doubled, frame_id=hostile, labels=(hostile, *doubled.labels[1:]),
                    landmark_ids=(hostile, *doubled.landmark_ids[1:]))
    report = check_map(named, detections, options=QUICK)
    images = dict.fromkeys([0, 49], np.full((480, 640, 3), 128, np.uint8))
    write_check(tmp_path, hostile, named, report, detections, images.get)
    page = (tmp_path / CHECK).read_text()
    assert '<script' not in page and '&lt;script&gt;' in page and 'http' not in page
    kinds = Counter(re.findall(r' (?:src|href)="(.{15})', page))
    assert kinds.keys() == {'data:image/png;', 'data:image/jpeg'}
    assert kinds['data:image/png;'] == 2
    assert kinds['data:image/jpeg'] >= 5, 'five duplicates are shown'
    assert page.count('<u style') == len(report.measures) == 4, 'one bar each; no keyframes'
    assert json.loads((tmp_path / CHECK_DATA).read_text())['landmarks'][0]['faults']
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([CHECK, CHECK_DATA])


def layer_at(*poses):
    return replace(make_layer(ROOM, len(poses), points=5), map_from_camera=np.array(poses))


@pytest.mark.parametrize(('x', 'degrees', 'reached'), [
    (1.9, 0.0, True), (2.1, 0.0, False), (0.0, -41.0, False), (0.9, 20.0, True),
    (1.1, 20.0, False)])
def test_reach_is_near_and_in_the_same_direction(x, degrees, reached):
    assert in_reach(layer_at(level()), level(x, 0.0, degrees)[None]) == [reached]


def test_a_place_is_localized_by_objects_or_by_a_keyframe_within_reach():
    few = CheckOptions(max_positions=6, headings=4)
    grid = check_map(ROOM, options=few).grid
    everywhere = layer_at(*(make_transform(level(0.0, 0.0, angle)[:3, :3], place)
                            for place in grid.positions for angle in range(0, 360, 30)))
    full = check_map(ROOM, options=few, layer=everywhere)
    assert full.grid.by_keyframes.all() and (full.grid.localized == full.grid.headings).all()
    nowhere = check_map(ROOM.select(range(1)), options=few)
    assert not nowhere.grid.localized.any()
    text = 'no heading localizes'
    assert any(text in hint for hint in nowhere.advice)
    assert not any(text in hint for hint in full.advice)


def test_a_map_without_landmarks_is_judged_by_its_keyframes(tmp_path, detections):
    empty, layer = LandmarkMap.empty('map'), layer_at(level())
    report = check_map(empty, options=QUICK, layer=layer)
    assert report.verdict == 'keyframes only' and (
        '(0 by simulated objects, 1 within reach of a keyframe); ' in report.localized[0])
    write_check(tmp_path, 'map', empty, report)
    # boxes without images cannot try keyframes
    report = check_map(empty, detections, options=QUICK, layer=layer)
    assert 'keyframes not tried' in report.localized[0]
    assert report.verdict == 'not judged by keyframes' and 'without the images' in report.advice[0]
    assert report.localized[1].endswith(
        f'; 0 of {len(report.recording.trials)} recorded and 0 of 36 simulated views misled')
    with pytest.raises(MappingError, match='neither landmarks nor keyframes'):
        check_map(empty, options=QUICK)


def test_a_map_that_leaves_no_free_position_is_checked():
    hall = map_of(['hall'], np.zeros((1, 3)), (4.0, 4.0, 3.0))
    report = check_map(hall, options=QUICK, layer=layer_at(level()))
    assert len(report.grid.localized) == len(report.grid.positions) == 0
    assert report.verdict == 'failed'


def test_the_report_has_keyframes_only_where_there_are_some(tmp_path, run_here):
    write_map(tmp_path / 'room.yaml', ROOM)
    given = [tmp_path / 'room.yaml', '--positions', '4', '--headings', '2',
             '--min-localized', '0', '--min-by-objects', '0', '--out', tmp_path / 'out']
    done = run_here(main, *given, '--keyframes')
    assert done.returncode == 1 and 'room.keyframes.npz:' in done.stderr
    assert run_here(main, *given).returncode == 0
    assert json.loads((tmp_path / 'out/check.json').read_text())['keyframes'] == 0
    save_layer(layer_path(tmp_path / 'room.yaml'), layer_at(level(), level(1.0)))
    done = run_here(main, *given)
    assert done.returncode == 0 and ' within reach of a keyframe)' in done.stdout
    assert json.loads((tmp_path / 'out/check.json').read_text())['keyframes'] == 2


# ---- sizes of classes, the scale of a map, and verdicts that depend on objects or keyframes
FEW = CheckOptions(max_positions=4, headings=4)


@pytest.fixture(scope='module')
def office(shared_data):
    return LandmarkMap.from_file(shared_data / 'tum_fr3_office/map.yaml')


@pytest.fixture(scope='module')
def office_report(office):
    return check_map(office, options=FEW)


def scaled(landmark_map, scale):
    return replace(landmark_map, centers=scale * landmark_map.centers,
                   semi_axes=scale * landmark_map.semi_axes)


@pytest.mark.parametrize('scale', [0.3, 2.6])
def test_the_scale_of_a_map_by_the_sizes_of_its_objects(office, scale):
    report = check_map(scaled(office, scale), options=FEW)
    assert report.scale == pytest.approx(scale, rel=0.5)
    assert 'times too ' + ('large' if scale > 1.0 else 'small') in report.advice[0]


def test_right_sizes_few_classes_and_views_of_one_side_tell_no_scale(office, office_report):
    cups = [row for row, name in enumerate(office.class_ids) if name == 'cup']
    one_sided = replace(office, details=(LandmarkDetails(baseline_deg=5.0),) * len(office))
    assert office_report.scale is None
    for none in (office.select(cups), one_sided):
        assert check_map(scaled(none, 3.0), options=FEW).scale is None
    given = replace(FEW, is_size_given=True)
    assert check_map(scaled(office, 3.0), options=given).scale is None, 'the user knows it'
    for ratios, expected in (((0.32, 0.39, 1.11), None), ((0.5, 0.54, 0.9), None),
                             ((0.32, 0.39, 0.45, 1.11), 0.42)):
        names = ('chair', 'bottle', 'book', 'keyboard')[:len(ratios)]
        several = office.select(range(len(ratios)))
        several = replace(several, class_ids=names, semi_axes=np.array([
            [0.5 * ratio * size_of_class(name).extent_m] * 3
            for name, ratio in zip(names, ratios, strict=True)]))
        assert check_map(several, options=FEW).scale == (
            expected and pytest.approx(expected, abs=0.03))


def test_a_landmark_that_is_too_large_has_a_serious_fault(office):
    row = office.class_ids.index('chair')
    semi_axes = office.semi_axes.copy()
    semi_axes[row] = np.array([0.26, 0.4, 1.61])
    report = check_map(replace(office, semi_axes=semi_axes), options=FEW)
    found, = (one for one in report.landmarks if one.landmark_id == office.landmark_ids[row])
    assert found.severity >= 1.0 and 'is 3.2 m long, and no chair' in found.faults[0]
    assert size_of_class('unknown thing') is None
    assert size_of_class('Chair') == size_of_class('chair') is not None


@pytest.mark.parametrize(('missed', 'verdict'), [
    ((), 'passed'), (('min_by_keyframes',), 'passed'), (('min_by_objects',), 'keyframes only'),
    (('min_localized',), 'keyframes only'), (('max_misled',), 'failed'),
    (('max_systematic',), 'failed'),
    (('min_by_objects', 'min_by_keyframes'), 'failed')])
def test_one_table_gives_the_verdict(office_report, missed, verdict):
    measures = tuple(Measure(key, 4 + 3 * ((key in missed) == key.startswith('max')), 11, 0.5)
                     for key in MEASURES)
    told = replace(office_report, measures=measures)
    assert told.verdict == verdict and told.passed == (verdict == 'passed')
    assert told.summary[0].startswith(f'{verdict}: {VERDICTS[verdict][1]}')
    assert len(told.failures) == len({*missed} - {'min_by_keyframes'})


def test_the_page_has_this_table():
    page = (Path(__file__).parents[2] / 'doc/trust.md').read_text()
    for name, words in MEASURES.items():
        cells = [words, f'`--{name.replace("_", "-")}`',
                 f'at {"most" if name.startswith("max") else "least"} '
                 f'{getattr(Thresholds, name):.0%}',
                 *('needed' * (name in VERDICTS[verdict][0]) for verdict in (
                     'passed', 'keyframes only'))]
        assert ''.join(f'| {cell} ' if cell else '| ' for cell in cells) + '|\n' in page
    for verdict, (_, meaning) in VERDICTS.items():
        assert f'* `{verdict}`: {meaning}.\n' in page


def test_a_figure_is_told_apart_from_its_limit():
    assert str(Measure('min_localized', 199, 500, 0.4)) == '199 of 500 (39.8%, at least 40.0%)'
    assert str(Measure('max_misled', 1, 1497, 0.01)) == '1 of 1497 (0.1%, at most 1.0%)'
    assert str(Measure('max_systematic', 0.5, 1.0, 0.25)) == '50%, at most 25%'
    assert str(Measure('max_misled', 0, 0, 0.01)) == '0 of 0 (0%, at most 1%)'


def longest(views):
    """Return the longest extent of the fit from a sphere around the table's middle [m]."""
    fit = fit_ellipsoid(views, np.arange(len(views.frames)), make_table(2).centers[1],
                        0.1 * np.eye(3))
    return 2.0 * np.linalg.norm(fit.basis, axis=0).max()


def test_the_size_of_a_class_decides_only_where_boxes_of_one_side_do_not():
    # errors of boxes 6 degrees apart look like a bottle that is long along the rays
    table, size = make_table(2).select([1]), size_of_class('bottle')
    assert table.class_ids == ('bottle',)
    table = replace(table, semi_axes=np.array([[0.8, 0.04, 0.13]]),
                    quats_xyzw=np.array([[0.0, 0.0, 0.0, 1.0]]))
    one_side, all_sides = (see(table, walk, noise_px=1.0) for walk in (
        walk_around(40, turn_deg=6.0), walk_around(30)))
    sized, sized_all = (add_depths(make_views(seen), replace(seen, depths=np.full(
        len(seen.classes), np.nan, np.float32))) for seen in (one_side, all_sides))
    assert longest(make_views(one_side)) > size.most_m > longest(sized)
    assert longest(sized_all) == pytest.approx(1.6, rel=0.03)
