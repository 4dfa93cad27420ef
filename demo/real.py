# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the demo in a real room: download a recording, and build the map from half of its images."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
from tqdm import tqdm

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.storage import make_folder, unfinished, write_text
from cliploc_ros.offline.datasets.folders import read_sequence
from cliploc_ros.offline.datasets.frames import ImageFile, read_color, undistorted
from cliploc_ros.offline.datasets.tum import TumSequence
from cliploc_ros.units import NS_PER_S
from demo.processes import build_map
from demo.run import DemoOptions, run_demo
from studies.reproduce import SOURCES, Sources, alone_in, is_agreed, say_downloads, unpacked

# The sequence in studies/reproduce.yaml.
_SEQUENCE = 'fr1'
# Images to map, at least, of a long sequence; the robot sees those halfway between them.
_MAPPED = 150


def run_real_demo(options: DemoOptions, sources: Path | None, is_asked: bool) -> int:
    """Download a recording, build its map, and wake up in it; return the exit code.

    Each stage writes its files when it is complete, so a second run continues. The networks are
    those in the assets, or the default profile's. CliplocError: a download or a stage fails.
    """
    if options.has_rig:
        raise OptionsError('the recording of --real has one camera: remove --cameras')
    recording = Sources.of_file(sources or SOURCES).recording(_SEQUENCE)
    out = options.out / 'real'
    world, archive = out / 'world', out / 'downloads' / recording.file
    make_folder(out)
    say_downloads([] if archive.exists() or world.exists() else [recording], out)
    if not options.detector:
        print("build_map then downloads the default profile's networks (doc/install.md#networks).")
    if is_asked and not is_agreed():
        return 1
    with alone_in(out):
        if not world.exists():
            sequence, camera, _ = read_sequence(unpacked(recording, out, out), None)
            with unfinished(world, Path.mkdir) as staging:
                step = 2 * max(1, len(sequence) // (2 * _MAPPED))
                for name, first in ('mapping', 0), ('sequence', step // 2):
                    _write(sequence, camera, staging / name, range(first, len(sequence), step))
                staging.rename(world)
        map_file = world / 'map.yaml'
        if not map_file.exists():
            build_map('--tum', world / 'mapping', '--out', map_file, '--no-check',
                      *(['--no-clip'] if options.method.startswith('class') else []),
                      **options.detector, **options.encoder)
        run_demo(replace(options, assets=world,
                         recording=f'{recording.name}, {recording.licence}'))
    return 0


def _write(sequence: TumSequence, camera: Camera, folder: Path, rows: Sequence[int]) -> None:
    """Write some images of a sequence as a TUM folder, undistorted."""
    make_folder(folder)
    lines = []
    for row in tqdm(rows, desc=folder.name, unit='image', disable=None):
        stamp_ns, path = sequence.stamps_ns[row], sequence.image_paths[row]
        image_rgb, _ = read_color(ImageFile(stamp_ns, path, camera))
        lines.append(f'{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d} {stamp_ns}.png\n')
        cv2.imwrite(str(folder / f'{stamp_ns}.png'), undistorted(image_rgb, camera)[..., ::-1])
    write_text(folder / 'rgb.txt', ''.join(lines))
    write_text(folder / 'camera.json', json.dumps({
        name: getattr(camera, name) for name in ('width', 'height', 'fx', 'fy', 'cx', 'cy')}))
    shutil.copy(sequence.folder / 'groundtruth.txt', folder)
