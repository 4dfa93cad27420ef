# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Findings on a map: faults of its landmarks, places that look alike, a grid of positions."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.acceptance.look_alikes import find_alike
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import counted, misspelt_classes
from cliploc_ros.offline.mapping import evidence
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.doubles import close_pairs, find_doubles
from cliploc_ros.offline.mapping.fitting import fit_landmarks
from cliploc_ros.offline.mapping.landmarks import Landmarks, classes_of, landmarks_of_map
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions
from cliploc_ros.offline.mapping.views import Views
from cliploc_ros.offline.vocabulary.vocabulary import shipped_classes, size_of_class

# A thinner landmark was seen from one side, or is a sheet: boxes hardly constrain its position.
_MIN_THINNESS = 0.05
# A landmark is missing if this number of frames should show it and none does.
_MIN_EXPECTED = 10
# A landmark is misplaced if its boxes put it farther away than all three limits. Chosen.
_MIN_OFFSET_M, _OFFSET_SHARE, _OFFSET_SIGMAS = 0.1, 0.3, 4.0
_MARGIN_M = 0.5
# Without a recording. Chosen.
_GUESSED_MARGIN_M = 1.5
_GUESSED_HEIGHT_M = 0.3   # above the median landmark
_GUESSED_PITCH_DEG = -10.0
# The outermost landmarks, this share on each side, do not widen the grid.
_OUTLYING = 0.03
# Positions within this distance of the recording's path are near it [m].
_NEAR_M = 1.0
#: A place is the area within this radius of a landmark [m].
RADIUS_M = 2.0
# Places that share fewer landmarks look alike by chance, and labels tell them
# apart. With the share of find_alike, which only proposes rivals of a pose, most offices and shops
# would be reported.
_LEAST_SHARE = 0.6


class Overlap(NamedTuple):
    """Two overlapping landmarks."""

    #: Rows in the map
    first: int
    second: int
    distance: float  #: Normalized, see cliploc_ros.core.geometry.ellipsoid.STANDS_IN
    #: They are the same object: frames do not show two objects. Landmarks without any box are
    #: duplicates if they have a class in common.
    is_duplicate: bool


@dataclass(frozen=True, kw_only=True)
class LandmarkCheck:
    """The findings on one landmark. Unknown values are None."""

    landmark_id: str
    label: str
    class_id: str
    center: tuple[float, float, float]  #: [m]
    #: Frames that show it, frames that should, and those of the latter that show it
    support: int | None = None
    expected: int | None = None
    seen: int | None = None
    seen_ratio: float | None = None  #: Share of the latter in which it was detected
    #: Greatest angle between two directions from which it was seen [deg]
    baseline_deg: float | None = None
    #: Standard deviation of its centre on the worst axis [m]
    position_sigma_m: float | None = None
    #: Distance from its centre to its position by the boxes [m]; None if they do not determine it
    offset_m: float | None = None
    median_iou: float | None = None  #: Of its boxes
    thinness: float  #: Least semi-axis divided by the greatest one
    #: Landmarks that overlap it, and their normalized distances
    overlaps: tuple[tuple[str, float], ...]
    faults: tuple[str, ...] = ()  #: The faults and what to do, the worst first
    severity: float = 0.0  #: 0: nothing; 1 and more: a serious fault


class Witness(NamedTuple):
    """The evidence that a recording gives on a map."""

    class_names: tuple[str, ...]  #: Of the recording
    landmarks: Landmarks  #: Of the map, with the recording's classes
    shown: NDArray[np.int64]  #: (n,): the landmark that each box shows, -1 for none
    gathered: evidence.Evidence
    #: (L,): frames that should show each landmark, including landmarks without a box
    expected: NDArray[np.int64]
    fitted: Landmarks  #: The landmarks fitted to the boxes that show them
    fitted_sigmas: NDArray[np.float64]  #: (L,): deviations of these centres [m]


def hear_witness(views: Views, landmark_map: LandmarkMap, class_names: tuple[str, ...]) -> Witness:
    """Return the evidence that a recording gives on a map."""
    landmarks = landmarks_of_map(landmark_map, class_names)
    shown = associate(views, landmarks)
    gathered = evidence.gather_evidence(views, landmarks, shown)
    # a landmark without a box may be hidden
    sight = evidence.look_for(views, landmarks, shown,
                              np.ones(len(landmarks.centers), dtype=np.bool_))
    expected = np.where(gathered.support == 0, sight.expected_frames, gathered.expected)
    fitted = fit_landmarks(views, landmarks, shown)
    return Witness(class_names, landmarks, shown, gathered, expected, fitted,
                   evidence.gather_evidence(views, fitted, shown).position_sigma)


def find_map_overlaps(landmark_map: LandmarkMap, witness: Witness | None, views: Views | None
                      ) -> list[Overlap]:
    """Return the overlapping landmarks of a map: duplicates first, then the nearest."""
    doubles, shown = set[tuple[int, int]](), np.empty(0, dtype=np.int64)
    if witness is not None and views is not None:
        shown, doubles = witness.shown, {*find_doubles(views, witness.landmarks, witness.shown)}
    is_shown = np.isin(np.arange(len(landmark_map)), shown)
    names = [{*classes_of(landmark_map, row)} for row in range(len(landmark_map))]
    found = [Overlap(first, second, distance, (first, second) in doubles
                     if is_shown[[first, second]].any() else bool(names[first] & names[second]))
             for first, second, distance in close_pairs(landmarks_of_map(landmark_map, ()))]
    return sorted(found, key=lambda overlap: (not overlap.is_duplicate, overlap.distance))


def check_landmarks(landmark_map: LandmarkMap, witness: Witness | None,
                    overlaps: list[Overlap]) -> list[LandmarkCheck]:
    """Return each landmark's check, the worst first; among equals, the least seen first.

    Without a recording, support comes from the map's own fields.
    """
    ids, classes = landmark_map.landmark_ids, landmark_map.class_ids
    partners: list[list[tuple[int, Overlap]]] = [[] for _ in ids]
    for overlap in overlaps:
        partners[overlap.first].append((overlap.second, overlap))
        partners[overlap.second].append((overlap.first, overlap))
    misspelt = (misspelt_classes(classes, shipped_classes()) if witness is None
                else misspelt_classes(classes, witness.class_names, all_known=True))
    checks = []
    for row, others in enumerate(partners):
        semi_axes = landmark_map.semi_axes[row]
        x, y, z = landmark_map.centers[row].tolist()
        check = LandmarkCheck(
            landmark_id=ids[row], label=landmark_map.labels[row], class_id=classes[row],
            center=(x, y, z), **_support(landmark_map, row, witness),
            thinness=float(semi_axes.min() / semi_axes.max()),
            overlaps=tuple((ids[other], overlap.distance) for other, overlap in others))
        faults = [(1.5, f'is the same object as {ids[other]}: delete one of them')
                  for other, overlap in others if overlap.is_duplicate]
        if hint := misspelt.get(classes[row]):
            faults.append((1.0, f"may have a misspelt class: '{classes[row]}'{hint}")
                          if witness is None else
                          (1.6, f"has the class '{classes[row]}', which the detector does not "
                                f'have{hint}: correct its class_id'))
        if MappingOptions().moves(classes[row]):
            faults.append((1.3, f'is a {classes[row]}, which moves: delete it'))
        if not faults:
            faults += _support_faults(check, float(np.linalg.norm(semi_axes)))
        faults += [(0.4, f'lies in {ids[other]} of class {classes[other]}: one object under two '
                         'classes, or one on the other; keep one if it is one object')
                   for other, overlap in others if witness is None and not overlap.is_duplicate]
        size, extent_m = size_of_class(classes[row]), 2.0 * float(semi_axes.max())
        if size is not None and extent_m > size.most_m:
            faults.append((1.2, f'is {extent_m:.2g} m long, and no {classes[row]} is longer than '
                                f'about {size.most_m:.2g} m: record it from more sides, or '
                                'delete it'))
        if check.thinness < _MIN_THINNESS:
            faults.append((0.3, f'is a sheet: its axes have the ratio {check.thinness:.3f}; '
                                'record it from another side, or give it thickness'))
        faults.sort(key=lambda fault: -fault[0])
        checks.append(replace(
            check, faults=tuple(text for _, text in faults),
            severity=faults[0][0] + 0.05 * (len(faults) - 1) if faults else 0.0))
    return sorted(checks, key=lambda check: (
        -check.severity, 1.0 if check.seen_ratio is None else check.seen_ratio))


def _support(landmark_map: LandmarkMap, row: int, witness: Witness | None) -> dict[str, Any]:
    """Return the support of a landmark by field, from a recording or from the map itself."""
    given = landmark_map.details[row] if landmark_map.details else LandmarkDetails()
    if witness is None:
        return {'support': given.support, 'seen_ratio': given.seen_ratio,
                'baseline_deg': given.baseline_deg, 'position_sigma_m': given.position_sigma}
    gathered, expected = witness.gathered, int(witness.expected[row])
    if gathered.support[row] == 0:
        return {'support': 0, 'expected': expected, 'seen': 0,
                'seen_ratio': 0.0 if expected else None}
    offset = float(np.linalg.norm(witness.fitted.centers[row] - witness.landmarks.centers[row]))
    is_told = offset > _OFFSET_SIGMAS * witness.fitted_sigmas[row] or offset < _MIN_OFFSET_M
    return {'support': int(gathered.support[row]), 'expected': expected,
            'seen': int(gathered.seen[row]), 'seen_ratio': float(gathered.seen_ratio[row]),
            'baseline_deg': float(gathered.baseline_deg[row]),
            # localization uses the map's own value
            'position_sigma_m': float(gathered.position_sigma[row])
            if given.position_sigma is None else given.position_sigma,
            'offset_m': offset if is_told else None,
            'median_iou': float(gathered.median_iou[row])}


def _support_faults(check: LandmarkCheck, size_m: float) -> list[tuple[float, str]]:
    """Return the faults of a landmark's support, each with its severity."""
    support, expected, ratio = check.support, check.expected, check.seen_ratio
    if support == 0:
        if expected is not None and expected < _MIN_EXPECTED:
            return [(0.5, f'was in view in {counted(expected, "frame")}: record this place')]
        return [(1.4, f'is never detected, although {expected} frames should show it: delete it '
                      'if it is gone, or map again')]
    faults = []
    if support is not None and support < MappingOptions.min_viewpoints:
        faults.append((1.1, f'was seen in {counted(support, "frame")}: record it from more sides'))
    if ratio is not None and ratio < MappingOptions.min_seen_ratio:
        faults.append((1.2, f'is detected in {ratio:.1%} of the frames that should show it: '
                            'delete it if it has moved, or is hard to detect'))
    iou, baseline, sigma = check.median_iou, check.baseline_deg, check.position_sigma_m
    if iou is not None and iou < evidence.MIN_MEDIAN_IOU:
        faults.append((1.2, f'does not fit its boxes (median IoU {iou:.2f}), as if it had moved '
                            'or were two objects: delete it or map again'))
    if baseline is not None and baseline < MappingOptions.min_baseline_deg:
        faults.append((0.7, f'was seen from one side only, {baseline:.0f} degrees wide: record it '
                            'from another side'))
    if (offset := check.offset_m) is not None and offset > max(
            _MIN_OFFSET_M, _OFFSET_SHARE * size_m, _OFFSET_SIGMAS * (sigma or 0.0)):
        faults.append((1.1, f'is {offset * 100:.0f} cm away from where its boxes put it: delete '
                            'it or map again'))
    if sigma is not None and sigma > max(MappingOptions.max_position_sigma_m,
                                         evidence.MAX_SIGMA_SHARE * size_m):
        faults.append((0.7, f'may be {sigma * 100:.0f} cm off (standard deviation): record it '
                            'from more sides'))
    return faults


@dataclass(frozen=True)
class Grid:
    """P positions with H headings each."""

    positions: NDArray[np.float64]  #: (P, 3): [m]
    is_near: NDArray[np.bool_]  #: (P,): near the path of the recording, if there is one
    #: (P * H, 4, 4): map_from_camera, heading by heading of each position
    poses: NDArray[np.float64]
    spacing_m: float


def make_grid(landmark_map: LandmarkMap, recorded: NDArray[np.float64] | None,
              options: CheckOptions) -> Grid:
    """Return the grid of camera positions for a map.

    Parameters
    ----------
    recorded : ndarray (F, 4, 4), optional
        Poses map_from_camera of a recording, or of keyframes, which determine height, pitch and
        extent.
    """
    centers = landmark_map.centers if len(landmark_map) or recorded is None else (
        recorded[:, :3, 3])
    low, high = np.quantile(centers, [_OUTLYING, 1.0 - _OUTLYING], axis=0)
    if recorded is None:
        margin, pitch_deg = _GUESSED_MARGIN_M, _GUESSED_PITCH_DEG
        height = float(np.median(centers[:, 2])) + _GUESSED_HEIGHT_M
        path = None
    else:
        path = recorded[:, :3, 3]
        low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
        margin, height = _MARGIN_M, float(np.median(path[:, 2]))
        pitch_deg = float(np.degrees(np.arcsin(np.clip(np.median(recorded[:, 2, 2]), -1, 1))))
    if options.camera_height_m is not None:
        height = options.camera_height_m
    low, high, spacing = low[:2] - margin, high[:2] + margin, options.spacing_m
    while (counts := np.maximum(1, np.ceil((high - low) / spacing)).astype(int)
           ).prod() > options.max_positions:
        spacing *= 1.1
    first = (low + high) / 2 - spacing * (counts - 1) / 2
    x, y = (first[axis] + spacing * np.arange(counts[axis]) for axis in (0, 1))
    positions = np.stack([column.ravel() for column in np.meshgrid(x, y, height, indexing='ij')],
                         axis=1)
    # positions inside a landmark are left out
    inside = np.zeros(len(positions), dtype=np.bool_)
    for center, basis in zip(landmark_map.centers, landmarks_of_map(landmark_map, ()).bases,
                             strict=True):
        inside |= np.linalg.norm(np.linalg.solve(basis, (positions - center).T), axis=0) < 1.0
    positions = positions[~inside]
    near = np.ones(len(positions), dtype=np.bool_)
    if path is not None:
        near = cKDTree(path[:, :2]).query(positions[:, :2])[0] <= max(_NEAR_M, spacing)
    # a level camera has its x axis to the right and its z axis forward
    headings = 2.0 * np.pi * np.arange(options.headings) / options.headings
    cosine, sine, pitch = np.cos(headings), np.sin(headings), np.radians(pitch_deg)
    forward = np.stack([cosine * np.cos(pitch), sine * np.cos(pitch),
                        np.full(len(headings), np.sin(pitch))], axis=1)
    right = np.stack([sine, -cosine, np.zeros(len(headings))], axis=1)
    poses = np.tile(np.eye(4), (len(positions), len(headings), 1, 1))
    poses[:, :, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=2)
    poses[:, :, :3, 3] = positions[:, None]
    return Grid(positions, near, poses.reshape(-1, 4, 4), spacing)


@dataclass(frozen=True)
class LookAlike:
    """A pair of places that look alike."""

    #: The middles of the places [m]
    first: tuple[float, float, float]
    second: tuple[float, float, float]
    #: Pairs of a landmark of the first place and the landmark of the second that it looks like
    matched: tuple[tuple[str, str], ...]
    landmarks: int  #: Number of landmarks of the first place
    share: float  #: Share of these that are matched, 0 to 1
    same_labels: int  #: Number of pairs with equal labels, which no crop tells apart
    turn_deg: float  #: Rotation about the vertical, from the first place to the second [deg]


def find_look_alikes(landmark_map: LandmarkMap) -> list[LookAlike]:
    """Return the pairs of places that look alike, the most alike first.

    A place that looks the same after a rotation by more than 45 degrees counts as well.
    """
    ids, labels = landmark_map.landmark_ids, landmark_map.labels
    found: list[LookAlike] = []
    left = np.ones(len(landmark_map), dtype=np.bool_)
    for row, position in enumerate(landmark_map.centers):
        if not left[row]:
            continue
        left[landmark_map.tree.query_ball_point(position, RADIUS_M)] = False
        alike = find_alike(landmark_map, position)
        for move, others, matched in zip(alike.moves, alike.others, alike.found, strict=True):
            if matched.mean() < _LEAST_SHARE:
                continue
            pairs = list(zip(alike.landmarks[matched].tolist(), others[matched].tolist(),
                             strict=True))
            found.append(LookAlike(
                tuple(position.tolist()), tuple((move[:3, :3] @ position + move[:3, 3]).tolist()),
                tuple((ids[first], ids[second]) for first, second in pairs), len(alike.landmarks),
                float(matched.mean()),
                sum(labels[first] == labels[second] for first, second in pairs),
                float(np.degrees(np.arctan2(move[1, 0], move[0, 0])))))
    kept: list[LookAlike] = []
    for pair in sorted(found, key=lambda pair: (-len(pair.matched) * pair.share, -pair.share)):
        if not any((_near(pair.first, other.first) and _near(pair.second, other.second))
                   or (_near(pair.first, other.second) and _near(pair.second, other.first))
                   for other in kept):
            kept.append(pair)
    return kept


def _near(first: tuple[float, float, float], second: tuple[float, float, float]) -> bool:
    return float(np.hypot(first[0] - second[0], first[1] - second[1])) < RADIUS_M
