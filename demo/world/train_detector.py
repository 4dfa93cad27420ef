# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train the demo's detector: ``python -m demo.world.train_detector WORLDS --out yolo.pt``.

This trains a small YOLO of ultralytics from scratch on images of rendered worlds.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.files.storage import write_file
from cliploc_ros.models.yolo_weights import import_ultralytics
from demo.truth import TrueFrame, read_frames
from demo.world.appearance import CLASSES
from demo.world.trajectories import CAMERA
from demo.world.worlds import find_worlds, hold_out

ARCHITECTURE = Path(__file__).parent / 'yolo.yaml'


def write_dataset(parts: dict[str, list[Path]], folder: Path) -> Path:
    """Lay out worlds as a data set of ultralytics; return its description file.

    Parameters
    ----------
    parts : dict of str to list of Path
        Worlds by part of the data set: 'train', 'val'.
    folder : Path
        Folder of the data set; it links the images.
    """
    for part, worlds in parts.items():
        (folder / 'images' / part).mkdir(parents=True)
        (folder / 'labels' / part).mkdir(parents=True)
        for world in worlds:
            for frame in read_frames(world):
                name = f'{world.name}_{frame.timestamp}'
                (folder / 'images' / part / f'{name}.jpg').symlink_to(frame.image.resolve())
                (folder / 'labels' / part / f'{name}.txt').write_text(_label_rows(frame))
    description = folder / 'data.yaml'
    description.write_text(yaml.safe_dump({
        'path': str(folder), **{part: f'images/{part}' for part in parts},
        'names': dict(enumerate(CLASSES))}))
    return description


def _label_rows(frame: TrueFrame) -> str:
    """Write the boxes of an image as rows of class, centre and size, relative to the image."""
    rows = []
    for box in frame.boxes:
        low, high = box.bbox_xyxy[:2] + 0.5, box.bbox_xyxy[2:] + 0.5  # edges, not pixel centres
        numbers = np.concatenate([(low + high) / 2, high - low]) / np.tile(
            [CAMERA.width, CAMERA.height], 2)
        rows.append(f'{CLASSES.index(box.class_id)} '
                    + ' '.join(f'{number:.6f}' for number in numbers))
    return '\n'.join(rows) + '\n'


def train(data: Path, desk: Path, *, architecture: Path, epochs: int, imgsz: int, batch: int,
          seed: int, threads: int) -> Any:
    """Train with ultralytics' trainer; return the trained model."""
    ultralytics = import_ultralytics()
    import torch

    torch.set_num_threads(threads)
    model = ultralytics.YOLO(architecture, task='detect')
    with tqdm(total=epochs, unit='epoch') as bar:
        def show(trainer: Any) -> None:
            torch.set_num_threads(threads)  # ultralytics leaves one core free on a CPU
            losses = trainer.tloss.values() if isinstance(trainer.tloss, dict) else trainer.tloss
            bar.set_postfix(loss=' '.join(f'{float(x):.2f}' for x in losses))
            bar.update()

        model.add_callback('on_train_start', lambda trainer: torch.set_num_threads(threads))
        model.add_callback('on_train_epoch_end', show)
        model.train(
            data=str(data), epochs=epochs, imgsz=imgsz, batch=batch, nbs=batch, seed=seed,
            deterministic=True, device='cpu', workers=0, amp=False, plots=False,
            val=False, verbose=False, optimizer='AdamW', lr0=0.002, lrf=0.02, warmup_epochs=1,
            mosaic=1.0, close_mosaic=max(1, epochs // 4), scale=0.4, hsv_h=0.0, hsv_s=0.2,
            hsv_v=0.3, fliplr=0.5, erasing=0.0, project=str(desk), name='run', exist_ok=True)
    return ultralytics.YOLO(desk / 'run' / 'weights' / 'last.pt')


def score(model: Any, data: Path, desk: Path) -> Any:
    """Score a model on the part 'val' of a data set; return ultralytics' metrics."""
    return model.val(data=str(data), imgsz=CAMERA.width, batch=8, device='cpu', workers=0,
                     plots=False, verbose=False, project=str(desk), name='val')


def save(model: Any, path: Path) -> None:
    """Write the weights atomically, in half precision and without paths of this machine."""
    import torch

    checkpoint = {'model': model.model.half().cpu(), 'ema': None, 'epoch': -1,
                  'train_args': {'task': 'detect', 'data': 'worlds'}}
    for name in ('args', 'yaml_file', 'pt_path'):
        if hasattr(checkpoint['model'], name):
            setattr(checkpoint['model'], name, {} if name == 'args' else '')
    checkpoint['model'].yaml.pop('yaml_file', None)
    write_file(path, lambda partial: torch.save(checkpoint, partial))


def run(arguments: list[str]) -> int:
    """Train, score on held-out worlds, and save."""
    parser = argparse.ArgumentParser(prog='train_detector', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('worlds', type=Path, metavar='WORLDS', help='folder of make_worlds')
    parser.add_argument('--out', type=Path, required=True, help='.pt file to write')
    parser.add_argument('--architecture', type=Path, default=ARCHITECTURE)
    parser.add_argument('--epochs', type=int, default=12)
    parser.add_argument('--imgsz', type=int, default=480, help='longer side in training [px]')
    parser.add_argument('--batch', type=int, default=8, help='images per step')
    parser.add_argument('--threads', type=int, default=2)
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(arguments)
    training, held_out = hold_out(find_worlds(options.worlds))
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_train_') as name:
        desk = Path(name)
        data = write_dataset({'train': training, 'val': held_out}, desk / 'data')
        model = train(data, desk, architecture=options.architecture, epochs=options.epochs,
                      imgsz=options.imgsz, batch=options.batch, seed=options.seed,
                      threads=options.threads)
        scores = score(model, data, desk)
        save(model, options.out)
    print(f'{len(held_out)} worlds held out: mAP50 {scores.box.map50:.3f}, '
          f'mAP50-95 {scores.box.map:.3f}')
    print(f'wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB)')
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
