# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names on maps from above."""

from itertools import combinations

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from scene import make_room

from cliploc_ros.offline.evaluation.figures import draw_map, png_of, spread_names


@pytest.mark.parametrize('inches', [8.0, 1.5], ids=['large', 'small'])
def test_names_do_not_cover_each_other(inches):
    room = make_room()
    figure = Figure(figsize=(inches, inches), layout='constrained')
    axes = figure.add_subplot(aspect='equal')
    draw_map(axes, room)
    axes.autoscale_view()
    spread_names(figure)
    names = [one for one in axes.texts if one.get_visible()]
    boxes = [one.get_window_extent() for one in names]
    assert not any(first.overlaps(second) for first, second in combinations(boxes, 2))
    assert all(axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 for box in boxes)
    assert (len(names) == len(room)) == (inches > 2.0), 'a small map has no room for all'
    highest = room.landmark_ids[int(np.argmax(room.centers[:, 2]))]
    assert highest in [one.get_text() for one in names]
    image = cv2.imdecode(np.frombuffer(png_of(figure, 50), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[0] == pytest.approx(50 * inches, abs=1)
