# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From an observation and a map to the scene that is searched: the association of one frame."""

from math import comb

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.association.candidates import (
    ADAPTIVE,
    Candidates,
    adaptive_candidates,
    balanced_order,
    joined,
    nearest_candidates,
    prosac_order,
)
from cliploc_ros.core.association.culling import FEW, SortedLandmarks
from cliploc_ros.core.association.scene import Scene, make_scene
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.sampling import SAMPLE_SIZE
from cliploc_ros.errors import OptionsError

#: The most candidates that auto goes through: which of them are compatible, pair by pair, takes
#: this squared in bytes, and milliseconds. In sparse maps of 100,000 landmarks the search ends
#: here and not at its iterations, since candidates of equal class are hardly ever neighbours.
MAX_CANDIDATES = 1_500

# No lens sees what is so far off its axis, on the plane z = 1; squares of it are still numbers.
_FARTHEST = 1e6


def match_frame(landmark_map: LandmarkMap, observation: Observation, options: RelocalizerOptions
                ) -> tuple[Scene, float]:
    """Return the scene of a frame, and which share of its samples the candidates kept allow.

    The share is below 1 only where auto meets more candidates than it can go through.

    Raises
    ------
    OptionsError
        The matching type needs similarities that are missing, of the wrong shape, or not finite.
    """
    bboxes = observation.camera.normalize_bboxes(observation.detections.bboxes_xyxy)
    # NaN where the lens model has no inverse; and a box turned inside out has no ellipse
    sound = (bboxes[:, 2:] > bboxes[:, :2]).all(axis=1) & (np.abs(bboxes) < _FARTHEST).all(axis=1)
    classes = landmark_map.classes.classes_of(observation.detections.class_ids)
    classes[~sound] = -1
    nearest = _nearest(landmark_map, observation, options, sound)
    candidates, share = _candidates(landmark_map, classes, nearest, options)
    by_class = classes if options.matching != 'clip' else np.full_like(classes, -1)
    single, nearby = _potential(landmark_map, by_class, nearest)
    # what is not sound is replaced by numbers that nothing is done with
    return make_scene(np.where(sound[:, None], bboxes, 1.0), landmark_map.centers,
                      landmark_map.shapes, single, candidates.pairs, options.iou_threshold,
                      nearby, by_class), share


def _potential(landmark_map: LandmarkMap, classes: NDArray[np.int64], nearest: Candidates | None
               ) -> tuple[NDArray[np.int64], SortedLandmarks | None]:
    """Return which pairs (p, 2) to verify, and the landmarks among which are those of equal class.

    Small maps are not sorted for that: there the pairs are all.
    """
    if len(landmark_map) <= FEW:
        of_class = landmark_map.classes.candidates(classes)
        return (of_class if nearest is None else
                joined(nearest, of_class, len(landmark_map))).pairs, None
    if nearest is None:
        return np.empty((0, 2), dtype=np.int64), landmark_map.nearby
    others = landmark_map.classes.of_landmarks[nearest.landmarks] != classes[nearest.detections]
    return nearest.select(others).pairs, landmark_map.nearby


def _nearest(landmark_map: LandmarkMap, observation: Observation, options: RelocalizerOptions,
             sound: NDArray[np.bool_]) -> Candidates | None:
    """Return the landmarks that CLIP finds most similar to sound detections; None without CLIP."""
    if not options.needs_similarities:
        return None
    shape = (len(observation.detections), len(landmark_map))
    similarities = observation.similarities
    if similarities is None or similarities.shape != shape:
        found = 'none' if similarities is None else f'{similarities.shape}'
        raise OptionsError(f"matching '{options.matching}' needs similarities of shape "
                           f'{shape}, found {found}')
    nearest = adaptive_candidates(similarities) if options.k == ADAPTIVE \
        else nearest_candidates(similarities, options.k)
    return nearest.select(sound[nearest.detections])


def _candidates(landmark_map: LandmarkMap, classes: NDArray[np.int64],
                nearest: Candidates | None, options: RelocalizerOptions
                ) -> tuple[Candidates, float]:
    """Return the candidates in the order of the sampler, and see match_frame."""
    automatic = options.algorithm == 'auto'
    if nearest is not None:
        if options.algorithm == 'prosac':
            nearest = prosac_order(nearest)
        elif options.algorithm in ('b-prosac', 'auto'):
            nearest = balanced_order(nearest)
        if options.matching == 'clip' or not automatic:
            return nearest, 1.0
    index = landmark_map.classes
    if not automatic:
        return index.candidates(classes), 1.0
    of_class = index.candidates(classes, rarest_first=True, limit=MAX_CANDIDATES)
    left_out = int(index.sizes_of(classes).sum()) - len(of_class)
    kept = of_class if nearest is None else joined(nearest, of_class,
                                                               len(landmark_map))
    share = comb(len(kept), SAMPLE_SIZE) / max(comb(len(kept) + left_out, SAMPLE_SIZE), 1)
    return kept, share if left_out else 1.0
