# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write the demo's walk in the format of each program or device, from its public definition.

COLMAP's models are written by pycolmap itself.
"""

import json
import shutil
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions

ASSETS = Path(__file__).resolve().parents[1] / 'demo/assets'
WALK = ASSETS / 'mapping'
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# map of ARKit and HoloLens from a map with z up
Y_UP = np.eye(4)
Y_UP[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
DEPTH_MM = np.full((192, 256), 2000, dtype=np.uint16)


class Shot(NamedTuple):
    path: Path
    stamp_ns: int
    pose: np.ndarray
    camera: Camera


def once_for_each(function):
    """Return a function of an image (h, w, 3) that computes the result of equal pixels once."""
    found = cache(lambda data, shape, *options: function(
        np.frombuffer(data, np.uint8).reshape(shape), *options))
    return lambda image, *options: found(image.tobytes(), image.shape, *options)


def shots_of(folder=WALK):
    raws = list(read_folder(folder, FolderOptions(layout='tum')).read_raw(
        lambda place, stamp_ns, pose: pose is not None))
    return [Shot(raw.color.args[0].color, raw.stamp_ns, raw.map_from_camera,
                 raw.color.args[0].camera) for raw in raws]


def copy_walk(source, folder, every, with_last=True):
    """Copy a walk of the demo with every n-th image; return the lines of these images.

    Without the last one, the last of them has no pose.
    """
    shutil.copytree(source, folder)
    rows = [line for line in (folder / 'rgb.txt').read_text().splitlines()
            if not line.startswith('#')][::every]
    (folder / 'rgb.txt').write_text('\n'.join(rows) + '\n')
    end = float(rows[-1].split()[0]) + (1.0 if with_last else -0.25)
    truth = (folder / 'groundtruth.txt').read_text().splitlines()
    (folder / 'groundtruth.txt').write_text('\n'.join(
        line for line in truth if line.startswith('#') or float(line.split()[0]) < end))
    return rows


def write_colmap(folder, shots, text=False, camera_of=None, scale=1.0, world=None):
    """Write a project; camera_of(number) returns a camera's model, size and values."""
    import pycolmap

    model = pycolmap.Reconstruction()
    seen = {}
    for number, shot in enumerate(shots, start=1):
        one = shot.camera
        values = camera_of(number) if camera_of else (
            'PINHOLE', one.width, one.height, [one.fx, one.fy, one.cx + 0.5, one.cy + 0.5])
        if repr(values) not in seen:
            name, width, height, parameters = values
            camera = pycolmap.Camera(model=name, width=width, height=height, params=parameters)
            camera.camera_id = seen[repr(values)] = len(seen) + 1
            model.add_camera_with_trivial_rig(camera)
        pose = shot.pose.copy() if world is None else world @ shot.pose
        pose[:3, 3] /= scale
        image = pycolmap.Image(name=f'walk/{shot.path.name}', camera_id=seen[repr(values)],
                               image_id=number,
                               keypoints=np.array([[1.5, 2.5], [3.0, 4.0]]))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert_transform(pose)[:3]))
    (folder / 'sparse/0').mkdir(parents=True)
    (folder / 'images/walk').mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder / 'sparse/0'))
    for shot in shots:
        shutil.copy(shot.path, folder / 'images/walk')
    return folder


def write_nerf(folder, shots, per_frame=False, **more):
    one = shots[0].camera
    intrinsics = {'w': one.width, 'h': one.height, 'fl_x': one.fx, 'fl_y': one.fy,
                  'cx': one.cx + 0.5, 'cy': one.cy + 0.5, 'k1': 0.0, 'camera_model': 'OPENCV'}
    frames = [{'file_path': f'./images/{shot.path.name}', 'colmap_im_id': number,
               'transform_matrix': (shot.pose @ FLIP).tolist(),
               **(intrinsics if per_frame else {})}
              for number, shot in enumerate(shots)]
    (folder / 'images').mkdir(parents=True)
    for shot in shots:
        shutil.copy(shot.path, folder / 'images')
    (folder / 'transforms.json').write_text(json.dumps({
        **({} if per_frame else intrinsics), 'aabb_scale': 16, 'frames': frames, **more}))
    return folder


def edited(folder, edit):
    """Change the values of a transforms.json by a function."""
    values = json.loads((folder / 'transforms.json').read_text())
    edit(values)
    (folder / 'transforms.json').write_text(json.dumps(values))
    return folder


def write_polycam(folder, shots):
    root = folder / 'keyframes'
    for name in ('corrected_images', 'corrected_cameras', 'cameras', 'depth', 'confidence'):
        (root / name).mkdir(parents=True)
    for shot in shots:
        one, stem = shot.camera, str(shot.stamp_ns // 1000)
        pose = Y_UP @ shot.pose @ FLIP
        (root / f'corrected_cameras/{stem}.json').write_text(json.dumps({
            'fx': one.fx, 'fy': one.fy, 'cx': one.cx, 'cy': one.cy, 'width': one.width,
            'height': one.height, 'blur_score': 90.0,
            **{f't_{i}{j}': pose[i, j] for i in range(3) for j in range(4)}}))
        shutil.copy(shot.path, root / f'corrected_images/{stem}.jpg')
        cv2.imwrite(str(root / f'depth/{stem}.png'), DEPTH_MM)
        certain = np.full(DEPTH_MM.shape, 255, dtype=np.uint8)
        certain[:96] = 0
        cv2.imwrite(str(root / f'confidence/{stem}.png'), certain)
    return folder


def write_record3d(folder, shots):
    (folder / 'rgbd').mkdir(parents=True)
    one, poses = shots[0].camera, [Y_UP @ shot.pose @ FLIP for shot in shots]
    for number, shot in enumerate(shots):
        shutil.copy(shot.path, folder / f'rgbd/{number}.jpg')
    (folder / 'metadata').write_text(json.dumps({
        'w': one.width, 'h': one.height, 'fps': 60, 'dw': 192, 'dh': 256,
        'K': [one.fx, 0, 0, 0, one.fy, 0, one.cx, one.cy, 1],
        'poses': [[*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]]
                  for pose in poses],
        'frameTimestamps': [shot.stamp_ns / 1e9 for shot in shots]}))
    return folder


def write_stray(folder, shots):
    for name in ('rgb', 'depth', 'confidence'):
        (folder / name).mkdir(parents=True)
    rows = ['timestamp, frame, x, y, z, qx, qy, qz, qw']
    for number, shot in enumerate(shots):
        pose = Y_UP @ shot.pose
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        rows.append(', '.join([f'{shot.stamp_ns / 1e9}', f'{number:06d}', *map(str, numbers)]))
        shutil.copy(shot.path, folder / f'rgb/{number:06d}.jpg')
        cv2.imwrite(str(folder / f'depth/{number:06d}.png'), DEPTH_MM)
        cv2.imwrite(str(folder / f'confidence/{number:06d}.png'),
                    np.full(DEPTH_MM.shape, 2, dtype=np.uint8))
    (folder / 'odometry.csv').write_text('\n'.join(rows))
    (folder / 'camera_matrix.csv').write_text('\n'.join(
        ', '.join(map(str, row)) for row in shots[0].camera.matrix))
    return folder


def write_arkitscenes(folder, shots):
    for name in ('lowres_wide', 'lowres_wide_intrinsics', 'lowres_depth'):
        (folder / name).mkdir(parents=True)
    rows = []
    for shot in shots:
        one, time = shot.camera, f'{shot.stamp_ns / 1e9:.3f}'
        back = invert_transform(shot.pose)
        rows.append(' '.join(map(str, [time, *Rotation.from_matrix(back[:3, :3]).as_rotvec(),
                                       *back[:3, 3]])))
        cv2.imwrite(str(folder / f'lowres_wide/41_{time}.png'), cv2.imread(str(shot.path)))
        cv2.imwrite(str(folder / f'lowres_depth/41_{time}.png'), DEPTH_MM)
        # their names may be a millisecond off
        near = f'{shot.stamp_ns / 1e9 + 0.001:.3f}'
        (folder / f'lowres_wide_intrinsics/41_{near}.pincam').write_text(
            ' '.join(map(str, [one.width, one.height, one.fx, one.fy, one.cx, one.cy])))
    (folder / 'lowres_wide.traj').write_text('\n'.join(rows))
    return folder


def write_hololens(folder, shots):
    (folder / 'PV').mkdir(parents=True)
    one = shots[0].camera
    rows = [f'{one.cx},{one.cy},{one.width},{one.height}']
    for shot in shots:
        ticks = 116_444_736_000_000_000 + shot.stamp_ns // 100
        cv2.imwrite(str(folder / f'PV/{ticks}.png'), cv2.imread(str(shot.path)))
        pose = Y_UP @ shot.pose @ FLIP
        rows.append(','.join(map(str, [ticks, one.fx, one.fy, *pose.ravel()])))
    (folder / '2026-01-01-120000_pv.txt').write_text('\n'.join(rows) + '\n')
    return folder


#: Layouts, and the functions that write them.
WRITERS = {
    'COLMAP model': write_colmap, 'transforms.json': write_nerf, 'Polycam': write_polycam,
    'Record3D': write_record3d, 'Stray Scanner': write_stray, 'ARKitScenes': write_arkitscenes,
    'HoloLens 2': write_hololens}
