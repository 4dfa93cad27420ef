# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Furnish a room with shelves and tables, and place objects on them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from demo.world.appearance import CLASSES, Appearance, draw_appearance, draw_lookalike
from demo.world.meshes import Mesh, box, join, make_object

LENGTH_M, WIDTH_M, HEIGHT_M = 6.0, 5.0, 2.7
_SLOT_M = 0.31
#: Scale of an ellipsoid inscribed in an object's box, which looks too small from the corners.
_ELLIPSOID_SCALE = 1.1


@dataclass(frozen=True)
class Slot:
    """A place for an object: a point on a board [m], and the yaw of its front [rad]."""

    position: tuple[float, float, float]
    yaw: float


@dataclass(frozen=True)
class WorldObject:
    """An object at a place."""

    name: str  #: Landmark id
    look: Appearance  #: Its look
    slot: Slot  #: Its place
    in_map: bool = True  #: Whether the map contains it
    moved: bool = False  #: Whether it was moved after mapping

    @property
    def map_from_object(self) -> npt.NDArray[np.float64]:
        """Transform, shape (4, 4), [m]."""
        transform = np.eye(4)
        transform[:3, :3] = Rotation.from_euler('z', self.slot.yaw).as_matrix()
        transform[:3, 3] = self.slot.position
        return transform

    def landmark(self) -> dict[str, Any]:
        """Return its entry in a map file: ellipsoid, label and class."""
        mesh = join(*(part for part, _ in make_object(self.look)))
        middle = (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2
        pose = self.map_from_object
        return {
            'label': self.look.label,
            'class_id': self.look.class_id,
            'center': (pose[:3, :3] @ middle + pose[:3, 3]).tolist(),
            'semi_axes': (mesh.half_extents * _ELLIPSOID_SCALE).tolist(),
            'orientation': Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(),
        }


@dataclass(frozen=True)
class Room:
    """A room with its furniture and objects."""

    seed: int  #: Seed of its surfaces
    furniture: tuple[tuple[Mesh, str], ...]  #: Each piece in map coordinates [m], and its surface
    objects: tuple[WorldObject, ...]  #: The objects


def make_room(seed: int, counts: Mapping[str, int] | None = None, unknown: int = 4) -> Room:
    """Furnish a room.

    Parameters
    ----------
    seed : int
        Equal seeds give equal rooms.
    counts : mapping of str to int, optional
        Number of objects by class; by default 7 or 8 of each.
    unknown : int
        Number of objects that are not in the map.

    Returns
    -------
    Room
    """
    rng = np.random.default_rng(seed)
    furniture, slots = _furnish(rng)
    if counts is None:
        counts = {class_id: 7 + int(rng.random() < 0.5) for class_id in CLASSES}
    looks = [look for class_id, count in counts.items()
             for look in _draw_looks(class_id, count, rng)]
    if len(looks) > len(slots):
        raise ValueError(f'{len(looks)} objects do not fit into {len(slots)} places')
    chosen = rng.permutation(len(slots))[:len(looks)]
    unmapped = set(rng.permutation(len(looks))[:unknown])
    numbers = dict.fromkeys(CLASSES, 0)
    objects = []
    for i, (look, place) in enumerate(zip(looks, chosen, strict=True)):
        numbers[look.class_id] += 1
        slot = slots[place]
        x, y, z = slot.position
        dx, dy = rng.uniform(-0.025, 0.025, 2)
        jitter = Slot((x + dx, y + dy, z), slot.yaw + rng.uniform(-0.5, 0.5))
        objects.append(WorldObject(f'{look.class_id}_{numbers[look.class_id]}', look,
                                   jitter, i not in unmapped))
    return Room(seed, furniture, tuple(objects))


def find_places(seed: int) -> list[Slot]:
    """Return all places for objects in the room of a seed."""
    return _furnish(np.random.default_rng(seed))[1]


def move_objects(room: Room, count: int, seed: int) -> Room:
    """Swap some mapped objects of the room in pairs."""
    rng = np.random.default_rng(seed)
    objects = list(room.objects)
    mapped = [i for i, o in enumerate(objects) if o.in_map]
    order = rng.permutation(mapped)
    for a, b in zip(order[:count:2], order[1:count:2], strict=False):
        objects[a], objects[b] = (
            replace(objects[a], slot=room.objects[b].slot, moved=True),
            replace(objects[b], slot=room.objects[a].slot, moved=True))
    return replace(room, objects=tuple(objects))


def _draw_looks(class_id: str, count: int, rng: np.random.Generator) -> list[Appearance]:
    """Draw distinct looks; one in six is nearly equal to another."""
    looks: list[Appearance] = []
    while len(looks) < count:
        similar = looks and len(looks) % 6 == 5
        look = (draw_lookalike(looks[int(rng.integers(len(looks)))], rng) if similar
                else draw_appearance(class_id, rng))
        if look.label not in {other.label for other in looks}:
            looks.append(look)
    return looks


def _furnish(rng: np.random.Generator) -> tuple[tuple[tuple[Mesh, str], ...], list[Slot]]:
    """Place two shelves and three tables along the walls."""
    x, y = LENGTH_M, WIDTH_M
    pieces = [(box((x, y, 0.02), (x / 2, y / 2, -0.02), uv_m=1.2), 'floor'),
              (box((x, y, 0.02), (x / 2, y / 2, HEIGHT_M), uv_m=2.0), 'ceiling'),
              (box((0.02, y, HEIGHT_M), (-0.01, y / 2, 0), uv_m=1.5), 'wall'),
              (box((0.02, y, HEIGHT_M), (x + 0.01, y / 2, 0), uv_m=1.5), 'wall'),
              (box((x, 0.02, HEIGHT_M), (x / 2, -0.01, 0), uv_m=1.5), 'wall'),
              (box((x, 0.02, HEIGHT_M), (x / 2, y + 0.01, 0), uv_m=1.5), 'wall'),
              (box((2.4, 1.6, 0.01), (x / 2, y / 2, 0), uv_m=0.8), 'rug'),
              (box((0.03, 1.1, 1.0), (x, 1.2 + 2.4 * rng.random(), 1.1)), 'picture')]
    slots: list[Slot] = []
    for make, at, yaw in (
            (_shelf, (1.2 + 0.5 * rng.random(), 0.2), np.pi / 2),
            (_shelf, (0.2, 2.6 + 0.8 * rng.random()), 0.0),
            (_table, (4.6 + 0.3 * rng.random(), 0.5), np.pi / 2),
            (_table, (2.2 + 1.2 * rng.random(), y - 0.45), -np.pi / 2),
            (_table, (x - 0.5, 2.6 + rng.random()), np.pi)):
        parts, places = make()
        turn = Rotation.from_euler('z', yaw).as_matrix()
        for part, surface in parts:
            vertices = part.vertices @ turn.T + (*at, 0.0)
            pieces.append((replace(part, vertices=vertices), surface))
        slots += [Slot((*(turn @ place + (*at, 0.0)),), yaw) for place in places]
    return tuple(pieces), slots


def _shelf() -> tuple[list[tuple[Mesh, str]], npt.NDArray[np.float64]]:
    """Make a shelf, its front along x, and the places on its boards."""
    width, depth, height, boards = 2.2, 0.36, 2.05, (0.3, 0.75, 1.2, 1.65)
    parts = [box((depth, width, 0.03), (0, 0, z - 0.03), uv_m=0.7) for z in (*boards, height)]
    parts += [box((depth, 0.03, height), (0, side * width / 2, 0), uv_m=0.7) for side in (-1, 1)]
    parts += [box((0.02, width, height), (-depth / 2, 0, 0), uv_m=0.7)]
    along = (np.arange(7) - 3) * _SLOT_M * 0.97
    return [(join(*parts), 'shelf')], np.array([(0.03, y, z) for z in boards for y in along])


def _table() -> tuple[list[tuple[Mesh, str]], npt.NDArray[np.float64]]:
    """Make a table, its front along x, and the places on it in two rows."""
    width, depth, height = 1.6, 0.8, 0.74
    parts = [box((depth, width, 0.04), (0, 0, height - 0.04), uv_m=0.7)]
    parts += [box((0.06, 0.06, height - 0.04), (x * (depth / 2 - 0.06), y * (width / 2 - 0.06), 0),
                  uv_m=0.7) for x in (-1, 1) for y in (-1, 1)]
    rows = [(x, y + shift, height) for x, shift in ((-0.2, 0.0), (0.18, _SLOT_M / 2))
            for y in (np.arange(4) - 1.75) * _SLOT_M * 1.15]
    return [(join(*parts), 'table')], np.array(rows)
