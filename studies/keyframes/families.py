# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cases: what happens to queries, map and layer, and where each query then is in the map."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.datasets.frames import RawFrame
from studies.keyframes.changes import (
    IMAGE_CHANGES,
    PICTURES,
    Image,
    World,
    hang,
    mirrored_map,
    moved_half,
    twin,
)
from studies.keyframes.sites import Place, Raws

# A picture shows a place that looks another way; a second look is about 20 cm from the first.
_AWAY_COS = 0.5
_SECOND_M, _SECOND_RANGE_M, _SECOND_DEG = 0.2, (0.1, 0.35), 25.0
_SHARES = (15, 30, 60)
# How much of the second room's keyframes a layer has, and which room the robot is in.
_TWIN_LAYERS = {'full': 1.0, 'three quarters': 0.75, 'half': 0.5, 'a quarter': 0.25, 'none': 0.0}
_TWIN_ROOMS = {'first': 0, 'second': 1}

Pose = NDArray[np.float64]


class Shot(NamedTuple):
    """An image as the robot gets it.

    Parameters
    ----------
    image_rgb : ndarray (h, w, 3)
    camera : Camera
        As the robot believes it.
    odom_from_camera, up_in_camera : ndarray (4, 4), (3,), optional
    most_features : int
    classes : numpy.random.Generator, optional
        Draws the class of each box anew.
    """

    image_rgb: Image
    camera: Camera
    odom_from_camera: Pose | None = None
    up_in_camera: NDArray[np.float64] | None = None
    most_features: int = 2000
    classes: np.random.Generator | None = None


class Query(NamedTuple):
    """Looks of one robot, the oldest first, and its true poses at the last one.

    Parameters
    ----------
    shots : tuple of Shot
    truths : tuple of ndarray (4, 4)
        The first one counts; the second one is another that may be meant. None: it is not in the
        map, and every accepted pose is false.
    height_range_m : tuple of float, optional
        Where the robot is said to be.
    """

    shots: tuple[Shot, ...]
    truths: tuple[Pose, ...]
    height_range_m: tuple[float, float] | None = None


class Scene(NamedTuple):
    """A mapped place, the shift of its world, and places of other sites."""

    place: Place
    shift_m: NDArray[np.float64]
    others: tuple[Place, ...]

    def strange(self, rng: np.random.Generator) -> tuple[RawFrame, Place]:
        """Return an image of another site."""
        other = self.others[int(rng.integers(len(self.others)))]
        return other.asked[int(rng.integers(len(other.asked)))], other

    def elsewhere(self, frame: RawFrame, rng: np.random.Generator) -> RawFrame:
        """Return a mapped image that looks another way, by more than 60 degrees or the most."""
        axes = np.array([_pose(one)[:3, 2] for one in self.place.mapped])
        cosines = axes @ _pose(frame)[:3, 2]
        away = np.nonzero(cosines < _AWAY_COS)[0]
        return self.place.mapped[int(rng.choice(away)) if len(away) else int(np.argmin(cosines))]


#: Makes a query of a frame; None where there is none.
MakeQuery = Callable[[Scene, RawFrame, np.random.Generator], Query | None]


class Case(NamedTuple):
    """How queries are made, and what becomes of the world before."""

    query: MakeQuery
    world: Callable[[World, np.random.Generator], World] | None = None


def cases() -> dict[str, Case]:
    """Return all cases by name, ``FAMILY: CASE``."""
    found = {'plain: one image': Case(_plain), 'pair: two images': Case(_pair)}
    for name in IMAGE_CHANGES:
        found[f'image: {name}'] = Case(partial(_changed, name))
    for kind in PICTURES:
        for share in _SHARES:
            for family, looks, is_strange in (
                    ('picture', 1, False), ('picture elsewhere', 1, True),
                    ('picture pair', 2, False), ('picture pair elsewhere', 2, True)):
                found[f'{family}: {kind}, {share} %'] = Case(
                    partial(_with_picture, kind, share / 100, looks, is_strange))
    found['mirror: image'] = Case(_mirrored)
    found['mirror: landmarks'] = Case(_plain, mirrored_map)
    for metres in (0.6, 1.0, 1.5, 2.0):
        found[f'moved half: {metres} m'] = Case(_of_either_half, moved_half(metres))
    for layer, which, removed in product(_TWIN_LAYERS, _TWIN_ROOMS, (0, 3)):
        found[f'twins, layer {layer}: {which} room, {removed} objects less'] = Case(
            partial(_in_room, _TWIN_ROOMS[which]), twin(_TWIN_LAYERS[layer], removed))
    for factor in (0.5, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 2.0):
        found[f'intrinsics: K times {factor}'] = Case(partial(_with_focal_length, factor))
    found['other room: image'] = Case(_from_elsewhere)
    found['classes: shuffled'] = Case(_with_drawn_classes)
    found['features: 500'] = Case(_with_few_features)
    found['prior: height outside'] = Case(_above)
    found['prior: vertical outside'] = Case(_tilted)
    return found


def _pose(frame: RawFrame) -> Pose:
    assert frame.map_from_camera is not None
    return frame.map_from_camera


def _shot(frame: RawFrame) -> Shot:
    return Shot(*frame.color())


def _plain(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    return Query((_shot(frame),), (_pose(frame),))


def _changed(name: str, scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    image, camera = frame.color()
    other = scene.strange(rng)[0].color()[0] if 'occluder' in name else image
    return Query((Shot(IMAGE_CHANGES[name](image, other, rng), camera),), (_pose(frame),))


def _pair(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query | None:
    frames = _second_look(frame, scene.place.seconds)
    return None if frames is None else _linked(
        [_shot(one) for one in frames], [_pose(one) for one in frames], rng)


def _second_look(frame: RawFrame, others: Raws) -> tuple[RawFrame, RawFrame] | None:
    """Return a frame and the one whose distance is nearest to 20 cm; None where none is near."""
    found = [(abs(distance - _SECOND_M), row) for row, other in enumerate(others)
             for distance, angle in [pose_error(_pose(frame), _pose(other))]
             if _SECOND_RANGE_M[0] <= distance <= _SECOND_RANGE_M[1] and angle < _SECOND_DEG]
    return (frame, others[min(found)[1]]) if found else None


def _linked(shots: list[Shot], poses: list[Pose], rng: np.random.Generator) -> Query:
    """Return looks that odometry links, with the error that the package expects of it."""
    odom = [np.eye(4)]
    for before, after in pairwise(poses):
        step = invert_transform(before) @ after
        error = odometry_deviations(step) * rng.normal(size=6)
        odom.append(odom[-1] @ step @ make_transform(
            Rotation.from_rotvec(error[3:]).as_matrix(), error[:3]))
    return Query(tuple(shot._replace(odom_from_camera=pose)
                       for shot, pose in zip(shots, odom, strict=True)), (poses[-1],))


def _with_picture(kind: str, share: float, looks: int, is_strange: bool, scene: Scene,
                  frame: RawFrame, rng: np.random.Generator) -> Query | None:
    """Hang a picture of the mapped place into an image of it, or of another site."""
    seconds, source = scene.place.seconds, scene.elsewhere(frame, rng)
    if is_strange:
        frame, other = scene.strange(rng)
        seconds = other.seconds
    frames = (frame,) if looks == 1 else _second_look(frame, seconds)
    if frames is None:
        return None
    image, camera = source.color()
    first = invert_transform(_pose(frame))
    picture = PICTURES[kind](frame.color()[1], image, camera, share, rng)
    shots = [shot._replace(image_rgb=hang(shot.image_rgb, picture, shot.camera,
                                          first @ _pose(one)))
             for one in frames for shot in [_shot(one)]]
    query = _linked(shots, [_pose(one) for one in frames], rng) if looks > 1 \
        else Query(tuple(shots), (_pose(frame),))
    return query._replace(truths=()) if is_strange else query


def _mirrored(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    image, camera = frame.color()
    return Query((Shot(np.ascontiguousarray(image[:, ::-1]), camera),), (_pose(frame),))


def _moved(pose: Pose, shift_m: NDArray[np.float64]) -> Pose:
    return make_transform(pose[:3, :3], pose[:3, 3] + shift_m)


def _of_either_half(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    """Return a query that is where the half that stayed says; or, where the other one says."""
    return Query((_shot(frame),), (_pose(frame), _moved(_pose(frame), scene.shift_m)))


def _in_room(room: int, scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    return Query((_shot(frame),), (_moved(_pose(frame), room * scene.shift_m),))


def _with_focal_length(factor: float, scene: Scene, frame: RawFrame, rng: np.random.Generator
                       ) -> Query:
    image, camera = frame.color()
    return Query((Shot(image, replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)),),
                 (_pose(frame),))


def _from_elsewhere(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    return Query((_shot(scene.strange(rng)[0]),), ())


def _with_drawn_classes(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    return Query((_shot(frame)._replace(classes=rng),), (_pose(frame),))


def _with_few_features(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    return Query((_shot(frame)._replace(most_features=500),), (_pose(frame),))


def _above(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    """Return a robot that is said to be 1 to 3 m above where it is."""
    height = float(_pose(frame)[2, 3])
    return Query((_shot(frame),), (_pose(frame),), (height + 1.0, height + 3.0))


def _tilted(scene: Scene, frame: RawFrame, rng: np.random.Generator) -> Query:
    """Return a robot whose vertical is wrong by 30 degrees."""
    up = _pose(frame)[2, :3]
    axis = np.cross(up, rng.normal(size=3))
    turn = Rotation.from_rotvec(np.radians(30.0) * axis / np.linalg.norm(axis))
    return Query((_shot(frame)._replace(up_in_camera=turn.apply(up)),), (_pose(frame),))
