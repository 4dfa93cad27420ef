# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an image encoder saw of each landmark, kept in step with the map while it is edited.

A landmark carries its look. So a look follows its landmark through merge, split, delete, undo and
redo, and saving writes the looks of the landmarks that are there.
"""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    load_landmark_embeddings,
    save_landmark_embeddings,
)
from cliploc_ros.errors import MapError
from cliploc_ros.mapping.labelling import choose_medoids, embed_landmarks
from cliploc_ros.mapping.posed_detections import PosedDetections


@dataclass(frozen=True, eq=False)
class Look:
    """What an image encoder saw of one landmark.

    Parameters
    ----------
    mean : ndarray (d,) float16
        The mean direction of its crops, of unit length.
    medoids : ndarray (m, d) float16
        Crops that stand for all of its crops, unit rows; at most five.
    encoder_key : str
        Of the encoder.
    """

    mean: NDArray[np.float16]
    medoids: NDArray[np.float16]
    encoder_key: str

    @cached_property
    def key(self) -> str:
        """Return what tells one look from another."""
        content = self.encoder_key.encode() + self.mean.tobytes() + self.medoids.tobytes()
        return hashlib.sha256(content).hexdigest()[:24]

    def to_json(self) -> dict[str, Any]:
        """Return the look as JSON holds it."""
        return {'look': self.key, 'encoder': self.encoder_key,
                'mean': base64.b64encode(self.mean.tobytes()).decode(),
                'medoids': base64.b64encode(self.medoids.tobytes()).decode()}


def look_from_json(tree: Mapping[str, Any]) -> Look | None:
    """Return a look from JSON; None where it is damaged."""
    try:
        mean, medoids = (np.frombuffer(base64.b64decode(tree[name], validate=True), np.float16)
                         for name in ('mean', 'medoids'))
        look = Look(mean, medoids.reshape(-1, len(mean)), str(tree['encoder']))
    except (KeyError, TypeError, ValueError):
        return None
    return look if look.key == tree.get('look') else None


def merge_looks(looks: Sequence[Look | None], weights: Sequence[float]) -> Look | None:
    """Return the look of one landmark that several become; None where no look is known.

    Looks of another encoder than the first one's do not count.

    Parameters
    ----------
    looks : sequence of Look
    weights : sequence of float
        Of each landmark, as the number of its boxes.
    """
    known = [(look, weight) for look, weight in zip(looks, weights, strict=True)
             if look is not None]
    known = [(look, weight) for look, weight in known
             if (look.encoder_key, len(look.mean)) == (known[0][0].encoder_key,
                                                       len(known[0][0].mean))]
    if len(known) < 2:
        return known[0][0] if known else None
    mean = np.sum([weight * look.mean.astype(np.float32) for look, weight in known], axis=0)
    length = float(np.linalg.norm(mean))
    if not length > 0.0:
        return None
    crops = np.concatenate([look.medoids for look, _ in known]).astype(np.float32)
    shares = np.concatenate([np.full(len(look.medoids), weight / max(1, len(look.medoids)))
                             for look, weight in known])
    return Look((mean / length).astype(np.float16),
                crops[choose_medoids(crops, shares)].astype(np.float16), known[0][0].encoder_key)


def look_of_boxes(detections: PosedDetections, rows: NDArray[np.int64]) -> Look | None:
    """Return the look of what some boxes of a recording show; None without embeddings."""
    if detections.embeddings is None or not len(rows):
        return None
    shown = np.full(len(detections.classes), -1, dtype=np.int64)
    shown[rows] = 0
    return _looks_of(embed_landmarks([''], detections, shown)).get('')


def _looks_of(embeddings: LandmarkEmbeddings) -> dict[str, Look]:
    offsets = embeddings.medoid_offsets
    return {landmark_id: Look(embeddings.means[row],
                              embeddings.medoids[offsets[row]:offsets[row + 1]],
                              embeddings.encoder_key)
            for row, landmark_id in enumerate(embeddings.landmark_ids)
            if embeddings.is_known[row]}


class LookFile(NamedTuple):
    """The file of image embeddings next to a map.

    Parameters
    ----------
    path : Path
    encoder_key : str
        Of the encoder that made the looks; '' where the file is missing or cannot be used.
    looks : dict of str to Look
        By id of the landmark.
    state : tuple of int or None
        Tells whether another program changed the file since; None where there is none.
    """

    path: Path
    encoder_key: str
    looks: Mapping[str, Look]
    state: tuple[int, int] | None

    def write(self, looks: Mapping[str, Look | None]) -> tuple['LookFile', str]:
        """Write the looks of all landmarks of the map in one step.

        Those of another encoder are left out. Nothing is written where nothing changed, and
        nothing over what another program wrote.

        Returns
        -------
        LookFile
            As it is then.
        str
            Why it does not hold these looks; '' if it does.

        Raises
        ------
        MapError
            The file cannot be written; it is as it was.
        """
        own = [look for look in (*self.looks.values(), *looks.values())
               if look is not None and look.encoder_key == self.encoder_key]
        size = len(own[0].mean) if own else 0
        known = {key: look for key, look in looks.items() if look is not None
                 and (look.encoder_key, len(look.mean)) == (self.encoder_key, size)}
        if not self.encoder_key or self.is_of(known):
            return self, ''
        if _state_of(self.path) != self.state:
            return self, (f'{self.path.name}: another program changed this file, so the studio '
                          'leaves it as it is; build the map again, or remove the file')
        nothing = Look(np.zeros(size, np.float16), np.empty((0, size), np.float16), '')
        rows = [known.get(key, nothing) for key in looks]
        save_landmark_embeddings(self.path, LandmarkEmbeddings(
            self.encoder_key, tuple(looks), np.array([one.mean for one in rows]),
            np.concatenate([one.medoids for one in rows]),
            np.cumsum([0, *(len(one.medoids) for one in rows)])))
        return self._replace(looks=known, state=_state_of(self.path)), ''

    def is_of(self, known: Mapping[str, Look]) -> bool:
        """Return whether the file holds exactly these looks."""
        return ({key: look.key for key, look in known.items()}
                == {key: look.key for key, look in self.looks.items()})


def read_look_file(map_path: Path) -> tuple[LookFile, str]:
    """Return the image embeddings next to a map, and what is wrong with them, or ''."""
    path = embeddings_path(map_path)
    state = _state_of(path)
    if state is None:
        return LookFile(path, '', {}, None), ''
    try:
        embeddings = load_landmark_embeddings(path)
    except MapError as error:
        return LookFile(path, '', {}, state), f'{error}. The studio leaves this file as it is'
    return LookFile(path, embeddings.encoder_key, _looks_of(embeddings), state), ''


def _state_of(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
