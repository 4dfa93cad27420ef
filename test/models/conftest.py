# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the models' tests: checkpoints and an image."""

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope='session')
def small_clip(tmp_path_factory):
    from clip_reference import SMALL_CONFIG, make_small_reference  # needs PyTorch

    return make_small_reference('small-clip', SMALL_CONFIG, tmp_path_factory.mktemp('small_clip'))


@pytest.fixture(scope='session')
def large_clip(tmp_path_factory):
    from clip_reference import make_reference

    return make_reference('ViT-B-32', tmp_path_factory.mktemp('large_clip'))


@pytest.fixture(scope='session')
def truncated(tmp_path_factory):
    """Return a function that copies the first part of a file."""
    def cut(file: Path, share: float) -> Path:
        copy = tmp_path_factory.mktemp('truncated') / file.name
        copy.write_bytes(file.read_bytes()[:int(file.stat().st_size * share)])
        return copy
    return cut


@pytest.fixture
def image_rgb() -> np.ndarray:
    """Return an image with structure at all scales, 640 x 480."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[0:480, 0:640]
    waves = np.stack([np.sin(x / 37) + np.cos(y / 23), np.sin((x + y) / 11), np.cos(x * y / 9e3)],
                     axis=-1)
    return (127 + 50 * waves + rng.normal(0, 8, waves.shape)).clip(0, 255).astype(np.uint8)
