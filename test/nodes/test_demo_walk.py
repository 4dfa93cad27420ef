# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo's walk as a recording, through real nodes with the real networks trained for it."""

import numpy as np
import pytest
import yaml
from processes import PROJECT
from wake_ups import judge, wake_up_on_frames

from cliploc_ros.cli.tum_to_bag import main as tum_to_bag
from cliploc_ros.datasets.tum import read_tum

ASSETS = PROJECT / 'cliploc_ros/demo/assets'
# Of 48: where requests and frames keep step, the last few may take many rounds of the recording.
FRAMES = 44


@pytest.fixture
def recording(tmp_path, monkeypatch):
    output = tmp_path / 'walk'
    monkeypatch.setattr('sys.argv', ['tum_to_bag', str(ASSETS / 'sequence'), str(output)])
    assert tum_to_bag() == 0
    return output


def test_the_labels_tell_where_the_robot_is(recording, tmp_path, start, tester):
    print()
    start('nodes.detector', fresh=True, parameters={'model': ASSETS / 'yolo.pt'}).wait_for_output(
        'ready after')
    start('nodes.relocalizer', fresh=True, parameters={
        'map_file': ASSETS / 'map.yaml', 'matching': 'hybrid',
        'clip_model': ASSETS / 'clip.json', 'clip_pretrained': ASSETS / 'clip.safetensors',
        'cache_dir': tmp_path}).wait_for_output('ready after')
    tester.connect()
    # so slow that one round is enough to ask about nearly every frame
    start('cli.replay', recording, '--loop', '--rate', '0.6')
    answers = wake_up_on_frames(tester, FRAMES)
    errors_m, wrong = judge(answers, read_tum(ASSETS / 'sequence'))
    limits = yaml.safe_load((PROJECT / 'test/thresholds.yaml').read_text())['demo']['nodes']
    assert np.mean(errors_m < 0.5) >= limits['success_at_half_a_metre']
    assert wrong <= limits['accepted_wrong_by_1m']
