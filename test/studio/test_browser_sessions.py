# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keys, files that change, tokens, hostile maps and lost connections, in a real browser."""

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from browser import wait_for
from studio_map import ASSETS, demo_studio, person_at

from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.simulation.detector import guess_detector
from cliploc_ros.studio.document import Document
from cliploc_ros.studio.recording import Recording
from cliploc_ros.studio.studio import Studio

pytestmark = [pytest.mark.full, pytest.mark.clock,
              pytest.mark.needs('viser', 'playwright', 'chromium')]



def with_simulated_boxes(detections, landmark_map):
    """Return views with the boxes that a detector might find in them."""
    model = replace(guess_detector(landmark_map, (2.0, 0.04)), camera=detections.cameras[0])
    rng = np.random.default_rng(0)
    names = tuple(sorted(set(landmark_map.class_ids)))
    found = [model.detect(pose, rng)[0] for pose in detections.map_from_camera]
    return PosedDetections(
        detections.cameras, detections.map_from_camera, detections.stamps_s,
        np.cumsum([0, *(len(one) for one in found)]),
        np.concatenate([one.bboxes_xyxy for one in found]), names,
        np.array([names.index(name) for one in found for name in one.class_ids]),
        np.concatenate([one.scores for one in found]))


def test_the_worst_landmarks_by_keys(chromium, path):
    """One key each accepts, deletes, skips, fixes or says why not; typing does not."""
    studio = demo_studio(path)
    document = studio.document
    studio = Studio(document, Recording(with_simulated_boxes(studio.recording.detections,
                                                             document.to_map())), studio.images)
    with person_at(chromium, studio) as (person, _):
        page, review = person.page, studio.review
        page.get_by_text(re.compile('checked 60 landmarks')).wait_for()
        worst = review.order
        assert document.selection == (worst[0],)
        person.picture('worst')
        for key, decision in (('a', 'accepted'), ('d', 'deleted')):
            current, = document.selection
            page.keyboard.press(key)
            wait_for(lambda current=current, decision=decision:
                     review.decision(current) == decision, decision)
            wait_for(lambda current=current: document.selection != (current,), 'the next one')
        page.get_by_text('2 of 60: 1 accepted, 0 fixed, 1 deleted').wait_for()
        page.keyboard.press('Control+z')
        wait_for(lambda: review.counts()['deleted'] == 0, 'undo')
        key = max(review.order, key=lambda key: review.check_of(key).support or 0)
        document.select([key])
        person.wait_for_card(key)
        page.keyboard.press('f')
        page.get_by_text(f'{key} seen from one side only').first.wait_for()  # not fitted
        here, = document.selection
        page.keyboard.press('n')
        wait_for(lambda: document.selection != (here,), 'N')
        here, = document.selection
        person.wait_for_card(here)
        label = person.field('Label')
        label.fill('')
        label.press_sequentially('a new can', delay=20)
        label.press('Delete')
        label.press('Enter')
        wait_for(lambda: document.landmarks[here].label == 'a new can', 'the label')
        assert not review.decision(here) and len(document.landmarks) == 60


def test_a_hostile_map_is_shown_as_text(chromium, path):
    """Ids, labels, classes, unknown fields and the coordinate frame hold HTML and long texts."""
    # an id holds no dots
    attack = '<img src=x onerror="self[`hacked`]=1"><script>self[`hacked`]=1</script>'
    tree = yaml.safe_load((ASSETS / 'map.yaml').read_text())
    one = tree['/**']['ros__parameters']['map']
    one['frame_id'] = f'map{attack}'
    landmarks = one['landmarks']
    landmarks[attack] = {**landmarks.pop('mug_1'), 'label': attack, 'class_id': attack}
    landmarks['long'] = {**landmarks.pop('mug_2'), 'label': 'long ' * 199, 'class_id': 'c' * 999,
                         attack: attack}
    landmarks['i' * 100_000] = landmarks.pop('can_1')
    path.write_text(yaml.safe_dump(tree))
    studio = Studio(Document(path))
    with person_at(chromium, studio) as (person, _):
        for text in ('<img', 'long', 'iiiiiiii'):
            person.find(text)
            person.row(text).click()
            wait_for(lambda text=text: studio.document.selection
                     and studio.document.selection[0].startswith(text), text)
        person.select(studio.document, 'long')
        person.type('Label', 'x' * 100_000)
        person.page.get_by_text('longer than 1000 characters').wait_for()
        person.type('Label', 'short')
        wait_for(lambda: studio.document.landmarks['long'].label == 'short', 'the label')
        person.picture('hostile')
        assert person.page.evaluate('window.hacked') is None
        assert person.page.locator('img[src=x]').count() == 0
