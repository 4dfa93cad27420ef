# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an image encoder saw of each landmark: ``NAME.embeddings.npz`` next to ``NAME.yaml``."""

import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import MapError
from cliploc_ros.replace_file import replace_file

#: The most medoids of one landmark.
MOST_MEDOIDS = 5
# Arrays of the file: shape in terms of L landmarks, m medoids and d numbers; kinds of dtype.
_LAYOUT = {
    'encoder_key': ((), 'U'),
    'landmark_ids': (('L',), 'U'),
    'means': (('L', 'd'), 'f'),
    'medoids': (('m', 'd'), 'f'),
    'medoid_offsets': (('L+1',), 'iu'),
}
_KIND_NAMES = {'U': 'text', 'f': 'floats', 'iu': 'integers'}
# float16 rounds each number by up to 5e-4 of it.
_MAX_NORM_ERROR = 5e-3


@dataclass(frozen=True)
class LandmarkEmbeddings:
    """Image embeddings of L landmarks: d numbers each."""

    #: Identifies the encoder: crops of another one must not be compared with these
    encoder_key: str
    landmark_ids: tuple[str, ...]  #: The landmarks, each once
    #: (L, d): the mean direction of each landmark's crops, unit rows; a zero row is unknown
    means: NDArray[np.float16]
    #: (m, d): crops that stand for all crops of their landmark, unit rows
    medoids: NDArray[np.float16]
    #: (L + 1,): landmark l has the medoids from medoid_offsets[l] up to medoid_offsets[l + 1], at
    #: most five
    medoid_offsets: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.landmark_ids)

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Return whether each landmark (L,) has an embedding."""
        return np.asarray(self.means.any(axis=1))

    def in_order(self, landmark_ids: Sequence[str]) -> 'LandmarkEmbeddings':
        """Return the embeddings of some landmarks in the order given; missing ones are unknown."""
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
    """Return the embeddings of several maps, of one encoder and in their order, as one."""
    counts = np.concatenate([np.diff(one.medoid_offsets) for one in several])
    return LandmarkEmbeddings(
        several[0].encoder_key, tuple(landmark_ids),
        np.concatenate([one.means for one in several]),
        np.concatenate([one.medoids for one in several]), np.append(0, np.cumsum(counts)))


def embeddings_path(map_path: str | os.PathLike[str]) -> Path:
    """Return the file of a map's embeddings: NAME.embeddings.npz next to NAME.yaml."""
    return Path(map_path).with_suffix('.embeddings.npz')


def load_embeddings_of_map(map_path: str | os.PathLike[str], landmark_ids: Sequence[str]
                           ) -> LandmarkEmbeddings | None:
    """Return the embeddings of a map's landmarks, in its order; None where it has no such file.

    Landmarks that were removed from the map are left out, and added ones are unknown.

    Raises
    ------
    MapError
        The file is invalid, or it has none of these landmarks.
    """
    path = embeddings_path(map_path)
    if not path.exists():
        return None
    embeddings = load_landmark_embeddings(path)
    if not set(embeddings.landmark_ids) & set(landmark_ids):
        raise MapError(f'{path}: holds no landmark of {map_path}: it is of another map; remove it')
    return embeddings.in_order(landmark_ids)


def load_landmark_embeddings(path: str | os.PathLike[str]) -> LandmarkEmbeddings:
    """Read and validate a file of landmark embeddings.

    Raises
    ------
    MapError
        Names the file, the array, what is wrong with it, and what to do.
    """
    path = Path(path)
    try:
        arrays = _read_arrays(path)
        _check_layout(arrays)
        _check_values(arrays)
    except _ArrayError as error:
        raise MapError(f'{path}: {error}; build the map again, or remove the file') from error
    return LandmarkEmbeddings(
        str(arrays['encoder_key']), tuple(map(str, arrays['landmark_ids'])),
        arrays['means'].astype(np.float16), arrays['medoids'].astype(np.float16),
        arrays['medoid_offsets'].astype(np.int64))


def save_landmark_embeddings(path: str | os.PathLike[str], embeddings: LandmarkEmbeddings
                             ) -> None:
    """Write landmark embeddings in one step: an existing file is replaced complete, or stays.

    Raises
    ------
    MapError
        The embeddings are malformed, or the file cannot be written.
    """
    path = Path(path)
    arrays = {
        'encoder_key': np.array(embeddings.encoder_key, dtype=np.str_),
        'landmark_ids': np.array(embeddings.landmark_ids, dtype=np.str_),
        'means': embeddings.means.astype(np.float16),
        'medoids': embeddings.medoids.astype(np.float16),
        'medoid_offsets': embeddings.medoid_offsets.astype(np.int64),
    }
    try:
        _check_layout(arrays)
        _check_values(arrays)
        with replace_file(path) as partial, partial.open('wb') as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
    except _ArrayError as error:
        raise MapError(f'{path}: cannot be written: {error}') from error
    except OSError as error:
        raise MapError(f'{path}: cannot be written: {error.strerror}; nothing was changed'
                       ) from error


class _ArrayError(Exception):
    """What is wrong with an array; the caller adds the file's name."""


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    if not path.is_file():
        raise _ArrayError('no such file')
    try:
        content = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _ArrayError('is no complete npz file') from error
    if not isinstance(content, np.lib.npyio.NpzFile):
        raise _ArrayError('is a single array, not an npz file of named arrays')
    with content:
        return {name: _read_array(content, name) for name in _LAYOUT}


def _read_array(content: Any, name: str) -> NDArray[Any]:
    if name not in content.files:
        raise _ArrayError(f'array {name} is missing')
    try:
        return np.asarray(content[name])
    except Exception as error:  # whatever numpy and zipfile meet in a broken file
        raise _ArrayError(f'array {name} cannot be read: {error}') from error


def _check_layout(arrays: dict[str, NDArray[Any]]) -> None:
    for name in ('landmark_ids', 'means', 'medoids'):
        if arrays[name].ndim == 0:
            raise _ArrayError(f'array {name} is a single value')
    count = len(arrays['landmark_ids'])
    sizes: dict[object, int] = {'L': count, 'L+1': count + 1, 'm': len(arrays['medoids']),
                                'd': arrays['means'].shape[-1]}
    for name, (letters, kinds) in _LAYOUT.items():
        array, shape = arrays[name], tuple(sizes[letter] for letter in letters)
        if array.shape != shape:
            raise _ArrayError(f'array {name} has shape {array.shape}, expected {shape}')
        if array.dtype.kind not in kinds:
            raise _ArrayError(f'array {name} has type {array.dtype}, expected '
                              f'{_KIND_NAMES[kinds]}')


def _check_values(arrays: dict[str, NDArray[Any]]) -> None:
    if not str(arrays['encoder_key']):
        raise _ArrayError('array encoder_key is empty: it names no encoder')
    ids = arrays['landmark_ids']
    _, first_places = np.unique(ids, return_index=True)
    _refuse('landmark_ids', 'repeats an id', ~np.isin(np.arange(len(ids)), first_places))
    for name in ('means', 'medoids'):
        lengths = np.linalg.norm(arrays[name].astype(np.float32), axis=1)
        allowed = np.abs(lengths - 1.0) <= _MAX_NORM_ERROR  # false for NaN
        if name == 'means':
            allowed |= lengths == 0.0
        _refuse(name, 'is not of unit length', ~allowed)
    offsets = arrays['medoid_offsets'].astype(np.int64)
    if offsets[0] != 0 or offsets[-1] != len(arrays['medoids']):
        raise _ArrayError(f'array medoid_offsets goes from {offsets[0]} to {offsets[-1]}, '
                          f"expected 0 to {len(arrays['medoids'])}, the number of medoids")
    counts = np.diff(offsets)
    _refuse('medoid_offsets', f'gives a landmark less than 0 or more than {MOST_MEDOIDS} medoids',
            (counts < 0) | (counts > MOST_MEDOIDS))


def _refuse(name: str, what: str, is_wrong: NDArray[np.bool_]) -> None:
    if is_wrong.any():
        raise _ArrayError(f'array {name} {what} in row {int(np.argmax(is_wrong))}')
