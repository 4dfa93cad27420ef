# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images with their cameras, poses and depth, from folders and recordings.

Evaluation, mapping and the map editor share this reader. It yields a stream of raw frames:
unwanted frames are never decoded, and a raw frame can be decoded in another process. The readers
of the layouts of folders get FolderOptions, and return a Capture: images in order of time.
"""

import math
import re
from collections import Counter
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
from cliploc_ros.core.geometry.transforms import is_rigid, move_poses
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.parsing import MAX_STAMP_S
from cliploc_ros.offline.datasets.poses import STAMP_TOLERANCE_NS, TimedPoses
from cliploc_ros.units import NS_PER_S

_MOST_NOTES = 5  # on cameras; each image may have a different camera
# Greatest number of pixels to compute for an undistorted image; each takes 0.6 kB.
_MOST_PLACES = 1_000_000
#: Endings of image files.
IMAGES = ('.jpg', '.jpeg', '.png')
# Step between images without stamps. They may be separate photos: at this step, no motion between
# two of them looks like a jump of the poses.
_INVENTED_STEP_NS = NS_PER_S
# Files store rotations with few digits.
_ROTATION_TOLERANCE = 1e-2


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
    of_tf: bool = False  #: Whether tf has the poses, or the mount of the camera
    is_metric: bool = True  #: Whether the unit of the poses is known
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


def move_frames(frames: Frames, scale: float, rotation: NDArray[np.float64],
                shift: NDArray[np.float64] | float = 0.0) -> Frames:
    """Scale, rotate and shift the poses of frames, see move_poses."""
    def moved(pose: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        return None if pose is None else move_poses(pose[None], scale, rotation, shift)[0]

    def read_raw(is_wanted: Wanted) -> Iterator[RawFrame]:
        for raw in frames.read_raw(lambda place, stamp_ns, pose: is_wanted(place, stamp_ns,
                                                                           moved(pose))):
            yield replace(raw, map_from_camera=moved(raw.map_from_camera))
    return replace(
        frames, read_raw=read_raw, digest=f'{frames.digest} {scale} {rotation.tolist()} {shift}',
        of_cameras=tuple(move_frames(part, scale, rotation, shift) for part in frames.of_cameras))


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
        of_tf=parts[0].of_tf, notes=tuple(note for part in parts for note in part.notes))


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


_AS_USUAL = DepthFormat()


def folder_frames(folder: Path, files: Sequence[ImageFile], form: DepthFormat = _AS_USUAL
                  ) -> Frames:
    """Return the frames of image files; the poses of the files are map_from_camera."""
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


@dataclass(frozen=True)
class FolderOptions:
    """Settings for reading a folder that its files do not contain."""

    intrinsics: str | None = None  #: Name of a preset, or a camera.json; None: those of the folder
    trajectory: TimedPoses | None = None  #: Poses to use instead of those of the folder
    max_gap_ns: int = 0  #: Greatest gap between two poses to interpolate over [ns]
    #: (4, 4): mount of the camera on the body of the poses
    body_from_camera: NDArray[np.float64] | None = None
    depth: DepthFormat = _AS_USUAL  #: Differences from the folder's usual format
    layout: str = ''  #: Key of one of LAYOUTS; '': recognized by its files
    images: Path | None = None  #: Folder of the images, for colmap and nerf
    #: Convention of the stored poses, one of AXES; None: that of the layout
    axes: str | None = None
    scale: float | None = None  #: Metres per stored unit
    #: Two images and the distance between their cameras [m], to compute the scale
    known_distance: tuple[str, str, float] | None = None
    any_unit: bool = False  #: Whether to read an unknown unit as metres
    level: bool = False  #: Whether to rotate the map until z is up, by the tilt of the cameras
    #: Greatest difference between the stamps of a TUM RGB-D image and its pose or depth image [ns]
    tolerance_ns: int = STAMP_TOLERANCE_NS


@dataclass(frozen=True)
class Capture:
    """Images in order of time, with their poses as stored."""

    files: tuple[ImageFile, ...]
    axes: str = 'opencv'  #: Convention of the stored poses: one of agreement.AXES
    depth: DepthFormat = _AS_USUAL
    #: Axis of the poses' coordinate frame that the layout defines as up: 'y' or 'z'; '' if it
    #: defines none
    up: str = ''
    is_metric: bool = True  #: Whether the layout defines the metre as its unit
    notes: tuple[str, ...] = ()
    images: int = 0  #: Number of images, if it exceeds that of the files; the others have no pose
    #: The trajectory that the poses were interpolated from, if any. It must overlap the images in
    #: time, even where single images have no pose
    trajectory: TimedPoses | None = None

    @classmethod
    def of(cls, files: Sequence[ImageFile], where: object, axes: str,
           depth: DepthFormat = _AS_USUAL, up: str = '', is_metric: bool = True,
           notes: Sequence[str] = (), images: int = 0) -> 'Capture':
        """Make a capture of listed images, see arrange.

        Its notes count the listed images and depth images that are missing.
        """
        arranged = arrange(files, where)
        missing = [[file.color for file in files if beside(file.color) is None],
                   [file.depth for file in files if file.depth is not None
                    and beside(file.depth) is None]]
        left_out = [f'{len(paths)} of {len(files)} listed {what} are missing, such as {paths[0]}'
                    for what, paths in zip(('images', 'depth images'), missing, strict=True)
                    if paths]
        return cls(tuple(file if file.depth is None else file._replace(depth=beside(file.depth))
                         for file in arranged), axes, depth, up, is_metric,
                   (*notes, *left_out), images)


def arrange(files: Sequence[ImageFile], where: object) -> tuple[ImageFile, ...]:
    """Sort images by time, and make their poses rigid.

    Images without stamps are sorted by name, with numbers in names by value. Images whose file is
    missing are left out.

    Raises
    ------
    DatasetError
        No image exists or has a pose, an image is listed twice, or a pose is not rigid.
    """
    present = [file for file in files if beside(file.color) is not None]
    if not present:
        raise DatasetError(f'{where}: none of {len(files)} images exists' + (
            f', such as {files[0].color}; give the folder of the images with `images`'
            if files else ''))
    counts = Counter((file.color, file.number) for file in present)
    (first, _), count = counts.most_common(1)[0]
    if count > 1:
        raise DatasetError(f'{where}: lists the image {first.name} twice')
    stamps = {file.stamp_ns for file in present}
    if NO_STAMP in stamps or len(stamps) < len(present):
        present.sort(key=lambda file: re.sub(
            '[0-9]+', lambda number: number[0].zfill(20), str(file.color)))
        times = [place * _INVENTED_STEP_NS for place in range(len(present))]
    else:
        present.sort(key=lambda file: file.stamp_ns)
        times = [file.stamp_ns for file in present]
        if times[0] < 0 or times[-1] > MAX_STAMP_S * NS_PER_S:
            times = [time - times[0] for time in times]
    if times[-1] > MAX_STAMP_S * NS_PER_S:
        raise DatasetError(f'{where}: its stamps span {times[-1] / NS_PER_S:.3g} s')
    arranged = tuple(
        file._replace(stamp_ns=time, pose=_sound(file.pose, f'{where}: pose of {file.color.name}'))
        for time, file in zip(times, present, strict=True))
    if all(file.pose is None for file in arranged):
        raise DatasetError(f'{where}: none of {len(present)} images has a pose')
    return arranged


def _sound(pose: NDArray[np.float64] | None, where: str) -> NDArray[np.float64] | None:
    """Return the nearest rigid pose (4, 4); None where tracking was lost."""
    if pose is None or not np.isfinite(pose).all():
        return None
    if not is_rigid(pose, _ROTATION_TOLERANCE):
        is_mirrored = is_rigid(pose @ np.diag([1.0, 1.0, -1.0, 1.0]), _ROTATION_TOLERANCE)
        raise DatasetError(f'{where} is not a rotation and translation' + (
            ': it is a reflection; export with right-handed axes'
            if is_mirrored else ': its axes are not of unit length or not orthogonal'))
    left, _, right = np.linalg.svd(pose[:3, :3])
    sound = pose.copy()
    sound[:3, :3] = left @ right
    return sound


def first_image(folder: Path, stem: str) -> Path | None:
    """Find the image file with a stem and an ending in IMAGES; None if there is none."""
    return next((found for end in IMAGES if (found := beside(folder / f'{stem}{end}'))), None)


def size_of_image(path: Path) -> tuple[int, int] | None:
    """Return width and height of an image file [px]; None if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else (image.shape[1], image.shape[0])


def beside(path: Path) -> Path | None:
    """Return the path of a file if it exists; None if it is missing or not a valid file name."""
    try:
        return path if path.is_file() else None
    except OSError:  # too long
        return None
