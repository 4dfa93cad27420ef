# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory of CLIP's first start and of a start with a warm cache."""

import pytest

from cliploc_ros.models.clip_weights import ClipOptions
from studies.speed.startup import KINDS, format_results, measure_startup

pytestmark = pytest.mark.full


def test_a_warm_start_leaves_the_text_tower_out(large_clip, tmp_path):
    options = ClipOptions(large_clip.name, str(large_clip.file), device='cpu',
                          cache_dir=str(tmp_path), inference='pytorch')
    first, warm = results = [measure_startup(kind, options) for kind in KINDS[1:]]
    print(f'\n{format_results(results)}')
    whole_mib = sum(each.numel() * 4 for each in large_clip.model.parameters()) / 2**20
    assert first.weights_mib == warm.weights_mib < whole_mib - 200
    assert not first.holds_text_tower and not warm.holds_text_tower
    # One tower at a time: its weights, and the pages of the mapped file that they are copied from.
    assert first.peak_mib - first.imports_mib < 2 * first.weights_mib + 64
    assert warm.peak_mib - warm.imports_mib < 2 * warm.weights_mib + 64
    # The image tower is larger than the text tower, so it determines the peak of both starts.
    assert warm.peak_mib < first.peak_mib + 16
