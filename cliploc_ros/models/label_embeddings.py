# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cache of label embeddings, so that CLIP starts without its text tower."""

import contextlib
import hashlib
import json
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from cliploc_ros.core.map.landmark_details import WeightedLabels
from cliploc_ros.errors import ModelError
from cliploc_ros.files.arrays import Check, Field, Schema
from cliploc_ros.files.storage import replace_file, warn_not_kept
from cliploc_ros.models.files import remove_unused

_FORMAT = 1
# A map of 1,000 labels takes 3 MB with ViT-L-14.
_MOST_FILES = 32

logger = logging.getLogger(__name__)
#: Greatest number of labels encoded, cached and held at once: 134 MB with 512 numbers each.
PART = 65_536
# L labels, d numbers, t bytes that identify labels and encoder.
_SCHEMA = Schema('file of label embeddings', {
    'identity': Field('uint8', ('t',)),
    'embeddings': Field('float32', ('L', 'd'), (Check('is not of unit length', lambda rows: ~(
        np.abs(np.einsum('ij,ij->i', rows, rows) - 1.0) <= 2e-3)),)),
}, ModelError)


class LabelCache:
    """A folder of label embeddings, one ``.npz`` for each model and set of labels.

    The name of a file is the hash of the encoder's key (model, activation, fingerprint of the
    weights) and of the labels. The file also contains both, to detect foreign and damaged files. A
    file holds a whole set of labels, not a single label, so that embeddings never depend on
    earlier batches; a changed map costs one slow start. Files are written under another name and
    renamed, so that any number of processes can share the folder. Reading a file marks it as used.
    Beyond ``most_files``, the least recently used files are removed. The first write makes the
    folder.
    """

    def __init__(self, folder: Path, most_files: int = _MOST_FILES) -> None:
        self._folder = folder
        self._most_files = most_files

    def load(self, key: str, labels: Sequence[str], embed_dim: int) -> NDArray[np.float32] | None:
        """Return the embeddings (L, embed_dim) of L labels; None if they are not in the cache."""
        file = self._file(key, labels)
        if not file.exists():
            return None
        try:
            arrays = _SCHEMA.read(file)
        except ModelError as error:
            return self._ignore(file, error)
        embeddings = arrays['embeddings']
        if bytes(arrays['identity']) != _identity(key, labels):
            return self._ignore(file, 'it is for other weights or labels')
        if embeddings.shape != (len(labels), embed_dim):
            return self._ignore(file, 'its embeddings are not of the expected shape')
        with contextlib.suppress(OSError):  # a read-only cache works too
            os.utime(file)
        return embeddings

    def store(self, key: str, labels: Sequence[str], embeddings: NDArray[np.float32]) -> None:
        """Write the embeddings of labels; a failure causes only a warning."""
        file = self._file(key, labels)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            remove_unused(self._folder.glob('labels-*.npz'),
                          self._folder.glob('.*.labels-*.npz'), self._most_files - 1)
            with replace_file(file) as partial:
                np.savez(partial, embeddings=embeddings,
                         identity=np.frombuffer(_identity(key, labels), dtype=np.uint8))
        except OSError as error:
            warn_not_kept('label embeddings are not cached and the next start is slow again: '
                          f'cannot write {file} ({error.strerror or error}); make room, or '
                          'choose a writable cache_dir')

    def _file(self, key: str, labels: Sequence[str]) -> Path:
        digest = hashlib.sha256(_identity(key, labels)).hexdigest()
        return self._folder / f'labels-{digest[:32]}.npz'

    @staticmethod
    def _ignore(file: Path, reason: object) -> None:
        logger.warning('label embeddings in %s cannot be used (%s): encoding the labels again',
                       file, reason)


def _identity(key: str, labels: Sequence[str]) -> bytes:
    return json.dumps([_FORMAT, key, list(labels)]).encode()


def mixed_rows(descriptions: Sequence[WeightedLabels],
               encode: Callable[[Sequence[str]], NDArray[np.float32]], embed_dim: int
               ) -> NDArray[np.float32]:
    """Return the embeddings (R, embed_dim) of R descriptions.

    The embedding of a description is the weighted mean of the embeddings of its labels, scaled to
    unit length. That of a single label is unchanged. ``encode`` returns the embeddings (m,
    embed_dim) of m labels, as unit rows. It is called with sorted labels, at most PART at once.
    """
    labels = sorted({label for description in descriptions for label, _ in description})
    # the share of each label in each description, a sparse matrix (R, U)
    columns = {label: column for column, label in enumerate(labels)}
    ends = np.cumsum([0, *map(len, descriptions)])
    shares = np.array([weight for description in descriptions for _, weight in description],
                      dtype=np.float32)
    owners = np.repeat(np.arange(len(descriptions)), np.diff(ends))
    shares /= np.bincount(owners, shares, len(descriptions)).astype(np.float32)[owners]
    weights = csr_matrix(
        (shares, [columns[label] for description in descriptions for label, _ in description],
         ends), shape=(len(descriptions), len(labels)))
    rows = np.zeros((len(descriptions), embed_dim), dtype=np.float32)
    for start in range(0, len(labels), PART):
        part = slice(start, start + PART)
        rows += weights[:, part] @ encode(labels[part])
    lengths = np.maximum(np.sqrt(np.einsum('ij,ij->i', rows, rows)), 1e-12)
    rows /= np.where(np.diff(weights.indptr) > 1, lengths, 1.0)[:, None]
    return rows
