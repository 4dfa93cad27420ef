# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Record a walk through a world as a TUM folder with ground truth, and write maps."""

import json
import multiprocessing
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import yaml
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
    shape_matrices,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from demo.world.meshes import make_object
from demo.world.photograph import expose
from demo.world.renderer import Renderer
from demo.world.room import Room, WorldObject
from demo.world.trajectories import CAMERA

#: An object with fewer visible pixels gets no box.
_FEWEST_PX = 40
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 88]
#: Prior spread of an object's centre [m] and of the logarithms of its axes.
_USUAL_SPREAD = np.array([0.03, 0.03, 0.03, 0.2, 0.2, 0.2])
Box = dict[str, Any]


def record(folder: Path, room: Room, renderer: Renderer, poses: npt.NDArray[np.float64], *,
           seed: int, rate_hz: float = 1.0) -> None:
    """Render a walk and write its images and ground truth as a TUM folder.

    Parameters
    ----------
    folder : Path
        Made if it does not exist.
    room : Room
        The room.
    renderer : Renderer
        Renderer of the room.
    poses : (n, 4, 4) array
        map_from_camera of each image.
    seed : int
        Seed of the camera's errors.
    rate_hz : float
        Rate of the stamps [Hz].
    """
    rng = np.random.default_rng(seed)
    (folder / 'rgb').mkdir(parents=True, exist_ok=True)
    rgb, truth, frames = ['# timestamp filename'], ['# timestamp tx ty tz qx qy qz qw'], []
    for number, pose in enumerate(_with_progress(poses, folder.name)):
        stamp = f'{1000 + number / rate_hz:.6f}'
        image = expose(renderer.render(pose), rng)
        cv2.imwrite(str(folder / 'rgb' / f'{stamp}.jpg'), image[..., ::-1], _JPEG)
        rgb.append(f'{stamp} rgb/{stamp}.jpg')
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat()
        truth.append(' '.join([stamp, *(f'{value:.6f}' for value in (*pose[:3, 3], *quat))]))
        frames.append({'timestamp': stamp, 'boxes': find_boxes(room, renderer, pose)})
    (folder / 'rgb.txt').write_text('\n'.join(rgb) + '\n')
    (folder / 'groundtruth.txt').write_text('\n'.join(truth) + '\n')
    objects = [{'id': o.name, **o.landmark(), 'in_map': o.in_map, 'moved': o.moved}
               for o in room.objects]
    (folder / 'truth.json').write_text(json.dumps({'objects': objects, 'frames': frames}))
    (folder / 'camera.json').write_text(json.dumps({
        'width': CAMERA.width, 'height': CAMERA.height, 'fx': CAMERA.fx, 'fy': CAMERA.fy,
        'cx': CAMERA.cx, 'cy': CAMERA.cy}))


def _with_progress(poses: npt.NDArray[np.float64], what: str) -> Iterable[Any]:
    """Return poses with a progress bar, except in a worker process."""
    is_worker = multiprocessing.parent_process() is not None
    return tqdm(poses, what, unit='image', disable=is_worker or None)


def find_boxes(room: Room, renderer: Renderer, map_from_camera: npt.NDArray[np.float64]) -> \
        list[Box]:
    """Find the box around the visible pixels of each object, and the visible share."""
    index = renderer.render_index(map_from_camera)
    boxes = []
    for number in np.unique(index[index >= 0]):
        rows, columns = np.nonzero(index == number)
        outline = _outline_px(room.objects[number], map_from_camera)
        if len(rows) < _FEWEST_PX or outline == 0:
            continue
        # Pixel centres have integer coordinates: a pixel extends by half a pixel.
        bbox = [columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5]
        boxes.append({'object': room.objects[number].name, 'bbox_xyxy': [float(x) for x in bbox],
                      'visibility': round(min(1.0, len(rows) / outline), 3)})
    return boxes


def _outline_px(item: WorldObject, map_from_camera: npt.NDArray[np.float64]) -> int:
    """Count the pixels that an object would cover alone in an unbounded image.

    The result is 0 for an object that reaches the camera or is too near to be completely visible.
    """
    camera_from_object = invert_transform(map_from_camera) @ item.map_from_object
    hulls = []
    for mesh, _ in make_object(item.look):
        points = mesh.vertices @ camera_from_object[:3, :3].T + camera_from_object[:3, 3]
        if points[:, 2].min() < 0.05:
            return 0
        hulls.append(cv2.convexHull(
            (points[:, :2] / points[:, 2:] * (CAMERA.fx, CAMERA.fy)).astype(np.float32)))
    corner = np.concatenate(hulls).min((0, 1))
    width, height = np.concatenate(hulls).max((0, 1)) - corner + 1
    if max(width, height) > 2000:
        return 0
    canvas = np.zeros((int(height) + 1, int(width) + 1), dtype=np.uint8)
    for hull in hulls:
        cv2.fillConvexPoly(canvas, np.round(hull - corner).astype(np.int32), 255)
    return int(np.count_nonzero(canvas))


def write_true_map(path: Path, room: Room) -> None:
    """Write the map with the exact ellipsoids of its objects."""
    _write_map(path, {o.name: o.landmark() for o in room.objects if o.in_map})


def write_fitted_map(path: Path, room: Room, renderer: Renderer,
                     poses: npt.NDArray[np.float64], *, seed: int) -> None:
    """Write a map with ellipsoids fitted to the boxes of many views, as in a mapping run.

    The fit uses views that show an object completely and almost unoccluded. Boxes are perturbed by
    a pixel, like those of a detector. An object with fewer than three such views keeps its exact
    ellipsoid.
    """
    rng = np.random.default_rng(seed)
    views: dict[str, list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]] = {}
    for pose in _with_progress(poses, 'true map'):
        for seen in find_boxes(room, renderer, pose):
            bbox = np.array(seen['bbox_xyxy'])
            inside = bbox[:2].min() > 2 and bbox[2] < CAMERA.width - 3 and \
                bbox[3] < CAMERA.height - 3
            if seen['visibility'] > 0.8 and inside:
                views.setdefault(seen['object'], []).append(
                    (invert_transform(pose), bbox + rng.normal(0, 1.0, 4)))
    _write_map(path, {o.name: _fit(o.landmark(), views.get(o.name, ()))
                      for o in room.objects if o.in_map})


def _fit(entry: dict[str, Any], views: Sequence[tuple[npt.NDArray[np.float64], ...]]) -> \
        dict[str, Any]:
    """Fit centre and axes of an ellipsoid to its boxes."""
    if len(views) < 3:
        return entry
    poses = np.array([pose for pose, _ in views])
    bboxes = np.array([bbox for _, bbox in views])
    start = np.concatenate([entry['center'], np.log(entry['semi_axes'])])

    def residuals(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        shape = shape_matrices(np.exp(x[None, 3:]), np.array([entry['orientation']]))
        conics = np.concatenate([project_ellipsoids(pose, x[None, :3], shape) for pose in poses])
        # An ellipsoid that reaches the camera has no outline: a large finite residual.
        outlines = np.nan_to_num(ellipse_bboxes(ellipses_in_pixels(conics, CAMERA)), nan=1e4)
        # Views from one side leave the depth undetermined; the prior then determines it.
        return np.concatenate([(outlines - bboxes).ravel(), (x - start) / _USUAL_SPREAD])

    found = least_squares(residuals, start, loss='soft_l1', f_scale=3.0).x
    return {**entry, 'center': found[:3].tolist(), 'semi_axes': np.exp(found[3:]).tolist()}


def _write_map(path: Path, landmarks: dict[str, dict[str, Any]]) -> None:
    def rounded(value: Any) -> Any:
        return [round(float(x), 5) for x in value] if isinstance(value, list) else value

    entries = {name: {key: rounded(value) for key, value in entry.items()}
               for name, entry in landmarks.items()}
    text = yaml.safe_dump({'/**': {'ros__parameters': {'map': {
        'frame_id': 'map', 'landmarks': entries}}}}, default_flow_style=None, sort_keys=False,
        width=98)
    path.write_text(text)
