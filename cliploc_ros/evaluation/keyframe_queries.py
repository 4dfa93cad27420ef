# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Queries with the local features of their images, which a layer of keyframes needs.

A recording's boxes are kept in a file, its images are not. So they are read once more, and what
is kept of each are its features: at most 0.3 MB.
"""

import time
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import replace

from tqdm import tqdm

from cliploc_ros.core.keyframes.localization import query_features
from cliploc_ros.datasets.frames import Frames
from cliploc_ros.evaluation.trials import ImageFeatures, Query


def with_features(queries: Sequence[Query], frames: Frames) -> tuple[Query, ...]:
    """Return queries with the features of their images; those without an image stay.

    Parameters
    ----------
    queries : sequence of Query
        Recorded from these frames.
    frames : Frames
    """
    waiting: dict[int, deque[int]] = defaultdict(deque)
    for row, query in enumerate(queries):
        waiting[query.observation.stamp_ns].append(row)
    found = list(queries)
    wanted = frames.read_raw(lambda place, stamp_ns, pose: pose is not None
                             and bool(waiting.get(stamp_ns)))
    for raw in tqdm(wanted, 'features', len(queries), unit='image', disable=None):
        if not waiting[raw.stamp_ns]:
            continue  # of images of one stamp, more than were recorded
        row = waiting[raw.stamp_ns].popleft()
        frame = raw.decode()
        begin = time.perf_counter()
        features = query_features(frame.image_rgb)
        spent_ms = 1e3 * (time.perf_counter() - begin)
        found[row] = replace(queries[row], image=ImageFeatures(features, frame.camera, spent_ms))
    return tuple(found)
