# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many folders have the same images: their features are extracted once."""

import pytest
from capture_folders import once_for_each

from cliploc_ros.offline.datasets import agreement


@pytest.fixture(autouse=True, scope='session')
def extracted_once():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(agreement, 'extract', once_for_each(agreement.extract))
        yield
