# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map tags from images with poses: a joint adjustment of tags, their unknown sizes, and poses."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.tag_pose import Sight, flips, sights_of
from cliploc_ros.core.geometry.transforms import invert_transform, quaternion_from_transform
from cliploc_ros.core.map.tags import SQUARE, Tag, check_family, check_size
from cliploc_ros.core.observation import Observation
from cliploc_ros.errors import MapError, OptionsError, counted

# Deviations of the poses [m] [rad] and of a corner [px]; scale of the robust loss, in deviations.
_POSE, _CORNER_PX, _LOSS = np.repeat([0.02, np.radians(0.5)], 3), 0.5, 3.0
# A sighting is an outlier if its corners are off by more pixels and metres at the tag.
_MOST_PX, _MOST_M = 4.0, 0.03
# Least sightings of a tag, least distance between two of them [m], and most sightings of each tag.
_LEAST, _APART_M, _MOST = 3, 0.1, 60
# Outliers that show a second tag, moved or copied: their number, and their share of all.
_ELSEWHERE, _SHARE = 3, 0.1


class Seen(NamedTuple):
    """A tag in an image of a recording."""

    frame: int
    sight: Sight
    map_from_camera: NDArray[np.float64]  #: (4, 4)


class MappedTags(NamedTuple):
    """The tags of a recording."""

    tags: tuple[Tag, ...]
    off_m: tuple[float, ...]  #: Median distance of the corners of each in the images [m]
    left_out: tuple[str, ...]  #: The other tags that were seen, with reasons

    def line(self) -> str:
        """Return what was mapped and left out, in one line."""
        found = f', corners within {100 * np.median(self.off_m):.1f} cm (median), ' \
                f'{100 * max(self.off_m):.1f} cm (worst tag)' if self.tags else ''
        return '; left out: '.join([counted(len(self.tags), 'tag') + found, *self.left_out])


def parse_sizes(texts: Iterable[str]) -> dict[str, float | None]:
    """Return the size of the tags of each family [m], given as FAMILY or FAMILY:SIZE.

    OptionsError: it is something else.
    """
    sizes: dict[str, float | None] = {}
    for text in texts:
        family, _, size = text.partition(':')
        try:
            check_family(family, '--tags')
            sizes[family] = float(size) if size else None
            check_size(sizes[family] or 1.0, '--tags')
        except (MapError, ValueError) as error:
            raise OptionsError(f'--tags {text}: expected FAMILY:METRES as tag36h11:0.16, or a '
                               f'family of unknown size: {error}') from error
    return sizes


def seen_tags(frames: Iterable[tuple[Observation, NDArray[np.float64]]]) -> dict[str, list[Seen]]:
    """Return the sightings of each tag in frames with tags and poses, map_from_camera (4, 4)."""
    seen: dict[str, list[Seen]] = {}
    for number, (frame, pose) in enumerate(frames):
        for name in frame.tags.names if frame.tags else ():
            family, _, tag = name.rpartition('_')
            one = Tag(name, family, int(tag), 1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            seen.setdefault(name, []).extend(
                Seen(number, sight, pose) for sight in sights_of([one], frame))
    return seen


def map_tags(seen: Mapping[str, Sequence[Seen]], sizes: Mapping[str, float | None]) -> MappedTags:
    """Map tags from their sightings, see seen_tags, with the sizes of families, see parse_sizes.

    Poses with errors of centimetres are adjusted together with the tags.
    """
    tags, kept, left_out = list[Tag](), list[list[Seen]](), list[str]()
    for name, every in sorted(seen.items()):
        chosen = [every[row] for row in np.unique(np.linspace(
            0, len(every) - 1, min(len(every), _MOST)).astype(np.int64))]
        places = np.array([one.map_from_camera[:3, 3] for one in chosen])
        if len(chosen) < _LEAST or np.linalg.norm(np.ptp(places, axis=0)) < _APART_M:
            left_out.append(f'{name}: {counted(len(chosen), "image")} from one place')
            continue
        tag, inside = _start(chosen, sizes[chosen[0].sight.tag.family])
        if len(outside := np.nonzero(~inside)[0]) >= max(_ELSEWHERE, _SHARE * len(chosen)):
            other, agree = _start([chosen[row] for row in outside], tag.size)
            if agree.sum() >= max(_ELSEWHERE, _SHARE * len(chosen)):
                apart = float(np.linalg.norm(np.subtract(other.center, tag.center)))
                left_out.append(f'{name} is seen at two places {apart:.2f} m apart, moved or '
                                'copied')
                continue
        if inside.sum() < _LEAST:
            left_out.append(f'{name}: {counted(len(chosen), "image")} that disagree')
            continue
        tags.append(tag)
        kept.append([chosen[row] for row in np.nonzero(inside)[0]])
    if tags:
        tags = _adjusted(tags, kept, sizes)
    off_m = tuple(float(np.median(_off(tag, own)[0] * [
        tag.size / one.sight.side_px for one in own])) for tag, own in zip(tags, kept, strict=True))
    return MappedTags(tuple(tags), off_m, tuple(left_out))


def _start(seen: Sequence[Seen], size: float | None) -> tuple[Tag, NDArray[np.bool_]]:
    """Return the pose of a tag that most sightings agree with, and which do."""
    rays = [(one, one.map_from_camera @ flip)
            for one in seen for flip in flips(one.sight)]
    if size is None:  # the unit flips give directions, and distances in units of the size
        left = np.concatenate([np.hstack([np.eye(3), -(
            pose[:3, 3] - one.map_from_camera[:3, 3])[:, None]]) for one, pose in rays])
        right = np.concatenate([one.map_from_camera[:3, 3] for one, _ in rays])
        size = float(least_squares(lambda x: left @ x - right, np.r_[right[:3], 0.1],
                                   loss='cauchy', f_scale=0.05).x[3])
    best = (seen[0].sight.tag, np.zeros(len(seen), dtype=np.bool_))
    for one, pose in rays:
        place = one.map_from_camera[:3, 3] + size * (pose[:3, 3] - one.map_from_camera[:3, 3])
        tag = replace(one.sight.tag, size=size, center=tuple(place),
                      quat_xyzw=tuple(quaternion_from_transform(pose)))
        inside = np.less(*_off(tag, seen))
        best = max(best, (tag, inside), key=lambda pair: int(pair[1].sum()))
    return best


def _off(tag: Tag, seen: Sequence[Seen]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far the corners of a tag are off in each sighting (s,), and the limit [px]."""
    poses = np.linalg.inv([one.map_from_camera for one in seen])
    inside = tag.corners @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    errors = inside[..., :2] / np.maximum(inside[..., 2:], 1e-3) - [
        one.sight.bearings for one in seen]
    sides = np.array([one.sight.side_px for one in seen])
    return (np.array([one.sight.scale for one in seen]) * np.sqrt(
        (errors ** 2).sum(axis=2).mean(axis=1)), _MOST_PX + _MOST_M / tag.size * sides)


def _adjusted(tags: Sequence[Tag], kept: Sequence[Sequence[Seen]],
              sizes: Mapping[str, float | None]) -> list[Tag]:
    """Return the tags after a robust least squares fit of tags and poses to all corners."""
    every = [(row, one) for row, own in enumerate(kept) for one in own]
    numbers, frames = np.unique([one.frame for _, one in every], return_inverse=True)
    owner, count = np.array([row for row, _ in every]), 6 * len(numbers)
    given = np.array([invert_transform(one.map_from_camera) for _, one in every])
    starts, free = np.array([tag.map_from_tag for tag in tags]), np.array(
        [sizes[tag.family] is None for tag in tags])
    bearings = np.array([one.sight.bearings for _, one in every])
    weights = np.array([one.sight.scale / _CORNER_PX for _, one in every])[:, None, None]

    def placed(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        steps = x[count:].reshape(-1, 7)
        poses = starts.copy()
        poses[:, :3, :3] = starts[:, :3, :3] @ Rotation.from_rotvec(steps[:, 3:6]).as_matrix()
        poses[:, :3, 3] += steps[:, :3]
        return poses, np.array([tag.size for tag in tags]) * np.exp(free * steps[:, 6])

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        poses, lengths = placed(x)
        points = (lengths[:, None, None] * SQUARE) @ poses[:, :3, :3].transpose(0, 2, 1) \
            + poses[:, None, :3, 3]
        steps = x[:count].reshape(-1, 6)[frames]
        inside = points[owner] @ given[:, :3, :3].transpose(0, 2, 1) + given[:, None, :3, 3]
        inside = inside @ Rotation.from_rotvec(steps[:, 3:]).as_matrix().transpose(0, 2, 1) \
            + steps[:, None, :3]
        off = weights * (inside[..., :2] / np.maximum(inside[..., 2:], 1e-3) - bearings)
        return np.concatenate([off.ravel(), x[:count] / np.tile(_POSE, len(numbers))])
    pattern = lil_matrix((8 * len(every) + count, count + 7 * len(tags)), dtype=np.int8)
    for row, (frame, tag) in enumerate(zip(frames.ravel().tolist(), owner.tolist(), strict=True)):
        pattern[8 * row:8 * row + 8, 6 * frame:6 * frame + 6] = 1
        pattern[8 * row:8 * row + 8, count + 7 * tag:count + 7 * tag + 7] = 1
    for row in range(count):
        pattern[8 * len(every) + row, row] = 1
    found = least_squares(residuals, np.zeros(count + 7 * len(tags)), jac_sparsity=pattern,
                          loss='cauchy', f_scale=_LOSS, x_scale='jac')
    poses, lengths = placed(found.x)
    return [replace(tag, size=float(length), center=tuple(pose[:3, 3]),
                    quat_xyzw=tuple(quaternion_from_transform(pose)))
            for tag, pose, length in zip(tags, poses, lengths, strict=True)]
