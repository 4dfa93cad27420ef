# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's claim, with real networks: ``python -m cliploc_ros.demo.class_growth --out DIR``.

Rooms in which all objects are of one class, more and more of them. Matching by class must then
try ever more correspondences, and finds the right ones ever more rarely; labels tell them apart.
"""

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cliploc_ros.cli.command import run_command
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.transforms import pose_error
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.errors import ImageError

ASSETS = Path(__file__).parent / 'assets'
COUNTS = (6, 12, 24, 48)
CLASS_ID = 'book'
METHODS = ('class_ransac', 'class_bf', 'hybrid_ransac', 'hybrid_b-prosac')
_SUCCESS_M = 0.5
_MAX_DETECTIONS = 50
_TRIALS = 5
#: Exhaustive search is stopped after this long [s] for each image: whole, it would take hours.
_BF_BUDGET_S = 2.0


@dataclass(frozen=True)
class Point:
    """How a method does among so many objects.

    Parameters
    ----------
    method : str
        As the paper names it.
    count : int
        Objects of the class in the map.
    success : float
        Share of images with a pose within 0.5 m of the truth.
    search_ms : float
        Mean time of a search [ms]; of one cut short, what it took divided by its coverage.
    coverage : float
        Mean share of its samples that the search could try.
    """

    method: str
    count: int
    success: float
    search_ms: float
    coverage: float


def render(folder: Path, count: int, images: int, seed: int) -> None:
    """Render a room with so many objects of one class, all of them in the map."""
    from cliploc_ros.demo.world.recording import record, write_true_map
    from cliploc_ros.demo.world.renderer import Light, Renderer
    from cliploc_ros.demo.world.room import make_room
    from cliploc_ros.demo.world.trajectories import CAMERA, query_walk

    room = make_room(seed, {CLASS_ID: count}, unknown=0)
    record(folder, room, Renderer(room, CAMERA, Light()), query_walk(images), seed=seed)
    write_true_map(folder / 'map.yaml', room)


def observe(folder: Path) -> tuple[LandmarkMap, list[tuple[Observation, NDArray[np.float64]]]]:
    """Run detector and CLIP on a rendered room; each observation with its true pose (4, 4)."""
    from cliploc_ros.models.clip_encoder import load_encoder
    from cliploc_ros.models.clip_weights import ClipOptions
    from cliploc_ros.models.observer import Observer
    from cliploc_ros.models.yolo_detector import YoloDetector, YoloOptions

    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    detector = YoloDetector(YoloOptions(model=str(ASSETS / 'yolo.pt')))
    clip = ClipOptions(model=str(ASSETS / 'clip.json'), cache_dir=str(folder),
                       pretrained=str(ASSETS / 'clip.safetensors'))
    observer = Observer(*load_encoder(clip, landmark_map.labels))
    sequence, camera = read_tum(folder), find_camera(None, folder)[0]
    observed = []
    for stamp, path in zip(sequence.stamps_ns, sequence.image_paths, strict=True):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        truth = sequence.pose_at(stamp)
        if image is None or truth is None:
            raise ImageError(f'{path} cannot be read, or has no true pose')
        image_rgb = np.ascontiguousarray(image[..., ::-1])
        detections = detector.detect(image_rgb).usable(camera.width, camera.height,
                                                       _MAX_DETECTIONS)
        observed.append((observer.observe(image_rgb, camera, detections, stamp), truth))
    return landmark_map, observed


def measure(method: str, landmark_map: LandmarkMap,
            observed: Sequence[tuple[Observation, NDArray[np.float64]]]) -> Point:
    """Measure a method: 500 samples each, or all of them as far as time allows."""
    matching, algorithm = method.split('_')
    exhaustive = algorithm == 'bf'
    errors, times_ms, coverages = [], [], []
    for seed in range(1 if exhaustive else _TRIALS):
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions(
            matching=matching, algorithm=algorithm, iterations=500, random_seed=seed,
            k=min(3, len(landmark_map)),
            time_budget_s=_BF_BUDGET_S if exhaustive else float('inf')))
        relocalizer.warm_up()
        for observation, truth in observed:
            start = time.perf_counter()
            found = relocalizer.relocalize([observation])
            elapsed_ms = (time.perf_counter() - start) * 1e3
            errors.append(pose_error(found.map_from_camera, truth)[0]
                          if found.map_from_camera is not None else np.inf)
            times_ms.append(elapsed_ms / max(found.coverage, 1e-9))
            coverages.append(found.coverage)
    return Point(method, len(landmark_map), float(np.mean(np.array(errors) < _SUCCESS_M)),
                 float(np.mean(times_ms)), float(np.mean(coverages)))


def plot(points: Sequence[Point], path: Path) -> None:
    """Draw success and time over the number of objects."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.8), layout='constrained')
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    # Okabe and Ito's colours, which the colour-blind tell apart.
    styles = dict(zip(METHODS, (('#D55E00', 'o-'), ('#E69F00', 's--'), ('#56B4E9', '^-.'),
                                ('#0072B2', 'D-')), strict=True))
    for method, (color, style) in styles.items():
        own = [point for point in points if point.method == method]
        counts = [point.count for point in own]
        left.plot(counts, [point.success for point in own], style, color=color, label=method)
        right.plot(counts, [point.search_ms / 1e3 for point in own], style, color=color,
                   label=method)
    for axes in (left, right):
        axes.set_xscale('log', base=2)
        axes.set_xticks(COUNTS, [str(count) for count in COUNTS])
        axes.set_xlabel(f'objects in the map, all of class {CLASS_ID}')
        axes.grid(alpha=0.3)
    left.set_ylim(-0.02, 1.02)
    left.set_ylabel(f'success (within {_SUCCESS_M:g} m)')
    right.set_yscale('log')
    right.set_ylabel('time of a search [s]')
    right.legend(frameon=False)
    figure.savefig(path, dpi=120)


def run(arguments: list[str]) -> int:
    """Render, observe, measure, draw."""
    parser = argparse.ArgumentParser(prog='class_growth', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--out', type=Path, default=Path('class_growth'), metavar='DIR')
    parser.add_argument('--images', type=int, default=24, help='of each room (%(default)s)')
    parser.add_argument('--seed', type=int, default=70)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    points = []
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_growth_') as name:
        rooms = {count: Path(name) / str(count) for count in COUNTS}
        # In processes of its own: the LLVMs of Mesa and of PyTorch do not bear each other.
        with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context('spawn')) as pool:
            made = [pool.submit(render, folder, count, options.images, options.seed)
                    for count, folder in rooms.items()]
            for room in tqdm(made, 'rendering', unit='room'):
                room.result()
        for folder in rooms.values():
            landmark_map, observed = observe(folder)
            points += [measure(method, landmark_map, observed) for method in METHODS]
            for point in points[-len(METHODS):]:
                print(f'{point.count:3d} objects, {point.method:16s} success {point.success:.2f}, '
                      f'{point.search_ms:12.1f} ms' + (
                          f' (extrapolated from {point.coverage:.1%} of the samples)'
                          if point.coverage < 0.999 else ''), flush=True)
    (options.out / 'class_growth.json').write_text(json.dumps([*map(asdict, points)], indent=1))
    plot(points, options.out / 'class_growth.png')
    print(f'wrote {options.out / "class_growth.png"}')
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
