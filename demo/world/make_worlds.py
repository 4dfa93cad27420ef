# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make worlds for training: ``python -m demo.world.make_worlds DIR --count 100``."""

import argparse
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from tqdm import tqdm

from demo.world.recording import record, write_true_map
from demo.world.renderer import Light, Renderer
from demo.world.room import make_room
from demo.world.trajectories import CAMERA, draw_views


def make_world(folder: Path, seed: int, frames: int) -> None:
    """Render one world from random views and write it as a TUM folder, unless it exists."""
    if (folder / 'map.yaml').exists():  # written last
        return
    rng = np.random.default_rng(seed)
    room = make_room(seed)
    renderer = Renderer(room, CAMERA, Light.draw(rng))
    record(folder, room, renderer, draw_views(room, frames, rng), seed=seed)
    write_true_map(folder / 'map.yaml', room)


def main() -> None:
    """Make worlds in parallel, each from its own seed."""
    parser = argparse.ArgumentParser(prog='make_worlds', description=__doc__)
    parser.add_argument('folder', type=Path, metavar='DIR')
    parser.add_argument('--count', type=int, default=90, help='number of worlds (%(default)s)')
    parser.add_argument('--frames', type=int, default=10, help='images each (%(default)s)')
    parser.add_argument('--seed', type=int, default=1000, help='seed of the first (%(default)s)')
    parser.add_argument('--jobs', type=int, default=multiprocessing.cpu_count(),
                        help='parallel processes (%(default)s)')
    options = parser.parse_args()
    # VTK's contexts do not survive a fork.
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
        made = [pool.submit(make_world, options.folder / f'world_{number:03d}',
                            options.seed + number, options.frames)
                for number in range(options.count)]
        for world in tqdm(as_completed(made), total=options.count, unit='world'):
            world.result()


if __name__ == '__main__':
    main()
