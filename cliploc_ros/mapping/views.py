# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Posed detections as the kernels of mapping read them: boxes and poses on the plane z = 1."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import MappingError
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections

# Two frames less than this apart in both show a landmark from one viewpoint.
_VIEWPOINT_DISTANCE_M = 0.1
_VIEWPOINT_ANGLE_DEG = 5.0
# No robot or person with a camera is faster.
_MAX_SPEED_M_PER_S = 10.0
_MAX_TURN_DEG_PER_S = 720.0
_LEAST_JUMP_M, _LEAST_JUMP_DEG = 0.5, 30.0
_MAX_EMPTY_SHARE = 0.5


class Views(NamedTuple):
    """F frames with n boxes. Everything in the image is on the plane z = 1."""

    #: (F, 3, 3), (F, 3): of camera_from_map
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    stamps_s: NDArray[np.float64]  #: (F,): [s]
    #: (F,): number of the viewpoint of each frame, ascending: frames that the camera took without
    #: moving share one
    viewpoints: NDArray[np.int64]
    #: (F,): one over the number of frames of the same viewpoint: their boxes err alike
    weights: NDArray[np.float64]
    offsets: NDArray[np.int64]  #: (F + 1,): first box of each frame
    #: (n,): of each box
    frames: NDArray[np.int64]
    classes: NDArray[np.int64]
    edges: NDArray[np.float64]  #: (n, 4): Left, top, right, bottom, clipped to the image
    stiffness: NDArray[np.float64]  #: (n, 4): inverse standard deviation of each edge
    #: (n, 4): the edge lies at the image border: the object may extend beyond it
    is_open: NDArray[np.bool_]
    bounds: NDArray[np.float64]  #: (4,): Left, top, right, bottom of the image
    #: (n,): measured depth of the object's centre [m], and its inverse standard deviation; 0 where
    #: unknown
    depths: NDArray[np.float64]
    depth_stiffness: NDArray[np.float64]

    def between(self, first: int, last: int) -> 'Views':
        """Return the frames from first up to last, last excluded; nothing is copied."""
        frames = slice(first, last)
        boxes = slice(int(self.offsets[first]), int(self.offsets[last]))
        return Views(
            self.rotations[frames], self.translations[frames], self.stamps_s[frames],
            self.viewpoints[frames], self.weights[frames],
            self.offsets[first:last + 1] - boxes.start, self.frames[boxes] - first,
            self.classes[boxes], self.edges[boxes], self.stiffness[boxes], self.is_open[boxes],
            self.bounds, self.depths[boxes], self.depth_stiffness[boxes])


def make_views(detections: PosedDetections, options: MappingOptions) -> Views:
    """Return what the kernels read of posed detections."""
    camera = detections.camera
    boxes_px, is_open = detections.bboxes_xyxy, detections.open_edges
    size = np.array([camera.width, camera.height], dtype=np.float64)
    bounds_px = np.concatenate([[0.0, 0.0], size])
    if is_open is None:
        boxes_px = np.clip(boxes_px, 0.0, np.tile(size, 2))
        is_open = np.hstack([boxes_px[:, :2] <= options.border_px,
                             boxes_px[:, 2:] >= size - options.border_px])
    else:
        reach = np.concatenate([boxes_px[:, :2].min(axis=0, initial=np.inf),
                                boxes_px[:, 2:].max(axis=0, initial=-np.inf)])
        bounds_px = np.where(is_open.any(axis=0), reach, bounds_px)
    focal = np.array([camera.fx, camera.fy, camera.fx, camera.fy])
    principal = np.array([camera.cx, camera.cy, camera.cx, camera.cy])
    extents_px = np.tile(boxes_px[:, 2:] - boxes_px[:, :2], 2)
    deviations_px = np.hypot(options.edge_sigma_px, options.edge_sigma_share * extents_px)
    viewpoints = number_viewpoints(detections.map_from_camera)
    return Views(
        *camera_from_map(detections.map_from_camera),
        np.ascontiguousarray(detections.stamps_s, dtype=np.float64), viewpoints,
        1.0 / np.bincount(viewpoints)[viewpoints], detections.frame_offsets, detections.frames,
        detections.classes, (boxes_px - principal) / focal, focal / deviations_px, is_open,
        (bounds_px - principal) / focal, np.zeros(len(boxes_px)), np.zeros(len(boxes_px)))


def camera_from_map(map_from_camera: NDArray[np.float64]
                    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (F, 3, 3) and translations (F, 3) of the inverses of poses (F, 4, 4)."""
    rotations = np.ascontiguousarray(map_from_camera[:, :3, :3].transpose(0, 2, 1))
    translations = -np.einsum('fij,fj->fi', rotations, map_from_camera[:, :3, 3])
    return rotations, np.ascontiguousarray(translations)


def thin_out(views: Views, most: int) -> NDArray[np.bool_]:
    """Return a mask (F,) of a number of frames of each viewpoint at most, evenly chosen."""
    counts = np.bincount(views.viewpoints - views.viewpoints[0])
    places = np.arange(len(views.viewpoints)) - np.repeat(np.cumsum(counts) - counts, counts)
    counts = np.maximum(np.repeat(counts, counts), most)
    return np.asarray((places * most) // counts != ((places - 1) * most) // counts)


def map_from_cameras(views: Views) -> NDArray[np.float64]:
    """Return the poses map_from_camera (F, 4, 4) of all frames."""
    poses = np.tile(np.eye(4), (len(views.rotations), 1, 1))
    poses[:, :3, :3] = views.rotations.transpose(0, 2, 1)
    poses[:, :3, 3] = camera_centers(views)
    return poses


def camera_centers(views: Views, frames: NDArray[np.int64] | slice = slice(None)
                   ) -> NDArray[np.float64]:
    """Return where the camera was in some frames, or in all (k, 3) [m]."""
    return np.asarray(-np.einsum('fji,fj->fi', views.rotations[frames],
                                 views.translations[frames]))


def number_viewpoints(map_from_camera: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return which viewpoint each of F poses (F, 4, 4) belongs to, ascending from 0.

    A viewpoint ends with the first frame that differs from its first one by 10 cm or 5 degrees.
    """
    viewpoints = np.zeros(len(map_from_camera), dtype=np.int64)
    least_cosine = np.cos(np.radians(_VIEWPOINT_ANGLE_DEG))
    first, number = 0, 0
    for frame in range(1, len(map_from_camera)):
        here, there = map_from_camera[frame], map_from_camera[first]
        cosine = 0.5 * (np.sum(here[:3, :3] * there[:3, :3]) - 1.0)
        distance = np.linalg.norm(here[:3, 3] - there[:3, 3])
        if cosine < least_cosine or distance > _VIEWPOINT_DISTANCE_M:
            first, number = frame, number + 1
        viewpoints[frame] = number
    return viewpoints


def check_input(detections: PosedDetections, views: Views, options: MappingOptions) -> list[str]:
    """Return notes on the input.

    MappingError: no map can be made of it; the message says what to correct.
    """
    if len(detections.classes) == 0:
        raise MappingError(f'the {len(detections)} frames have no detections; check the detector, '
                           'its classes and its confidence threshold')
    viewpoints = int(views.viewpoints[-1]) + 1
    if viewpoints < options.min_viewpoints:
        raise MappingError(f'the camera took {viewpoints} viewpoints, at least '
                           f'{options.min_viewpoints} are needed; move it around the objects, and '
                           'check that the poses are those of the images')
    # the pose moves faster than any camera does
    poses, stamps = detections.map_from_camera, detections.stamps_s
    seconds = np.maximum(np.diff(stamps), 1e-3)
    distances = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    traces = np.einsum('fij,fij->f', poses[1:, :3, :3], poses[:-1, :3, :3])
    angles = np.degrees(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))
    far = (distances > _LEAST_JUMP_M) & (distances > _MAX_SPEED_M_PER_S * seconds)
    far |= (angles > _LEAST_JUMP_DEG) & (angles > _MAX_TURN_DEG_PER_S * seconds)
    jumps, notes = stamps[1:][far], []
    if len(jumps):
        notes.append(f'the poses jump {len(jumps)} times, first at {jumps[0]:.2f} s; check the '
                     'localization that they come from')
    empty = float(np.mean(np.diff(detections.frame_offsets) == 0))
    if empty > _MAX_EMPTY_SHARE:
        notes.append(f'{empty:.0%} of the frames have no detections; check the detector')
    if len(detections.class_names) == 1:
        notes.append(f"all boxes are of the class '{detections.class_names[0]}'; maps with more "
                     'classes relocalize better')
    return notes
