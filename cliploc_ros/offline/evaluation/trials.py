# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make queries, also with simulated sensors, and run methods on them: poses and their errors."""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.joined_map import place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import DatasetError, OptionsError
from cliploc_ros.offline.datasets.agreement import w_first
from cliploc_ros.offline.datasets.observations import Queries
from cliploc_ros.offline.datasets.poses import TimedPoses, check_clock
from cliploc_ros.offline.datasets.tum import read_tum_trajectory
from cliploc_ros.offline.evaluation.methods import ALL, AUTO, PAPER_METHODS, Method
from cliploc_ros.offline.posed_query import PosedQuery, ask
from cliploc_ros.units import NS_PER_S

#: Result.source of a pose that another program found.
GIVEN = 'given'
#: Greatest difference in time between a query and its given pose [ms]: evo's default.
GIVEN_TOLERANCE_MS = 10
# Given poses with higher median errors [m] [deg] do not fit the truth, and a transform that fits
# must divide these errors. At least and at most this many poses are compared. Chosen.
_FITS, _BETTER, _LEAST_GIVEN, _COMPARED = (0.25, 5.0), 3.0, 4, 100
# Relative difference of units that is named. Chosen.
_OTHER_UNIT = 0.05


@dataclass(frozen=True)
class Result:
    """The result of one search."""

    method: str
    trial: int  #: Number of the trial, from 0, which is added to the seed of the run
    query: int  #: Number of the frame in its query file
    timestamp: float  #: Timestamp of the image [s]
    boxes: int  #: Number of detections
    #: Whether a pose was found, and whether it was accepted
    solved: bool
    accepted: bool
    map_from_camera: list[list[float]] | None  #: The best pose; None if none was found
    #: Error of the best pose; None if none was found
    error_m: float | None
    error_deg: float | None
    score: float = 0.0  #: Sum of the IoUs of its inliers
    confidence: float = 0.0  #: Probability that it is within 1 m, according to the relocalizer
    nees: float | None = None  #: Squared error in its own covariance, see normalized_square
    inliers: int = 0
    hypotheses: int = 0  #: Number of hypotheses tried
    best_iteration: int = 0  #: Iteration that found the best pose, from 1
    coverage: float = 1.0  #: Share of all samples that the search tried
    reason: str = ''  #: Reason of the refusal; empty when accepted
    search_ms: float = 0.0  #: Time of the search of objects. Only times differ from run to run.
    crops_share: float = 1.0  #: Share of the query's crops that were compared with labels
    #: Name of the map that the pose belongs to, where there are several. The pose is in the
    #: coordinates of the first map, far away if it belongs to another map. Empty for a single map.
    map: str = ''
    refusal_kind: str = ''  #: See cliploc_ros.core.acceptance.verdict; empty when accepted
    #: Source of the pose: 'objects', 'keyframes' or 'both'; empty if none was found. GIVEN for all
    #: results of another program
    source: str = ''
    #: Points of keyframes that agree on the pose of the keyframes, whatever the source
    keyframe_inliers: int = 0
    keyframes_ms: float = 0.0  #: Time of features, matching and the pose from them [ms]
    keyframe_search: str = 'none'  #: The last pass over keyframes: 'none', 'fast' or 'thorough'


def make_queries(queries: Queries, landmark_map: LandmarkMap, every_frame: bool = False
                 ) -> tuple[PosedQuery, ...]:
    """Return the queries of a file, with similarities in the map's order.

    With `every_frame`, neighbouring frames are queries, too. DatasetError: the queries were
    recorded with another map.
    """
    column = {landmark_id: number for number, landmark_id in enumerate(queries.landmark_ids)}
    if others := sorted(column.keys() ^ set(landmark_map.landmark_ids)):
        more = f' and {len(others) - 1} more' if others[1:] else ''
        raise DatasetError('the queries were recorded with another map: only one of both has the '
                           f"landmark '{others[0]}'{more}")
    columns = [column[landmark_id] for landmark_id in landmark_map.landmark_ids]
    return tuple(replace(query, observation=replace(
        query.observation, similarities=np.ascontiguousarray(
            np.asarray(query.observation.similarities, dtype=np.float32)[:, columns])))
        for query in queries.frames if every_frame or query.is_main)


def join_cameras(queries: Mapping[str, Sequence[PosedQuery]], tolerance_s: float
                 ) -> tuple[PosedQuery, ...]:
    """Return the queries of the first camera, each with the other cameras' frames of its instant.

    The mounts of the cameras follow from the true poses. DatasetError: no image of another camera
    is within the tolerance of an image of the first camera.
    """
    (first, main), *others = queries.items()
    stamps = {name: np.array([query.observation.stamp_ns for query in its])
              for name, its in others}
    found = []
    for query in main:
        stamp_ns, beside = query.observation.stamp_ns, []
        for name, its in others:
            near = np.abs(stamps[name] - stamp_ns)
            if len(near) and near.min() <= tolerance_s * NS_PER_S:
                nearest = its[int(near.argmin())]
                beside.append(replace(nearest.observation, camera_name=name, stamp_ns=stamp_ns,
                                      odom_from_camera=nearest.map_from_camera))
        found.append(replace(query, neighbours=tuple(beside), observation=replace(
            query.observation, camera_name=first, odom_from_camera=query.map_from_camera)))
    if not any(query.neighbours for query in found):
        raise DatasetError(f'no image of {", ".join(name for name, _ in others)} is within '
                           f'{tolerance_s:g} s of an image of {first}')
    return tuple(found)


def run_trial(landmark_map: LandmarkMap, method: Method, trial: int, queries: Sequence[PosedQuery],
              keyframes: KeyframeLocalizer | None = None) -> list[Result]:
    """Run one trial of a method, numbered from 0, on some queries; return results by stamp.

    One localizer gets all queries in the order of their stamps, as on a robot, so that evidence
    about cameras and depth accumulates. For the paper's methods, each query gets a new localizer:
    its searches are independent.

    `keyframes` localizes in the keyframes of the map, if the method uses them and the query has
    an image.
    """
    relocalizer = Relocalizer(landmark_map, replace(
        method.options, random_seed=method.options.random_seed + trial))
    layer = keyframes if method.keyframes else None
    localizer, results = Localizer(relocalizer, layer), []
    for query in sorted(queries, key=lambda query: query.observation.stamp_ns):
        if not method.accumulates:
            localizer = Localizer(relocalizer, layer)
        results.append(_result(localizer, landmark_map, method, trial, query))
    return results


def read_given_poses(words: Iterable[str], methods: Iterable[Method]) -> dict[str, TimedPoses]:
    """Read the poses of other programs, which are given as NAME=FILE; return them by name.

    OptionsError: a word has another form, or a method has the same name. DatasetError: a file is
    not a trajectory in TUM format.
    """
    taken = {*PAPER_METHODS, AUTO, ALL, *(method.name for method in methods)}
    found: dict[str, TimedPoses] = {}
    for word in words:
        name, _, file = word.partition('=')
        if not name or not file or '@' in name or '/' in name:
            raise OptionsError(f"`poses` {word}: expected NAME=FILE, and no '@' or '/' in NAME")
        if name in taken or name in found:
            raise OptionsError(f"`poses` {word}: another method is called '{name}'")
        found[name] = read_tum_trajectory(file)
    return found


def given_results(name: str, poses: TimedPoses, queries: Sequence[PosedQuery]) -> list[Result]:
    """Return a result for each query from the poses of another program.

    The poses are those of the camera in the map. Each query gets the pose that is nearest in time,
    within GIVEN_TOLERANCE_MS.
    DatasetError: the time span of the poses does not overlap that of the queries.
    """
    stamps_ns = [query.observation.stamp_ns for query in queries]
    tolerance_ns = GIVEN_TOLERANCE_MS * 1_000_000
    check_clock(poses, min(stamps_ns) - tolerance_ns, max(stamps_ns) + tolerance_ns,
                f'poses of {name}')
    results = []
    for query, stamp_ns in zip(queries, stamps_ns, strict=True):
        gaps_ns = np.abs(poses.stamps_ns - stamp_ns)
        row = int(gaps_ns.argmin())
        pose = (transforms.transform_from_pose(poses.positions_xyz[row], poses.quats_xyzw[row])
                if gaps_ns[row] <= tolerance_ns else None)
        results.append(Result(
            name, 0, query.number, stamp_ns / NS_PER_S, len(query.observation.detections),
            solved=pose is not None, accepted=False, source=GIVEN, **_error(pose, query)))
    return results


def find_misfit(results: Sequence[Result], queries: Sequence[PosedQuery], timed: TimedPoses
                ) -> str:
    """Return a note if poses of another program are wrong, but fit after one transform; else ''.

    Quaternions may be w first, poses inverse, in another unit, or those of another body or in
    another coordinate frame.
    """
    pairs = [(result.map_from_camera, query.map_from_camera)
             for result, query in zip(results, queries, strict=True) if result.solved]
    pairs = pairs[::-(-len(pairs) // _COMPARED) or 1]
    if len(pairs) < _LEAST_GIVEN:
        return _late(results, timed)
    given, truth = np.array(pairs).transpose(1, 0, 2, 3)

    def errors_of(poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the median errors (k, 2) of poses (k, n, 4, 4), in units of _FITS."""
        cosines = (poses[..., :3, :3] * truth[:, :3, :3]).sum(axis=(-1, -2)) / 2 - 0.5
        return np.median([np.linalg.norm((poses - truth)[..., :3, 3], axis=-1),
                          np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))], axis=-1).T / _FITS

    before = errors_of(given[None]).max()
    # any transform fits poses of one place
    moving = min(before, errors_of(truth[:, None]).max(axis=1).min())
    readings = {'': given, 'quaternions are w first (add this first line to the file: # timestamp '
                'tx ty tz qw qx qy qz)': np.array([*map(w_first, given)]),
                'poses are inverse (map in camera)': np.linalg.inv(given)}
    spreads = [np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))
               for places in (truth[:, :3, 3], given[:, :3, 3])]
    unit_m = spreads[0] / max(spreads[1], 1e-9)
    if abs(unit_m - 1.0) > _OTHER_UNIT:
        scaled = given.copy()
        scaled[:, :3, 3] *= unit_m
        readings[f'their unit is {unit_m:.4g} m'] = scaled
    candidates: list[tuple[str, str, NDArray[np.float64], NDArray[np.float64]]] = []
    for reading, poses in readings.items():
        inverse = np.linalg.inv(poses)
        left, right = truth @ inverse, inverse @ truth
        candidates += [('', reading, np.eye(4)[None], poses[None]),
                       ('map from their frame', reading, left, left[:, None] @ poses),
                       ('their body from camera', reading, right, poses @ right[:, None])]
    # a reading that fits alone needs no transform
    for name, reading, moves, moved in sorted(candidates, key=lambda one: bool(one[0])):
        errors = errors_of(moved).max(axis=1)
        if before > 1.0 and errors.min() < min(1.0, (moving if name else before) / _BETTER):
            move = moves[errors.argmin()]
            numbers = [*move[:3, 3], *transforms.quaternion_from_transform(move)]
            transform = name and f'{name} x y z qx qy qz qw ' + ' '.join(
                f'{each:.4f}' for each in numbers)
            misread = ', '.join(filter(None, (reading, transform)))
            return (f'note: {results[0].method}: poses would fit after one transform (not '
                    f'applied): {misread}; give poses of the camera (z forward) in the map, '
                    'x y z qx qy qz qw')
    return ''


def _late(results: Sequence[Result], poses: TimedPoses) -> str:
    """Return a note if all stamps of poses are off those of the results alike; else ''."""
    offsets_ms = []
    for result in results:
        gaps_ms = poses.stamps_ns / 1e6 - 1e3 * result.timestamp
        offsets_ms.append(gaps_ms[np.abs(gaps_ms).argmin()])
    median_ms = float(np.median(offsets_ms))
    spread_ms = float(np.median(np.abs(np.array(offsets_ms) - median_ms)))
    return '' if abs(median_ms) <= GIVEN_TOLERANCE_MS or spread_ms > GIVEN_TOLERANCE_MS else (
        f'note: {results[0].method}: its stamps are {median_ms:+.0f} ms off those of the queries: '
        'correct them')


def _error(pose: NDArray[np.float64] | None, query: PosedQuery) -> dict[str, Any]:
    """Return the pose and the errors of a result by their fields; None without a pose."""
    if pose is None:
        return dict.fromkeys(('map_from_camera', 'error_m', 'error_deg'))
    error_m, error_deg = transforms.pose_error(pose, query.map_from_camera)
    return {'map_from_camera': pose.tolist(), 'error_m': float(error_m),
            'error_deg': float(error_deg)}


def _result(localizer: Localizer, landmark_map: LandmarkMap, method: Method, trial: int,
            query: PosedQuery) -> Result:
    """Ask a localizer about a query, and judge its answer."""
    stages_s = list[float]()  # starts of keyframes, then search, alternately
    found = ask(localizer, query, lambda stage: stages_s.append(time.perf_counter()))
    keyframes_ms = 1e3 * (sum(stages_s[1::2]) - sum(stages_s[::2]))
    pose = found.map_from_camera
    assert localizer.query is not None
    rows = np.concatenate([frame.similarity_rows for frame in localizer.query.frames])
    return Result(
        method=method.name, trial=trial, query=query.number,
        timestamp=float(query.observation.stamp_ns) / NS_PER_S,
        boxes=len(query.observation.detections),
        solved=found.solved, accepted=found.accepted, **_error(pose, query),
        score=float(found.score), confidence=float(found.confidence),
        nees=None if pose is None or found.covariance is None
        else normalized_square(pose, found.covariance, query.map_from_camera),
        inliers=len(found.matches), hypotheses=int(found.tried),
        best_iteration=int(found.best_iteration), coverage=float(found.coverage),
        reason=found.reason, search_ms=float(found.search_ms) - keyframes_ms,
        crops_share=float(method.options.needs_similarities
                          and (rows >= 0).sum() / max(1, len(rows))),
        map='' if pose is None else place_of(landmark_map, pose).name,
        refusal_kind=found.refusal_kind or '',
        source='' if pose is None else found.source,
        keyframe_inliers=0 if found.recognized is None else found.recognized.inliers,
        keyframes_ms=keyframes_ms, keyframe_search=found.keyframe_search)


def with_vertical(queries: Sequence[PosedQuery], noise_deg: float = 0.0, seed: int = 0
                  ) -> tuple[PosedQuery, ...]:
    """Return queries with a known vertical, as an accelerometer measures it.

    Parameters
    ----------
    noise_deg : float
        Standard deviation of the error of each vertical [deg]: a rotation about a random
        horizontal axis.
    seed : int
        Equal seeds give equal noise, whatever the order of the queries.
    """
    found = []
    for query in queries:
        rng = np.random.default_rng([seed, query.number])
        up = turned(query.map_from_camera[2, :3], np.radians(noise_deg) * rng.normal(), rng)
        own = query.observation.odom_from_camera
        # the other cameras of a robot know the same vertical
        neighbours = tuple(
            seen if own is None or seen.odom_from_camera is None else replace(
                seen, up_in_camera=seen.odom_from_camera[:3, :3].T @ own[:3, :3] @ up)
            for seen in query.neighbours)
        found.append(replace(query, neighbours=neighbours, observation=replace(
            query.observation, up_in_camera=up)))
    return tuple(found)


def with_neighbours(queries: Sequence[PosedQuery], groups: Sequence[int], noise_m: float = 0.0,
                    noise_deg: float = 0.0, seed: int = 0) -> tuple[PosedQuery, ...]:
    """Return queries with the other frames of their group, linked by odometry.

    Parameters
    ----------
    queries : sequence of PosedQuery
        All frames.
    groups : sequence of int
        The group of each frame.
    noise_m, noise_deg : float
        Standard deviations of the error of odometry from each frame to the next, on each axis.
    seed : int
        Equal seeds give equal noise.

    Raises
    ------
    OptionsError
        No group has a second frame.
    """
    found: dict[int, PosedQuery] = {}
    for group in dict.fromkeys(groups):
        frames = sorted(
            (query for query, its in zip(queries, groups, strict=True) if its == group),
            key=lambda query: query.observation.stamp_ns)
        rng = np.random.default_rng([seed, abs(group), 1])
        joined = [replace(frame.observation, odom_from_camera=pose) for frame, pose in zip(
            frames, _odometry(frames, noise_m, noise_deg, rng), strict=True)]
        for row, query in enumerate(frames):
            near = sorted(range(len(frames)), key=lambda other: abs(other - row))[1:MAX_FRAMES]
            found[query.number] = replace(query, observation=joined[row], neighbours=tuple(
                joined[other] for other in sorted(near)))
    if not any(query.neighbours for query in found.values()):
        raise OptionsError('no query of this input has neighbouring frames in its group to fuse')
    return tuple(found[query.number] for query in queries)


def _odometry(frames: Sequence[PosedQuery], noise_m: float, noise_deg: float,
              rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Return odom_from_camera (4, 4) of each frame, with a random error in each step."""
    poses = [np.eye(4)]
    for before, after in pairwise(frames):
        step = transforms.invert_transform(before.map_from_camera) @ after.map_from_camera
        turn = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=3)).as_matrix()
        shift = noise_m * rng.normal(size=3)
        poses.append(poses[-1] @ step @ transforms.make_transform(turn, shift))
    return poses


def turned(direction: NDArray[np.float64], angle: float, rng: np.random.Generator
            ) -> NDArray[np.float64]:
    """Return a direction (3,) rotated by an angle [rad] about a random perpendicular axis."""
    axis = np.cross(direction, rng.normal(size=3))
    return np.asarray(Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).apply(direction))
