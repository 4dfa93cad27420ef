# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays of posed detections for the kernels of mapping: boxes and poses on the plane z = 1."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.errors import MappingError, counted
from cliploc_ros.offline.mapping.landmarks import group_boxes
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.simulation import EDGE_SIGMA_PX, EDGE_SIGMA_SHARE

#: Entry of Views.sizes for a class without a known size.
NO_SIZE = (np.inf, 1.0)
# An edge this near to the image border is open: the object may extend beyond it.
_BORDER_PX = 3.0
# No robot or person with a camera is faster.
_MAX_SPEED_M_PER_S = 10.0
_MAX_TURN_DEG_PER_S = 720.0
_LEAST_JUMP_M, _LEAST_JUMP_DEG = 0.5, 30.0
_MAX_EMPTY_SHARE = 0.5
# A camera that moves by more than this relative to the first one is not on a rig with it.
_MOST_PLAY_M = 0.5
# Arrays of Views with a row for each frame, and for each box.
_OF_FRAMES = ('rotations', 'translations', 'stamps_s', 'cameras', 'levers', 'viewpoints',
              'weights', 'bounds')
_OF_BOXES = ('frames', 'classes', 'edges', 'stiffness', 'is_open', 'depths', 'depth_stiffness',
             'sizes')


class Views(NamedTuple):
    """F frames with n boxes. Image coordinates are on the plane z = 1."""

    #: (F, 3, 3), (F, 3): of camera_from_map
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    stamps_s: NDArray[np.float64]  #: (F,): [s]
    cameras: NDArray[np.int64]  #: (F,): number of the camera of each frame
    #: (F, 3): offset of each camera from the first camera at that time, in the map's axes [m]. The
    #: rig is rigid: an error of its rotation also displaces this camera.
    levers: NDArray[np.float64]
    #: (F,): number of the viewpoint of each frame, ascending for each camera: frames that a camera
    #: took without moving share a viewpoint
    viewpoints: NDArray[np.int64]
    #: (F,): one over the number of frames of the viewpoint, as the errors of their boxes are equal
    weights: NDArray[np.float64]
    offsets: NDArray[np.int64]  #: (F + 1,): first box of each frame
    #: (n,): of each box
    frames: NDArray[np.int64]
    classes: NDArray[np.int64]
    edges: NDArray[np.float64]  #: (n, 4): Left, top, right, bottom, clipped to the image
    stiffness: NDArray[np.float64]  #: (n, 4): inverse standard deviation of each edge
    #: (n, 4): the edge lies at the image border: the object may extend beyond it
    is_open: NDArray[np.bool_]
    bounds: NDArray[np.float64]  #: (F, 4): Left, top, right, bottom of the image
    #: (n,): measured depth of the object's centre [m], and its inverse standard deviation; 0 where
    #: unknown
    depths: NDArray[np.float64]
    depth_stiffness: NDArray[np.float64]
    #: (n, 2): logarithm of half the longest extent [m] of objects of the box's class and its
    #: inverse standard deviation, see triangulation.add_depths; only with depth
    sizes: NDArray[np.float64]

    @property
    def centers(self) -> NDArray[np.float64]:
        """Return the centres of the cameras (F, 3) [m]."""
        return np.asarray(-np.einsum('fji,fj->fi', self.rotations, self.translations))

    @property
    def poses(self) -> NDArray[np.float64]:
        """Return the poses map_from_camera (F, 4, 4) of all frames."""
        poses = np.tile(np.eye(4), (len(self.rotations), 1, 1))
        poses[:, :3, :3] = self.rotations.transpose(0, 2, 1)
        poses[:, :3, 3] = self.centers
        return poses

    def with_poses(self, map_from_camera: NDArray[np.float64]) -> 'Views':
        """Return the same views with other poses (F, 4, 4)."""
        rotations, translations = _inverses(map_from_camera)
        return self._replace(rotations=rotations, translations=translations)

    def between(self, first: int, last: int) -> 'Views':
        """Return the frames from first up to last, last excluded; nothing is copied."""
        boxes = slice(int(self.offsets[first]), int(self.offsets[last]))
        return self.select(slice(first, last), boxes)._replace(
            offsets=self.offsets[first:last + 1] - boxes.start, frames=self.frames[boxes] - first)

    def select(self, frames: slice | NDArray[np.int64], boxes: slice | NDArray[np.int64]
               ) -> 'Views':
        """Return the given frames and boxes; the caller renumbers offsets and frames."""
        return self._replace(**{name: getattr(self, name)[rows] for names, rows in (
            (_OF_FRAMES, frames), (_OF_BOXES, boxes)) for name in names})


def make_views(detections: PosedDetections) -> Views:
    """Convert posed detections to the arrays that the kernels read."""
    boxes_px, is_open = detections.bboxes_xyxy, detections.open_edges
    of_boxes = detections.frame_cameras[detections.frames]
    sizes = np.array([[camera.width, camera.height] * 2 for camera in detections.cameras],
                     dtype=np.float64)
    focals = np.array([[camera.fx, camera.fy] * 2 for camera in detections.cameras])
    principals = np.array([[camera.cx, camera.cy] * 2 for camera in detections.cameras])
    bounds_px = np.concatenate([0.0 * sizes[:, :2], sizes[:, 2:]], axis=1)
    if is_open is None:
        boxes_px = np.clip(boxes_px, 0.0, sizes[of_boxes])
        is_open = at_border(boxes_px, sizes[of_boxes])
    else:
        for number, bounds in enumerate(bounds_px):
            own, own_open = boxes_px[of_boxes == number], is_open[of_boxes == number]
            reach = np.concatenate([own[:, :2].min(axis=0, initial=np.inf),
                                    own[:, 2:].max(axis=0, initial=-np.inf)])
            bounds_px[number] = np.where(own_open.any(axis=0), reach, bounds)
    extents_px = np.tile(boxes_px[:, 2:] - boxes_px[:, :2], 2)
    deviations_px = np.hypot(EDGE_SIGMA_PX, EDGE_SIGMA_SHARE * extents_px)
    viewpoints = number_viewpoints(detections)
    return Views(
        *_inverses(detections.map_from_camera),
        np.ascontiguousarray(detections.stamps_s, dtype=np.float64), detections.frame_cameras,
        _levers(detections), viewpoints, 1.0 / np.bincount(viewpoints)[viewpoints],
        detections.frame_offsets, detections.frames, detections.classes,
        (boxes_px - principals[of_boxes]) / focals[of_boxes], focals[of_boxes] / deviations_px,
        is_open, ((bounds_px - principals) / focals)[detections.frame_cameras],
        np.zeros(len(boxes_px)), np.zeros(len(boxes_px)), np.tile(NO_SIZE, (len(boxes_px), 1)))


def at_border(boxes_px: NDArray[np.float64], sizes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (n, 4) of the edges of boxes that lie at the border of their images.

    The sizes (n, 4), or (4,), are width, height, width, height [px].
    """
    return np.hstack([boxes_px[:, :2] <= _BORDER_PX,
                      boxes_px[:, 2:] >= sizes[..., 2:] - _BORDER_PX])


def _levers(detections: PosedDetections) -> NDArray[np.float64]:
    """Return the levers (F, 3) of Views [m].

    The position of a camera on the rig is the median of its positions relative to the first
    camera, whose poses are interpolated. This is an approximation for a camera that moves on its
    robot. Cameras that move independently, like those of a folder of photos, have no levers.
    """
    cameras, poses = detections.frame_cameras, detections.map_from_camera
    levers, first = np.zeros((len(cameras), 3)), np.nonzero(cameras == 0)[0]
    for number in range(1, len(detections.cameras) if len(first) else 0):
        own = np.nonzero(cameras == number)[0]
        if len(own):
            there = np.stack([np.interp(detections.stamps_s[own], detections.stamps_s[first],
                                        poses[first, axis, 3]) for axis in range(3)], axis=1)
            axes = poses[own, :3, :3]
            places = np.einsum('fji,fj->fi', axes, poses[own, :3, 3] - there)
            place = np.median(places, axis=0)
            if np.median(np.linalg.norm(places - place, axis=1)) < _MOST_PLAY_M:
                levers[own] = axes @ place
    return levers


def _inverses(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (F, 3, 3) and translations (F, 3) of the inverses of poses (F, 4, 4)."""
    rotations = np.ascontiguousarray(poses[:, :3, :3].transpose(0, 2, 1))
    return rotations, np.ascontiguousarray(-np.einsum('fij,fj->fi', rotations, poses[:, :3, 3]))


def thin_out(views: Views, most: int) -> NDArray[np.bool_]:
    """Return a mask (F,) that keeps an even sample of at most `most` frames of each viewpoint."""
    kept = np.zeros(len(views.viewpoints), dtype=np.bool_)
    for frames in group_boxes(views.viewpoints, int(views.viewpoints.max(initial=-1)) + 1):
        steps = np.arange(-1, len(frames)) * most // len(frames)
        kept[frames] = steps[1:] != steps[:-1]
    return kept


@dataclass(frozen=True)
class KeyframeOptions:
    """Spacing of keyframes; reaching one limit is sufficient.

    The defaults are the spacing of viewpoints.
    """

    #: [m] [deg]. 0: every frame with a pose.
    distance_m: float = 0.1
    angle_deg: float = 5.0


_VIEWPOINT = KeyframeOptions()


class KeyframeFilter:
    """Chooses keyframes among the frames of a camera, which are passed in order.

    It counts all frames as `asked`, and those without a pose.
    """

    def __init__(self, options: KeyframeOptions) -> None:
        self._options = options
        self._last: NDArray[np.float64] | None = None
        self.asked = self.without_pose = 0

    def __call__(self, place: int, stamp_ns: int, pose: NDArray[np.float64] | None) -> bool:
        """Return whether the frame with this pose is a keyframe."""
        self.asked += 1
        if pose is None:
            self.without_pose += 1
            return False
        if self._last is not None:
            distance, angle = pose_error(pose, self._last)
            if distance < self._options.distance_m and angle < self._options.angle_deg:
                return False
        self._last = pose
        return True


def number_viewpoints(detections: PosedDetections, spacing: KeyframeOptions = _VIEWPOINT
                      ) -> NDArray[np.int64]:
    """Return the number of the viewpoint (F,) of each frame, ascending from 0, camera by camera.

    A new viewpoint begins where a keyframe would, by default as soon as a frame differs from the
    first frame of the current one by 10 cm or 5 degrees.
    """
    poses, order = detections.map_from_camera, detections.by_camera
    filters = [KeyframeFilter(spacing) for _ in detections.cameras]
    is_new = [filters[detections.frame_cameras[frame]](0, 0, poses[frame]) for frame in order]
    viewpoints = np.zeros(len(poses), dtype=np.int64)
    viewpoints[order] = np.cumsum(is_new) - 1
    return viewpoints


def check_input(detections: PosedDetections, views: Views,
                min_viewpoints: int = MappingOptions.min_viewpoints) -> list[str]:
    """Return notes on the input.

    MappingError: no map can be made of it; the message says what to correct.
    """
    if len(detections.classes) == 0:
        raise MappingError(f'the {len(detections)} frames have no detections; check the detector, '
                           'its classes and its confidence threshold')
    viewpoints = int(views.viewpoints.max()) + 1
    if viewpoints < min_viewpoints:
        raise MappingError(f'the camera took {counted(viewpoints, "viewpoint")}, at least '
                           f'{min_viewpoints} are needed; move it around the objects, and check '
                           'the poses')
    jumps = np.sort(np.concatenate([
        _jumps(detections.map_from_camera[own], detections.stamps_s[own])
        for own in (views.cameras == number for number in range(len(detections.cameras)))]))
    notes = []
    if len(jumps):
        notes.append(f'the poses jump {len(jumps)} times, first at {jumps[0]:.2f} s; check the '
                     'localization that produced them')
    empty = float(np.mean(np.diff(detections.frame_offsets) == 0))
    if empty > _MAX_EMPTY_SHARE:
        notes.append(f'{empty:.0%} of the frames have no detections; check the detector')
    if len(detections.class_names) == 1:
        notes.append(f"all boxes are of the class '{detections.class_names[0]}'; maps with more "
                     'classes relocalize better')
    return notes


def _jumps(poses: NDArray[np.float64], stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the stamps [s] at which the poses of one camera move faster than any camera."""
    seconds = np.maximum(np.diff(stamps), 1e-3)
    distances = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    traces = np.einsum('fij,fij->f', poses[1:, :3, :3], poses[:-1, :3, :3])
    angles = np.degrees(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))
    far = (distances > _LEAST_JUMP_M) & (distances > _MAX_SPEED_M_PER_S * seconds)
    far |= (angles > _LEAST_JUMP_DEG) & (angles > _MAX_TURN_DEG_PER_S * seconds)
    return stamps[1:][far]
