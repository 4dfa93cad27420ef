# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write a map as a ROS 2 parameter file, which LandmarkMap.from_file reads, and related files."""

import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    save_landmark_embeddings,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError
from cliploc_ros.files.storage import MAKE_ROOM, WriteOfSet, replace_file, replace_set

_INDENT = ' ' * 10


def write_map(path: str | os.PathLike[str], landmark_map: LandmarkMap,
              comments: Iterable[str] = (), embeddings: LandmarkEmbeddings | None = None,
              besides: Mapping[Path, WriteOfSet | None] | None = None) -> None:
    """Write a map file and the files next to it atomically, as one set.

    Comments are lines for the head of the file. Image embeddings are written next to the map.
    Without embeddings, those of a replaced map are removed, because they belong to the old map.
    `besides` are further files, see cliploc_ros.files.storage.replace_set.

    Raises
    ------
    MapError
        A file cannot be written.
    """
    path = Path(path)

    def write_embeddings(place: Path, digest: str) -> None:
        assert embeddings is not None
        save_landmark_embeddings(place, replace(embeddings, set_digest=digest))

    try:
        replace_set(path, set_digest(landmark_map), partial(
            write_landmarks, landmark_map=landmark_map, comments=comments), {
            embeddings_path(path): None if embeddings is None else write_embeddings,
            **(besides or {})})
    except OSError as error:
        raise MapError(f'{path}: cannot be written: {error.strerror}; nothing was changed; '
                       f'{MAKE_ROOM}') from error


def write_landmarks(path: Path, digest: str, landmark_map: LandmarkMap,
                    comments: Iterable[str] = ()) -> None:
    """Write a file of landmarks that belongs to a set; OSError: it cannot be written."""
    family = landmark_map.map_set.family or digest
    with replace_file(path) as unfinished, unfinished.open('w', encoding='utf-8') as file:
        file.writelines(f'# {" ".join(line.split())}\n' for line in comments)
        file.write(f'# set {family} {digest}\n')
        file.writelines(f'{line}\n' for line in _lines(landmark_map))


def removed_path(map_path: Path) -> Path:
    """Return the path of the file with the landmarks that updates removed from a map."""
    return map_path.with_suffix('.removed.yaml')


def load_removed(map_path: Path, family: str) -> LandmarkMap | None:
    """Read the landmarks that updates removed from a map; None if none, or of another family."""
    path = removed_path(map_path)
    found = LandmarkMap.from_file(path) if path.exists() else None
    return found if found is not None and found.map_set.family == family else None


def set_digest(landmark_map: LandmarkMap) -> str:
    """Return the digest that identifies a map and the files written with it.

    Maps of keyframes alone have no landmarks to tell them apart: they get a random digest.
    """
    if not len(landmark_map):
        return secrets.token_hex(6)
    digest = hashlib.sha256()
    for line in _lines(landmark_map):
        digest.update(line.encode())
    return digest.hexdigest()[:12]


def _lines(landmark_map: LandmarkMap) -> Iterator[str]:
    yield '/**:'
    yield '  ros__parameters:'
    yield '    map:'
    yield f'      frame_id: {quoted(landmark_map.frame_id)}'
    yield from [f'      nav2_map: {quoted(landmark_map.nav2_map)}'] * bool(landmark_map.nav2_map)
    yield f'      landmarks:{"" if len(landmark_map) else " {}"}'
    for row, landmark_id in enumerate(landmark_map.landmark_ids):
        yield f'        {quoted(landmark_id)}:'
        yield f'{_INDENT}label: {quoted(landmark_map.labels[row])}'
        yield f'{_INDENT}class_id: {quoted(landmark_map.class_ids[row])}'
        yield f'{_INDENT}center: {_floats(landmark_map.centers[row])}'
        yield f'{_INDENT}semi_axes: {_floats(landmark_map.semi_axes[row])}'
        yield f'{_INDENT}orientation: {_floats(landmark_map.quats_xyzw[row])}'
        if landmark_map.details:
            yield from _detail_lines(landmark_map.details[row])
    for number, tag in enumerate(landmark_map.tags):
        yield from [*['      tags:'] * (number == 0), f'        {quoted(tag.tag_id)}:',
                    f'{_INDENT}family: {quoted(tag.family)}', f'{_INDENT}id: {tag.number}',
                    f'{_INDENT}size: {tag.size:.5f}', f'{_INDENT}center: {_floats(tag.center)}',
                    f'{_INDENT}orientation: {_floats(tag.quat_xyzw)}']


def _detail_lines(details: LandmarkDetails) -> Iterator[str]:
    if details.labels is not None:
        yield f'{_INDENT}labels:'
        yield f'{_INDENT}  text: [{", ".join(quoted(text) for text, _ in details.labels)}]'
        yield f'{_INDENT}  weight: {_floats(_weight(weight) for _, weight in details.labels)}'
    if details.class_weights is not None:
        yield f'{_INDENT}class_weights:'
        for name, weight in details.class_weights:
            yield f'{_INDENT}  {quoted(name)}: {_weight(weight):.4f}'
    for name, digits in (('support', 0), ('position_sigma', 4), ('shared_sigma', 4),
                         ('shared_sigma_deg', 3), ('seen_ratio', 3), ('baseline_deg', 1),
                         ('last_seen', 3)):
        if (value := getattr(details, name)) is not None:
            yield f'{_INDENT}{name}: {value:.{digits}f}'
    if details.source is not None:
        yield f'{_INDENT}source: {quoted(details.source)}'


def _weight(weight: float) -> float:
    """Return a weight that is not rounded to 0 when written: the reader refuses 0."""
    return max(weight, 1e-4)


def quoted(text: str) -> str:
    """Quote text as YAML: as a JSON string, except for characters beyond 16 bits such as emoji."""
    if max(text, default='') <= '\uffff':
        return json.dumps(text)
    return '"' + ''.join(f'\\U{ord(character):08x}' if character > '\uffff'
                         else json.dumps(character)[1:-1] for character in text) + '"'


def _floats(values: Iterable[float] | NDArray[np.float64]) -> str:
    """Return numbers as YAML that ROS reads as floats, even integers."""
    return f'[{", ".join(f"{value:.5f}" for value in values)}]'
