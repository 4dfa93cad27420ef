# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map tags from images with poses: a joint adjustment of tags, their unknown sizes, and poses."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.tag_pose import TagSight, flips, sights_of
from cliploc_ros.core.geometry.transforms import invert_transform, quaternion_from_transform
from cliploc_ros.core.map.tags import SQUARE, Tag, read_tags
from cliploc_ros.core.observation import Observation
from cliploc_ros.errors import MapError, OptionsError, counted

# Deviations of the poses [m] [rad] and of a corner [px]; scale of the robust loss, in deviations.
_POSE, _CORNER_PX, _LOSS, _STEPS = np.repeat([0.02, np.radians(0.5)], 3), 0.5, 8.0, 12
# A sighting is an outlier if its corners are off by more pixels, radians, and metres at the tag.
_MOST_PX, _MOST_RAD, _MOST_M = 4.0, 0.02, 0.06
# Least sightings of a tag, least distance between two of them [m], and most sightings of each tag.
_LEAST, _APART_M, _MOST = 3, 0.1, 60
# Outliers that show a second tag, moved or copied: number, share of all, and distance [m].
_ELSEWHERE, _SHARE, _FAR_M = 3, 0.1, 0.2


class Seen(NamedTuple):
    """A tag in an image of a recording."""

    frame: int
    sight: TagSight
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
            sizes[family] = float(size) if size else None
            read_tags({'one': {
                'family': family, 'id': 0, 'size': float(size or 1.0), 'center': [0.0, 0.0, 0.0],
                'orientation': [0.0, 0.0, 0.0, 1.0]}}, '--tags')
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
            apart = float(np.linalg.norm(np.subtract(other.center, tag.center)))
            if agree.sum() >= max(_ELSEWHERE, _SHARE * len(chosen)) and apart > _FAR_M:
                left_out.append(f'{name} is seen at two places {apart:.2f} m apart, moved or '
                                'copied')
                continue
        if inside.sum() < _LEAST:
            left_out.append(f'{name}: {counted(len(chosen), "image")} that disagree')
            continue
        tags.append(tag)
        kept.append([chosen[row] for row in np.nonzero(inside)[0]])
    return MappedTags(*(_adjusted(tags, kept, sizes) if tags else ((), ())), tuple(left_out))


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
        (errors ** 2).sum(axis=2).mean(axis=1)), _MOST_PX + _MOST_M / tag.size * sides
        + _MOST_RAD * np.array([one.sight.scale for one in seen]))


def _adjusted(tags: Sequence[Tag], kept: Sequence[Sequence[Seen]],
              sizes: Mapping[str, float | None]) -> tuple[tuple[Tag, ...], tuple[float, ...]]:
    """Return the tags after robust Gauss-Newton steps of tags and poses on all corners.

    Also return how far the corners of each are off in the images (median) [m].
    """
    every = [(row, one) for row, own in enumerate(kept) for one in own]
    numbers, frames = np.unique([one.frame for _, one in every], return_inverse=True)
    owner, count = np.array([row for row, _ in every]), 6 * len(numbers)
    poses = np.array([invert_transform(next(
        one.map_from_camera for _, one in every if one.frame == number)) for number in numbers])
    places, lengths = np.array([tag.map_from_tag for tag in tags]), np.array(
        [tag.size for tag in tags])
    free = np.array([sizes[tag.family] is None for tag in tags])
    bearings = np.array([one.sight.bearings for _, one in every])
    pixels = np.array([one.sight.scale for _, one in every])[:, None, None]
    moved = np.zeros((len(numbers), 6))
    for _ in range(_STEPS):
        corners = lengths[owner, None, None] * SQUARE
        points = corners @ places[owner, :3, :3].transpose(0, 2, 1) + places[owner, None, :3, 3]
        views = poses[frames]
        inside = points @ views[:, :3, :3].transpose(0, 2, 1) + views[:, None, :3, 3]
        flat = inside[..., :2] / inside[..., 2:]
        off = pixels * (flat - bearings)
        weights = 1.0 / (_CORNER_PX ** 2 + (off ** 2).sum(axis=(1, 2)) / _LOSS)
        # derivatives of the pixels by a point in the camera, and of this by all steps
        lens = np.zeros((*flat.shape, 3))
        lens[..., [0, 1], [0, 1]], lens[..., 2] = 1.0, -flat
        lens *= (pixels / inside[..., 2:])[..., None]
        axes = np.broadcast_to((views[:, :3, :3] @ places[owner, :3, :3])[:, None],
                               (*flat.shape[:2], 3, 3))
        steps = np.concatenate([
            np.broadcast_to(np.eye(3), axes.shape), -_crossed(inside), axes,
            -axes @ _crossed(corners), axes @ corners[..., None]
            * free[owner, None, None, None]], axis=3)
        jacobian = (lens @ steps).reshape(len(every), 8, 13)
        blocks = jacobian.transpose(0, 2, 1) * weights[:, None, None]
        information = np.diag(np.r_[np.tile(_POSE ** -2.0, len(numbers)), np.full(
            7 * len(tags), 1e-6)])
        gradient = np.r_[(moved / _POSE ** 2).ravel(), np.zeros(7 * len(tags))]
        for row, (frame, tag) in enumerate(zip(frames.ravel(), owner, strict=True)):
            at = np.r_[6 * frame:6 * frame + 6, count + 7 * tag:count + 7 * tag + 7]
            information[np.ix_(at, at)] += blocks[row] @ jacobian[row]
            gradient[at] += blocks[row] @ off[row].ravel()
        step = -np.linalg.solve(information, gradient)
        moved += step[:count].reshape(-1, 6)
        poses = _steps(step[:count].reshape(-1, 6)) @ poses
        of_tags = step[count:].reshape(-1, 7)
        places = places @ _steps(of_tags[:, :6])
        lengths = lengths * np.exp(of_tags[:, 6])
    metres = np.linalg.norm(off, axis=2).mean(axis=1) * lengths[owner] / [
        one.sight.side_px for _, one in every]
    return tuple(replace(tag, size=float(length), center=tuple(pose[:3, 3]),
                         quat_xyzw=tuple(quaternion_from_transform(pose)))
                 for tag, pose, length in zip(tags, places, lengths, strict=True)), tuple(
        float(np.median(metres[owner == row])) for row in range(len(tags)))


def _crossed(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    return np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)


def _steps(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transforms (n, 4, 4) of steps (n, 6): shift and rotation vector."""
    found = np.tile(np.eye(4), (len(steps), 1, 1))
    found[:, :3, :3] = Rotation.from_rotvec(steps[:, 3:]).as_matrix()
    found[:, :3, 3] = steps[:, :3]
    return found
