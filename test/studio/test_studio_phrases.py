# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Phrases that the demo's CLIP suggests for landmarks, also for a new one."""

import shutil
import time

import numpy as np
import pytest
from studio_map import ASSETS

from cliploc_ros.cli.studio import make_parser, open_studio
from cliploc_ros.core.map.landmark_embeddings import embeddings_path, load_landmark_embeddings
from cliploc_ros.models.clip_encoder import ClipEncoder
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.offline.datasets.images import open_images, views_of_folder
from cliploc_ros.offline.datasets.observations import save_observations
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio import edits
from demo.truth import read_frames

WALK = ASSETS / 'mapping'
CLIP = ('--clip-pretrained', str(ASSETS / 'clip'))
PATIENCE_S = 120.0


def opened(*arguments):
    return open_studio(make_parser().parse_args(list(map(str, arguments))))


def wait_for_phrases(studio):
    """Return the final suggestions, and the notes until then."""
    deadline, notes = time.monotonic() + PATIENCE_S, set()
    while True:
        found, note = studio.phrases('bowl_1')
        if 'CLIP is searching' not in note:
            return found, notes
        notes.add(note)
        assert time.monotonic() < deadline, f'no answer to {found}'
        time.sleep(0.02)


@pytest.fixture
def path(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    path = tmp_path / 'map.yaml'
    shutil.copy(ASSETS / 'map.yaml', path)
    return path


def test_clip_offers_phrases_for_what_the_images_show(path):
    studio = opened(path, '--images', WALK, *CLIP)
    truth = studio.document.landmarks['bowl_1'].label
    studio.document.edit(edits.set_fields, ['bowl_1'], label='something')
    studio.document.select(['bowl_1'])
    assert studio.phrases('bowl_1').phrases[0] != truth, 'labels of the class while CLIP loads'
    found, notes = wait_for_phrases(studio)
    print(f'{truth}: {found}')
    assert len(found) == 5 and truth in found
    assert len(notes) == 1 and studio.phrases('bowl_1').note == ''
    studio.document.edit(edits.set_fields, ['bowl_1'], center=[1, 1, 1])
    assert studio.phrases('bowl_1').phrases == found, 'a drag requests no phrases'
    studio.stop()
    studio.document.close()


def observed(tmp_path, object_id):
    """Write an observation file with the true boxes of one object, and their embeddings."""
    options = ClipOptions(pretrained=CLIP[1])
    encoder = ClipEncoder(resolve_clip_weights(options), options)
    views, images = views_of_folder(WALK), open_images(WALK, None)
    boxes = [[box.bbox_xyxy for box in frame.boxes if box.object_id == object_id]
             for frame in read_frames(WALK)]
    rows = [encoder.encode_crops(images.near(float(stamp_s)), np.array(seen))
            for stamp_s, seen in zip(views.stamps_s, boxes, strict=True) if seen]
    embeddings, count = np.concatenate(rows).astype(np.float16), sum(map(len, boxes))
    file = tmp_path / 'walk.npz'
    save_observations(file, PosedDetections(
        views.cameras, views.map_from_camera, views.stamps_s,
        np.cumsum([0, *map(len, boxes)]), np.concatenate([box for box in boxes if box]),
        ('bowl',), np.zeros(count, dtype=np.int64), np.ones(count), embeddings=embeddings,
        encoder_key=encoder.key))
    return file, embeddings


def test_a_new_landmark_has_the_mean_of_its_boxes(path, tmp_path):
    """CLIP also suggests phrases for it, without its images."""
    file, embeddings = observed(tmp_path, 'bowl_1')
    new = tmp_path / 'new.yaml'
    studio = opened(new, '--observations', file, *CLIP)
    for view in np.flatnonzero(np.diff(studio.recording.detections.frame_offsets)).tolist():
        studio.show_view(view)
        box = studio.recording.detections.detections_of(view).bboxes_xyxy[0]
        studio.new.draw(view, box[:2], box[2:])
    assert studio.new.class_id == 'bowl', 'the class of the detected box there'
    studio.new.create('something', 'bowl')
    found, _ = wait_for_phrases(studio)
    assert len(found) == 5
    studio.document.save()
    stored = load_landmark_embeddings(embeddings_path(new))
    assert stored.landmark_ids == ('bowl_1',) and 1 <= len(stored.medoids) <= 5
    mean = embeddings.astype(float).mean(axis=0)
    assert stored.means[0] @ mean / np.linalg.norm(mean) > 0.99
    studio.stop()
    studio.document.close()
