# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kinds of places: rooms, offices, shops, corridors of equal bays, symmetric halls.

Numbers of objects, spacings and shares are guesses about ordinary buildings.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import shape_matrices

#: Semi-axes [m] and height of the centre [m] of COCO's classes of things indoors. Means of the
#: ellipsoids of TUM fr3's two maps: keyboard, mouse, cell phone, book, bottle, cup, scissors and
#: teddy bear; tv between its monitors and a television. The others are guesses.
TYPICAL = {
    'chair': (0.25, 0.25, 0.45, 0.45), 'couch': (0.9, 0.45, 0.4, 0.4),
    'potted plant': (0.2, 0.2, 0.35, 0.5), 'bed': (1.0, 0.8, 0.3, 0.3),
    'dining table': (0.8, 0.5, 0.38, 0.38), 'toilet': (0.2, 0.3, 0.4, 0.4),
    'bench': (0.7, 0.2, 0.25, 0.25), 'refrigerator': (0.35, 0.35, 0.85, 0.85),
    'suitcase': (0.25, 0.15, 0.35, 0.35), 'backpack': (0.18, 0.14, 0.25, 0.3),
    'handbag': (0.18, 0.1, 0.15, 0.7), 'umbrella': (0.1, 0.1, 0.4, 0.45),
    'tv': (0.4, 0.08, 0.26, 1.3), 'clock': (0.15, 0.04, 0.15, 1.9),
    'microwave': (0.25, 0.18, 0.15, 1.1), 'oven': (0.3, 0.3, 0.4, 0.4),
    'sink': (0.28, 0.22, 0.1, 0.9), 'toaster': (0.14, 0.1, 0.1, 1.0),
    'laptop': (0.17, 0.12, 0.12, 0.85), 'keyboard': (0.24, 0.13, 0.07, 0.76),
    'mouse': (0.06, 0.05, 0.03, 0.76), 'cell phone': (0.05, 0.1, 0.03, 0.76),
    'book': (0.12, 0.17, 0.05, 0.8), 'vase': (0.08, 0.08, 0.15, 0.95),
    'bottle': (0.05, 0.05, 0.14, 0.88), 'wine glass': (0.04, 0.04, 0.1, 0.85),
    'cup': (0.07, 0.07, 0.09, 0.82), 'bowl': (0.09, 0.09, 0.05, 0.81),
    'scissors': (0.06, 0.11, 0.05, 0.77), 'teddy bear': (0.22, 0.16, 0.34, 0.6),
    'sports ball': (0.11, 0.11, 0.11, 0.11), 'fire hydrant': (0.15, 0.15, 0.4, 0.4),
}
CLASS_NAMES = tuple(sorted(TYPICAL))
#: Classes of things on the floor, on tables, on shelves and on walls.
FURNITURE = ('chair', 'couch', 'potted plant', 'dining table', 'refrigerator', 'suitcase',
             'backpack', 'bench', 'teddy bear', 'sports ball', 'umbrella')
ON_TABLES = ('laptop', 'keyboard', 'mouse', 'cell phone', 'book', 'vase', 'bottle', 'cup', 'bowl',
             'scissors', 'handbag', 'teddy bear')
ON_SHELVES = ('bottle', 'book', 'cup', 'bowl', 'vase', 'wine glass', 'teddy bear', 'toaster')
ON_WALLS = ('tv', 'clock')
# Classes that detectors assign to a vase with flowers, or to a part of it.
_CONFUSED = ('book', 'vase', 'potted plant', 'bottle', 'cup', 'book', 'book', 'chair')
# Range of the factor of each axis. Volumes then vary like those of the bottles, books and mice of
# TUM fr3, for which the logarithm of the mean axis has a deviation of .11 to .17.
_GROWTH = (0.75, 1.3)


class Thing(NamedTuple):
    """An object: class, centre [m], yaw [rad] and look.

    Things of one class and model look alike.
    """

    name: str
    x: float
    y: float
    z: float
    yaw: float
    model: int
    whole: int = 0  #: Number of the thing that it is a part of; 0 for a complete thing


class Objects(NamedTuple):
    """The n objects of a world."""

    class_ids: tuple[str, ...]
    models: NDArray[np.int64]  #: (n,): objects of one class and model look alike
    #: (n, 3): [m]
    centers: NDArray[np.float64]
    semi_axes: NDArray[np.float64]
    yaws: NDArray[np.float64]  #: (n,): about the vertical [rad]
    wholes: NDArray[np.int64]  #: (n,): the thing that each is a part of; 0 for a complete thing

    @property
    def quats_xyzw(self) -> NDArray[np.float64]:
        """Return the rotations (n, 4) from the objects' axes into the world's."""
        zero = np.zeros(len(self.yaws))
        return np.stack([zero, zero, np.sin(0.5 * self.yaws), np.cos(0.5 * self.yaws)], axis=1)

    @property
    def shapes(self) -> NDArray[np.float64]:
        """Return the shape matrices (n, 6), see cliploc_ros.core.geometry.ellipsoid."""
        return shape_matrices(self.semi_axes, self.quats_xyzw)


def rows_of(class_ids: Sequence[str]) -> list[int]:
    """Return the rows in CLASS_NAMES of classes."""
    return [CLASS_NAMES.index(name) for name in class_ids]


def make_objects(things: Sequence[Thing], rng: np.random.Generator) -> Objects:
    """Return things as objects; objects of one class and model have the same size."""
    models = np.array([thing.model for thing in things])
    sizes = np.array([TYPICAL[CLASS_NAMES[row]][:3] for row in rows_of([
        thing.name for thing in things])])
    growth = {kind: rng.uniform(*_GROWTH, 3)
              for kind in dict.fromkeys((thing.name, thing.model) for thing in things)}
    sizes *= [growth[thing.name, thing.model] for thing in things]
    return Objects(tuple(thing.name for thing in things), models,
                   np.array([[thing.x, thing.y, thing.z] for thing in things]), sizes,
                   np.array([thing.yaw for thing in things]),
                   np.array([thing.whole for thing in things]))


class Place(NamedTuple):
    """Things in a rectangle from (0, 0) to (width, depth) [m]."""

    width: float
    depth: float
    things: Sequence[Thing]
    focus: tuple[float, float, float] | None = None  #: Point that robots look at, all around [m]


def room(rng: np.random.Generator) -> Place:
    """Return a room: furniture and tables with things on them, all different."""
    width, depth = rng.uniform(3.0, 6.0, 2)
    things = _scattered(rng, FURNITURE, _some(rng, 5, 13), width, depth)
    for _ in range(_some(rng, 2, 5)):
        things += _table(rng, *_spot(rng, width, depth), _some(rng, 3, 11))
    things += _on_walls(rng, _some(rng, 0, 3), width, depth)
    return Place(width, depth, things)


def office(rng: np.random.Generator) -> Place:
    """Return an office: rows of desks with the same monitors, keyboards and chairs."""
    columns, rows = _some(rng, 2, 5), _some(rng, 1, 4)
    pitch = rng.uniform(1.9, 2.6, 2)
    likeness = rng.uniform(0.3, 0.9)
    things = [thing for column in range(columns) for row in range(rows)
              for thing in _desk(rng, 1.2 + pitch[0] * column, 1.2 + pitch[1] * row,
                                 0.5 * np.pi * rng.integers(4), likeness)]
    width, depth = 2.4 + pitch * (columns - 1, rows - 1)
    things += _scattered(rng, FURNITURE, _some(rng, 1, 6), width, depth)
    return Place(width, depth, things + _on_walls(rng, _some(rng, 0, 4), width, depth))


def shop(rng: np.random.Generator) -> Place:
    """Return a shop: shelves with rows of identical things, and few other objects."""
    aisles = _some(rng, 2, 5)
    width, depth = rng.uniform(4.0, 7.0), 1.5 + 1.8 * aisles
    things = []
    for aisle in range(aisles):
        x, y = 0.5, 0.8 + 1.8 * aisle
        while x < width - 0.5:
            name, model = str(rng.choice(ON_SHELVES)), _new_model(rng)
            spacing = 2.0 * TYPICAL[name][0] * rng.uniform(1.1, 1.6)
            count = _some(rng, 3, 9)
            height = rng.choice((0.5, 0.9, 1.3, 1.7))
            things += [Thing(name, x + spacing * number, y, height, 0.0, model)
                       for number in range(count) if rng.random() < 0.9]
            x += spacing * count + rng.uniform(0.1, 0.4)
    things += _scattered(rng, FURNITURE, _some(rng, 1, 5), width, depth)
    return Place(width, depth, things + _on_walls(rng, _some(rng, 0, 3), width, depth))


def corridor(rng: np.random.Generator) -> Place:
    """Return a corridor of equal bays; some bays lack a thing or have an extra one."""
    bays, pitch = _some(rng, 4, 11), rng.uniform(2.2, 4.0)
    width, depth = bays * pitch, rng.uniform(1.8, 3.0)
    pattern = _scattered(rng, (*FURNITURE, *ON_WALLS), _some(rng, 3, 8), pitch, depth)
    things = [thing._replace(x=thing.x + pitch * bay) for bay in range(bays) for thing in pattern
              if rng.random() < 0.93]
    things += _scattered(rng, FURNITURE, _some(rng, 0, bays), width, depth)
    return Place(width, depth, things)


def hall(rng: np.random.Generator) -> Place:
    """Return a hall of twofold symmetry with a few exceptions."""
    width, depth = rng.uniform(6.0, 12.0, 2)
    half = _scattered(rng, FURNITURE, _some(rng, 6, 15), 0.5 * width, depth)
    for _ in range(_some(rng, 1, 4)):
        half += _table(rng, *_spot(rng, 0.5 * width, depth), _some(rng, 2, 9))
    turned = [thing._replace(x=width - thing.x, y=depth - thing.y, yaw=thing.yaw + np.pi)
              for thing in half]
    things = [thing for thing in half + turned if rng.random() < 0.93]
    return Place(width, depth, things + _scattered(rng, (*FURNITURE, *ON_WALLS),
                                                   _some(rng, 0, 5), width, depth))


def bare_room(rng: np.random.Generator) -> Place:
    """Return a room with hardly anything in it."""
    width, depth = rng.uniform(3.0, 7.0, 2)
    return Place(width, depth, _scattered(rng, (*FURNITURE, *ON_TABLES), _some(rng, 4, 8),
                                          width, depth))


def two_rooms(rng: np.random.Generator) -> Place:
    """Return two equal rooms side by side, each with up to three extra things."""
    first = room(rng)
    gap = 1.5
    twin = [thing._replace(x=thing.x + first.width + gap) for thing in first.things]
    own = [_scattered(rng, FURNITURE, _some(rng, 0, 4), first.width, first.depth)
           for _ in range(2)]
    moved = [thing._replace(x=thing.x + first.width + gap) for thing in own[1]]
    return Place(2.0 * first.width + gap, first.depth, [*first.things, *twin, *own[0], *moved])


def arrangement(rng: np.random.Generator) -> Place:
    """Return a room with a table; a robot looks at the things on it from all sides.

    A detector assigns several classes to these things, or to parts of them.
    """
    size = rng.uniform(4.0, 6.0)
    table, *things = _table(rng, 0.5 * size, 0.5 * size, 0)
    spread = rng.uniform((0.0, 0.01), (0.15, 0.05))
    for whole in range(1, _some(rng, 2, 4)):
        x, y = (table.x, table.y) + spread[0] * rng.normal(size=2)
        things += [Thing(name, x + spread[1] * rng.normal(), y + spread[1] * rng.normal(),
                         rng.uniform(0.8, 1.2), rng.uniform(0.0, np.pi), _new_model(rng), whole)
                   for name in map(str, rng.choice(_CONFUSED, _some(rng, 2, 7)))]
    things += _scattered(rng, FURNITURE, _some(rng, 0, 3), size, size)
    return Place(size, size, [table, *things], (table.x, table.y, 0.9))


def row(rng: np.random.Generator) -> Place:
    """Return things on one line: on a shelf, or along a corridor."""
    length, on_floor = rng.uniform(2.0, 5.0), rng.random() < 0.5
    count, height = _some(rng, 5, 13), float(rng.choice((0.5, 0.9, 1.3)))
    things = [Thing(name, length * (number + rng.uniform(0.2, 0.8)) / count,
                    1.5 + 0.03 * rng.normal(), TYPICAL[name][3] if on_floor else height,
                    0.1 * rng.normal(), _new_model(rng))
              for number, name in enumerate(map(str, rng.choice(
                  FURNITURE if on_floor else ON_SHELVES, count)))]
    return Place(length, 3.0, things, (0.5 * length, 1.5, height))


def one_desk(rng: np.random.Generator) -> Place:
    """Return a desk with its usual things, and up to two pieces of furniture."""
    things = _desk(rng, 2.0, 2.0, rng.uniform(0.0, np.pi), rng.uniform(0.3, 0.9))
    things += _scattered(rng, FURNITURE, _some(rng, 0, 3), 4.0, 4.0)
    return Place(4.0, 4.0, things, (2.0, 2.0, 0.8))


#: All kinds of places, by name.
KINDS: dict[str, Callable[[np.random.Generator], Place]] = {
    'room': room, 'office': office, 'shop': shop, 'corridor': corridor, 'hall': hall,
    'bare room': bare_room, 'two rooms': two_rooms, 'arrangement': arrangement, 'row': row,
    'one desk': one_desk}


def _some(rng: np.random.Generator, least: int, limit: int) -> int:
    """Draw an integer from least (inclusive) to limit (exclusive)."""
    return int(rng.integers(least, limit))


def _new_model(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 40))


def _spot(rng: np.random.Generator, width: float, depth: float) -> tuple[float, float]:
    return rng.uniform(0.3, width - 0.3), rng.uniform(0.3, depth - 0.3)


def _scattered(rng: np.random.Generator, names: Sequence[str], count: int, width: float,
               depth: float) -> list[Thing]:
    """Return things at random spots, at their usual heights, all looking different."""
    return [Thing(name, *_spot(rng, width, depth), TYPICAL[name][3],
                  rng.uniform(0.0, np.pi), _new_model(rng))
            for name in map(str, rng.choice(names, count))]


def _on_walls(rng: np.random.Generator, count: int, width: float, depth: float) -> list[Thing]:
    things = []
    for name in map(str, rng.choice(ON_WALLS, count)):
        along, wall = rng.uniform(0.1, 0.9), rng.integers(4)
        x, y = ((along * width, 0.0), (along * width, depth), (0.0, along * depth),
                (width, along * depth))[wall]
        things.append(Thing(name, x, y, rng.uniform(1.2, 2.0), 0.5 * np.pi * (wall // 2),
                            _new_model(rng)))
    return things


def _table(rng: np.random.Generator, x: float, y: float, count: int) -> list[Thing]:
    """Return a table with things on it."""
    table = Thing('dining table', x, y, TYPICAL['dining table'][3], rng.uniform(0.0, np.pi),
                  _new_model(rng))
    along, across = TYPICAL['dining table'][:2]
    things = [table]
    for name in map(str, rng.choice(ON_TABLES, count)):
        u, v = rng.uniform(-0.8, 0.8, 2) * (along, across)
        things.append(_beside(table, name, u, v, rng, _new_model(rng)))
    return things


def _beside(table: Thing, name: str, u: float, v: float, rng: np.random.Generator, model: int
            ) -> Thing:
    """Return a thing at a place (u, v) [m] along and across a table."""
    cos, sin = np.cos(table.yaw), np.sin(table.yaw)
    height = TYPICAL[name][3] if name == 'chair' else 0.74 + TYPICAL[name][2]
    return Thing(name, table.x + cos * u - sin * v, table.y + sin * u + cos * v, height,
                 table.yaw + 0.15 * rng.normal(), model)


def _desk(rng: np.random.Generator, x: float, y: float, yaw: float, likeness: float
          ) -> list[Thing]:
    """Return a desk; likeness is the share of its things that look the same on every desk."""
    desk = Thing('dining table', x, y, TYPICAL['dining table'][3], yaw, 0)
    usual = (('tv', 0.0, 0.25, 0.9), ('keyboard', 0.0, -0.1, 0.9), ('mouse', 0.35, -0.1, 0.9),
             ('chair', 0.0, -0.7, 0.9), ('laptop', -0.45, 0.0, 0.4), ('cup', 0.55, 0.1, 0.5),
             ('tv', 0.5, 0.25, 0.3), ('bottle', -0.6, 0.2, 0.4), ('cell phone', 0.5, -0.2, 0.3))
    things = [desk]
    for name, u, v, share in usual:
        if rng.random() < share:
            model = 0 if rng.random() < likeness else _new_model(rng)
            shift = 0.06 * rng.normal(size=2)
            thing = _beside(desk, name, u + shift[0], v + shift[1], rng, model)
            things.append(thing._replace(z=0.74 + 0.25) if name == 'tv' else thing)
    for name in map(str, rng.choice(('book', 'book', 'scissors', 'bowl', 'vase', 'teddy bear'),
                                    _some(rng, 0, 4))):
        u, v = rng.uniform(-0.8, 0.8, 2) * TYPICAL['dining table'][:2]
        things.append(_beside(desk, name, u, v, rng, _new_model(rng)))
    return things
