# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Profiles choose networks that exist; names given by hand override them."""

import open_clip
import pytest

from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.profiles import PROFILES, resolve_profile, with_detector, with_encoder
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_weights import import_ultralytics

pytestmark = pytest.mark.full

UNNAMED = ClipOptions(model='', pretrained='', device='cpu')


def test_published_networks_only():
    import_ultralytics()
    from ultralytics.utils.downloads import GITHUB_ASSETS_NAMES

    for profile in PROFILES.values():
        assert profile.detector in GITHUB_ASSETS_NAMES
        # an entry of the model hub can be kept for a start without a network
        assert open_clip.get_pretrained_cfg(profile.clip_model, profile.clip_pretrained)['hf_hub']


def test_a_cpu_is_balanced():
    assert resolve_profile('auto', 'cpu') is PROFILES['balanced']
    assert with_encoder(UNNAMED, 'auto').model == PROFILES['balanced'].clip_model
    assert with_detector(DetectorOptions('', device='cpu'), 'auto').model == 'yolov8m.pt'


@pytest.mark.parametrize(('model', 'pretrained', 'path', 'named'), [
    ('RN50', '', '', ('RN50', 'openai')),
    ('', 'weights.pt', '', ('ViT-L-14', 'weights.pt')),
    ('', '', 'weights.pt', ('ViT-L-14', 'openai')),
    ('RN50', 'cc12m', '', ('RN50', 'cc12m'))])
def test_names_override_a_profile(model, pretrained, path, named):
    encoder = with_encoder(ClipOptions(model, pretrained, path, device='cpu'), 'fast')
    assert (encoder.model, encoder.pretrained) == named
    assert encoder.checkpoint_path == path
