# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A CLIP with the architecture from a user's model config."""

import json

import pytest

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights


def resolve(config, tmp_path):
    weights = tmp_path / 'own.safetensors'
    weights.write_bytes(b'x' * 100)
    return resolve_clip_weights(ClipOptions(model=str(config), pretrained=str(weights)))


@pytest.mark.parametrize(('text', 'complaint'), [
    ('', 'cannot be read as JSON'),
    ('{"embed_dim": 12', 'cannot be read as JSON'),
    ('[1, 2]', 'lacks embed_dim, vision_cfg, text_cfg'),
    ('{"embed_dim": 12, "text_cfg": {}}', 'lacks vision_cfg'),
])
def test_broken_configs_are_named(tmp_path, text, complaint):
    config = tmp_path / 'own_model.json'
    config.write_text(text)
    with pytest.raises(ModelError, match=complaint) as caught:
        resolve(config, tmp_path)
    assert str(config) in str(caught.value)


def test_a_missing_config_is_named(tmp_path):
    with pytest.raises(ModelError, match=r'nowhere\.json does not exist'):
        resolve(tmp_path / 'nowhere.json', tmp_path)


def test_a_name_that_open_clip_uses_otherwise_is_refused(tmp_path):
    config = tmp_path / 'ViT-B-32.json'
    config.write_text(json.dumps({'embed_dim': 8, 'vision_cfg': {}, 'text_cfg': {}}))
    with pytest.raises(ModelError, match="another model of the name 'ViT-B-32': rename"):
        resolve(config, tmp_path)
