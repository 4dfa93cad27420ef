# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write maps in the formats of other systems."""

import csv
import io
import json
import struct
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap
from studies.foreign_maps import COCO

HEADER = 'id,label,class_id,x,y,z,a,b,c,qx,qy,qz,qw'


def dual_quadric(center, semi_axes, quat_xyzw) -> np.ndarray:
    """Return the 4 x 4 dual quadric of an ellipsoid, its last element -1."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quat_xyzw).as_matrix()
    pose[:3, 3] = center
    return pose @ np.diag([*np.square(semi_axes), -1.0]) @ pose.T


def dual_quadrics(landmark_map: LandmarkMap) -> list[np.ndarray]:
    return [dual_quadric(*row) for row in zip(landmark_map.centers, landmark_map.semi_axes,
                                              landmark_map.quats_xyzw, strict=True)]


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def number_field(number: int, value: int) -> bytes:
    return varint(8 * number) + varint(value)


def bytes_field(number: int, content: bytes) -> bytes:
    return varint(8 * number + 2) + varint(len(content)) + content


def packed(number: int, values: Iterable[int]) -> bytes:
    return bytes_field(number, b''.join(map(varint, values)))


def ellipsoid_message(quadric) -> bytes:
    return bytes_field(1, np.asarray(quadric, dtype='<f4').tobytes())


def goreloc_object(number: int, quadric, votes: Sequence[tuple[int, int]]) -> bytes:
    """Return the message of one object with the counts of its categories."""
    return bytes_field(1, bytes_field(1, ellipsoid_message(quadric)) + number_field(2, number)
                       + packed(3, [category for category, _ in votes])
                       + packed(4, [count for _, count in votes])
                       + packed(5, [7, 300, 70_000]))


def goreloc_file(landmark_map: LandmarkMap) -> bytes:
    """Return NAME.objects of GOReloc."""
    return b''.join(
        goreloc_object(row, quadric, [(COCO.index(name), 9), (COCO.index('vase'), 3)])
        for row, (quadric, name) in enumerate(zip(dual_quadrics(landmark_map),
                                                  landmark_map.class_ids, strict=True)))


def oaslam_text(landmark_map: LandmarkMap) -> str:
    """Return map_objects_NAME.txt of OA-SLAM."""
    lines = []
    for row, quadric in enumerate(dual_quadrics(landmark_map)):
        numbers = ' '.join(f'{value:.8f}' for value in quadric.ravel(order='F'))
        lines.append(f'{row} {COCO.index(landmark_map.class_ids[row])} {numbers}\n')
    return ''.join(lines)


def oaslam_files(landmark_map: LandmarkMap) -> tuple[bytes, bytes]:
    """Return map_NAME.mapobjects and map_NAME.objecttracks of OA-SLAM."""
    objects = b''.join(
        bytes_field(1, bytes_field(1, ellipsoid_message(quadric)) + number_field(2, row))
        for row, quadric in enumerate(dual_quadrics(landmark_map)))
    box = bytes_field(8, b''.join(varint(8 * field + 5) + struct.pack('<f', field)
                                  for field in (1, 2, 3, 4)))
    tracks = b''.join(
        bytes_field(1, number_field(1, row) + number_field(2, COCO.index(name)) + 4 * box
                    + bytes_field(10, struct.pack('<4d', .9, .8, .7, .6)))
        for row, name in enumerate(landmark_map.class_ids))
    return objects, tracks


def msgloc_node(number: int, center, semi_axes, quat_xyzw, **labels) -> dict:
    """Return a node of MSG-Loc, with a quaternion w, x, y, z and one negative radius."""
    x, y, z, w = map(float, quat_xyzw)
    radii = [float(radius) for radius in semi_axes]
    return {'id': (ord('q') << 56) + number, 'translation': [float(value) for value in center],
            'orientation': [w, x, y, z], 'radii': [-radii[0], *radii[1:]], 'neighbor_node': [],
            **labels}


def msgloc_text(landmark_map: LandmarkMap) -> str:
    """Return a map of MSG-Loc whose likeliest class is not the one detected most often."""
    nodes = [
        msgloc_node(row, landmark_map.centers[row], landmark_map.semi_axes[row],
                    landmark_map.quats_xyzw[row],
                    baseline_label={f'{COCO.index(name)}.0': [0.75, [1.0, 2.0, 3.0]],
                                    f'{COCO.index("vase")}.0': [0.25, [1.0, 2.0, 3.0]]},
                    msgloc_label={f'{COCO.index("vase")}.0': [1.0],
                                  f'{COCO.index(name)}.0': [0.9]})
        for row, name in enumerate(landmark_map.class_ids)]
    return json.dumps({'nodes': nodes, 'edges': []})


def table_text(landmark_map: LandmarkMap) -> str:
    """Return a CSV table with every column of an ellipsoid."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(HEADER.split(','))
    for row in range(len(landmark_map)):
        writer.writerow([landmark_map.landmark_ids[row], landmark_map.labels[row],
                         landmark_map.class_ids[row], *landmark_map.centers[row],
                         *landmark_map.semi_axes[row], *landmark_map.quats_xyzw[row]])
    return out.getvalue()
