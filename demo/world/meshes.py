# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Meshes of objects and furniture: boxes and surfaces of revolution."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from demo.world.appearance import SIZES, Appearance


@dataclass(frozen=True)
class Mesh:
    """Triangles with texture coordinates; they stand on z = 0 with x to the front."""

    vertices: npt.NDArray[np.float64]  #: Corners [m]
    uv: npt.NDArray[np.float64]  #: Texture coordinates, v upwards
    triangles: npt.NDArray[np.int64]  #: Rows of `vertices`

    @property
    def half_extents(self) -> npt.NDArray[np.float64]:
        """Half the side lengths of the bounding box, shape (3,), [m]."""
        return (self.vertices.max(0) - self.vertices.min(0)) / 2


def join(*meshes: Mesh) -> Mesh:
    """Join meshes into one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]),
                np.concatenate([mesh.uv for mesh in meshes]),
                np.concatenate([mesh.triangles + start
                                for mesh, start in zip(meshes, starts, strict=False)]))


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0),
        uv_m: float | None = None) -> Mesh:
    """Make a box of a size [m] with the centre of its bottom at a point [m].

    With `uv_m` the texture repeats after this many metres; without, each face shows it once.
    """
    vertices: list[npt.NDArray[np.float64]] = []
    uv, triangles = [], []
    half = np.array(size) / 2
    for axis in range(3):
        # The two other axes, so that the texture stands upright on the sides.
        across, up = ((1, 2), (0, 2), (0, 1))[axis]
        for sign in (-1.0, 1.0):
            start = len(vertices)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner = np.zeros(3)
                corner[axis], corner[across], corner[up] = sign, a, b
                vertices.append(corner * half + (0, 0, half[2]) + np.array(at))
                mirror = sign * (1 if axis != 1 else -1)  # text reads correctly from outside
                cell = np.array([(a * mirror + 1) / 2, (b + 1) / 2])
                uv.append(cell * 2 * half[[across, up]] / uv_m if uv_m else cell)
            triangles += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    return Mesh(np.array(vertices), np.array(uv), np.array(triangles))


def revolve(profile: list[tuple[float, float]], sides: int = 28) -> Mesh:
    """Revolve a profile of (radius, height) [m] about the vertical; the texture wraps around."""
    radii, heights = np.array(profile).T
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    vertices = np.concatenate(
        [np.c_[ring * r, np.full(sides + 1, h)] for r, h in zip(radii, heights, strict=True)])
    v = (heights - heights.min()) / max(float(np.ptp(heights)), 1e-9)
    uv = np.concatenate([np.c_[angles / (2 * np.pi), np.full(sides + 1, x)] for x in v])
    triangles = []
    for row in range(len(profile) - 1):
        a = row * (sides + 1) + np.arange(sides)
        b = a + sides + 1
        triangles += [np.c_[a, a + 1, b + 1], np.c_[a, b + 1, b]]
    return Mesh(vertices, uv, np.concatenate(triangles))


def _ring(radius: float, thickness: float, at: tuple[float, float]) -> Mesh:
    """Make the handle of a mug: a ring in the plane y = 0 with centre (x, z) `at`."""
    u, w = np.meshgrid(np.linspace(0, 2 * np.pi, 17), np.linspace(0, 2 * np.pi, 9), indexing='ij')
    reach = radius + thickness * np.cos(w)
    vertices = np.stack([at[0] + reach * np.cos(u), thickness * np.sin(w),
                         at[1] + reach * np.sin(u)], axis=-1).reshape(-1, 3)
    cell = (np.arange(16)[:, None] * 9 + np.arange(8)).ravel()
    triangles = np.concatenate([np.c_[cell, cell + 9, cell + 10],
                                np.c_[cell, cell + 10, cell + 1]])
    return Mesh(vertices, np.full((len(vertices), 2), 0.02), triangles)


def make_object(look: Appearance) -> list[tuple[Mesh, str]]:
    """Make the parts of an object.

    Returns
    -------
    list of (Mesh, str)
        Each part with the name of its plain colour, or '' for the object's own texture.
    """
    s = SIZES[look.size]
    return {
        'mug': lambda: [
            (revolve([(0, .004 * s), (.055 * s, 0), (.06 * s, .07 * s), (.06 * s, .14 * s),
                      (.052 * s, .14 * s), (.048 * s, .02 * s), (0, .02 * s)]), ''),
            (_ring(.042 * s, .010 * s, (.085 * s, .07 * s)), look.color)],
        'bottle': lambda: [
            (revolve([(0, 0), (.06 * s, 0), (.06 * s, .2 * s)]), ''),
            (revolve([(.06 * s, .2 * s), (.05 * s, .235 * s), (.022 * s, .27 * s),
                      (.022 * s, .33 * s)]), look.color),
            (revolve([(.026 * s, .315 * s), (.026 * s, .345 * s), (0, .346 * s)]), 'black')],
        'book': lambda: [
            (box((.06 * s, .2 * s, .28 * s)), ''),
            (box((.045 * s, .194 * s, .284 * s), (0, .004 * s, 0)), 'white')],
        'box': lambda: [(box((.22 * s, .26 * s, .2 * s)), '')],
        'bowl': lambda: [
            (revolve([(0, 0), (.05 * s, 0), (.1 * s, .05 * s), (.125 * s, .11 * s),
                      (.115 * s, .11 * s), (.09 * s, .05 * s), (0, .02 * s)]), '')],
        'can': lambda: [
            (revolve([(.055 * s, .008 * s), (.055 * s, .152 * s)]), ''),
            (revolve([(0, 0), (.05 * s, 0), (.055 * s, .008 * s)]), 'white'),
            (revolve([(.055 * s, .152 * s), (.048 * s, .16 * s), (0, .157 * s)]), 'white')],
        'clock': lambda: _clock(s),
        'plant': lambda: _plant(s),
    }[look.class_id]()


def _clock(s: float) -> list[tuple[Mesh, str]]:
    def stand(mesh: Mesh, x: float) -> Mesh:
        v = mesh.vertices
        return Mesh(np.c_[v[:, 2] + x, v[:, 0], v[:, 1] + .13 * s], mesh.uv, mesh.triangles)
    hands = [box((.006, .012 * s, .07 * s), (.034 * s, 0, .13 * s)),
             box((.006, .055 * s, .012 * s), (.034 * s, .027 * s, .125 * s))]
    return [(stand(revolve([(0, -.03 * s), (.13 * s, -.03 * s), (.13 * s, .03 * s),
                            (.1 * s, .03 * s)]), 0), ''),
            (stand(revolve([(.1 * s, .028 * s), (0, .0281 * s)]), 0), 'white'),
            *((hand, 'black') for hand in hands)]


def _plant(s: float) -> list[tuple[Mesh, str]]:
    leaves = []
    for number, turn in enumerate(np.linspace(0, 2 * np.pi, 10)[:-1]):
        lean, length = (.55, .17 * s) if number % 2 else (.3, .22 * s)
        out, up = np.sin(lean) * length, np.cos(lean) * length
        side = np.array([-np.sin(turn), np.cos(turn), 0]) * .028 * s
        way = np.array([np.cos(turn), np.sin(turn), 0])
        root, tip = np.array([0, 0, .13 * s]), np.array([0, 0, .13 * s + up]) + way * out
        middle = (root + tip) / 2 + (0, 0, .02 * s)
        corners = np.array([root, middle - side, tip, middle + side])
        leaves.append(Mesh(corners, np.full((4, 2), .5), np.array([(0, 1, 2), (0, 2, 3)])))
    pot = revolve([(0, 0), (.06 * s, 0), (.085 * s, .13 * s), (.075 * s, .13 * s), (0, .12 * s)])
    return [(pot, ''), (join(*leaves), 'green')]
