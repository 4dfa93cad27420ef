# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Crops on demand: compare only as many crops of a frame as its pose needs.

A network that embeds crops takes longer than all else on a CPU. The frame is first localized by
classes alone, then with more and more of its crops, the most informative ones first, until the
pose is accepted or no crop is left.

Each of these searches is another chance of a false accept. So a pose from a part of the crops
needs a greater confidence, see cliploc_ros.core.acceptance.verdict.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.looks import Looks
from cliploc_ros.core.keyframes.recognizer import ImageRecognizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import Similarities
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import SearchedFrame

#: Crops between two searches. A search takes less time than one crop of most networks on a CPU.
BATCH = 4
_NO_LOOKS = Looks()


@dataclass(frozen=True)
class Crops:
    """The crops of one frame, which a search compares with the labels as it needs them."""

    #: Takes the rows of m detections; returns their similarities (m, L)
    compare: Callable[[NDArray[np.int64]], Similarities]
    #: (m,): detections whose similarities cost nothing; the first search has them
    known: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    room: Callable[[], int] = lambda: BATCH  #: Returns how many crops to compare next; 0 ends


def can_do_without_crops(options: RelocalizerOptions) -> bool:
    """Return whether a frame can be localized without some of its crops: by hybrid_auto alone."""
    return options.algorithm == 'auto' and options.matching == 'hybrid'


def recorded_crops(observation: Observation, options: RelocalizerOptions) -> Crops | None:
    """Return the crops on demand of an observation that has all similarities.

    A search gets only those that it needs; None where the options give it all at once.
    """
    if options.crops != 'on_demand' or not can_do_without_crops(options):
        return None
    recorded = np.asarray(observation.similarities)
    return Crops(lambda rows: recorded[rows])


def informative_first(landmark_map: LandmarkMap, observation: Observation) -> NDArray[np.int64]:
    """Return the detections in the order in which their crops say most about the pose.

    A crop tells the landmarks of its class apart, the more of them there are; a large crop does
    so more reliably.
    """
    classes = landmark_map.classes.classes_of(observation.detections.class_ids)
    sizes = landmark_map.classes.sizes_of(classes)
    boxes = observation.detections.bboxes_xyxy
    sides = np.sqrt(np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0), axis=1))
    return np.asarray(np.argsort(-np.log2(1.0 + sizes) * sides, kind='stable'))


def localize_on_demand(relocalizer: Relocalizer, earlier: Sequence[SearchedFrame],
                       observation: Observation, crops: Crops | None = None,
                       looks: Looks = _NO_LOOKS, recognizer: ImageRecognizer | None = None
                       ) -> tuple[SearchedFrame, Relocalization]:
    """Localize a frame with more and more of its crops until its pose is accepted.

    Parameters
    ----------
    earlier : sequence of SearchedFrame
        Frames before it, linked by odometry.
    crops : Crops, optional
        They take the place of its similarities; without them it is localized once, as it is.
    looks : Looks, optional
        Results of earlier frames, which have to agree.
    recognizer : ImageRecognizer, optional
        Of the keyframes.

    Returns
    -------
    frame : SearchedFrame
        With the crops that it took.
    found : Relocalization
        Its time is that of all searches.

    Raises
    ------
    OptionsError
        See Relocalizer.relocalize.
    """
    search_ms, left = 0.0, np.empty(0, dtype=np.int64)
    if crops is not None:
        compared = crops.known
        observation = replace(observation, similarities=crops.compare(compared),
                              compared=compared)
        left = informative_first(relocalizer.landmark_map, observation)
        left = left[~np.isin(left, compared)]
    while True:
        budget = relocalizer.begin(len(earlier) + 1)
        frame = relocalizer.search(observation, budget.search_end())
        found = relocalizer.locate([*earlier, frame], budget, looks, recognizer)
        search_ms += found.search_ms
        if found.accepted or crops is None or not len(left) or (count := crops.room()) <= 0:
            return frame, replace(found, search_ms=search_ms)
        compared, left = np.append(compared, left[:count]), left[count:]
        observation = replace(observation, similarities=crops.compare(compared),
                              compared=compared)
