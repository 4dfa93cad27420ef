# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Localize an image among keyframes: find similar keyframes, match them, solve for the pose."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import SAME_ANSWER, SAME_SIGHT, invert_transform
from cliploc_ros.core.keyframes.features import SIFT, FeatureKind, Features
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.places import Recognition, RecognizedPlace
from cliploc_ros.core.keyframes.point_pose import (
    LEAST_INLIERS,
    agreeing,
    find_pose,
    free_focal,
    refine,
)
from cliploc_ros.core.search.scene import Constraint
from cliploc_ros.errors import MapError

# Number of keyframes to match: the most similar, the most similar at other places (so that places
# that look alike are found), and keyframes near each pose that objects propose.
_SIMILAR, _ELSEWHERE, PROPOSED = 5, 2, 3
#: With fewer agreeing points, more keyframes are matched: this many near the pose, and as many of
#: the next similar keyframes.
ENOUGH_INLIERS, _MORE = 100, 5
# An image's words may resemble those of the wrong keyframes. If none of the above shows the place,
# the strongest 600 features are matched with the next 25 keyframes. A chance pose has up to 8
# inliers among these matches, so 20 are required.
_FURTHER, _STRONGEST, _CLEAR = 25, 600, 20
# The thorough pass extracts features at full size: maximum number, and longest side.
_THOROUGH_FEATURES, _THOROUGH_PX = 3000, 1600
# Of the keyframes with the most similar words (candidates), it matches the keyframes that share
# the most of the image's strongest features (voters).
_CANDIDATES, _VOTERS, _VOTED = 100, 300, 20
# It then searches for points of keyframes near the pose where the pose projects them: within this
# angle (8 px at f = 525 px), among this many nearest features (a long lens has all features within
# the angle), and with at least this cosine of the descriptors.
_GUIDED_RADIUS, _GUIDED_NEAREST = 8.0 / 525.0, 10
_GUIDED_COSINE, _GUIDED_KEYFRAMES = 0.8, 12
# Points closer to the camera [m], or farther from its axis on the plane z = 1, are skipped.
_GUIDED_LEAST_M, _GUIDED_MOST_BEARING = 0.1, 5.0
#: No pass begins with less time left [s]: the extraction of features cannot be interrupted.
LEAST_S = 0.5
#: Maximum number of mutually different places of an image.
MOST_PLACES = 3
# Number of similar keyframes among which keyframes at other places are chosen.
_MOST_RANKED = 500
#: A keyframe has the view of a pose if distance / NEAR_M + angle / NEAR_DEG is less than 1.
NEAR_M, NEAR_DEG = SAME_SIGHT
# Number of three-point samples: for the first place, and for each rival.
_ITERATIONS, _RIVAL_ITERATIONS = 3000, 1000
# A part of a place was elsewhere if a pose within this tolerance of its own, which other features
# agree with, moves the median of their points by this [m]; errors of maps move it by up to .2 m.
# Features within this angle of agreeing ones (20 px at f = 525 px) do not count: a texture of the
# bonsai's room repeats every .3 m. Measured on four rooms, see studies/README.md.
_MOVED, _LEAST_MOVE_M, _BESIDE = SAME_SIGHT._replace(distance_m=4.0), 0.3, 20.0 / 525.0
# Before the search for a rival, all points within this multiple of the tolerance are removed.
_RIVAL_TOLERANCE = 3.0
#: No constraint on the camera.
NOTHING_KNOWN = Constraint()
# Cells of the image (columns, rows). A cell is comparable with at least this many points of a
# keyframe and features of the image; an image has half as many features as a keyframe.
_CELLS = (8, 6)
_LEAST_EXPECTED, _LEAST_SEEN = 4, 2
# Nearby points share errors, and several keyframes contain the same point: errors of poses and
# focal lengths are larger by this factor than with independent points. Of 570 right poses of the
# kitchen and fr1, 92 % have a focal length within two such deviations.
_MUCH_ALIKE = 4.5
# A rolling shutter stretches the image of a rotating camera: standard deviations of the logarithms
# of focal length and aspect.
_STRETCHED = (0.005, 0.01)
# Errors that all points of a keyframe share: the error of its pose, and the error of its points,
# which grows with distance and angle from the keyframe. Chosen on the kitchen, see the study.
_KEYFRAME_M, _KEYFRAME_RAD, PER_RADIAN = 0.012, np.radians(0.45), 0.04


class _Matched(NamedTuple):
    """The k matches of an image: features, points in the map, their keyframes and rows.

    The shares measure how distinctive the matches are, see core.keyframes.features.match.
    """

    features: NDArray[np.int64]
    points: NDArray[np.float64]
    keyframes: NDArray[np.int64]
    rows: NDArray[np.int64]
    shares: NDArray[np.float32]

    def select(self, chosen: NDArray[np.int64]) -> '_Matched':
        return _Matched._make(column[chosen] for column in self)

    def join(self, *others: '_Matched') -> '_Matched':
        return _Matched(*map(np.concatenate, zip(self, *others, strict=True)))


_NO_MATCH = _Matched(np.empty(0, np.int64), np.empty((0, 3)), np.empty(0, np.int64),
                     np.empty(0, np.int64), np.empty(0, np.float32))


def query_features(image_rgb: NDArray[np.uint8], kind: FeatureKind = SIFT,
                   is_thorough: bool = False) -> Features:
    """Extract the features of an image (h, w, 3) to be localized, for the fast or thorough pass.

    The kind must be that of the layer.
    """
    return kind.extract(image_rgb, *((_THOROUGH_FEATURES, _THOROUGH_PX) if is_thorough
                                     else (kind.query_most, kind.query_px)))


class ImageFeatures:
    """The features of an image for both passes, each extracted when it is first needed.

    Parameters
    ----------
    read_rgb : callable
        Returns the image (h, w, 3).
    camera : Camera
        Camera of the image.
    kind : FeatureKind
        Kind of features of the layer in which the image is localized.
    """

    def __init__(self, read_rgb: Callable[[], NDArray[np.uint8]], camera: Camera,
                 kind: FeatureKind = SIFT) -> None:
        self._read_rgb, self.camera, self._kind = read_rgb, camera, kind
        self._found: dict[bool, Features] = {}

    def of_pass(self, is_thorough: bool) -> Features:
        """Return the features of a pass."""
        if is_thorough not in self._found:
            self._found[is_thorough] = query_features(self._read_rgb(), self._kind, is_thorough)
        return self._found[is_thorough]


class _Look(NamedTuple):
    """A query image: its features, their bearings (n, 2), the camera and its constraint."""

    features: Features
    bearings: NDArray[np.float64]
    camera: Camera
    constraint: Constraint = NOTHING_KNOWN
    least_inliers: int = 0


class _Place(NamedTuple):
    """A pose, all matches, its inliers, and the number of agreeing features, also per cell."""

    map_from_camera: NDArray[np.float64]
    covariance: NDArray[np.float64]
    among: _Matched
    inliers: _Matched
    agreed: int
    cells: NDArray[np.int64]
    #: Features that agree on another pose, from which their points have moved
    parted: NDArray[np.int64] = np.empty(0, dtype=np.int64)


class KeyframeLocalizer:
    """Localizes images in a layer of keyframes, or in the joined layers of several maps.

    Each joined layer is searched alone, and the time grows with their number: a pose is solved in
    single precision, which is too coarse for points of several maps.
    """

    def __init__(self, layer: KeyframeLayer, first: int = 0) -> None:
        self.layer, self._first = layer, first  # of a part: number of its first keyframe
        self._parts = [*map(KeyframeLocalizer, layer.parts, np.cumsum(
            [0, *map(len, layer.parts)]).tolist())]
        layer.prepare()

    def localize_features(self, features: Features, camera: Camera,
                          guesses: Sequence[NDArray[np.float64]] = (), deadline: float = np.inf,
                          constraint: Constraint = NOTHING_KNOWN, fast: Recognition | None = None
                          ) -> Recognition:
        """Find the places where an image with these features may have been taken.

        Parameters
        ----------
        features : Features
            See query_features.
        guesses : sequence of ndarray (4, 4)
            Poses that objects propose; keyframes near them are matched, too.
        deadline : float
            Time after which no further keyframe is matched (monotonic clock) [s].
        constraint : Constraint, optional
            Poses outside its height range or max_tilt are dropped.
        fast : Recognition, optional
            Result of the fast pass. If given, this is the thorough pass: it matches many keyframes
            instead of a few and refines the pose with all of their points, which takes several
            times as long.

        Raises
        ------
        MapError
            The features are not of the kind of the layer.
        """
        if self._parts:
            # those of the map with the most inliers first
            found = sorted((part.localize_features(
                features, camera, guesses, deadline, constraint, fast) for part in self._parts),
                key=lambda seen: (seen.is_complete, -max((
                    place.inliers for place in seen.places), default=0), seen.outside_m is None))
            # if one search is incomplete, rivals may be missing
            return found[0]._replace(places=tuple(
                place for seen in found for place in seen.places if found[0].is_complete))
        kind, is_thorough = self.layer.kind, fast is not None
        if features.descriptors.shape[1] != kind.dimensions:
            raise MapError(f'features have {features.descriptors.shape[1]} dimensions, but the '
                           f'keyframes have {kind.name}: extract them with the kind of the layer')
        bearings = camera.normalize_points(features.pixels)
        known = np.isfinite(bearings).all(axis=1)
        features = Features(features.pixels[known], features.descriptors[known],
                            features.strengths[known])
        if len(features) < LEAST_INLIERS:
            return Recognition(is_thorough=is_thorough)
        descriptors = kind.units(features.descriptors)
        look = _Look(features, bearings[known], camera, constraint, kind.least_inliers)
        searched = self._search_fast(descriptors, look, guesses, deadline) if fast is None else (
            self._search_thoroughly(descriptors, look, guesses, [
                place.map_from_camera for place in fast.places], deadline))
        places, outside_m = _places(*searched, look)
        if is_thorough:
            places[:1] = [self._guided(place, look, descriptors) for place in places[:1]]
        if time.monotonic() > deadline:
            return Recognition(is_complete=False, is_thorough=is_thorough)
        return Recognition(tuple(self._recognized(place, look, is_thorough) for place in places),
                           is_thorough=is_thorough, outside_m=outside_m)

    def _search_fast(self, descriptors: NDArray[np.float32], look: _Look,
                     guesses: Sequence[NDArray[np.float64]], deadline: float
                     ) -> tuple['_Place | None', _Matched]:
        """Find the best pose from a few similar keyframes; return it and all matches with them."""
        ranks = np.argsort(-self.layer.similarities(descriptors), kind='stable').tolist()
        # similar keyframes, similar ones at other places, and keyframes near the guesses
        poses, chosen = self.layer.map_from_camera, ranks[:_SIMILAR]
        others = np.array(ranks[_SIMILAR:_MOST_RANKED], dtype=np.int64)
        for _ in range(_ELSEWHERE):
            others = others[~SAME_ANSWER.agreeing(poses[others], poses[chosen]).any(axis=1)]
            chosen += others[:1].tolist()
        for guess in guesses:
            chosen += [keyframe for keyframe in keyframes_near(poses, guess)[:PROPOSED].tolist()
                       if keyframe not in chosen]
        matched = self._match(descriptors, chosen, deadline)
        first = _place(matched, look)
        if first is None or first.agreed < ENOUGH_INLIERS:
            # also match keyframes near the pose, and the next similar keyframes
            near = keyframes_near(poses, first.map_from_camera)[:_MORE].tolist() if first else []
            more = [rank for rank in dict.fromkeys([*near, *ranks[:_SIMILAR + _MORE]])
                    if rank not in chosen]
            matched = matched.join(self._match(descriptors, more, deadline))
            first = _place(matched, look)
        if first is None or first.agreed < LEAST_INLIERS:
            # search less similar keyframes for a pose, and match the keyframes near it
            further = _place(self._match(descriptors[:_STRONGEST], ranks[_SIMILAR + _MORE:][
                :_FURTHER], deadline), look, _RIVAL_ITERATIONS)
            if further is not None and further.agreed >= _CLEAR:
                near = keyframes_near(poses, further.map_from_camera)[:_MORE].tolist()
                matched = matched.join(self._match(descriptors, near, deadline))
                first = _place(matched, look)
        return first, matched

    def _search_thoroughly(self, descriptors: NDArray[np.float32], look: _Look,
                           guesses: Sequence[NDArray[np.float64]],
                           found: Sequence[NDArray[np.float64]], deadline: float
                           ) -> tuple['_Place | None', _Matched]:
        """Find the best pose from many voted keyframes; return it and all matches with them.

        The poses found by the fast pass (4, 4) compete, too.
        """
        ranks = np.argsort(-self.layer.similarities(descriptors), kind='stable')[:_CANDIDATES]
        votes = [len(self._match(descriptors[:_VOTERS], [rank], deadline).features)
                 for rank in ranks.tolist()]
        chosen = ranks[np.argsort(-np.array(votes), kind='stable')][:_VOTED].tolist()
        for guess in (*guesses, *found):
            chosen += keyframes_near(self.layer.map_from_camera, guess)[:PROPOSED].tolist()
        matched = self._match(descriptors, [*dict.fromkeys(chosen)], deadline)
        first = _place(matched, look, found=found)
        if first is not None:
            near = keyframes_near(self.layer.map_from_camera, first.map_from_camera)
            more = [keyframe for keyframe in near[:_MORE].tolist() if keyframe not in chosen]
            matched = matched.join(self._match(descriptors, more, deadline))
            first = _place(matched, look, found=[first.map_from_camera])
        return first, matched

    def _guided(self, place: '_Place', look: _Look, descriptors: NDArray[np.float32]) -> '_Place':
        """Refine a place with all points that the image shows at their projections.

        These points show how much of the image the place covers. They are no further evidence that
        the place is right: at any pose, some points match by chance.
        """
        camera_from_map = invert_transform(place.map_from_camera)
        near = keyframes_near(self.layer.map_from_camera, place.map_from_camera)
        seen = dict.fromkeys([*self._used(place)[0].tolist(), *near.tolist()])
        tree, matched = cKDTree(look.bearings), place.inliers
        for keyframe in [*seen][:_GUIDED_KEYFRAMES]:
            theirs = self.layer.points_in_map(keyframe)
            inside = theirs @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
            ahead = np.isfinite(inside).all(axis=1) & (inside[:, 2] > _GUIDED_LEAST_M)
            rows = np.nonzero(ahead & (np.abs(inside[:, :2]) < _GUIDED_MOST_BEARING
                                       * inside[:, 2:]).all(axis=1))[0]
            _, nearest = tree.query(inside[rows, :2] / inside[rows, 2:], [*range(
                1, _GUIDED_NEAREST + 1)], distance_upper_bound=_GUIDED_RADIUS)
            of_points, ranks = np.nonzero(nearest < len(look.bearings))
            of_points, of_features = rows[of_points], nearest[of_points, ranks]
            cosines = np.einsum('kd,kd->k', self.layer.unit_descriptors(keyframe)[of_points],
                                descriptors[of_features])
            # mutually most similar pairs
            order = np.argsort(-cosines, kind='stable')
            order = order[cosines[order] > _GUIDED_COSINE]
            mutual = np.intersect1d(np.unique(of_points[order], return_index=True)[1],
                                    np.unique(of_features[order], return_index=True)[1])
            of_points, kept = of_points[order[mutual]], of_features[order[mutual]]
            matched = matched.join(_Matched(
                kept, theirs[of_points], np.full(len(kept), keyframe),
                of_points + self.layer.rows(keyframe).start, np.ones(len(kept), np.float32)))
        # drop duplicate matches
        _, kept = np.unique([matched.features, matched.rows], axis=1, return_index=True)
        matched = matched.select(np.sort(kept))
        refined = refine(matched.points, look.bearings[matched.features], camera_from_map)
        return place if refined is None else place._replace(
            map_from_camera=refined.map_from_camera, covariance=refined.covariance,
            inliers=matched.select(refined.inliers))

    def _used(self, place: '_Place') -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the keyframes with inliers, in decreasing order, and the inliers (K,) of each."""
        counts = np.bincount(place.inliers.keyframes, minlength=len(self.layer))
        return np.argsort(-counts, kind='stable')[:np.count_nonzero(counts)], counts

    def coverage(self, map_from_camera: NDArray[np.float64], camera: Camera) -> float:
        """Return the share of an image that the layer covers at a pose (4, 4).

        It is the share of cells of the image in which keyframes near the pose predict points. If
        it is 0, no keyframe is near: failed recognition is then no evidence against this place.
        """
        if self._parts:  # the keyframes of other maps are far away
            return max(part.coverage(map_from_camera, camera) for part in self._parts)
        near = keyframes_near(self.layer.map_from_camera, map_from_camera)
        return float(self._expects(near, map_from_camera, camera).mean())

    def _recognized(self, place: '_Place', look: '_Look', is_thorough: bool) -> RecognizedPlace:
        """Evaluate the evidence for and against a place."""
        used, counts = self._used(place)
        pose, shares = place.map_from_camera, counts[used] / counts.sum()
        # cells with inliers among the comparable cells; a cell without features, such as an
        # occluded cell, is not comparable
        seen = _count(look.features.pixels, look.camera)
        comparable = (seen >= _LEAST_SEEN) & self._expects(used, pose, look.camera)
        confirmed = np.count_nonzero(place.cells[comparable]) / max(1, int(comparable.sum()))
        among = place.among.select(np.nonzero(np.isin(place.among.keyframes, used))[0])
        free = free_focal(among.points, look.bearings[among.features], invert_transform(pose))
        (ratio, aspect), (deviation, of_aspect) = ((1.0, 1.0), (np.inf, np.inf)) if free is None \
            else (np.exp(free[0]), np.hypot(_MUCH_ALIKE * free[1], _STRETCHED))
        # features beside agreeing ones show a texture that repeats, not a part that has moved
        parted = np.count_nonzero(cKDTree(look.bearings[place.inliers.features]).query(
            look.bearings[np.unique(place.parted)])[0] > _BESIDE)
        shared = self._shared(pose, counts)
        covariance = _MUCH_ALIKE**2 * place.covariance + shared
        return RecognizedPlace(
            pose, covariance, shared, place.agreed, confirmed, ratio, deviation,
            aspect, of_aspect, look.constraint.tilt_error(pose, covariance),
            tuple((self._first + used).tolist()), tuple(shares.tolist()),
            look.features.pixels[place.inliers.features], place.inliers.rows,
            place.inliers.points, is_thorough,
            float(_distances(self.layer.map_from_camera[used], pose).min()),
            parted / (place.agreed + parted),
            self.layer.recorded(int(used[0])))

    def _match(self, descriptors: NDArray[np.float32], chosen: Sequence[int], deadline: float
               ) -> _Matched:
        found = []
        for keyframe in chosen:
            if time.monotonic() > deadline:
                break
            pairs, its = self.layer.kind.match(descriptors, self.layer.unit_descriptors(keyframe))
            inside = self.layer.points_in_map(keyframe)[pairs[:, 1]]
            found.append(_Matched(
                pairs[:, 0], inside, np.full(len(pairs), keyframe),
                self.layer.offsets[keyframe] + pairs[:, 1], its,
            ).select(np.nonzero(np.isfinite(inside).all(axis=1))[0]))
        return _NO_MATCH.join(*found)

    def _expects(self, keyframes: NDArray[np.int64], pose: NDArray[np.float64], camera: Camera
                 ) -> NDArray[np.bool_]:
        """Return a mask of the cells of an image in which the first keyframes predict points."""
        counts = [_count(_project(self.layer.points_in_map(keyframe), pose, camera), camera)
                  for keyframe in keyframes[:_SIMILAR].tolist()]
        return np.max(counts, axis=0, initial=0) >= _LEAST_EXPECTED

    def _shared(self, pose: NDArray[np.float64], counts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the errors that the points of a keyframe share."""
        used = np.nonzero(counts)[0]
        shares = counts[used] / counts.sum()
        poses = self.layer.map_from_camera[used]
        grown_m = shares @ (self.layer.deviations(used) * np.linalg.norm(
            poses[:, :3, 3] - pose[:3, 3], axis=1))
        turns = Rotation.from_matrix(poses[:, :3, :3].transpose(0, 2, 1) @ pose[:3, :3])
        angle = shares @ turns.magnitude()
        return np.diag(np.repeat([_KEYFRAME_M**2 + grown_m**2,
                                  _KEYFRAME_RAD**2 + (PER_RADIAN * angle)**2], 3))


def _places(first: _Place | None, matched: _Matched, look: _Look
            ) -> tuple[list[_Place], float | None]:
    """Return the first place and its rivals, the best places elsewhere; see also outside_m.

    The place whose points lie in the most cells of the image comes first: a poster has many
    points, but shows only a part of its place.
    """
    place, found, places, outside_m = first, list[_Place](), list[_Place](), None
    while place is not None and (not places or place.agreed >= LEAST_INLIERS):
        if look.constraint.allows(place.map_from_camera):
            found.append(place)
            if not any(SAME_ANSWER.agree(place.map_from_camera, other.map_from_camera)
                       for other in places):
                places.append(place)
        elif outside_m is None and place.agreed >= LEAST_INLIERS:
            outside_m = look.constraint.outside_m(place.map_from_camera)
        if len(found) == MOST_PLACES:
            break
        taken = agreeing(matched.points, look.bearings[matched.features],
                         invert_transform(place.map_from_camera), _RIVAL_TOLERANCE)
        matched = matched.select(np.setdiff1d(np.arange(len(matched.features)), taken))
        place = _place(matched, look, _RIVAL_ITERATIONS)
    places = [place._replace(parted=max((
        other.inliers.features for other in found if _was_elsewhere(other, place)), key=len,
        default=place.parted)) for place in places]
    return (sorted(places, key=lambda place: -np.count_nonzero(place.cells)),
            None if places else outside_m)


def _was_elsewhere(part: _Place, place: _Place) -> bool:
    """Check whether the points of another pose have moved, if a place is right."""
    move = place.map_from_camera @ invert_transform(part.map_from_camera) - np.eye(4)
    moves_m = np.linalg.norm(part.inliers.points @ move[:3, :3].T + move[:3, 3], axis=1)
    return bool(_MOVED.agree(part.map_from_camera, place.map_from_camera)
                and np.median(moves_m) > _LEAST_MOVE_M)


def _place(matched: _Matched, look: _Look, iterations: int = _ITERATIONS,
           found: Sequence[NDArray[np.float64]] = ()) -> _Place | None:
    """Return the place that most features agree with: a new pose, or a pose found earlier."""
    matched = matched.select(np.argsort(matched.shares, kind='stable'))
    bearings, places = look.bearings[matched.features], list[_Place]()
    for pose in (find_pose(matched.points, bearings, iterations, are_best_first=True),
                 *(refine(matched.points, bearings, invert_transform(earlier))
                   for earlier in found)):
        if pose is None:
            continue
        inliers = matched.select(pose.inliers)
        features = np.unique(inliers.features)
        if len(features) >= look.least_inliers:
            places.append(_Place(pose.map_from_camera, pose.covariance, matched, inliers,
                                 len(features), _count(look.features.pixels[features],
                                                       look.camera)))
    return max(places, key=lambda place: place.agreed, default=None)


def keyframes_near(poses: NDArray[np.float64], guess: NDArray[np.float64], most: float = 1.0
                   ) -> NDArray[np.int64]:
    """Return the keyframes whose views overlap the view of a pose, the closest first."""
    costs = _distances(poses, guess)
    order = np.argsort(costs, kind='stable')
    return np.asarray(order[costs[order] < most])


def _distances(poses: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far (k,) the views of poses are from that of a pose: see NEAR_M."""
    metres = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
    cosines = 0.5 * (np.einsum('kij,ij->k', poses[:, :3, :3], pose[:3, :3]) - 1.0)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return np.asarray(metres / NEAR_M + angles / NEAR_DEG)


def _project(points: NDArray[np.float64], pose: NDArray[np.float64], camera: Camera
             ) -> NDArray[np.float64]:
    """Return the pixels (m, 2) of the points in front of a camera."""
    camera_from_map = invert_transform(pose)
    inside = points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    inside = inside[inside[:, 2] > 0.1]
    return camera.project_normalized(inside[:, :2] / inside[:, 2:])


def _count(pixels: NDArray[np.floating], camera: Camera) -> NDArray[np.int64]:
    """Return the number of pixels (m, 2) in each cell of the image."""
    with np.errstate(invalid='ignore'):
        inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    columns, rows = _CELLS
    place = (pixels[inside] * (columns / camera.width, rows / camera.height)).astype(np.int64)
    place = np.minimum(place, (columns - 1, rows - 1))
    return np.bincount(place[:, 1] * columns + place[:, 0], minlength=columns * rows)


class ImageRecognizer:
    """Keyframe search of one image; several searches of its objects share the result.

    Parameters
    ----------
    deadline : float
        See localize_features.
    begin_stage : callable
        Called with the name of each stage that begins: 'keyframes', followed by 'search'.
    may_be_thorough : bool
        Whether the image may be searched thoroughly.
    """

    def __init__(self, keyframes: KeyframeLocalizer, features: ImageFeatures,
                 deadline: float = np.inf,
                 begin_stage: Callable[[str], None] = lambda stage: None,
                 may_be_thorough: bool = True) -> None:
        self._keyframes, self._features = keyframes, features
        self.deadline = deadline
        self._begin_stage = begin_stage
        self._may_be_thorough = may_be_thorough
        self._known: tuple[set[int], Recognition] | None = None
        self._fast: Recognition | None = None

    def begin_thorough(self) -> bool:
        """Switch to the thorough pass; False if already in it, not allowed, or out of time."""
        if self._fast is not None or self._known is None or not self._may_be_thorough or (
                self.deadline - time.monotonic() < LEAST_S):
            return False
        (_, self._fast), self._known = self._known, None
        return True

    def recognize(self, guesses: Sequence[NDArray[np.float64]],
                  constraint: Constraint = NOTHING_KNOWN) -> Recognition:
        """Return the places of the image; search again only if guesses propose other keyframes."""
        near = {row for guess in guesses for row in keyframes_near(
            self._keyframes.layer.map_from_camera, guess)[:PROPOSED].tolist()}
        if self._known is None or not near <= self._known[0]:
            self._begin_stage('keyframes')
            self._known = near, self._keyframes.localize_features(
                self._features.of_pass(self._fast is not None), self._features.camera, guesses,
                self.deadline, constraint, self._fast)
            self._begin_stage('search')
        return self._known[1]

    def deviation_per_metre(self, place: RecognizedPlace) -> float:
        """Return the mean deviation_per_metre of the keyframes of a place."""
        return float(np.dot(place.shares, self._keyframes.layer.deviations(list(place.keyframes))))

    def coverage(self, map_from_camera: NDArray[np.float64]) -> float:
        """Return KeyframeLocalizer.coverage for the camera of the image."""
        return self._keyframes.coverage(map_from_camera, self._features.camera)
