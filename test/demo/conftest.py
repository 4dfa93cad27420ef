# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rendered worlds for the tests of training."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

# Import this before anything renders: PyTorch's Triton and Mesa's software renderer each load an
# LLVM, and the opposite order crashes the process. The programs render and train in separate
# processes.
if importlib.util.find_spec('torchvision'):
    import torchvision  # noqa: F401

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope='package')
def worlds(tmp_path_factory):
    """Two worlds of three images: one to train on, one held out."""
    folder = tmp_path_factory.mktemp('worlds')
    subprocess.run(
        [sys.executable, '-m', 'demo.world.make_worlds', str(folder), '--count', '2',
         '--frames', '3', '--seed', '40'], cwd=PROJECT, check=True, timeout=300)
    return folder
