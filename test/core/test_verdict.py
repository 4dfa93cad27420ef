# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The evidence for a pose, the numbers that weigh it, and what a refusal says."""

import importlib.util
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scene import CAMERA, make_room, see_room

from cliploc_ros.core.acceptance.calibration import CALIBRATION, FILE
from cliploc_ros.core.acceptance.genuine import Motion, Signs, chance_genuine
from cliploc_ros.core.acceptance.verdict import Evidence, RefusalKind, Rival, refusal
from cliploc_ros.core.fit.covariance import share_within
from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.datasets.observations import load_queries
from cliploc_ros.offline.evaluation.trials import make_queries

OPTIONS = RelocalizerOptions()
SURE = Evidence(inliers=9, likely=0.99)
GENUINE = Signs(math.log(30), 0.8, 0.0, 0.0, 1.0, 0.1, 0.0)
SMALL = GENUINE._replace(reach=0.3, unexplained=0.7, confirmed=0.4)
RECOGNIZED = RecognizedPlace(np.eye(4), np.eye(6), np.eye(6), 200, 0.9, 0.9)
# What takes the confidence away, and the kind of refusal that names it.
WEAK = {
    'rival': ({'likely': 0.5, 'rival': Rival(0.49, (9.0, 9.0, 9.0))}, RefusalKind.AMBIGUOUS),
    'other source': ({'likely': 0.5, 'rival': Rival(0.49, (9.0, 9.0, 9.0), '', True)},
                     RefusalKind.CONTRADICTION),
    'unexplained': ({'likely': 0.5, 'unexplained': 12.0}, RefusalKind.UNEXPLAINED),
    'distinct': ({'distinct': 0.5, 'twin': (2.3, 2.3, 1.2)},
                 RefusalKind.LOOK_ALIKE),
    'near': ({'near': 0.5, 'deviation_m': 1.23}, RefusalKind.UNCERTAIN_POSITION),
    'genuine': ({'signs': SMALL, 'recognized': RECOGNIZED}, RefusalKind.CHANGED),
    'mirror': ({'not_mirrored': 0.5}, RefusalKind.AMBIGUOUS),
    'keyframes': ({'uncontradicted': 0.1, 'rival': Rival(0.01, (9.0, 9.0, 9.0))},
                  RefusalKind.CONTRADICTION),
    'found': ({'meetings': 0.1, 'coverage': 0.5, 'tried': 700}, RefusalKind.SEARCH_CUT_SHORT),
    'looks': ({'earlier': (0.1,) * 9}, RefusalKind.FRAMES_DISAGREE),
    'crops': ({'likely': 0.95, 'crops_left': 12}, RefusalKind.NOT_ALL_CROPS),
    'inliers': ({'inliers': 2}, RefusalKind.TOO_FEW_OBJECTS)}


def test_sure_evidence_is_accepted():
    assert refusal(SURE, OPTIONS) is None
    assert refusal(replace(SURE, signs=GENUINE, recognized=RECOGNIZED), OPTIONS) is None


@pytest.mark.parametrize('what', WEAK)
def test_a_refusal_names_the_evidence_that_decided(what):
    fields, kind = WEAK[what]
    refused = refusal(replace(SURE, **fields), OPTIONS)
    assert refused.kind == kind
    assert len(f'refused: {refused.reason}') <= 120, 'what services answer is one line'


def test_keyframes_that_are_sure_replace_what_objects_lack():
    lacking = replace(SURE, inliers=0, coverage=0.1, tried=3, meetings=0.0)
    assert refusal(replace(lacking, by_points=0.99), OPTIONS) is None
    assert refusal(replace(lacking, by_points=0.89), OPTIONS).kind == RefusalKind.SEARCH_CUT_SHORT


def test_a_picture_needs_motion_to_be_told_from_the_place_and_motion_tells():
    in_doubt = GENUINE._replace(reach=0.6, unexplained=0.5)
    assert chance_genuine(SMALL) < chance_genuine(in_doubt) < chance_genuine(GENUINE)
    moved_like_the_place, moved_like_a_picture = Motion(2.0, 50.0), Motion(60.0, 2.0)
    only_turned = Motion(2.0, 2.0)
    assert chance_genuine(in_doubt, moved_like_the_place) > chance_genuine(in_doubt)
    assert chance_genuine(in_doubt, only_turned) == chance_genuine(in_doubt)
    assert chance_genuine(GENUINE, moved_like_a_picture) < 1e-6


def test_the_confidence_counts_the_published_covariance():
    seen = see_room(make_room())
    found = Relocalizer(make_room(), RelocalizerOptions(matching='class')).relocalize(
        [Observation(CAMERA, seen.select(np.arange(4)))])
    assert found.evidence.near < 1.0
    assert found.evidence.near == share_within(
        RIGHT_M, CALIBRATION.covariance.caution * found.covariance)


@pytest.fixture(scope='module')
def office(shared_data):
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    recorded = load_queries(folder / 'queries.npz', landmark_map.landmark_ids)
    return landmark_map, make_queries(recorded, landmark_map, True)


@pytest.mark.parametrize('knows_vertical', [False, True])
def test_no_pose_is_its_own_look_alike(office, knows_vertical):
    """Frames 12 and 14, and 3 with a vertical, were: the twin slid back when it was refined."""
    landmark_map, queries = office
    relocalizer = Relocalizer(landmark_map, OPTIONS)
    for number in (3, 12, 14):
        query = queries[number]
        observation = query.observation if not knows_vertical else replace(
            query.observation, up_in_camera=query.map_from_camera[2, :3].copy())
        found = relocalizer.relocalize([observation])
        if found.refusal_kind == RefusalKind.LOOK_ALIKE:
            one, other = (np.array([*map(float, place.split(','))]) for place in
                          re.findall(r'\(([-\d., ]+)\)', found.reason)[:2])
            assert np.linalg.norm(one - other) > 0.9


@pytest.mark.full
def test_mirror_images_are_refused(office):
    landmark_map, queries = office
    relocalizer = Relocalizer(landmark_map, replace(OPTIONS, matching='class'))
    accepted = 0
    for query in queries[::4]:
        seen, camera = query.observation.detections, query.observation.camera
        boxes = seen.bboxes_xyxy[:, [2, 1, 0, 3]] * (-1, 1, -1, 1) + (camera.width, 0) * 2
        mirrored = replace(query.observation, detections=replace(seen, bboxes_xyxy=boxes),
                           camera=replace(camera, cx=camera.width - camera.cx))
        accepted += relocalizer.relocalize([mirrored]).accepted
    assert accepted <= 1, f'of {len(queries[::4])}'


def test_each_number_states_its_unit_and_meaning_and_the_command_that_fits_it():
    sections = yaml.safe_load(FILE.read_text())
    assert [*sections] == [*CALIBRATION._fields]
    for name, section in sections.items():
        command = section['command']
        if command != 'by definition':
            module = re.fullmatch(r'python -m ([\w.]+)( \w+)?', command)[1]
            assert importlib.util.find_spec(module), command
        for term, entry in section['terms'].items():
            assert {*entry} == {'value', 'unit', 'meaning'}, f'{name}.{term}'
            loaded = getattr(CALIBRATION, name)
            assert entry['value'] == (loaded[term] if name == 'common' else getattr(loaded, term))
            assert entry['unit']
            assert len(entry['meaning']) > 10
