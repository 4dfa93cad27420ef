# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map: ellipsoidal landmarks with labels in natural language, and their index by class."""

import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cliploc_ros.core.geometry.ellipsoid import STANDS_IN, normalized_lengths, shape_matrices
from cliploc_ros.core.map.culling import SortedLandmarks, sort_landmarks
from cliploc_ros.core.map.landmark_details import (
    OPTIONAL_FIELDS,
    LandmarkDetails,
    WeightedLabels,
    checked_text,
    join_details,
    read_details,
)
from cliploc_ros.core.map.pairs import LandmarkPairs, make_pairs
from cliploc_ros.core.map.parameter_file import NO_SET, MapSet, parse_parameters, read_text, set_of
from cliploc_ros.errors import MapError, did_you_mean
from cliploc_ros.files.storage import finish_set

_UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_FIELDS = ('label', 'class_id', 'center', 'semi_axes', 'orientation')
#: Standard deviation of a centre on each axis [m] if the map has no position_sigma: a guess for
#: handmade maps. Landmarks of build_map have .012 (median, TUM fr3), simulated landmarks .005 to
#: .04. On the TUM map, which has no position_sigma, 0 to .03 localize equally well.
DEFAULT_SIGMA_M = 0.02
# Squares and fourth powers of lengths in this range neither underflow nor overflow.
_SEMI_AXIS_RANGE_M = (1e-4, 1e4)
_MAX_COORDINATE_M = 1e7
_MAX_QUATERNION_NORM_ERROR = 0.01
# Distance between two classes in the tree that has the class as a fourth coordinate.
_CLASS_DISTANCE_M = 10.0
# To find duplicates, each landmark is compared with this number of nearest neighbours of its class
# within this distance.
_COMPARED, _NEAR_M = 3, 0.5


@dataclass(frozen=True)
class ClassIndex:
    """The landmarks of each class: L landmarks, C classes, m memberships.

    A landmark is a member of its own class and of classes that the detector confuses it with.
    """

    numbers: Mapping[str, int]  #: Number of each class name, 0 to C - 1; own classes come first
    of_landmarks: NDArray[np.int64]  #: (L,): number of each landmark's own class
    #: (m,): landmarks grouped by class, in the map's order within a class
    landmarks: NDArray[np.int64]
    starts: NDArray[np.int64]  #: (C + 1,): index in `landmarks` of the first member of each class
    #: Frequency of a class relative to the landmark's most frequent class, by (landmark, class),
    #: 0 to 1; missing pairs have 1
    weights: Mapping[tuple[int, int], float] = field(default_factory=dict)

    @staticmethod
    def of(landmark_classes: Sequence[str], weights: Mapping[tuple[int, str], float]
           ) -> 'ClassIndex':
        """Build the index of a map's classes.

        Weights are those of pairs of a landmark and one of its classes, its own or another class.
        """
        others = [(row, name) for row, name in weights if name != landmark_classes[row]]
        names = [*landmark_classes, *(name for _, name in others)]
        numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
        classes = np.array([numbers[name] for name in names], dtype=np.int64)
        count = len(landmark_classes)
        landmarks = np.append(np.arange(count), [row for row, _ in others]).astype(np.int64)
        return ClassIndex(numbers, classes[:count], landmarks[np.lexsort((landmarks, classes))],
                          np.append(0, np.cumsum(np.bincount(classes))).astype(np.int64),
                          {(row, numbers[name]): weight
                           for (row, name), weight in weights.items()})

    @cached_property
    def members(self) -> NDArray[np.int64]:
        """Return the landmark and the class of each membership (m, 2), in the map's order."""
        classes = np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))
        order = np.argsort(self.landmarks, kind='stable')
        return np.column_stack([self.landmarks[order], classes[order]])

    def are_own(self, classes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return a mask (n,): the class is some landmark's own class, not only a confusion."""
        return np.asarray((classes >= 0) & (classes <= self.of_landmarks.max(initial=-1)))

    def shares(self, landmarks: NDArray[np.int64], classes: NDArray[np.int64]
               ) -> NDArray[np.float64]:
        """Return the frequency (p,) of a class relative to the landmark's most frequent class.

        1 for a class of the landmark without a known weight, 0 for other classes.
        """
        pairs = zip(landmarks.tolist(), classes.tolist(), strict=True)
        return np.array([self._shares.get(pair, 0.0) for pair in pairs])

    @cached_property
    def _shares(self) -> dict[tuple[int, int], float]:
        """Return the weight of each membership; see weights."""
        return {(row, number): self.weights.get((row, number), 1.0)
                for row, number in self.members.tolist()}

    def classes_of(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the number of each class name (n,); -1 for classes that the map lacks."""
        return np.array([self.numbers.get(name, -1) for name in names], dtype=np.int64)

    def sizes_of(self, classes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of landmarks of each class (n,); 0 for classes below 0."""
        return np.append(np.diff(self.starts), 0)[classes]  # -1 selects the appended 0

    def pairs(self, classes: NDArray[np.int64], order: NDArray[np.int64],
              limit: int | None = None) -> NDArray[np.int64]:
        """Return the pairs (c, 2) of a detection and a landmark of its class.

        Parameters
        ----------
        classes : ndarray (n,) of int
            Class of each detection, see classes_of.
        order : ndarray (m,) of int
            The detections in the order in which they are paired.
        limit : int, optional
            Maximum number of pairs; the first pairs are kept.
        """
        taken = self.sizes_of(classes)[order]
        if limit is not None:
            taken = np.clip(limit - (np.cumsum(taken) - taken), 0, taken)
        detections = np.repeat(order, taken)
        within = np.arange(len(detections)) - np.repeat(np.cumsum(taken) - taken, taken)
        return np.column_stack([detections,
                                self.landmarks[self.starts[classes[detections]] + within]])


@dataclass(frozen=True)
class LandmarkMap:
    """L landmarks in one map frame. L is 0 for a map of keyframes alone."""

    frame_id: str  #: Coordinate frame of centres and orientations
    #: Name, description in natural language and detector class of each landmark
    landmark_ids: tuple[str, ...]
    labels: tuple[str, ...]
    class_ids: tuple[str, ...]
    centers: NDArray[np.float64]  #: (L, 3) [m]
    semi_axes: NDArray[np.float64]  #: (L, 3): half lengths along each landmark's own axes [m]
    #: (L, 4): unit quaternions that rotate landmark axes into map axes
    quats_xyzw: NDArray[np.float64]
    #: Optional fields of each landmark; empty if the map has none
    details: tuple[LandmarkDetails, ...] = ()
    map_set: MapSet = NO_SET  #: Identity that the files next to the map must share
    nav2_map: str = ''  #: File of Nav2's grid of this place, from the folder of the map

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.landmark_ids)

    def select(self, rows: Sequence[int]) -> 'LandmarkMap':
        """Return a map of the given landmarks, at least one, in the given order."""
        def pick(values: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(values[row] for row in rows)

        return LandmarkMap(
            self.frame_id, pick(self.landmark_ids), pick(self.labels), pick(self.class_ids),
            self.centers[rows], self.semi_axes[rows], self.quats_xyzw[rows],
            pick(self.details) if self.details else (), nav2_map=self.nav2_map)

    def with_more(self, other: 'LandmarkMap') -> 'LandmarkMap':
        """Return the map with the landmarks of another map appended."""
        return LandmarkMap(
            self.frame_id, self.landmark_ids + other.landmark_ids, self.labels + other.labels,
            self.class_ids + other.class_ids, np.concatenate([self.centers, other.centers]),
            np.concatenate([self.semi_axes, other.semi_axes]),
            np.concatenate([self.quats_xyzw, other.quats_xyzw]),
            self.every_detail + other.every_detail if self.details or other.details else (),
            self.map_set, self.nav2_map)

    def joined(self, into: NDArray[np.int64]) -> 'LandmarkMap':
        """Return the map with the labels and classes of parts added to their whole landmarks.

        The array into (L,) has the row of the landmark that each landmark is a part of, or its own
        row.
        """
        details = list(self.every_detail)
        for row in np.unique(into[into != np.arange(len(into))]).tolist():
            parts = [row, *(part for part in np.nonzero(into == row)[0].tolist() if part != row)]
            details[row] = join_details([
                (self.labels[part], self.class_ids[part], details[part]) for part in parts])
        return replace(self, details=tuple(details))

    @property
    def every_detail(self) -> tuple[LandmarkDetails, ...]:
        """Return the optional fields of each landmark, L of them."""
        return self.details or (LandmarkDetails(),) * len(self)

    def prepare(self) -> None:
        """Compute the indices in advance, so that the first request does not wait for them."""
        _ = self.shapes, self.classes, self.sorted_landmarks, self.tree, self.pairs
        _ = self.objects, self.position_sigmas, self.shared_sigmas

    @cached_property
    def shapes(self) -> NDArray[np.float64]:
        """Return the shape matrices (L, 6), see cliploc_ros.core.geometry.ellipsoid."""
        return shape_matrices(self.semi_axes, self.quats_xyzw)

    @cached_property
    def position_sigmas(self) -> NDArray[np.float64]:
        """Return the standard deviation of each centre on each axis (L,) [m]."""
        given = (detail.position_sigma for detail in self.every_detail)
        return np.array([DEFAULT_SIGMA_M if sigma is None else sigma for sigma in given])

    @cached_property
    def shared_sigmas(self) -> NDArray[np.float64]:
        """Return the standard deviations of errors shared with neighbours (L, 2) [m] [rad].

        0 where the map has no value.
        """
        given = [(detail.shared_sigma or 0.0, detail.shared_sigma_deg or 0.0)
                 for detail in self.every_detail]
        return np.reshape(given, (-1, 2)) * [1.0, np.radians(1.0)]

    @property
    def weighted_labels(self) -> tuple[WeightedLabels, ...]:
        """Return all labels of each landmark, with their weights."""
        return tuple(detail.labels_with(label)
                     for detail, label in zip(self.every_detail, self.labels, strict=True))

    @cached_property
    def classes(self) -> ClassIndex:
        """Return the landmarks by class: their own classes, and classes they are mistaken for."""
        return ClassIndex.of(self.class_ids, {
            (row, name): share for row, detail in enumerate(self.details)
            for name, share in detail.class_shares()})

    @cached_property
    def sorted_landmarks(self) -> SortedLandmarks:
        """Return the landmarks sorted by position."""
        return sort_landmarks(self.centers, self.shapes, self.classes.members)

    @cached_property
    def tree(self) -> cKDTree:
        """Return a tree of the centres, for searches of nearby landmarks."""
        return cKDTree(self.centers)

    @cached_property
    def pairs(self) -> LandmarkPairs:
        """Return pairs of neighbours, for searches of repeated arrangements."""
        return make_pairs(self.centers, self.classes.of_landmarks, self.tree)

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """Return the object number of each landmark (L,); duplicates share a number.

        Landmarks of one class are duplicates if their centres are close relative to their sizes.
        Books side by side are not duplicates.
        """
        rows = np.arange(len(self))
        ranks = [*range(2, min(_COMPARED + 1, len(self)) + 1)]
        if not ranks:
            return rows
        near = self._tree_of_classes.query(self._with_class(self.centers, rows), ranks,
                                           distance_upper_bound=_NEAR_M)[1]
        first, column = np.nonzero(near < len(self))
        second = near[first, column]
        inside = normalized_lengths(
            self.centers[second] - self.centers[first],
            (self.shapes[first] + self.shapes[second])[:, _UPPER]) < STANDS_IN
        links = coo_matrix((np.ones(int(inside.sum())), (first[inside], second[inside])),
                           (len(self), len(self)))
        return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)

    @cached_property
    def _tree_of_classes(self) -> cKDTree:
        return cKDTree(self._with_class(self.centers, np.arange(len(self))))

    def of_class_near(self, spots: NDArray[np.float64], landmarks: NDArray[np.int64],
                      near_m: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Find the nearest landmark of a given class at each position.

        Parameters
        ----------
        spots : ndarray (..., n, 3)
            Positions in the map [m].
        landmarks : ndarray (n,) of int
            A landmark for each position, which gives the class.
        near_m : float
            Maximum distance, below 10 [m].

        Returns
        -------
        nearest : ndarray (..., n) of int
            0 if there is none.
        found : ndarray (..., n) of bool
        """
        distances, rows = self._tree_of_classes.query(self._with_class(spots, landmarks),
                                                      distance_upper_bound=near_m)
        found = np.isfinite(distances)
        return np.where(found, rows, 0), found

    def _with_class(self, spots: NDArray[np.float64], landmarks: NDArray[np.int64]
                    ) -> NDArray[np.float64]:
        """Return positions (..., n, 3) with the class of a landmark as fourth coordinate."""
        classes = np.broadcast_to(self.classes.of_landmarks[landmarks], spots.shape[:-1])
        return np.concatenate([spots, _CLASS_DISTANCE_M * classes[..., None]], axis=-1)

    @staticmethod
    def from_file(path: str | os.PathLike[str]) -> 'LandmarkMap':
        """Read a map from a ROS 2 parameter file.

        Raises
        ------
        MapError
            The file is invalid; the message names the file, the landmark and the field to correct.
        """
        text = read_text(path)
        map_set = set_of(text)
        finish_set(Path(path), map_set.digest)
        tree = parse_parameters(text, path)
        found = tree[find_map_node(tree, path)]['ros__parameters']['map']
        landmark_map = LandmarkMap.from_mapping(found, str(path))  # it checks the tree
        return replace(landmark_map, map_set=map_set, nav2_map=checked_text(
            found['nav2_map'], f'{path}: map: nav2_map') if 'nav2_map' in found else '')

    @staticmethod
    def empty(frame_id: str) -> 'LandmarkMap':
        """Return a map without landmarks, for a place with keyframes alone."""
        return LandmarkMap(frame_id, (), (), (), np.empty((0, 3)), np.empty((0, 3)),
                           np.empty((0, 4)))

    @staticmethod
    def from_mapping(tree: Any, source: str) -> 'LandmarkMap':
        """Build a map from a tree with the keys frame_id and landmarks.

        Raises
        ------
        MapError
            The tree is invalid; the message names the source, the landmark and the field to
            correct.
        """
        _check_keys(tree, ('frame_id', 'landmarks'), f'{source}: map', ('nav2_map',))
        frame_id = checked_text(tree['frame_id'], f'{source}: map: frame_id')
        landmarks = tree['landmarks']
        if not isinstance(landmarks, Mapping):
            raise MapError(f'{source}: map: landmarks: the map is empty; write {{}} for a map of '
                           'keyframes alone')
        if not landmarks:
            return LandmarkMap.empty(frame_id)
        rows = [_landmark(landmark_id, fields, source)
                for landmark_id, fields in landmarks.items()]
        labels, class_ids, centers, semi_axes, quats, details = zip(*rows, strict=True)
        quats_xyzw = np.array(quats)
        quats_xyzw /= np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
        return LandmarkMap(frame_id, tuple(map(str, landmarks)), labels, class_ids,
                           np.array(centers), np.array(semi_axes), quats_xyzw,
                           details if any(detail != LandmarkDetails() for detail in details)
                           else ())


def find_map_node(tree: Mapping[str, Any], path: str | os.PathLike[str]) -> str:
    """Return the node of a parameter file that has the map; MapError unless exactly one has."""
    found = [name for name, node in tree.items()
             if isinstance(node, dict) and isinstance(node.get('ros__parameters'), dict)
             and 'map' in node['ros__parameters']]
    if len(found) != 1:
        raise MapError(f"{path}: {'no' if not found else 'more than one'} map: expected one "
                       "'map' under '/**: ros__parameters:'")
    return found[0]


def _landmark(landmark_id: Any, fields: Any, source: str) -> tuple[Any, ...]:
    """Validate a landmark; return its fields in the order of _FIELDS, and its details."""
    where = f"{source}: landmark '{landmark_id}'"
    if not isinstance(landmark_id, str) or not landmark_id or '.' in landmark_id:
        # a dot would split the name of a ROS parameter
        raise MapError(f'{where}: the id must be text without dots')
    labelled = isinstance(fields, Mapping) and 'labels' in fields
    _check_keys(fields, _FIELDS[1:] if labelled else _FIELDS, where, _FIELDS[:1] + OPTIONAL_FIELDS)
    details = read_details(fields, where)
    heaviest_label = max(details.labels, key=lambda pair: pair[1])[0] if details.labels else ''
    label = fields.get('label', heaviest_label)
    semi_axes = _numbers(fields['semi_axes'], 3, f'{where}: semi_axes')
    low, high = _SEMI_AXIS_RANGE_M
    if not all(low <= axis <= high for axis in semi_axes):
        raise MapError(f'{where}: semi_axes: {semi_axes} must be between {low:g} and {high:g} m')
    center = _numbers(fields['center'], 3, f'{where}: center')
    if max(map(abs, center)) > _MAX_COORDINATE_M:
        raise MapError(f'{where}: center: {center} is beyond {_MAX_COORDINATE_M:g} m')
    quat_xyzw = _numbers(fields['orientation'], 4, f'{where}: orientation')
    if abs(math.hypot(*quat_xyzw) - 1.0) > _MAX_QUATERNION_NORM_ERROR:
        raise MapError(f'{where}: orientation: the quaternion {quat_xyzw} has norm '
                       f'{math.hypot(*quat_xyzw):.3g}, expected 1')
    return (checked_text(label, f'{where}: label'),
            checked_text(fields['class_id'], f'{where}: class_id'), center, semi_axes, quat_xyzw,
            details)


def _check_keys(tree: Any, expected: tuple[str, ...], where: str,
                optional: tuple[str, ...] = ()) -> None:
    if not isinstance(tree, Mapping):
        raise MapError(f'{where}: expected the fields {", ".join(expected)}')
    known = tuple(dict.fromkeys(expected + optional))
    unknown = [str(key) for key in tree if key not in known]
    if unknown:
        named = ', '.join(f'{key}{did_you_mean(key, known)}' for key in unknown[:5])
        raise MapError(f'{where}: unknown field: {named} (known: {", ".join(known)})')
    missing = [key for key in expected if key not in tree]
    if missing:
        raise MapError(f'{where}: missing field: {", ".join(missing)}')


def _numbers(value: Any, count: int, where: str) -> tuple[float, ...]:
    values = tuple(value) if isinstance(value, list | tuple) or hasattr(value, 'tolist') else ()
    numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if len(values) != count or not numeric:
        raise MapError(f'{where}: must be {count} numbers, not {value!r:.60}')
    if not all(abs(v) <= sys.float_info.max for v in values):  # ints may be larger
        raise MapError(f'{where}: {value!r:.60} has values that are not finite')
    return tuple(map(float, values))
