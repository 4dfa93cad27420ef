# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Paint tags into images, with any lens."""

import cv2
import numpy as np

_MODULE = 8  # pixels of a module in the texture


def texture_of(tag):
    """Return the pattern with a white margin, and the side of the whole in units of the size."""
    aruco, is_april = cv2.aruco, tag.family.startswith('tag')
    patterns = aruco.getPredefinedDictionary(getattr(
        aruco, f'DICT_APRILTAG_{tag.family[3:]}' if is_april else tag.family))
    modules = patterns.markerSize + 2
    draw = getattr(aruco, 'generateImageMarker', None) or aruco.drawMarker
    found = np.full((modules + 2, modules + 2), 230, np.uint8)
    found[1:-1, 1:-1] = 20 + 210 * (draw(patterns, tag.number, modules) > 0)
    # AprilTag's own pictures are turned by 180 degrees
    found = np.rot90(found, 2) if is_april else found
    return np.kron(found, np.ones((_MODULE, _MODULE), np.uint8)), (modules + 2) / modules


def paint_tag(image_rgb, tag, camera, map_from_camera):
    """Return an image (h, w, 3) with a tag of the map in it."""
    texture, whole = texture_of(tag)
    camera_from_tag = np.linalg.inv(map_from_camera) @ tag.map_from_tag
    half = 0.5 * whole * tag.size
    corners = camera_from_tag @ np.array([[x, y, 0.0, 1.0] for x in (-half, half)
                                          for y in (-half, half)]).T
    pixels = camera.project_normalized((corners[:2] / corners[2]).T)
    (left, top), (right, bottom) = (np.clip(
        edge, 0, (camera.width - 1, camera.height - 1)).astype(int)
        for edge in (pixels.min(axis=0) - 3, pixels.max(axis=0) + 4))
    x, y = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    rays = np.c_[camera.normalize_points(np.stack([x, y], axis=-1).reshape(-1, 2)),
                 np.ones(x.size)]
    rotation, shift = camera_from_tag[:3, :3], camera_from_tag[:3, 3]
    depths = (rotation[:, 2] @ shift) / (rays @ rotation[:, 2])
    on_tag = ((rays * depths[:, None] - shift) @ rotation)[:, :2]
    places = (on_tag * (1, -1) / (2 * half) + 0.5) * texture.shape[0] - 0.5
    sampled = cv2.remap(texture, *places.reshape(*x.shape, 2).astype(np.float32).transpose(
        2, 0, 1), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (np.abs(on_tag) <= half).all(axis=1).reshape(x.shape)
    painted = image_rgb.copy()
    painted[y[inside], x[inside]] = sampled[inside, None]
    return cv2.GaussianBlur(painted, (0, 0), 0.6)
