# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs of methods: with several processes; their names and numbers."""

import csv
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from scene import make_room
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform, quaternion_from_transform
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.offline.datasets.observations import Queries
from cliploc_ros.offline.datasets.poses import TimedPoses
from cliploc_ros.offline.evaluation import summary
from cliploc_ros.offline.evaluation.figures import draw_map, png_of, precision_recall, spread_names
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS, parse_methods
from cliploc_ros.offline.evaluation.run import run_methods
from cliploc_ros.offline.evaluation.trials import (
    Result,
    find_misfit,
    given_results,
    make_queries,
    run_trial,
    with_neighbours,
    with_vertical,
)

PAPER = RelocalizerOptions(iterations=60)
SHIFT = make_transform(np.diag([-1.0, -1.0, 1.0]), np.array([-2.0, 0.0, -1.0]))


@pytest.fixture(scope='module')
def questions(room, recording):
    return make_queries(recording, room)


@pytest.fixture(scope='module')
def methods(room):
    return parse_methods(['class_bf', 'class_ransac', 'hybrid_b-prosac'], PAPER, len(room))


def without_times(results):
    return [replace(result, search_ms=0.0) for result in results]


@pytest.fixture(scope='module')
def results(room, questions, methods):
    return run_methods(room, methods, questions, trials=3)


def test_every_method_trial_and_query_is_there_and_trials_differ(results, methods, questions):
    assert len(results) == 7 * len(questions)
    keys = [(result.method, result.trial, result.query) for result in results]
    assert len(set(keys)) == len(keys)
    assert [one.method for one in summary.summarize(results)] == [
        method.name for method in methods]
    assert {result.solved for result in results} == {True, False}
    for result in results:
        assert (result.error_m is None) == (not result.solved) == (result.map_from_camera is None)
    first, second, _ = np.reshape(
        [result.score for result in results if result.method == 'class_ransac'], (3, -1))
    assert first.tolist() != second.tolist()


def test_workers_do_not_matter_and_get_the_queries_once(results, room, questions, methods):
    class Counted(list):
        """Queries that count how often they are pickled."""

        def __reduce__(self):
            sent.append(1)
            return list, (list(self),)

    for workers in (1, 2):
        sent = []
        found = run_methods(room, methods, Counted(questions), trials=3, workers=workers)
        assert without_times(found) == without_times(results)
    assert len(sent) == 2
    asked, (auto,) = [*questions, *questions], parse_methods(['auto'], PAPER, len(room))
    alone = [result for query in asked for result in run_trial(room, auto, 0, [query])]
    together = without_times(run_methods(room, [auto], asked, trials=1))
    assert together == without_times(sorted(
        run_trial(room, auto, 0, asked), key=lambda result: result.query))
    assert together != without_times(sorted(
        alone, key=lambda result: result.query)), 'one localizer gets all'


def test_similarities_follow_the_maps_order(room, recording, questions):
    turned = Queries(recording.landmark_ids[::-1], tuple(replace(frame, observation=replace(
        frame.observation, similarities=frame.observation.similarities[:, ::-1]))
        for frame in recording.frames))
    for query, other in zip(make_queries(turned, room), questions, strict=True):
        np.testing.assert_array_equal(query.observation.similarities,
                                      other.observation.similarities)
    for other_ids, names in ((turned.landmark_ids[1:], turned.landmark_ids[0]),
                             (('lamp', *turned.landmark_ids, 'vase'), "lamp' and 1 more")):
        with pytest.raises(DatasetError, match=f'another map.*{names}'):
            make_queries(replace(turned, landmark_ids=other_ids), room)


def test_what_a_robot_asks_about_a_frame(questions):
    """The robot sees the frames after its query first, and goes back in the same time."""
    alone, = questions[5].in_order()
    assert (alone.frames, alone.run) == ((questions[5].observation,), None)
    rig = tuple(replace(questions[5].observation, camera_name=name) for name in 'ab')
    instant, = replace(questions[5], neighbours=rig).in_order()
    assert (instant.frames, instant.run) == ((*rig, questions[5].observation), None)
    fused = with_neighbours(questions, [0] * len(questions))[5]
    upright, = with_vertical([with_neighbours(questions, [0] * len(questions), 0.0, 5.0)[5]])
    own, *others = (frame.odom_from_camera[:3, :3] @ frame.up_in_camera
                    for frame in (upright.observation, *upright.neighbours))
    np.testing.assert_allclose(others, [own] * len(others))
    *earlier, last = replace(fused, image=lambda: np.zeros((1, 1, 3), np.uint8)).in_order()
    assert last.frames == (fused.observation,)
    assert len(last.images) == 1 and not any(query.images for query in earlier)
    seconds = [query.newest.stamp_ns // 10**9 for query in (*earlier, last)]
    late = max(frame.stamp_ns for frame in fused.neighbours) // 10**9
    assert seconds == sorted(set(seconds)) and seconds[-1] == 105 and len(seconds) > 2
    assert seconds[-2] == 105 - (late - 105)
    for query in (*earlier, last):
        assert (query.run, query.limit) == (5, len(seconds))
        assert query.length_s >= seconds[-1] - seconds[0]


def test_crops_on_demand_are_a_part_of_all(room, questions):
    """The last query sees twelve objects, so classes suffice; the first query sees two."""
    options = replace(PAPER, iterations=2000)
    found = {crops: run_methods(room, parse_methods(['auto'], replace(options, crops=crops),
                                                    len(room)), questions, trials=1)
             for crops in ('all', 'on_demand')}
    assert {result.crops_share for result in found['all']} == {1.0}
    shares = [result.crops_share for result in found['on_demand']]
    assert shares[0] == 1.0 and shares[-1] == 0.0
    assert ([result.accepted for result in found['on_demand']]
            == [result.accepted for result in found['all']])
    assert all(share == 1.0 or result.accepted
               for share, result in zip(shares, found['on_demand'], strict=True))
    (one,) = summary.summarize(found['on_demand'])
    assert one.crops_share == pytest.approx(np.mean(shares))
    refused = [result for result in found['on_demand'] if not result.accepted]
    assert refused and all(result.refusal_kind for result in refused)
    assert sum(one.refusals.values()) == len(refused)
    kinds = ', '.join(f'{count} {kind}' for kind, count in one.refusals.items())
    assert f'auto refused: {kinds}.' in summary.notes([one])


FIVE = RelocalizerOptions(iterations=500, k=5, random_seed=4)


def test_all_are_the_papers_ten_and_auto():
    *methods, auto = parse_methods(['all'], FIVE, 40)
    assert (auto,) == parse_methods(['auto'], FIVE, 40)
    assert tuple(method.name for method in methods) == PAPER_METHODS
    assert [method.name for method in parse_methods(
            ['all'], replace(FIVE, matching='class'), 40, with_clip=False)] == [
                'class_bf', 'class_ransac', 'auto']
    for method in methods:
        assert f'{method.options.matching}_{method.options.algorithm}' == method.name
        assert (method.options.iterations, method.options.k) == (500, 5)
        assert method.draws_nothing == method.name.endswith('_bf')


def test_named_sets_of_options_and_their_keyframes(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('wide: {base: hybrid_b-prosac, k: 9}\nstrict: {min_confidence: 0.9}\n'
                    'objects: {keyframes: false}\n')
    auto, _, wide, strict, objects = parse_methods(['auto', 'clip_bf', str(path)], FIVE, 40)
    assert (wide.name, wide.options.k, wide.options.iterations) == ('wide', 9, 500)
    assert (strict.options.min_confidence, strict.options.iterations) == (0.9, 10_000)
    assert auto.keyframes and strict.keyframes and not wide.keyframes and not objects.keyframes
    assert auto.options == RelocalizerOptions(random_seed=4)


@pytest.mark.parametrize(('text', 'named'), [
    ('wide: {kk: 9}', "mine.yaml: wide: 'kk' is none of base, matching"),
    ('wide: {k: many}', "mine.yaml: wide: k: 'many' is no int"),
    ('wide: 3', 'mine.yaml: wide: is not a mapping'),
    ('wide: {base: best}', "'best' is none of"),
    ('auto: {k: 2}', "two different methods are called 'auto'")])
def test_bad_files_are_named(tmp_path, text, named):
    path = tmp_path / 'mine.yaml'
    path.write_text(text)
    with pytest.raises(CliplocError) as caught:
        parse_methods(['auto', str(path)], FIVE, 40)
    assert named in str(caught.value)


def make_summary(errors, method='auto', accepted=None, confidence=None):
    """A summary whose errors [deg] are ten times those [m]."""
    errors = np.atleast_2d(np.array(errors, dtype=float))
    shape = errors.shape
    return summary.Summary(
        method, tuple(range(shape[1])), 1.0, {}, errors, 10.0 * errors,
        np.zeros(shape, bool) if accepted is None else np.atleast_2d(accepted),
        np.zeros(shape) if confidence is None else np.atleast_2d(confidence), np.full(shape, 2.0),
        np.ones(shape), np.full(shape, 'objects'), np.zeros(shape, int),
        np.zeros(shape), np.full(shape, 3.0))


def make_result(**changes):
    return Result(**({'method': 'clip_bf', 'trial': 0, 'query': 3, 'timestamp': 1.5, 'boxes': 4,
                      'solved': True, 'accepted': True, 'map_from_camera': np.eye(4).tolist(),
                      'error_m': 0.5, 'error_deg': 2.0} | changes))


def test_success_errors_and_their_spread_over_trials():
    one = make_summary([[0.1, 0.4, np.inf, 3.0], [0.1, 0.9, 0.2, 3.0]], 'clip_ransac')
    assert (one.success(0.25), one.success(1.0), one.solved) == (3 / 8, 5 / 8, 7 / 8)
    assert one.spreads['success_1m'] == pytest.approx((5 / 8, 0.125))
    assert one.spreads['median_error_m'] == pytest.approx(((0.4 + 0.9) / 2, 0.575))
    assert one.spreads['median_error_deg'] == pytest.approx((6.5, 5.75))
    assert one.spreads['mean_error_m'] == pytest.approx((7.7 / 7, (3.5 / 3 - 4.2 / 4) / 2))
    assert summary.table_rows([one])[1][2:4] == (
        '.38±.12 / .50±.00 / .62±.12', '0.650±0.575, 6.50±5.75; 1.10±0.06')
    assert [row[-1] for row in summary.table_rows([one])] == ['solved', '.88']
    row, = csv.DictReader(summary.csv_text(summary.csv_rows([one])).splitlines())
    assert (row['success_1m'], row['success_1m_std']) == ('0.625', '0.125')
    assert (row['mean_error_m'], row['mean_error_m_std']) == ('1.1', '0.0583333')
    half = make_summary([[0.1, np.inf], [np.inf, np.inf]])
    assert '±' not in summary.table_rows([half])[1][3]


def test_precision_and_recall():
    one = make_summary([0.1, 0.2, 0.4, 2.0, np.inf], accepted=[True, True, False, True, False])
    assert (one.false_accepts(), one.precision(), one.recall()) == pytest.approx((1, 2/3, 2/3))
    none = make_summary([np.inf, np.inf])
    assert (none.precision(), none.recall()) == (1.0, 1.0)
    assert none.precision_interval() == (0.0, 1.0)
    assert np.isnan(none.spreads['mean_error_m']).all()
    ranked = make_summary([0.1, 0.1, 2.0, 0.1, np.inf], confidence=[5.0, 4.0, 3.0, 3.0, 9.0])
    # trials of one query are not independent, so more trials do not narrow the interval
    for trials in (1, 5):
        assert make_summary([[0.1] * 10] * trials, accepted=[[True] * 10] * trials
                            ).precision_interval() == (pytest.approx(0.722, abs=1e-3), 1.0)
    recall, precision = precision_recall(ranked)
    assert recall.tolist() == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert precision.tolist() == pytest.approx([1.0, 1.0, 0.75])
    assert len(precision_recall(make_summary([2.0, np.inf]))[0]) == 0


def test_the_table_marks_noise():
    good = make_summary([[0.1] * 50] * 2, 'hybrid_bf')
    near = make_summary([[0.1] * 48 + [2.0] * 2] * 2, 'clip_ransac')
    bad = make_summary([[2.0] * 50] * 2, 'mine')
    difference = summary.compare(good, bad)
    assert difference == (1.0, 1.0, 1.0) and not difference.is_noise
    assert summary.find_best([bad, near, good]) is good
    rows = summary.table_rows([good, near, bad])
    assert rows[1][:3] == ('hybrid', 'bf', '1.00±.00 / 1.00±.00 / 1.00±.00')
    assert rows[2][2].endswith(' ~')
    assert rows[3][:3] == ('mine', '', '.00±.00 / .00±.00 / .00±.00')
    assert summary.as_markdown(rows).splitlines()[2].startswith('| hybrid | bf | 1.00')
    assert all(len(line) <= 160 for line in summary.as_text(rows).splitlines())
    assert rows[0][-1] == 'false accepts', 'all queries are solved'
    assert rows[1][-2:] == ('-', '0 of 0')
    assert 'hybrid_bf' in summary.notes([good, near])[2]


def test_poses_of_another_program_have_errors_only(questions):
    """The second query has the nearest of two poses. That of the last query is 20 ms late."""
    seconds, truth = [100.0, 101.004, 101.002, 111.02], questions[0].map_from_camera
    pose = quaternion_from_transform(truth).tolist()
    poses = TimedPoses.from_samples(
        [round(1e9 * second) for second in seconds],
        [[*(truth[:3, 3] + [0.1 * row, 0.0, 0.0]), *pose] for row in range(len(seconds))], 'here')
    results = given_results('theirs', poses, questions)
    assert [result.solved for result in results] == [True] * 2 + [False] * 10
    assert [result.error_m for result in results[:2]] == pytest.approx([0.0, 0.2])
    theirs, = summary.summarize(results)
    ours = make_summary([[0.1] * 6 + [2.0] * 6] * 5, 'clip_ransac')
    rows = summary.table_rows([ours, theirs])
    assert rows[2] == ('theirs', '', '.17 / .17 / .17', 'inf, inf; 0.10', *[''] * 4, '.17')
    _, row = csv.DictReader(summary.csv_text(summary.csv_rows([ours, theirs])).splitlines())
    assert (row['solved'], row['accepted'], row['mean_search_ms']) == ('0.166667', '', '')
    assert 'theirs: poses of another program; 10 of 12 queries have none' in '\n'.join(
        summary.notes([ours, theirs]))
    with pytest.raises(DatasetError, match='do not overlap'):
        given_results('theirs', replace(poses, stamps_ns=poses.stamps_ns + 10**12), questions)


def misread(pose):
    """Read the quaternion w x y z of a pose as x y z w."""
    return make_transform(Rotation.from_quat(np.roll(quaternion_from_transform(
        pose), 1)).as_matrix(), pose[:3, 3])


@pytest.mark.parametrize(('change', 'said'), [
    (lambda pose: SHIFT @ pose, 'map from their frame x y z qx qy qz qw -2.0000 0.0000 1.0000 '),
    (lambda pose: pose @ SHIFT, 'their body from camera x y z qx qy qz qw -2.0000 '),
    (misread, 'quaternions are w first'),
    (lambda pose: misread(SHIFT @ pose), 'quaternions are w first (add this first line to the '
     'file: # timestamp tx ty tz qw qx qy qz), map from their frame x y z'),
    (np.linalg.inv, 'poses are inverse (map in camera)'),
    (lambda pose: pose, ''),
    (lambda pose: pose @ make_transform(np.eye(3), np.random.default_rng(
        int(1e6 * abs(pose[0, 3]))).normal(size=3)), '')])
def test_poses_of_another_program_that_fit_after_one_transform(questions, change, said):
    """A third of their poses are wrong. At one place, any poses would fit."""
    rng = np.random.default_rng(3)
    queries = [replace(query, map_from_camera=make_transform(
        Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)))
        for query in questions]
    given = [change(query.map_from_camera if number % 3 else np.eye(4))
             for number, query in enumerate(queries)]
    poses = TimedPoses.from_samples(
        [query.observation.stamp_ns for query in queries],
        [[*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in given], 'here')
    found = find_misfit(given_results('theirs', poses, queries), queries, poses)
    assert found.startswith(said and 'note: theirs: poses would fit after one transform (not '
                            f'applied): {said}')
    assert bool(found) == bool(said)
    if 'frame' in said:
        assert not find_misfit(given_results('theirs', poses, questions), questions, poses)


@pytest.mark.parametrize(('unit', 'late_ms', 'said'), [
    (2.0, 0, 'their unit is 0.5 m'), (1.0, 50, 'its stamps are +50 ms off'), (1.0, 5, '')])
def test_poses_of_another_program_in_another_unit_or_late(questions, unit, late_ms, said):
    poses = TimedPoses.from_samples(
        [query.observation.stamp_ns + late_ms * 1_000_000 for query in questions],
        [[*number * unit * np.array([1.0, 0.3, 0.2]), 0.0, 0.0, 0.0, 1.0]
         for number in range(1, 1 + len(questions))], 'here')
    queries = [replace(query, map_from_camera=make_transform(
        np.eye(3), number * np.array([1.0, 0.3, 0.2])))
        for number, query in enumerate(questions, 1)]
    found = find_misfit(given_results('theirs', poses, queries), queries, poses)
    assert said in found and bool(said) == bool(found)


def test_the_table_in_latex():
    """A cell holds one number, also of rows that were read from CSV; an empty cell stays empty."""
    rows = summary.csv_rows([make_summary([[0.1, 0.4]] * 2, 'my_own{}')])
    cells = r'my\_own\{\} & 0.50 & 1.00 & 1.00 & 0.250 & 2.50 & 0.25 & 2.0 & 0.00 &  & 0 &  & \%'
    for again in (rows, [*csv.DictReader(summary.csv_text(rows).splitlines())]):
        text = summary.as_latex([{**again[0], 'paper_success': '%'}])
        assert text.splitlines() == [
            r'% needs \usepackage{booktabs}', rf'\begin{{tabular}}{{l{"r" * 12}}}', r'\toprule',
            'method & success 0.25m & success 0.5m & success 1m & median error m & median error '
            'deg & mean error m & mean search ms & accepted & precision 1m & wrongly accepted & '
            r'keyframes ms & paper success \\', r'\midrule', rf'{cells} \\', r'\bottomrule',
            r'\end{tabular}']
    assert '& &' in summary.as_latex([rows[0] | {'accepted': ''}]).replace('  ', ' ')


def test_errors_of_the_motion_between_queries():
    """A common offset of all poses is no relative error."""
    def at(x):
        return make_transform(np.eye(3), np.array([x, 0.0, 0.0]))

    shift = {0: 0.5, 1: 0.5, 3: 0.7}  # the third query has no pose
    results = [make_result(query=query, timestamp=float(query), solved=query in shift,
                           map_from_camera=at(query + shift[query]).tolist() if query in shift
                           else None) for query in range(4)]
    truth = {query: at(float(query)) for query in range(4)}
    found, = summary.relative_errors(results, truth).values()
    assert found == pytest.approx((0.1, 0.0))
    assert summary.relative_errors(results[2:], truth) == {}


@pytest.mark.parametrize('inches', [8.0, 1.5], ids=['large', 'small'])
def test_names_do_not_cover_each_other(inches):
    room = make_room()
    figure = Figure(figsize=(inches, inches), layout='constrained')
    axes = figure.add_subplot(aspect='equal')
    draw_map(axes, room)
    axes.autoscale_view()
    spread_names(figure)
    names = [text for text in axes.texts if text.get_visible()]
    boxes = [name.get_window_extent() for name in names]
    assert not any(first.overlaps(second) for first, second in combinations(boxes, 2))
    assert all(axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 for box in boxes)
    assert (len(names) == len(room)) == (inches > 2.0), 'a small figure has no room for all names'
    highest = room.landmark_ids[int(np.argmax(room.centers[:, 2]))]
    assert highest in [name.get_text() for name in names]
    image = cv2.imdecode(np.frombuffer(png_of(figure, 50), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[0] == pytest.approx(50 * inches, abs=1)
