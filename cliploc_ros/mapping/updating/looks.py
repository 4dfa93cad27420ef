# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How landmarks look, before and now: image embeddings of one encoder."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.maps.landmark_embeddings import LandmarkEmbeddings
from cliploc_ros.mapping.labelling import embed_landmarks
from cliploc_ros.mapping.posed_detections import PosedDetections


@dataclass(frozen=True)
class Looks:
    """How landmarks and objects look, in one encoder's space: unit rows, zero if unknown.

    Parameters
    ----------
    landmarks : ndarray (L, d)
        Of the old map.
    objects : ndarray (m, d)
        Of the recording.
    """

    landmarks: NDArray[np.float32]
    objects: NDArray[np.float32]

    def similarities(self, rows: NDArray[np.int64], objects: NDArray[np.int64]
                     ) -> NDArray[np.float64]:
        """Return cosines (k, j) of landmarks and objects; NaN if one is unknown."""
        first, second = self.landmarks[rows], self.objects[objects]
        cosines = (first @ second.T).astype(np.float64)
        cosines[~first.any(axis=1)] = np.nan
        cosines[:, ~second.any(axis=1)] = np.nan
        return cosines


def why_not_comparable(old: LandmarkEmbeddings | None, detections: PosedDetections) -> str:
    """Return why the looks of a map and a recording cannot be compared; '' if they can."""
    if old is None:
        return 'the map has no image embeddings'
    if detections.embeddings is None or not detections.encoder_key:
        return 'the recording has no embeddings that name their encoder; let CLIP look at it'
    if old.encoder_key != detections.encoder_key:
        return f"the map's encoder is {old.encoder_key}, the recording's {detections.encoder_key}"
    if old.means.shape[1] != detections.embeddings.shape[1]:
        return 'the embeddings of map and recording differ in length'
    return ''


def compare_looks(old: LandmarkEmbeddings, landmark_ids: Sequence[str],
                  detections: PosedDetections, shown: NDArray[np.int64], count: int) -> Looks:
    """Return the looks of the old landmarks and of the recording's objects.

    Parameters
    ----------
    old : LandmarkEmbeddings
    landmark_ids : sequence of str
        Of the old map.
    detections : PosedDetections
    shown : ndarray (n,) of int
        The object that each box shows, -1 for none.
    count : int
        Number of objects.
    """
    objects = embed_landmarks([str(number) for number in range(count)], detections, shown)
    return Looks(old.in_order(landmark_ids).means.astype(np.float32),
                 objects.means.astype(np.float32))


def renew_embeddings(old: LandmarkEmbeddings | None, landmark_ids: Sequence[str],
                     detections: PosedDetections, shown: NDArray[np.int64]
                     ) -> LandmarkEmbeddings | None:
    """Return the embeddings of the new map: the old ones, and the recording's for the others.

    Parameters
    ----------
    old : LandmarkEmbeddings, optional
    landmark_ids : sequence of str
        Of the new map.
    detections : PosedDetections
    shown : ndarray (n,) of int
        The landmark of the new map that each box shows, -1 for none.
    """
    kept = None if old is None else old.in_order(landmark_ids)
    if detections.embeddings is None or not detections.encoder_key:
        return kept
    seen = embed_landmarks(landmark_ids, detections, shown)
    if kept is None:
        return seen
    if why_not_comparable(kept, detections):
        return kept
    ids = np.array(landmark_ids)
    first, second = kept.in_order(ids[kept.is_known].tolist()), seen.in_order(
        ids[~kept.is_known].tolist())
    return LandmarkEmbeddings(
        kept.encoder_key, first.landmark_ids + second.landmark_ids,
        np.concatenate([first.means, second.means]),
        np.concatenate([first.medoids, second.medoids]),
        np.concatenate([first.medoid_offsets, len(first.medoids) + second.medoid_offsets[1:]])
    ).in_order(landmark_ids)
