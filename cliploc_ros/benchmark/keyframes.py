# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure a large layer of keyframes: ``python -m cliploc_ros.benchmark.keyframes --help``.

The layer of a map is repeated: the first time as it is, then at random places, with permuted
descriptors and words. A new process loads it and localizes some images. Times are processor time.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.command import run_command
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.features import DIMENSIONS
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.layer_file import layer_path, load_layer_of_map, save_layer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.datasets.folders import FolderOptions, rgbd_frames

_SIDE_M = 500.0


def enlarge(layer: KeyframeLayer, count: int, seed: int) -> KeyframeLayer:
    """Return a layer with so many keyframes, at least the given ones."""
    rng = np.random.default_rng(seed)
    copies = max(1, round(count / len(layer)))
    poses, descriptors, words = [layer.map_from_camera], [layer.descriptors], [layer.words]
    for _ in range(copies - 1):
        moved = layer.map_from_camera.copy()
        moved[:, :3, :3] = Rotation.random(len(layer), random_state=rng).as_matrix()
        moved[:, :3, 3] += rng.uniform(-_SIDE_M, _SIDE_M, 3)
        poses.append(moved)
        descriptors.append(layer.descriptors[:, rng.permutation(DIMENSIONS)])
        words.append(rng.permutation(len(layer.vocabulary))[layer.words].astype(np.uint16))
    steps = np.tile(np.diff(layer.offsets), copies)
    return replace(
        layer, map_from_camera=np.concatenate(poses), offsets=np.cumsum([0, *steps]),
        pixels=np.concatenate([layer.pixels] * copies),
        points=np.concatenate([layer.points] * copies), descriptors=np.concatenate(descriptors),
        words=np.concatenate(words))


def ask(map_file: Path, layer_file: Path, images: Path, requests: int) -> dict[str, object]:
    """Load a layer and localize images of its map that are no keyframes."""
    cv2.setNumThreads(1)
    landmark_map = LandmarkMap.from_file(map_file)
    before, begin = _memory_mib(), time.process_time()
    layer = load_layer_of_map(layer_file, landmark_map)
    localizer = KeyframeLocalizer(layer)
    loaded = time.process_time() - begin
    frames = rgbd_frames(images, FolderOptions())
    rows = np.linspace(0, frames.count - 1, requests).astype(int) | 1
    asked, errors = [], []
    for frame in frames.select(rows.tolist()).read():
        begin = time.process_time()
        found = localizer.localize(frame.image_rgb, frame.camera).places
        asked.append(round(1e3 * (time.process_time() - begin)))
        assert frame.map_from_camera is not None
        errors.append(None if not found else round(
            pose_error(found[0].map_from_camera, frame.map_from_camera)[0], 3))
    return {'keyframes': len(layer), 'file MB': round(layer_file.stat().st_size / 1e6),
            'load s': round(loaded, 2), 'requests ms': asked, 'errors m': errors,
            'memory MiB': round(_memory_mib() - before)}


def _memory_mib() -> float:
    """Return the memory of this process in RAM, pages of mapped files included [MiB]."""
    status = Path('/proc/self/status').read_text()
    return int(status.split('VmRSS:')[1].split()[0]) / 1024


def run() -> int:
    """Print one line for the layer as it is and one for the large one."""
    parser = argparse.ArgumentParser(prog='keyframes', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('map', type=Path, help='map with a layer next to it')
    parser.add_argument('--rgbd', type=Path, required=True, metavar='DIR',
                        help='images to localize; every second one is asked for')
    parser.add_argument('--count', type=int, default=10_000, help='keyframes (%(default)s)')
    parser.add_argument('--requests', type=int, default=6, help='(%(default)s)')
    parser.add_argument('--ask', type=Path, metavar='LAYER', help='only ask this layer')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    if options.ask is not None:
        print(json.dumps(ask(options.map, options.ask, options.rgbd, options.requests)))
        return 0
    small = layer_path(options.map)
    layer = load_layer_of_map(small, LandmarkMap.from_file(options.map))
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_keyframes_') as folder:
        large = Path(folder) / 'large.keyframes.npz'
        save_layer(large, enlarge(layer, options.count, options.seed))
        for file in (small, large):
            subprocess.run([sys.executable, '-m', 'cliploc_ros.benchmark.keyframes', options.map,
                            '--rgbd', options.rgbd, '--requests', str(options.requests),
                            '--ask', file], check=True)
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(run)


if __name__ == '__main__':
    sys.exit(main())
