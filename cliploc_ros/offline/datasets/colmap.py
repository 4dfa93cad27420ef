# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read cameras and images of COLMAP models, text or binary (colmap.github.io/format.html)."""

import mmap
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.files.storage import open_file
from cliploc_ros.offline.datasets import frames, parsing

_PLACES = ('.', 'sparse', 'sparse/0', 'sparse/1', 'colmap/sparse/0', 'model', 'colmap',
           'distorted/sparse', 'distorted/sparse/0')  # the last two of 3D Gaussian splatting
_PARTS = ('cameras', 'images')
_MOST_NAME = 4096
_REMEDY = 'undistort the images with colmap image_undistorter, and give its output folder'


class _Model(NamedTuple):
    """A camera model of COLMAP."""

    name: str
    focals: int  #: Number of focal lengths
    distortion: str = ''  #: Distortion model
    coefficients: int = 0  #: Number of its first coefficients, in OpenCV's order

    @property
    def length(self) -> int:
        return self.focals + 2 + self.coefficients


# By COLMAP's number of the model. COLMAP's pixel origin is the corner of the first pixel, OpenCV's
# is its centre.
_MODELS = {
    0: _Model('SIMPLE_PINHOLE', 1), 1: _Model('PINHOLE', 2),
    2: _Model('SIMPLE_RADIAL', 1, 'plumb_bob', 1), 3: _Model('RADIAL', 1, 'plumb_bob', 2),
    4: _Model('OPENCV', 2, 'plumb_bob', 4), 5: _Model('OPENCV_FISHEYE', 2, 'equidistant', 4),
    6: _Model('FULL_OPENCV', 2, 'rational_polynomial', 8),
    8: _Model('SIMPLE_RADIAL_FISHEYE', 1, 'equidistant', 1),
    9: _Model('RADIAL_FISHEYE', 1, 'equidistant', 2),
    14: _Model('SIMPLE_FISHEYE', 1, 'equidistant'), 15: _Model('FISHEYE', 2, 'equidistant')}
_LENGTHS = {'': 0, 'plumb_bob': 4, 'equidistant': 4, 'rational_polynomial': 8}
_OTHERS = {7: 'FOV', 10: 'THIN_PRISM_FISHEYE', 11: 'RAD_TAN_THIN_PRISM_FISHEYE',
           12: 'SIMPLE_DIVISION', 13: 'DIVISION', 16: 'EUCM', 17: 'EQUIRECTANGULAR'}
_BY_NAME = {model.name: number for number, model in _MODELS.items()}


class _Posed(NamedTuple):
    """An image of a model."""

    name: str
    camera_id: int
    pose: NDArray[np.float64] | None  #: (4, 4): map_from_camera


def read_colmap(folder: Path, options: frames.FolderOptions) -> frames.Capture:
    """Read the images of a model, or of the largest model of a project.

    The folder is that of the model (cameras and images, .bin or .txt), or that of the project.
    By default, the images are looked for in ``images/``, next to the model or above it.
    DatasetError: the model cannot be used; the message says how to correct it.
    """
    models = models_of(folder)
    if not models:
        raise DatasetError(f'{folder}: has no COLMAP model: expected cameras.bin and images.bin, '
                           'or .txt; run the mapper of COLMAP first')
    whole = [model for model in models if _has(model, 'bin') or _has(model, 'txt')]
    if not whole:
        lacking = [part for part in _PARTS if not any(
            (models[0] / f'{part}.{end}').is_file() for end in ('bin', 'txt'))]
        missing = f'{lacking[0]}.bin' if lacking else 'cameras and images of the same ending'
        raise DatasetError(f'{models[0]}: the COLMAP model lacks {missing}: export it again')
    models = [model for model in whole if not _is_distorted(model, folder)] or whole
    found = {model: list(_images(model)) for model in models}
    model = max(models, key=lambda model: len(found[model]))
    cameras, notes = dict(_cameras(model)), []
    if _has(model, 'bin') and _has(model, 'txt'):
        _check_same(model, cameras, found[model])
    if len(models) > 1:
        rest = sum(map(len, found.values())) - len(found[model])
        notes.append(f'the model is in {len(models)} pieces: {model.name} with '
                     f'{len(found[model])} images is used, {rest} images of the others are not')
    first = found[model][0].name if found[model] else ''
    names = ('input', 'images') if _is_distorted(model, folder) else ('images', 'input')
    roots = [options.images] if options.images else [
        *(above / name for above in (folder, *model.resolve().parents[:3]) for name in names),
        folder]
    root = next((path for path in roots if frames.beside(path / first)),
                next((path for path in roots if path.is_dir()), folder))
    files = []
    for image in found[model]:
        if image.camera_id not in cameras:
            raise DatasetError(f'{model}: image {image.name} is of camera {image.camera_id}, '
                               'which the model does not have')
        color = root / image.name
        if frames.beside(color) is None:  # a path of another operating system
            color = next(filter(None, (frames.beside(root / name) for name in (
                image.name.replace('\\', '/'), PureWindowsPath(image.name).name))), color)
        files.append(frames.ImageFile(frames.NO_STAMP, color, cameras[image.camera_id],
                                      image.pose))
    there = sum(file.suffix.lower() in frames.IMAGES for file in root.rglob('*'))
    return frames.Capture.of(files, model, 'opencv', is_metric=False, notes=notes, images=there)


def _check_same(model: Path, cameras: Mapping[int, Camera], images: Sequence[_Posed]) -> None:
    """Refuse a model whose text and binary files differ."""
    text = dict(_cameras(model, 'txt'))
    poses = {image.name: image.pose for image in _images(model, 'txt')}
    if any(not np.allclose(camera.matrix, text[number].matrix, rtol=1e-3)
           for number, camera in cameras.items() if number in text) or any(
               image.pose is not None and (other := poses.get(image.name)) is not None
               and not np.allclose(image.pose, other, atol=1e-3) for image in images):
        raise DatasetError(f'{model}: the .bin and .txt files of the model have different cameras '
                           'or poses: remove the outdated files')


def models_of(folder: Path) -> list[Path]:
    """Return the folders of models in a folder; a model may lack a file."""
    places = [*(folder / place for place in _PLACES), *sorted(folder.glob('sparse/*'))]
    return [place for place in dict.fromkeys(places) if any(
        (place / f'{part}.{end}').is_file() for part in _PARTS for end in ('bin', 'txt'))]


def _is_distorted(model: Path, folder: Path) -> bool:
    """Return whether a model of a splatting project describes the images before undistortion."""
    return 'distorted' in model.relative_to(folder).parts


def _has(model: Path, end: str) -> bool:
    return (model / f'cameras.{end}').is_file() and (model / f'images.{end}').is_file()


def _cameras(model: Path, kind: str = '') -> Iterator[tuple[int, Camera]]:
    """Yield the id and camera of each camera; kind 'txt' reads text even if binary files exist."""
    binary = model / 'cameras.bin'
    if kind == 'txt' or not _has(model, 'bin'):
        lines = parsing.read_cells(model / 'cameras.txt', 'CAMERA_ID MODEL WIDTH HEIGHT ...')
        for where, (camera_id, name, *cells) in lines:
            number, width, height = parsing.parse_all([camera_id, *cells[:2]], int, where)
            yield number, _camera(where, _BY_NAME.get(name, -1), name, (width, height),
                                  parsing.parse_all(cells[2:], float, where))
        return
    data = _Bytes(binary)
    for place in range(data.count(24)):
        camera_id, number, width, height = data.take('<IiQQ')
        name = _OTHERS.get(number, f'number {number}')
        values = data.take(f'<{_MODELS[number].length}d') if number in _MODELS else ()
        yield camera_id, _camera(f'{binary}: camera {place}', number, name, (width, height),
                                 values)


def _camera(where: str, number: int, name: str, size: tuple[int, int], values: Sequence[float]
            ) -> Camera:
    model = _MODELS.get(number)
    if model is None:
        raise DatasetError(f'{where} has the camera model {name}, which is not supported; '
                           f'{_REMEDY}')
    if len(values) != model.length:
        raise DatasetError(f'{where}: {model.name} has {model.length} values, not {len(values)}')
    fx, fy, (cx, cy) = values[0], values[model.focals - 1], values[model.focals:model.focals + 2]
    distortion = np.zeros(_LENGTHS[model.distortion])
    distortion[:model.coefficients] = values[model.focals + 2:]
    return parsing.camera_of(where, *size, fx, fy, cx - 0.5, cy - 0.5, model.distortion,
                             tuple(distortion.tolist()))


def _images(model: Path, kind: str = '') -> Iterator[_Posed]:
    """Yield the images of a model; see _cameras for the kind."""
    binary = model / 'images.bin'
    if kind == 'txt' or not _has(model, 'bin'):
        # each image has two lines, and the second may be empty
        path = model / 'images.txt'
        lines = [line for line in parsing.read_text(path).split('\n') if not line.startswith('#')]
        for number, line in enumerate(lines[::2]):
            cells, where = line.strip().split(maxsplit=9), f'{path}: image {number}'
            if not cells and 2 * number + 2 >= len(lines):
                continue
            if len(cells) != 10:
                raise DatasetError(f'{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID '
                                   f'NAME, got {line[:60]!r}')
            yield _posed(cells[9], parsing.parse_all(cells[8:9], int, where)[0],
                         parsing.parse_all(cells[1:8], float, where), where)
        return
    data = _Bytes(binary)
    for _ in range(data.count(73)):
        _, *numbers, camera_id = data.take('<I7dI')
        name = data.name()
        data.skip(24 * data.take('<Q')[0])
        yield _posed(name, camera_id, numbers, f'{binary}: image {name}')


def _posed(name: str, camera_id: int, numbers: Sequence[float], where: str) -> _Posed:
    w, x, y, z, *position = numbers
    camera_from_map = parsing.pose_of(position, (x, y, z, w), where)
    return _Posed(name, camera_id,
                  None if camera_from_map is None else invert_transform(camera_from_map))


class _Bytes:
    """A binary file that is read sequentially; its counts are checked against its size."""

    def __init__(self, path: Path) -> None:
        self._path, self._place = path, 0
        # ValueError: it is empty
        with (parsing.naming(path, OSError, ValueError, what='cannot be read: '),
              open_file(path) as file):
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def count(self, least_bytes: int) -> int:
        """Read the number of entries that follow, each of at least this size."""
        count = int(self.take('<Q')[0])
        if count * least_bytes > len(self._data):
            raise self._short(f'{count} entries do not fit')
        return count

    def take(self, form: str) -> tuple[Any, ...]:
        begin = self._place
        self.skip(struct.calcsize(form))
        return struct.unpack_from(form, self._data, begin)

    def skip(self, size: int) -> None:
        self._place += size
        if self._place > len(self._data):
            raise self._short(f'byte {self._place} is missing')

    def name(self) -> str:
        """Read a text that ends with a zero byte."""
        end = self._data.find(b'\0', self._place, self._place + _MOST_NAME)
        if end < 0:
            raise self._short('the name of an image does not end')
        text = self._data[self._place:end].decode('utf-8', 'replace')
        self._place = end + 1
        return text

    def _short(self, what: str) -> DatasetError:
        return DatasetError(f'{self._path}: is cut short or damaged: {what} in '
                            f'{len(self._data)} bytes; export the model again')
