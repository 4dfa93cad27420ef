# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Crops on demand: compare only as many crops of a frame as its pose needs.

A network that embeds crops takes longer than all else on a CPU. The frame is first localized by
classes alone, then with more and more of its crops, the most informative ones first, until the
pose is accepted or no crop is left.

Each of these searches is another chance of a false accept. So a pose from a part of the crops
needs a greater confidence, see cliploc_ros.core.acceptance.verdict.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

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
_NONE = np.empty(0, dtype=np.int64)
_NO_LOOKS = Looks()


def can_do_without_crops(options: RelocalizerOptions) -> bool:
    """Return whether a frame can be localized without some of its crops: by hybrid_auto alone."""
    return options.algorithm == 'auto' and options.matching == 'hybrid'


def stages_of(landmark_map: LandmarkMap, observation: Observation, options: RelocalizerOptions
              ) -> Iterator[Observation]:
    """Yield an observation that has all similarities, at once or crop after crop.

    Crops on demand that a search does not need are withheld from it.
    """
    if options.crops != 'on_demand' or not can_do_without_crops(options):
        return iter([observation])
    recorded = np.asarray(observation.similarities)
    return crops_on_demand(landmark_map, observation, lambda rows: recorded[rows])


def crops_on_demand(landmark_map: LandmarkMap, observation: Observation,
                    compare: Callable[[NDArray[np.int64]], Similarities],
                    known: NDArray[np.int64] = _NONE,
                    room: Callable[[], int] = lambda: BATCH) -> Iterator[Observation]:
    """Yield an observation with the similarities of more and more of its crops.

    Parameters
    ----------
    observation : Observation
        Its similarities are ignored.
    compare : callable
        Takes the rows of m detections; returns their similarities (m, L).
    known : ndarray (m,) of int, optional
        Detections whose similarities cost nothing; the first observation has them.
    room : callable, optional
        Returns how many crops to compare next; 0 ends.

    Yields
    ------
    Observation
        The first one has no similarities but the known ones, the last one has all if time allows.
    """
    compared = known
    yield replace(observation, similarities=compare(compared), compared=compared)
    left = informative_first(landmark_map, observation)
    left = left[~np.isin(left, known)]
    while len(left) and (count := room()) > 0:
        compared, left = np.append(compared, left[:count]), left[count:]
        yield replace(observation, similarities=compare(compared), compared=compared)


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
                       observations: Iterable[Observation], looks: Looks = _NO_LOOKS,
                       recognizer: ImageRecognizer | None = None
                       ) -> tuple[SearchedFrame, Relocalization]:
    """Localize a frame with more and more of its crops until its pose is accepted.

    The observations, one at least, are the frame with more and more of its crops, see
    crops_on_demand. Returns the frame with the crops that it took; the result's time is that of
    all searches. Raises OptionsError, see Relocalizer.relocalize.
    """
    search_ms = 0.0
    for observation in observations:
        budget = relocalizer.begin(len(earlier) + 1)
        frame = relocalizer.search(observation, budget.search_end())
        found = relocalizer.locate([*earlier, frame], budget, looks, recognizer)
        search_ms += found.search_ms
        if found.accepted:
            break
    return frame, replace(found, search_ms=search_ms)
