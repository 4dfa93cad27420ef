# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images with their cameras, poses and depth, from folders and recordings.

Evaluation, mapping and the map editor share this reader. It yields a stream of raw frames:
unwanted frames are never decoded, and a raw frame can be decoded in another process.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import camera_faults
from cliploc_ros.core.geometry.depth import DepthCamera, DepthImage, depth_from_counts
from cliploc_ros.core.geometry.transforms import move_poses
from cliploc_ros.errors import DatasetError
from cliploc_ros.units import NS_PER_S

_MOST_NOTES = 5  # on cameras; each image may have a different camera
# Greatest number of pixels to compute for an undistorted image; each takes 0.6 kB.
_MOST_PLACES = 1_000_000


@dataclass(frozen=True)
class PosedImage:
    """An image (h, w, 3) uint8, RGB, with its camera, pose and depth.

    ``map_from_camera`` is None if no pose is known at ``stamp_ns``.
    """

    stamp_ns: int
    image_rgb: NDArray[np.uint8]
    camera: Camera
    map_from_camera: NDArray[np.float64] | None
    depth: DepthImage | None = None


@dataclass(frozen=True)
class RawFrame:
    """A frame that is not decoded yet; it is small, and can be sent to another process."""

    place: int  #: Index of the image in its source
    stamp_ns: int  #: [ns]
    map_from_camera: NDArray[np.float64] | None  #: (4, 4)
    color: Callable[[], tuple[NDArray[np.uint8], Camera]]  #: Returns the image and its camera
    depth: Callable[[], DepthImage] | None = None  #: Returns the depth image
    camera: str = ''  #: Name of the camera; '' if there is only one

    def __str__(self) -> str:
        """Return the frame's name for messages."""
        of = f' of {self.camera}' if self.camera else ''
        return f'image {self.place}{of} at {self.stamp_ns / NS_PER_S:.6f} s'

    def decode(self) -> PosedImage:
        """Decode the frame.

        DatasetError: the image cannot be decoded, or its camera is invalid.
        """
        image_rgb, camera = self.color()
        return PosedImage(self.stamp_ns, image_rgb, camera, self.map_from_camera,
                          None if self.depth is None else self.depth())


#: Returns whether to read a frame, given its index, stamp [ns] and pose.
Wanted = Callable[[int, int, 'NDArray[np.float64] | None'], bool]


@dataclass(frozen=True)
class Frames:
    """Frames of a source, with one image in memory at a time; each use reads the source again."""

    source: Path  #: Folder or file
    count: int  #: Number of images
    #: Returns an iterator over the wanted frames; calls its argument once for each image, in order
    read_raw: Callable[[Wanted], Iterator[RawFrame]]
    camera: str = ''  #: Name of the camera; '' if there is only one
    #: The frames of each camera; empty if there is only one
    of_cameras: tuple['Frames', ...] = ()
    varies: bool = False  #: Whether the camera differs between images
    #: Digests of images with cameras, and of poses, which may change without the images
    digest: str = ''
    notes: tuple[str, ...] = ()  #: Notes for the user on the source

    @property
    def each(self) -> tuple['Frames', ...]:
        """Return the frames of each camera; there is at least one."""
        return self.of_cameras or (self,)

    def read(self) -> Iterator[PosedImage]:
        """Yield all frames, decoded."""
        for raw in self.read_raw(lambda place, stamp_ns, pose: True):
            yield raw.decode()

    def select(self, places: Iterable[int]) -> 'Frames':
        """Select frames by index; 0 is the first frame."""
        chosen = frozenset(places)

        def read_raw(is_wanted: Wanted) -> Iterator[RawFrame]:
            return self.read_raw(lambda place, stamp_ns, pose: place in chosen
                                 and is_wanted(place, stamp_ns, pose))
        return replace(self, count=len(chosen), read_raw=read_raw, camera='', of_cameras=())


def move_frames(frames: Frames, scale: float, rotation: NDArray[np.float64]) -> Frames:
    """Scale and rotate the poses of frames, see move_poses."""
    def moved(pose: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        return None if pose is None else move_poses(pose[None], scale, rotation)[0]

    def read_raw(is_wanted: Wanted) -> Iterator[RawFrame]:
        for raw in frames.read_raw(lambda place, stamp_ns, pose: is_wanted(place, stamp_ns,
                                                                           moved(pose))):
            yield replace(raw, map_from_camera=moved(raw.map_from_camera))
    return replace(
        frames, read_raw=read_raw, digest=f'{frames.digest} {scale} {rotation.tolist()}',
        of_cameras=tuple(move_frames(part, scale, rotation) for part in frames.of_cameras))


def join_frames(of_cameras: Mapping[str, Frames]) -> Frames:
    """Join the frames of the cameras of a recording, given by name, one camera after another."""
    first, parts = 0, []
    for name, frames in of_cameras.items():
        def read_raw(is_wanted: Wanted, name: str = name, frames: Frames = frames,
                     first: int = first) -> Iterator[RawFrame]:
            for raw in frames.read_raw(is_wanted):
                yield replace(raw, place=first + raw.place, camera=name)
        parts.append(replace(frames, read_raw=read_raw, camera=name))
        first += frames.count
    return Frames(parts[0].source, first, lambda is_wanted: chain.from_iterable(
        part.read_raw(is_wanted) for part in parts), of_cameras=tuple(parts),
        notes=tuple(note for part in parts for note in part.notes))


#: The stamp of an image of unknown time.
NO_STAMP = -2**63


class ImageFile(NamedTuple):
    """An image of a folder, with its camera, pose and depth image; None where missing."""

    stamp_ns: int  #: NO_STAMP if the layout has no stamps
    color: Path  #: An image, or a video
    camera: Camera
    #: (4, 4): in the convention of the folder, later map_from_camera; None if unknown
    pose: NDArray[np.float64] | None = None
    depth: Path | None = None
    confidence: Path | None = None  #: Image of the size of the depth image; 0: unreliable depth
    number: int | None = None  #: Number of the image in a video


@dataclass(frozen=True)
class DepthFormat:
    """Format of depth images."""

    #: Metres per count. None: 1 mm for 16-bit integers, 1 m for floats.
    unit_m: float | None = None
    camera: DepthCamera | None = None  #: None: registered to the colour image
    scale: float = 1.0  #: Further factor of depth [m], if unit_m is in the unit of the poses


def folder_frames(folder: Path, files: Sequence[ImageFile], depth: DepthFormat | None = None
                  ) -> Frames:
    """Return the frames of image files; the poses of the files are map_from_camera."""
    form = depth or DepthFormat()

    def read_raw(is_wanted: Wanted) -> Iterator[RawFrame]:
        for place, file in enumerate(files):
            if is_wanted(place, file.stamp_ns, file.pose):
                yield RawFrame(place, file.stamp_ns, file.pose, partial(read_color, file),
                               None if file.depth is None else partial(read_depth, file, form))
    cameras = dict.fromkeys(file.camera for file in files)
    # images may have been cropped without a record, so that no fault is certain
    notes = dict.fromkeys(f'note: {fault.text}' for camera in cameras
                          for fault in camera_faults(camera))
    return Frames(folder, len(files), read_raw, varies=len(cameras) > 1,
                  notes=tuple(notes)[:_MOST_NOTES])


def read_color(file: ImageFile, upright: bool = False) -> tuple[NDArray[np.uint8], Camera]:
    """Read an image (h, w, 3), RGB, and its camera.

    The EXIF orientation is applied if `upright` is set, or if only the rotated image has the
    camera's size. DatasetError: the image cannot be decoded, or its size differs from the
    camera's.
    """
    path, camera = file.color, file.camera
    image = (_read_image(path, upright) if file.number is None
             else _open_video(path).image(file.number))
    if image is None:
        of = '' if file.number is None else f': image {file.number} of the video'
        raise DatasetError(f'{path}{of} cannot be read as an image')
    if file.number is None and image.shape[:2] == (camera.width, camera.height) and (
            camera.width != camera.height):
        image = _read_image(path, not upright)
        assert image is not None
    if image.shape[:2] != (camera.height, camera.width):
        turned = image.shape[:2] == (camera.width, camera.height)
        raise DatasetError(
            f'{path} has {image.shape[1]}x{image.shape[0]} px, but the camera has '
            f'{camera.width}x{camera.height} px' + (
                '; does its EXIF orientation rotate it? Rotate the pixels, for example with '
                'mogrify -auto-orient' if turned else ''))
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8), camera


def _read_image(path: Path, upright: bool) -> Any:
    """Read an image (h, w, 3), BGR; None if it cannot be read."""
    return cv2.imread(str(path), cv2.IMREAD_COLOR | (0 if upright
                                                     else cv2.IMREAD_IGNORE_ORIENTATION))


class _Video:
    """A video that is read forward; to go back, it is opened again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open()

    def _open(self) -> None:
        self._next = 0
        self._capture = cv2.VideoCapture(str(self._path))
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)

    def image(self, number: int) -> NDArray[np.uint8] | None:
        """Read an image (h, w, 3), BGR, by its index; None if there is none."""
        if number < self._next:
            self._open()
        while self._next < number:
            self._next += 1
            if not self._capture.grab():
                return None
        self._next += 1
        found, image = self._capture.read()
        return image if found else None


_open_video = lru_cache(1)(_Video)


def read_depth(file: ImageFile, form: DepthFormat) -> DepthImage:
    """Read the depth image that belongs to an image; DatasetError: it cannot be read."""
    counts = cv2.imread(str(file.depth), cv2.IMREAD_UNCHANGED)
    if counts is None:
        raise DatasetError(f'{file.depth} cannot be read as a depth image')
    depths_m = depth_from_counts(counts, form.unit_m, str(file.depth))
    if form.scale != 1.0:
        depths_m *= np.float32(form.scale)
    if file.confidence is not None:
        certain = cv2.imread(str(file.confidence), cv2.IMREAD_UNCHANGED)
        if certain is None or certain.shape != depths_m.shape:
            raise DatasetError(f'{file.confidence} is not an image of the size of {file.depth}')
        depths_m[certain == 0] = np.nan
    return DepthImage(depths_m, form.camera)


def undistorted(image_rgb: NDArray[np.uint8], camera: Camera, pinhole: Camera | None = None
                ) -> NDArray[np.uint8]:
    """Undistort an image (h, w, 3) to a pinhole camera; default: the pinhole of its camera.

    Pixels outside the camera's view are black.
    """
    pinhole = pinhole or camera.pinhole
    if pinhole == camera.pinhole and camera.is_pinhole:
        return image_rgb
    # large images: a coarse grid is interpolated, since lens distortion is smooth
    step = max(1, math.isqrt(pinhole.width * pinhole.height // _MOST_PLACES))
    columns, rows = np.meshgrid(*(step * np.arange(-1, side // step + 2) + 0.5 * (step - 1)
                                  for side in (pinhole.width, pinhole.height)))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    places = camera.project_normalized(pinhole.normalize_points(pixels))
    places = np.nan_to_num(places, nan=-1.0).reshape(*columns.shape, 2).astype(np.float32)
    places = cv2.resize(places, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)[
        step:step + pinhole.height, step:step + pinhole.width]
    return np.asarray(cv2.remap(image_rgb, places[..., 0], places[..., 1], cv2.INTER_LINEAR),
                      dtype=np.uint8)
