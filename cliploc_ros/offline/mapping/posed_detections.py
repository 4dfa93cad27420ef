# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The input of mapping: the detections of many frames, and the pose of each frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import move_poses
from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import DatasetError

# Intrinsics that differ by a smaller share belong to one camera that refocuses.
_SAME_CAMERA = 0.02
_PER_BOX = ('bboxes_xyxy', 'classes', 'scores', 'depths', 'depth_spreads', 'embeddings',
            'open_edges')
_PER_FRAME = ('map_from_camera', 'stamps_s', 'odom_from_camera', 'camera_rows', 'stamps_ns')


@dataclass(frozen=True)
class PosedDetections:
    """Detections and poses of F frames in the order of time: n boxes of C classes.

    The frames of several cameras of one robot are interleaved.
    """

    cameras: tuple[Camera, ...]  #: Of the undistorted images
    map_from_camera: NDArray[np.float64]  #: (F, 4, 4): the poses used for mapping
    stamps_s: NDArray[np.float64]  #: (F,): times of the images [s], ascending
    #: (F + 1,): frame f has the boxes from frame_offsets[f] up to frame_offsets[f + 1]
    frame_offsets: NDArray[np.int64]
    bboxes_xyxy: NDArray[np.float64]  #: (n, 4): Left, top, right, bottom [px], undistorted
    class_names: tuple[str, ...]  #: The C detector classes
    classes: NDArray[np.int64]  #: (n,): index of each box's class
    scores: NDArray[np.float64]  #: (n,): detector confidences, 0 to 1
    #: (n,): depth of the object in each box, along z of the camera, and half the distance between
    #: its 16th and 84th percentile [m]; NaN where unknown
    depths: NDArray[np.float32] | None = None
    depth_spreads: NDArray[np.float32] | None = None
    embeddings: NDArray[np.float16] | None = None  #: (n, d): of the crops, unit rows
    encoder_key: str = ''  #: Identifies the encoder of the embeddings
    #: (F, 4, 4): camera poses by odometry, which drifts but does not jump; NaN where unknown
    odom_from_camera: NDArray[np.float64] | None = None
    #: (n, 4): the edge lay at the border of the original image, so the object may extend beyond
    #: it. Needed for a distorted lens, as the border is not straight in the undistorted image.
    #: None: edges at the border of the undistorted image are open.
    open_edges: NDArray[np.bool_] | None = None
    #: (F,): the row of each frame's camera in `cameras`; None: all frames are of the first one
    camera_rows: NDArray[np.int64] | None = None
    camera_names: tuple[str, ...] = ('',)  #: Of the cameras; '' for a single unnamed one
    stamps_ns: NDArray[np.int64] | None = None  #: (F,): exact times of recorded images [ns]
    #: Number of images in the recording, and of images without a pose
    images: int = 0
    without_pose: int = 0
    described: str = ''  #: All inputs and settings of the recording; '' where unknown

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.stamps_s)

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """Return the frame (n,) of each box."""
        return np.repeat(np.arange(len(self)), np.diff(self.frame_offsets))

    @cached_property
    def frame_cameras(self) -> NDArray[np.int64]:
        """Return the row (F,) of each frame's camera."""
        rows = self.camera_rows
        return np.zeros(len(self), dtype=np.int64) if rows is None else rows

    @cached_property
    def by_camera(self) -> NDArray[np.int64]:
        """Return the frames (F,) sorted by camera, and by time within each camera."""
        return np.argsort(self.frame_cameras, kind='stable')

    def camera_of(self, frame: int) -> Camera:
        """Return the camera of a frame."""
        return self.cameras[self.frame_cameras[frame]]

    def detections_of(self, frame: int) -> Detections:
        """Return the detections of a frame."""
        rows = slice(*self.frame_offsets[frame:frame + 2])
        return Detections(self.bboxes_xyxy[rows], tuple(
            self.class_names[kind] for kind in self.classes[rows]), self.scores[rows])

    def name_of(self, frame: int) -> str:
        """Return the name of a frame's camera; '' for a single unnamed camera."""
        return self.camera_names[self.frame_cameras[frame]]

    def every(self, step: int, first: int = 0) -> NDArray[np.int64]:
        """Return every n-th frame of each camera, in the order of time.

        Taking every n-th of the interleaved frames could select the frames of a single camera.
        """
        return np.sort(self.by_camera[first::step])

    def select_frames(self, frames: Sequence[int] | NDArray[np.int64]) -> 'PosedDetections':
        """Return the detections of some frames, in the order given."""
        frames = np.asarray(frames, dtype=np.int64)
        starts, ends = self.frame_offsets[frames], self.frame_offsets[frames + 1]
        boxes = np.concatenate([np.arange(0), *map(np.arange, starts, ends)])
        return replace(
            self, frame_offsets=np.cumsum(np.concatenate([[0], ends - starts])),
            **self._rows(_PER_BOX, boxes), **self._rows(_PER_FRAME, frames))

    def select_boxes(self, boxes: NDArray[np.bool_]) -> 'PosedDetections':
        """Return all frames with the boxes that a mask (n,) selects."""
        counts = np.bincount(self.frames[boxes], minlength=len(self))
        return replace(self, frame_offsets=np.cumsum(np.concatenate([[0], counts])),
                       **self._rows(_PER_BOX, boxes))

    def _rows(self, names: Sequence[str], rows: NDArray[Any]) -> dict[str, Any]:
        """Return the given rows of some arrays."""
        arrays = {name: getattr(self, name) for name in names}
        return {name: None if array is None else array[rows] for name, array in arrays.items()}

    def with_poses(self, map_from_camera: NDArray[np.float64]) -> 'PosedDetections':
        """Return the same detections with other poses (F, 4, 4)."""
        return replace(self, map_from_camera=map_from_camera)

    def moved(self, scale: float, rotation: NDArray[np.float64],
              shift: NDArray[np.float64] | float = 0.0) -> 'PosedDetections':
        """Return the same detections with moved poses, see move_poses."""
        return self.with_poses(move_poses(self.map_from_camera, scale, rotation, shift))


def join_detections(parts: Sequence[PosedDetections]) -> PosedDetections:
    """Join the detections of several recordings with poses in one coordinate frame.

    Classes are matched by name, and cameras by name and intrinsics. Numbers that a recording lacks
    are NaN. DatasetError: the embeddings are of several encoders.
    """
    if len({part.encoder_key for part in parts}) > 1:
        raise DatasetError('recordings with embeddings of different encoders, or without: record '
                           'all with one CLIP, or with `no_clip`')
    classes = sorted({name for part in parts for name in part.class_names})
    own = [[*zip(part.camera_names, part.cameras, strict=True)] for part in parts]
    known = [*dict.fromkeys(chain(*own))]
    names, cameras = zip(*known, strict=True)
    parts = [replace(
        part, classes=np.array([*map(classes.index, part.class_names), 0])[part.classes],
        camera_rows=np.array([*map(known.index, pairs)])[part.frame_cameras])
        for part, pairs in zip(parts, own, strict=True)]

    def joined(name: str) -> Any:
        found = [getattr(part, name) for part in parts]
        example = next((array for array in found if array is not None), np.empty(0, np.bool_))
        if example.dtype.kind != 'f' and any(array is None for array in found):
            return None
        return np.concatenate([np.full((len(part.classes if name in _PER_BOX else part),
                                        *example.shape[1:]), np.nan) if array is None else array
                               for part, array in zip(parts, found, strict=True)])
    together = replace(
        parts[0], cameras=cameras, class_names=tuple(classes), camera_names=tuple(
            f'{name}#{row}' if name in names[:row] else name for row, name in enumerate(names)),
        frame_offsets=np.cumsum([0, *chain(*(np.diff(part.frame_offsets) for part in parts))]),
        **{name: joined(name) for name in (*_PER_BOX, *_PER_FRAME)})
    return together.select_frames(np.argsort(together.stamps_s, kind='stable'))


def group_cameras(cameras: Sequence[Camera]
                  ) -> tuple[tuple[Camera, ...], NDArray[np.int64], tuple[str, ...]]:
    """Merge the cameras of F images of a folder.

    Cameras of one image size whose intrinsics differ only by refocusing are merged. Return the
    merged cameras, the row (F,) of each image, and the names of the cameras by their image size;
    '' for a single camera.
    """
    found: list[Camera] = []
    rows = {}
    for camera in dict.fromkeys(cameras):
        for row, other in enumerate(found):
            change = np.abs(camera.matrix - other.matrix).max() / other.fx
            if (camera.width, camera.height) == (other.width, other.height) and (
                    change < _SAME_CAMERA):
                rows[camera] = row
                break
        else:
            rows[camera] = len(found)
            found.append(camera)
    names = tuple(f'{number}: {camera.width}x{camera.height}'
                  for number, camera in enumerate(found, 1)) if len(found) > 1 else ('',)
    return tuple(found), np.array([rows[camera] for camera in cameras], dtype=np.int64), names
