# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image embeddings of the landmarks: ``NAME.embeddings.npz`` next to ``NAME.yaml``."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.parameter_file import NO_SET, MapSet, check_set
from cliploc_ros.core.map.similarities import LabelEmbeddings
from cliploc_ros.errors import MapError
from cliploc_ros.files.arrays import UNIQUE, ArrayError, Arrays, Check, Field, Offsets, Schema

#: Maximum number of medoids of a landmark.
MOST_MEDOIDS = 5
# Number of landmarks whose images represent crops when spreads are measured.
_CROPS_SAMPLED = 1024


def _check_key(name: str, arrays: Arrays) -> None:
    if not str(arrays[name]):
        raise ArrayError(f'array {name} is empty: the encoder is unknown')


def _is_no_direction(rows: NDArray[Any]) -> NDArray[np.bool_]:
    # float16 has a relative rounding error of up to 5e-4
    lengths = np.linalg.norm(rows.astype(np.float32), axis=1)
    return np.asarray(~(np.abs(lengths - 1.0) <= 5e-3))  # true for NaN


# L landmarks, m medoids, d dimensions.
_SCHEMA = Schema('file of embeddings', {
    'encoder_key': Field('text', (), (_check_key,)),
    'landmark_ids': Field('text', ('L',), (UNIQUE,)),
    'means': Field('floats', ('L', 'd'), (Check(
        'is not of unit length', lambda rows: _is_no_direction(rows) & (rows != 0).any(axis=1)),)),
    'medoids': Field('floats', ('m', 'd'), (Check('is not of unit length', _is_no_direction),)),
    'medoid_offsets': Field('integers', ('L+1',), (Offsets('medoids', 'medoids'), Check(
        f'gives a landmark more than {MOST_MEDOIDS} medoids',
        lambda offsets: np.diff(offsets) > MOST_MEDOIDS))),
    'set': Field('text', is_optional=True),
}, MapError, 'build the map again, or remove the file')


@dataclass(frozen=True)
class LandmarkEmbeddings:
    """Image embeddings of L landmarks, with d dimensions."""

    #: Identifies the encoder: crops from another encoder must not be compared with the embeddings
    encoder_key: str
    landmark_ids: tuple[str, ...]  #: The landmarks, without repetitions
    #: (L, d): mean direction of each landmark's crops, unit rows; zeros: unknown
    means: NDArray[np.float16]
    #: (m, d): representative crops of each landmark, unit rows
    medoids: NDArray[np.float16]
    #: (L + 1,): landmark l has the medoids [medoid_offsets[l], medoid_offsets[l + 1]), up to five
    medoid_offsets: NDArray[np.int64]
    set_digest: str = ''  #: Digest of the map that they were written with; '' if unknown

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.landmark_ids)

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Return a mask (L,) of the landmarks that have an embedding."""
        return np.asarray(self.means.any(axis=1))

    def in_order(self, landmark_ids: Sequence[str]) -> 'LandmarkEmbeddings':
        """Return the embeddings of the given landmarks in the given order, unknown if missing."""
        rows_of = {landmark_id: row for row, landmark_id in enumerate(self.landmark_ids)}
        rows = np.array([rows_of.get(landmark_id, -1) for landmark_id in landmark_ids],
                        dtype=np.int64)
        means = np.zeros((len(rows), self.means.shape[1]), dtype=np.float16)
        means[rows >= 0] = self.means[rows[rows >= 0]]
        chosen = [np.arange(self.medoid_offsets[row], self.medoid_offsets[row + 1])
                  if row >= 0 else np.empty(0, dtype=np.int64) for row in rows]
        offsets = np.cumsum([0, *map(len, chosen)])
        medoids = self.medoids[np.concatenate([np.empty(0, dtype=np.int64), *chosen])]
        return LandmarkEmbeddings(self.encoder_key, tuple(landmark_ids), means, medoids, offsets)


def concatenated(several: Sequence[LandmarkEmbeddings], landmark_ids: Sequence[str]
                 ) -> LandmarkEmbeddings:
    """Concatenate the embeddings of several maps, which have the same encoder."""
    counts = np.concatenate([np.diff(of_map.medoid_offsets) for of_map in several])
    return LandmarkEmbeddings(
        several[0].encoder_key, tuple(landmark_ids),
        np.concatenate([of_map.means for of_map in several]),
        np.concatenate([of_map.medoids for of_map in several]), np.append(0, np.cumsum(counts)))


def embeddings_path(map_path: str | os.PathLike[str]) -> Path:
    """Return the path of a map's embeddings: NAME.embeddings.npz next to NAME.yaml."""
    return Path(map_path).with_suffix('.embeddings.npz')


def load_embeddings_of_map(map_path: str | os.PathLike[str], landmark_ids: Sequence[str],
                           map_set: MapSet = NO_SET) -> LandmarkEmbeddings | None:
    """Read the embeddings of a map's landmarks, in the map's order; None if there is no file.

    Landmarks that were removed from the map are dropped; added landmarks are unknown.

    Raises MapError if the file is invalid, belongs to another set, or has none of the landmarks.
    """
    path = embeddings_path(map_path)
    if not path.exists():
        return None
    embeddings = load_landmark_embeddings(path)
    try:
        check_set(embeddings.set_digest, map_set.digest)
    except ValueError as error:
        raise _SCHEMA.invalid(path, error) from error
    if not set(embeddings.landmark_ids) & set(landmark_ids):
        raise MapError(f'{path}: contains no landmark of {map_path}: it is of another map; '
                       'remove it')
    return embeddings.in_order(landmark_ids)


def load_landmark_embeddings(path: str | os.PathLike[str]) -> LandmarkEmbeddings:
    """Read and validate a file of landmark embeddings.

    Raises MapError if it is invalid; the message names the file, the array, the fault and what to
    do.
    """
    arrays = _SCHEMA.read(Path(path))
    return LandmarkEmbeddings(
        str(arrays['encoder_key']), tuple(map(str, arrays['landmark_ids'])),
        arrays['means'].astype(np.float16), arrays['medoids'].astype(np.float16),
        arrays['medoid_offsets'].astype(np.int64), str(arrays.get('set', '')))


def save_landmark_embeddings(path: str | os.PathLike[str], embeddings: LandmarkEmbeddings) -> None:
    """Write landmark embeddings atomically.

    Raises MapError if the embeddings are malformed or the file cannot be written.
    """
    _SCHEMA.write(Path(path), {
        'encoder_key': np.array(embeddings.encoder_key, dtype=np.str_),
        'landmark_ids': np.array(embeddings.landmark_ids, dtype=np.str_),
        'means': embeddings.means.astype(np.float16),
        'medoids': embeddings.medoids.astype(np.float16),
        'medoid_offsets': embeddings.medoid_offsets.astype(np.int64),
        'set': np.array(embeddings.set_digest)})


def with_images(labels: LabelEmbeddings, images: LandmarkEmbeddings, compare: str
                ) -> LabelEmbeddings:
    """Combine label and image embeddings into one row for each landmark, for use with crops.

    A landmark without images keeps its label. If crops are compared with images alone, its label's
    similarity is scaled and shifted to the range of image similarities.

    Parameters
    ----------
    labels : LabelEmbeddings
        Label embeddings of L landmarks.
    images : LandmarkEmbeddings
        Image embeddings of these landmarks, at least one of them known.
    compare : str
        'image' or 'both'.
    """
    known = np.flatnonzero(images.is_known)
    means = images.means.astype(np.float32)
    # standard deviation of a crop's similarities over the map, with labels and with images
    sample = known[::-(-len(known) // _CROPS_SAMPLED)]
    crops = means[sample]
    with_labels = (crops @ labels.unique[labels.of_landmarks[sample]].T).std(axis=1).mean()
    others = ~np.eye(len(sample), dtype=np.bool_)  # without each mean's similarity to itself
    with_means = (crops @ crops.T).std(axis=1, where=others).mean() if len(sample) > 1 else 0.0
    text_spread, image_spread = max(float(with_labels), 1e-6), max(float(with_means), 1e-6)
    rows = np.asarray(labels, dtype=np.float32)
    if compare == 'both':
        share = image_spread / (text_spread + image_spread)
        means[~images.is_known] = means[known].mean(axis=0)
        rows *= share
        means *= 1.0 - share
        rows += means
    else:
        rows -= rows.mean(axis=0)
        rows *= image_spread / text_spread
        rows += means[known].mean(axis=0)
        rows[known] = means[known]
    return LabelEmbeddings.of(rows)
