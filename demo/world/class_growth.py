# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure growing classes with real networks: ``python -m demo.world.class_growth --out DIR``.

Each room holds 48 objects, of eight, four, two or one class. The camera sees the same number of
objects in each room, but more of them share a class. Matching by class then has more candidates
and finds the correct ones less often. Labels still distinguish the objects.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.files.parallel import run_tasks
from cliploc_ros.files.storage import make_folder
from cliploc_ros.offline.evaluation.methods import parse_methods
from cliploc_ros.offline.evaluation.run import run_methods
from cliploc_ros.offline.evaluation.summary import Summary, as_text, summarize, table_rows
from cliploc_ros.offline.evaluation.trials import make_queries
from demo.world.compare import record

#: Objects of each class in the four rooms.
COUNTS = (6, 12, 24, 48)
_TOTAL = 48
_CLASSES = ('book', 'box', 'bottle', 'plant', 'mug', 'can', 'bowl', 'clock')
METHODS = ('class_ransac', 'class_bf', 'hybrid_ransac', 'hybrid_b-prosac', 'auto')
_SUCCESS_M = 0.5
_TRIALS = 5
# A search ends after two seconds: complete exhaustive searches would take hours.
_OPTIONS = RelocalizerOptions(iterations=500, time_budget_s=2.0)


def render(folder: Path, count: int, images: int, seed: int) -> None:
    """Render a room with `count` objects of each class, all of them in the map."""
    from demo.world.recording import record as record_walk
    from demo.world.recording import write_true_map
    from demo.world.renderer import Light, Renderer
    from demo.world.room import make_room
    from demo.world.trajectories import CAMERA, query_walk

    counts = dict.fromkeys(_CLASSES[:_TOTAL // count], count)
    room = make_room(seed, counts, unknown=0)
    record_walk(folder, room, Renderer(room, CAMERA, Light()), query_walk(images), seed=seed)
    write_true_map(folder / 'map.yaml', room)


def _make_work(folder: Path, images: int, seed: int) -> Callable[[int], bool]:
    def work(count: int) -> bool:
        render(folder / str(count), count, images, seed)
        return True

    return work


def _whole_search_s(summary: Summary) -> float:
    """Return the mean time of a search [s], extrapolated to the complete search for bf."""
    share = np.maximum(summary.coverage, 1e-9) if summary.method.endswith('_bf') else 1.0
    return float((summary.search_ms / share).mean()) / 1e3


def plot(summaries: Mapping[int, Sequence[Summary]], path: Path) -> None:
    """Plot success and time over the number of objects of each class, the summaries' key."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.8), layout='constrained')
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    # Okabe and Ito's colours, which colour-blind readers can distinguish.
    styles = dict(zip(METHODS, (('#D55E00', 'o-'), ('#E69F00', 's--'), ('#56B4E9', '^-.'),
                                ('#0072B2', 'D-'), ('#000000', 'v-')), strict=True))
    for method, (color, style) in styles.items():
        own = [summary for of_room in summaries.values() for summary in of_room
               if summary.method == method]
        left.plot([*summaries], [summary.success(_SUCCESS_M) for summary in own], style,
                  color=color)
        right.plot([*summaries], [_whole_search_s(summary) for summary in own], style, color=color,
                   label=method)
    for axes in (left, right):
        axes.set_xscale('log', base=2)
        axes.set_xticks([*summaries], [str(count) for count in summaries])
        axes.set_xlabel(f'objects of the same class, of {_TOTAL} in the map')
        axes.grid(alpha=0.3)
    left.set_ylim(-0.02, 1.02)
    left.set_ylabel(f'success (within {_SUCCESS_M:g} m)')
    right.set_yscale('log')
    right.set_ylabel('time of a search [s]')
    right.legend(frameon=False)
    figure.savefig(path, dpi=120)


def run(arguments: list[str]) -> int:
    """Render the rooms, record queries, measure the methods, and plot the results."""
    parser = argparse.ArgumentParser(prog='class_growth', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--out', type=Path, default=Path('class_growth'), metavar='DIR')
    parser.add_argument('--images', type=int, default=24, help='images of each room (%(default)s)')
    parser.add_argument('--seed', type=int, default=70)
    options = parser.parse_args(arguments)
    make_folder(options.out)
    summaries: dict[int, list[Summary]] = {}
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_growth_') as name:
        # Render in other processes: Mesa and PyTorch each load an LLVM, and these conflict.
        for _ in tqdm(run_tasks(
                partial(_make_work, Path(name), options.images, options.seed), COUNTS, workers=2),
                'rendering', len(COUNTS), unit='room'):
            pass
        for count in COUNTS:
            folder = Path(name, str(count))
            landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
            queries = make_queries(record(folder, landmark_map, folder), landmark_map)
            summaries[count] = summarize(run_methods(
                landmark_map, parse_methods(METHODS, _OPTIONS, len(landmark_map)), queries,
                trials=_TRIALS, workers=2))
            print(f'\n{count} objects of each class\n{as_text(table_rows(summaries[count]))}',
                  flush=True)
    plot(summaries, options.out / 'class_growth.png')
    print(f'wrote {options.out / "class_growth.png"}')
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
