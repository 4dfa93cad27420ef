# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio's actions and access control, without a browser."""

import os
import re
import shutil
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import wait_for
from rig_bag import camera_messages, write_messages
from scene import make_layer, make_room, write_bare_map, write_map
from studio_map import ASSETS, open_page, write_two_rooms
from websockets.datastructures import Headers
from websockets.http11 import Request

from cliploc_ros.cli.studio import make_parser, open_studio
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes
from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.core.map.landmark_embeddings import embeddings_path, load_landmark_embeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.datasets.bag_frames import BagTopics
from cliploc_ros.offline.datasets.images import open_images, views_of_folder
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.page import picture_of
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.studio.studio import Studio
from cliploc_ros.offline.studio.web import Gate
from demo.truth import read_frames

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture
def office(tmp_path, shared_data):
    """Return the shared office with its boxes, without images."""
    folder = shared_data / 'tum_fr3_office'
    path = tmp_path / 'map.yaml'
    shutil.copy(folder / 'map.yaml', path)
    detections = load_observations(folder / 'observations.npz')
    studio = Studio(Document(path), Recording(detections.select_frames(range(0, 2583, 80))))
    yield studio
    studio.document.close()


def test_outlines_lie_in_the_image(studio):
    recording = studio.recording
    outlines = recording.outlines(studio.document.landmarks, 3)
    assert recording.image(3).shape == (480, 640, 3) and recording.image(-1) is None
    camera = recording.detections.map_from_camera[3, :3, 3]
    far_m = [np.linalg.norm(studio.document.landmarks[key].center - camera) for key in outlines]
    assert far_m == sorted(far_m) and 5 < len(far_m) < len(studio.document.landmarks)
    boxes = ellipse_bboxes(np.array([*outlines.values()]))
    assert (boxes[:, :2] < (640, 480)).all() and (boxes[:, 2:] > 0).all()


def test_sightings_are_sharp_whole_and_from_several_sides(studio):
    """A view that is too blurred is not shown first."""
    document, recording = studio.document, studio.recording
    first = recording.sightings(document.landmarks, 'mug_1')
    assert all(shot.is_whole and not shot.is_detected for shot in first)
    best, images = first[0].view, recording.images

    class Blurred:
        def of(self, detections, view):
            image = images.of(detections, view)
            return cv2.GaussianBlur(image, (0, 0), 8.0) if view == best else image

    recording.images = Blurred()
    assert recording.sightings(document.landmarks, 'mug_1')[0].view != best
    document.edit(edits.set_fields, ['mug_1'], center=[0.0, 0.0, 90.0])
    assert recording.sightings(document.landmarks, 'mug_1') == []


def test_moved_landmarks_come_back_by_refitting(office):
    document = office.document
    office.refit_all()
    fitted = document.landmarks
    moved = [key for key in ('tv_1', 'keyboard_1', 'book_3') if key in fitted]
    assert [office.lock(['book_1']) for _ in range(3)] == [
        'locked book_1', 'unlocked book_1', 'locked book_1']
    assert document.landmarks['book_1'].is_locked
    for key in moved:
        one = document.landmarks[key]
        document.edit(edits.set_fields, [key], center=one.center + 0.3 * one.semi_axes)
    document.select(moved)
    office.refit()
    for key in moved:
        assert np.linalg.norm(document.landmarks[key].center - fitted[key].center) < 0.01
    assert document.landmarks['book_1'].fields == fitted['book_1'].fields
    document.undo()
    assert document.landmarks[moved[0]].center.tolist() != fitted[moved[0]].center.tolist()


def test_the_review_goes_from_the_worst_to_the_end(office):
    """A moved landmark is fixed, a duplicate merged; each decision leads to the next finding."""
    document, review = office.document, office.review
    twin, moved = (document.landmarks[key] for key in ('book_2', 'tv_1'))
    document.edit(edits.create, 'a twin', 'book', twin.center + 0.01, twin.basis)
    document.edit(edits.set_fields, ['tv_1'], center=moved.center + 0.4 * moved.semi_axes.max())
    assert 'serious' in review.check()
    severities = [review.severity(key) for key in review.order]
    assert severities == sorted(severities, reverse=True) and severities[0] > 1.0
    total = len(document.landmarks)
    document.select(['tv_1'])
    assert any('away from where' in text for text in review.checks['tv_1'].faults)
    review.fix()
    assert review.decision('tv_1') == 'fixed'
    assert np.linalg.norm(document.landmarks['tv_1'].center - moved.center) < 0.1
    document.select(['book_2'])
    assert 'merged' in review.fix() and len(document.landmarks) == total - 1
    while 'complete' not in review.accept():
        assert len(document.selection) == 1
    counts = review.counts()
    assert counts['accepted'] + counts['fixed'] + counts['deleted'] == counts['total'] == total


def test_the_relocalizer_answers_and_an_edit_changes_the_figures(office):
    document, detections = office.document, office.recording.detections
    office.recording = Recording(detections.select_frames(range(0, 33, 3)))
    before = office.relocalize_all()
    accepted = sum(answer.verdict == 'accepted' for answer in office.answers.values())
    assert 'simulated' in before and '(was' not in before and accepted > 4
    accepted_view = next(view for view, one in office.answers.items() if one.verdict == 'accepted')
    office.show_view(accepted_view)
    assert f'view {accepted_view + 1}: accepted' in office.relocalize_here()
    (answer,) = office.answers.values()
    assert answer.error_m < 1.0
    document.select(list(document.landmarks)[::2])
    office.delete()
    after = office.relocalize_all()
    assert f'(was {accepted})' in after
    assert sum(answer.verdict == 'accepted' for answer in office.answers.values()) < accepted
    print(f'as given: {before}; every other landmark deleted: {after}')


def test_a_new_landmark_has_the_class_and_the_mean_embedding_of_its_boxes(tmp_path):
    """Its file is new, too."""
    rng, rows = np.random.default_rng(0), read_frames(ASSETS / 'mapping')
    views = views_of_folder(ASSETS / 'mapping')
    boxes = [[box.bbox_xyxy for box in frame.boxes if box.object_id == 'bowl_1'] for frame in rows]
    count = sum(map(len, boxes))
    embeddings = np.ones((count, 8)) + rng.normal(0.0, 0.1, (count, 8))
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    studio = Studio(Document(tmp_path / 'new.yaml'), Recording(PosedDetections(
        views.cameras, views.map_from_camera, views.stamps_s, np.cumsum([0, *map(len, boxes)]),
        np.concatenate([box for box in boxes if box]), ('bowl',), np.zeros(count, dtype=np.int64),
        np.ones(count), embeddings=embeddings.astype(np.float16), encoder_key='key')))
    for view in np.flatnonzero(np.diff(studio.recording.detections.frame_offsets)).tolist():
        box = studio.recording.detections.detections_of(view).bboxes_xyxy[0]
        studio.new.draw(view, box[:2], box[2:])
    assert studio.new.class_id == 'bowl', 'the class of the detected box there'
    studio.new.create('a blue bowl', 'bowl')
    studio.document.save()
    stored = load_landmark_embeddings(embeddings_path(tmp_path / 'new.yaml'))
    assert stored.landmark_ids == ('bowl_1',) and 1 <= len(stored.medoids) <= 5
    assert stored.means[0] @ (mean := embeddings.mean(axis=0)) / np.linalg.norm(mean) > 0.99
    studio.document.close()


def test_other_labels_of_the_class_are_offered(studio):
    document = studio.document
    own = document.landmarks['mug_1'].label
    document.edit(edits.set_fields, ['mug_1'], label='something')
    offered = studio.phrases('mug_1')
    assert 1 <= len(offered) <= 5 and own not in offered and 'something' not in offered
    assert set(offered) <= {one.label for one in document.landmarks.values()
                            if one.class_id == 'mug'}


def test_the_check_of_the_edited_map_is_stopped_and_grows_old(tmp_path):
    write_two_rooms(tmp_path / 'map.yaml')
    studio = Studio(Document(tmp_path / 'map.yaml'))
    studio.CHECK = CheckOptions(max_positions=4, headings=2)
    studio.stop_check()
    with pytest.raises(CliplocError, match='stopped'):
        studio.check_map()
    assert not studio.check_page and not studio.is_stale
    studio.allow_check()
    assert ' positions: ' in studio.check_map()
    assert 'look alike (5 of 5 landmarks)' in studio.check_page and not studio.is_stale
    assert picture_of(studio, '/check').content.decode() == studio.check_page
    studio.document.edit(edits.mark, ['cup_0'], 'lock', is_locked=True)
    assert not studio.is_stale, 'a lock changes nothing'
    studio.document.edit(edits.delete, ['cup_3'])
    assert studio.is_stale
    studio.document.undo()
    assert not studio.is_stale, 'the map is unchanged'
    studio.document.close()


# ---- inputs: a bag, keyframes

START_NS, STEP_NS, COUNT = 1_700_000_000_000_000_000, 100_000_000, 20


def test_each_view_gets_its_image_of_a_bag(tmp_path):
    """The images are recorded 0.4 s after their stamps, the last two at once."""
    camera, pixels = Camera(64, 48, 53.0, 53.0, 32.0, 24.0), np.full((48, 64, 3), 1, np.uint8)
    stamps = [START_NS + number * STEP_NS for number in range(COUNT)]
    write_messages(tmp_path / 'bag', [message for number, stamp in enumerate(stamps)
                                      for message in camera_messages(
        stamps[min(number, COUNT - 2)] + 4 * STEP_NS, number * pixels, camera, stamp=stamp)])
    images = open_images(tmp_path / 'bag', BagTopics())
    for number in (0, COUNT - 1, 7, COUNT - 2):
        image = images.near(stamps[number] / 1e9)
        assert image.shape == (48, 64, 3) and (image == number).all()
    assert images.near((START_NS + STEP_NS // 2) / 1e9) is None


def layer_of(path):
    studio = open_studio(make_parser().parse_args([str(path)]))
    studio.document.close()
    return studio.layer


def test_the_layer_comes_with_its_map(tmp_path, capsys):
    path, room = tmp_path / 'room.yaml', make_room()
    assert layer_of(path) is None, 'an empty map has none'
    write_map(room, path)
    assert layer_of(path) is None
    save_layer(layer_path(path), make_layer(room))
    assert len(layer_of(path)) == 6
    assert capsys.readouterr().out == ''
    layer_path(path).write_bytes(b'no layer')
    assert layer_of(path) is None
    assert 'without keyframes: ' in capsys.readouterr().out


def test_a_map_of_keyframes_alone_gets_its_first_landmark(tmp_path, capsys):
    """The keyframes stay the same as in the map."""
    path = tmp_path / 'bare.yaml'
    write_bare_map(path, make_layer(LandmarkMap.empty('map')))
    walk = ASSETS / 'sequence'
    studio = open_studio(make_parser().parse_args([str(path), '--images', str(walk)]))
    assert len(studio.layer) == 6
    assert 'refused: the map has only keyframes' in studio.relocalize_here()
    studio.document.edit(edits.create, 'a lamp', 'lamp', np.ones(3), np.eye(3))
    studio.document.save()
    studio.document.close()
    assert len(LandmarkMap.from_file(path)) == 1 and len(layer_of(path)) == 6
    assert capsys.readouterr().out == ''


# ---- who may open the page

def answer(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers),
                                    timeout=30) as reply:
            return reply.status
    except urllib.error.HTTPError as error:
        return error.code


def opens(host, origin, path='/'):
    """Return whether a WebSocket from a page of an origin opens."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    try:
        with connect(f'ws://{host}{path}', origin=origin, subprotocols=['viser-v1.1.1']):
            return True
    except InvalidStatus as error:
        assert error.response.status_code == 403
        return False


@pytest.mark.needs('viser')
@pytest.mark.parametrize('host', ['127.0.0.1', '0.0.0.0'])
def test_only_who_has_the_token_opens_the_page(tmp_path, host, caplog):
    """Neither another user of this machine nor a page of another site has access.

    A connection without a request, as Chromium opens in advance, leaves no trace in the log.
    """
    with open_page(Studio(Document(tmp_path / 'map.yaml')), host) as (url, _):
        base, token = url.rstrip('/').rsplit('/', 1)
        assert len(token) >= 32 and answer(url) == 200
        for wrong in ('', f'/{token[:-1]}/', '/studio.js'):
            assert answer(base + wrong) == 403
        where = base.removeprefix('http://')
        for text in (b'', b'GET', b'GET / HTTP'):
            with socket.create_connection(where.split(':')) as early:
                early.sendall(text)
        assert opens(where, base) is False and opens(where, base, f'/{token}') is True
        assert opens(where, None, f'/{token}') is False
        assert opens(where, 'http://evil.example', f'/{token}') is False, 'a foreign page'
        is_named = host == '0.0.0.0'
        assert answer(url, Host='evil.example') == (200 if is_named else 403), 'it points here'
        assert answer(url, Host='[') == answer(url, Origin='http://[') == 403, 'no host'
    assert not [record.name for record in caplog.records if record.exc_info]


@pytest.mark.needs('viser')
def test_the_command_line_of_the_browser_opens_the_page_for_no_other_user(tmp_path):
    """All users can read it in /proc."""
    browser = tmp_path / 'browser'
    browser.write_text(f'#!/bin/sh\necho "$1" > {tmp_path}/opened.part\n'
                       f'mv {tmp_path}/opened.part {tmp_path}/opened\n')
    browser.chmod(0o755)
    with subprocess.Popen([sys.executable, '-m', 'cliploc_ros.cli.studio', tmp_path / 'map.yaml'],
                          cwd=PROJECT, env=os.environ | {'BROWSER': str(browser)}, text=True,
                          stdout=subprocess.PIPE) as studio:
        url = next(line for line in studio.stdout if line.startswith('studio: ')).split()[1]
        wait_for((tmp_path / 'opened').exists, 'the browser')
        address = (tmp_path / 'opened').read_text().strip()
        page = Path(address.removeprefix('file://'))
        assert page.stat().st_mode & 0o777 == 0o600
        assert answer(re.search('url=(.*)"', page.read_text())[1]) == 200
        assert re.search('[^/]{32,}', url)[0] not in address
        studio.terminate()
    assert not page.exists()


def test_an_address_beyond_ascii_is_refused():
    """As websockets reads it: an error here would be reported as a server error."""
    assert Gate('127.0.0.1').admit(Request('/\udcff/', Headers({'Host': '127.0.0.1'}))) is None
