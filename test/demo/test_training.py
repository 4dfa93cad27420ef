# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train the demo's networks: CLIP's loss decreases, and the files load like any CLIP and YOLO."""

import csv
import re
import subprocess
import sys

import numpy as np
import pytest
import yaml
from without_pytorch import Lazy

from cliploc_ros.models.clip_encoder import ClipEncoder, encode_labels
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS
from demo import ASSETS
from demo.world.appearance import CLASSES

pytestmark = pytest.mark.full
torch, train_clip, train_detector = map(Lazy, (
    'torch', 'demo.world.train_clip', 'demo.world.train_detector'))

PROJECT = ASSETS.parents[1]


@pytest.fixture(scope='module')
def worlds(tmp_path_factory):
    """Two worlds of three images: one to train on, one held out."""
    folder = tmp_path_factory.mktemp('worlds')
    subprocess.run(
        [sys.executable, '-m', 'demo.world.make_worlds', str(folder), '--count', '2',
         '--frames', '3', '--seed', '40'], cwd=PROJECT, check=True, timeout=300)
    return folder


def test_it_learns_and_is_saved_as_any_clip(worlds, tmp_path, capsys):
    model, tokenizer, preprocess = train_clip.make_model(train_clip.CONFIG, seed=0)
    objects = list(train_clip.read_crops(worlds / 'world_000').values())
    assert len(objects) > 10
    losses = train_clip.train(objects, model, tokenizer, preprocess, steps=12, batch=16, seed=0)
    assert np.mean(losses[-3:]) < np.mean(losses[:3]) - 0.1
    file = tmp_path / 'clip.safetensors'
    train_clip.save(model, file)
    labels = ('a red mug', 'a blue box with white dots')
    clip = ClipOptions(model=str(train_clip.CONFIG), pretrained=str(file), cache_dir=str(tmp_path))
    weights = resolve_clip_weights(clip)
    encoder, embeddings = ClipEncoder(weights, clip), encode_labels(weights, labels, clip)
    model.eval()
    with torch.no_grad():
        wanted = model.encode_text(tokenizer(list(labels)), normalize=True).numpy()
    np.testing.assert_allclose(embeddings, wanted, atol=5e-3)  # half precision on disk
    crop = objects[0][0]
    image = np.asarray(crop.image)
    box = np.array([[0, 0, image.shape[1] - 1, image.shape[0] - 1]], dtype=float)
    assert encoder.encode_crops(image, box).shape == (1, 128)


def test_the_command_writes_a_detector(worlds, tmp_path, capsys):
    file = tmp_path / 'yolo.pt'
    assert train_detector.run([str(worlds), '--out', str(file), '--epochs', '1', '--imgsz', '160',
                               '--batch', '2']) == 0
    assert re.search(r'1 worlds held out: mAP50 0\.\d+', capsys.readouterr().out)
    assert file.stat().st_size < 3e6
    assert str(tmp_path).encode() not in file.read_bytes()
    detector = load_detector(DetectorOptions(model=str(file), conf=0.0, max_det=5))
    assert detector.class_names == CLASSES
    found = detector.detect(np.full((480, 640, 3), 128, dtype=np.uint8))
    assert found.bboxes_xyxy.shape[1] == 4


def test_the_networks_know_a_walk_they_never_saw_and_labels_lead_where_classes_do_not(tmp_path):
    limits = yaml.safe_load((PROJECT / 'test/thresholds.yaml').read_text())['demo']['table']
    done = subprocess.run(
        [sys.executable, '-m', 'demo.world.compare', '--out', str(tmp_path), '--budget', '0.05',
         '--trials', '1', '--workers', '1', '--every', '2'], cwd=PROJECT, capture_output=True,
        text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    print('\n' + done.stdout)
    map50, first, third = map(float, re.search(
        r'mAP50 ([.0-9]+); CLIP: top-1 ([.0-9]+), top-3 ([.0-9]+)', done.stdout).groups())
    assert map50 >= limits['map50']
    assert first >= limits['clip_top_1'] and third >= limits['clip_top_3']
    with (tmp_path / 'summary.csv').open() as file:
        rows = {row['method']: row for row in csv.DictReader(file)}
    assert tuple(rows) == (*PAPER_METHODS, 'auto')
    success = {name: float(row['success_0.5m']) for name, row in rows.items()}
    assert success['hybrid_b-prosac'] >= limits['hybrid_b-prosac_at_half_a_metre']
    assert success['hybrid_b-prosac'] > success['class_ransac']
    assert {name for name, row in rows.items() if int(row['wrongly_accepted'])} == set()
