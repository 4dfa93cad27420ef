# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights and model configs that are missing, damaged or of another model."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_encoder import load_encoder
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.files import fingerprint_file
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_detector import YoloDetector

pytestmark = pytest.mark.full


def options(model: str, file: object, tmp_path: Path, **changes) -> ClipOptions:
    return ClipOptions(model, str(file), device='cpu', cache_dir=str(tmp_path),
                       inference='pytorch', **changes)


def refusal(clip_options: ClipOptions) -> str:
    with pytest.raises(ModelError) as caught:
        load_encoder(clip_options, ['a label'])
    message = str(caught.value)
    assert '\n' not in message and len(message) < 1000
    return message


@pytest.mark.parametrize(('content', 'message'), [
    (b'', 'is empty'),
    (b'version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 3\n', 'git lfs pull'),
    (b'\n<!DOCTYPE html><html><body>Sign in</body></html>', 'is a web page'),
    (b'just text', 'holds no weights'), (b'PK\x03\x04' + bytes(1000), 'truncated'),
    (b'\x80\x02garbage', 'no checkpoint')])
def test_files_that_are_no_weights(tmp_path, content, message):
    file = tmp_path / 'weights.pt'
    file.write_bytes(content)
    text = refusal(options('ViT-B-32', file, tmp_path))
    assert message in text and str(file) in text


def test_weights_of_another_clip(small_clip, tmp_path):
    text = refusal(options('ViT-B-32', small_clip.file, tmp_path))
    assert str(small_clip.file) in text and "'ViT-B-32'" in text
    assert 'has shape' in text and 'more)' in text
    text = refusal(options('RN50', small_clip.file, tmp_path))
    assert 'weights' in text


class Hostile:
    """Runs a command when it is unpickled."""

    def __init__(self, proof: Path) -> None:
        self.proof = proof

    def __reduce__(self):
        return os.system, (f'touch {self.proof}',)


@pytest.mark.parametrize('zipped', [True, False])
def test_pickled_code_is_never_run(tmp_path, zipped):
    file, proof = tmp_path / 'weights.pt', tmp_path / 'proof'
    torch.save({'visual.proj': Hostile(proof)}, file, _use_new_zipfile_serialization=zipped)
    assert 'no checkpoint' in refusal(options('ViT-B-32', file, tmp_path))
    with pytest.raises(ModelError, match='no detection'):
        YoloDetector(DetectorOptions(str(file), device='cpu'))
    assert not proof.exists()


def test_fingerprint(tmp_path):
    file = tmp_path / 'weights'
    file.write_bytes(np.random.default_rng(0).bytes(20_000_000))
    first = fingerprint_file(file)
    assert fingerprint_file(file) == first
    content = bytearray(file.read_bytes())
    for offset in (0, len(content) // 2, len(content) - 1):
        changed = content[:]
        # A retrained tensor is longer than the gap between two blocks.
        changed[offset:offset + 400_000] = bytes(len(changed[offset:offset + 400_000]))
        file.write_bytes(changed)
        assert fingerprint_file(file) != first, offset
    file.write_bytes(content[:-1])
    assert fingerprint_file(file) != first
    file.write_bytes(b'')
    fingerprint_file(file)
