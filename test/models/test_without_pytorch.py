# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights for PyTorch localize the demo, also without PyTorch once they are exported."""

import json
import os
import subprocess
import sys

import pytest
from without_pytorch import hide_pytorch

from demo import ASSETS

pytestmark = pytest.mark.full

ONNX = (ASSETS / 'yolo.onnx', '', ASSETS / 'clip')
WEIGHTS = (ASSETS / 'yolo.pt', ASSETS / 'clip.json', ASSETS / 'clip.safetensors')


def localize(networks, cache, out, environment):
    """Run evaluate on some images of the demo."""
    model, clip_model, pretrained = networks
    named = ['--clip-model', clip_model] if clip_model else []
    return subprocess.run(
        [sys.executable, '-m', 'cliploc_ros.cli.evaluate', '--tum', ASSETS / 'sequence', '--map',
         ASSETS / 'map.yaml', '--every', '10', '--methods', 'auto', '--trials', '1', '--sweep',
         '--no-figures', '--workers', '1', '--model', model, *named, '--clip-pretrained',
         pretrained, '--out', out], env=environment | {'XDG_CACHE_HOME': str(cache)},
        capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture
def hidden(tmp_path):
    (tmp_path / 'hidden').mkdir()
    return hide_pytorch(tmp_path / 'hidden')


@pytest.mark.parametrize(('networks', 'named'), [
    (WEIGHTS, '--no-clip'), ((WEIGHTS[0], *ONNX[1:]), 'yolo.pt')])
def test_without_pytorch_weights_are_refused_with_what_to_do(networks, named, hidden, tmp_path):
    done = localize(networks, tmp_path / 'empty', tmp_path / 'out', hidden)
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert 'is not installed' in done.stderr and 'export_network' in done.stderr
    assert 'script/setup models' in done.stderr and named in done.stderr


def test_weights_are_exported_once_and_then_need_no_pytorch(hidden, tmp_path):
    found = []
    for networks, environment in ((ONNX, hidden), (WEIGHTS, dict(os.environ)), (WEIGHTS, hidden)):
        out = tmp_path / str(len(found))
        done = localize(networks, tmp_path / 'cache', out, environment)
        assert done.returncode == 0, done.stderr
        found.append([(row['accepted'], row['error_m'])
                      for row in json.loads((out / 'results.json').read_text())])
    onnx, exported, again = found
    assert exported == again
    assert [accepted for accepted, _ in onnx] == [accepted for accepted, _ in exported]
    off = [abs(one - other) for (accepted, one), (_, other) in zip(onnx, exported, strict=True)
           if accepted]
    print(f'\n{len(off)} of {len(onnx)} poses accepted, errors differ by {1e3 * max(off):.2f} mm')
    assert len(off) >= len(onnx) // 2 and max(off) < 0.01
