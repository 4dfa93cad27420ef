# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many folders have the same images: their features are extracted once."""

import pytest

from cliploc_ros.offline.datasets import agreement


@pytest.fixture(autouse=True, scope='session')
def extracted_once():
    extract, seen = agreement.extract, {}

    def once(image, *options):
        key = image.tobytes(), image.shape, *options
        if key not in seen:
            seen[key] = extract(image, *options)
        return seen[key]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(agreement, 'extract', once)
        yield
    print(len(seen))
