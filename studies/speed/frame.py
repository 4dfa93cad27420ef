# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure a request by stage for some networks: ``python -m studies.speed frame``.

Each pair of detector and CLIP runs in a process of its own. The image, its boxes and the map are
the demo's. The search uses the similarities of the demo's own CLIP, since similarities from random
weights mean nothing. Weights that are not in the cache are random: the times are then still valid,
but the detections and embeddings are not.
"""

import os

# As in the nodes: both are read when the libraries are imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import ModelError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_encoder import ClipEncoder, load_encoder_for_map
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.onnx_network import free_memory
from cliploc_ros.models.protocols import (
    PROFILES,
    ClipOptions,
    DetectorOptions,
    ObjectDetector,
    Profile,
)
from cliploc_ros.models.yolo_weights import import_ultralytics
from demo import ASSETS
from studies.reports import table
from studies.rooms.rooms import open_folder, posed

_PAIRS = {'paper': PROFILES['accurate'], 'small': Profile('yolov8n.pt', 'ViT-B-32', 'openai')}
_STAGES = ('detection', 'CLIP', 'search')
# The node's default.
_TIME_BUDGET_S = 0.05


def run(arguments: Sequence[str]) -> int:
    """Print the table, or serve as one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--networks', nargs='+', choices=_PAIRS, default=list(_PAIRS))
    parser.add_argument('--crops', type=int, default=12, metavar='N', help='(%(default)s)')
    parser.add_argument('--rounds', type=int, default=5, metavar='N', help='(%(default)s)')
    parser.add_argument('--threads', type=int, default=2, metavar='N', help='(%(default)s)')
    parser.add_argument('--child', nargs=3, metavar='X', help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.child:
        print(json.dumps(_measure(*options.child, crops=options.crops, rounds=options.rounds)))
        return 0
    rows = []
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_frame_') as folder:
        for name in options.networks:
            yolo, clip, kind = _weights(name, Path(folder))
            _load(yolo, clip, folder)  # exports and compiles them
            done = subprocess.run(
                [sys.executable, '-m', 'studies.speed', 'frame', *arguments, '--child', yolo,
                 clip, folder], stdout=subprocess.PIPE, text=True, check=True,
                env=os.environ | {'OMP_NUM_THREADS': str(options.threads)})
            found = json.loads(done.stdout.splitlines()[-1])
            wall, processor = found['wall_ms'], found['processor_ms']
            rows.append([name, *(
                f'{wall_ms:.0f} ({processor_ms:.0f})' for wall_ms, processor_ms in zip(
                    [*wall, sum(wall)], [*processor, sum(processor)], strict=True)),
                f'{found["start_s"]:.1f}', f'{found["mib"]:.0f}', kind])
    print(f'{options.crops} crops of 640 x 480 px, all embedded; {options.threads} threads; '
          f'median of {options.rounds} rounds: ms (ms of processor time)')
    print(table(['networks', *_STAGES, 'total', 'start [s]', 'MiB', 'weights'], rows))
    return 0


def _weights(name: str, folder: Path) -> tuple[str, str, str]:
    """Return the file of the detector, the encoder as JSON, and 'published' or what is random."""
    profile = _PAIRS[name]
    kept = resolve_cache_dir('') / 'weights' / profile.detector
    yolo, clip = kept, ''
    if not kept.exists():
        yolo = folder / profile.detector
        import torch

        torch.manual_seed(0)
        model = import_ultralytics().YOLO(Path(profile.detector).with_suffix('.yaml').name)
        torch.save({'model': model.model}, yolo)
    os.environ['HF_HUB_OFFLINE'] = '1'  # before huggingface_hub is imported
    try:
        resolve_clip_weights(ClipOptions(profile.clip_model, profile.clip_pretrained))
    except ModelError:
        clip = str(folder / f'{profile.clip_model}.pt')
        code = ('import sys, open_clip, torch; torch.manual_seed(0); '
                'torch.save(open_clip.create_model(sys.argv[1]).state_dict(), sys.argv[2])')
        subprocess.run([sys.executable, '-c', code, profile.clip_model, clip], check=True,
                       stderr=subprocess.DEVNULL)
    random = [what for what, is_real in (('detector', kept.exists()), ('CLIP', not clip))
              if not is_real]
    encoder = json.dumps([profile.clip_model, profile.clip_pretrained, clip])
    return str(yolo), encoder, f'random: {", ".join(random)}' if random else 'published'


def _load(yolo: str, clip: str, folder: str) -> tuple[ObjectDetector, ClipEncoder]:
    model, pretrained, checkpoint = json.loads(clip)
    options = ClipOptions(model, pretrained, checkpoint, cache_dir=folder)
    return (load_detector(DetectorOptions(yolo, cache_dir=folder)),
            ClipEncoder(resolve_clip_weights(options), options))


def _measure(yolo: str, clip: str, folder: str, *, crops: int, rounds: int) -> dict[str, Any]:
    """Load networks, and measure the median times of requests with them."""
    image_rgb, observation = _demo_frame(crops, folder)
    relocalizer = Relocalizer(LandmarkMap.from_file(ASSETS / 'map.yaml'),
                              RelocalizerOptions(time_budget_s=_TIME_BUDGET_S))
    relocalizer.warm_up()
    free_memory()
    imports_mib, started = _resident_mib(), time.perf_counter()
    detector, encoder = _load(yolo, clip, folder)
    start_s = time.perf_counter() - started
    stages: tuple[Callable[[], Any], ...] = (
        lambda: detector.detect(image_rgb),
        lambda: encoder.encode_crops(image_rgb, observation.detections.bboxes_xyxy),
        lambda: relocalizer.relocalize([observation]))
    wall_ms, processor_ms = [], []
    for stage in stages:
        stage()  # warm-up for these sizes
        times = []
        for _ in range(rounds):
            begin, used = time.perf_counter(), time.process_time()
            stage()
            times.append((time.perf_counter() - begin, time.process_time() - used))
        wall_ms.append(1e3 * median(wall for wall, _ in times))
        processor_ms.append(1e3 * median(used for _, used in times))
    return {'wall_ms': wall_ms, 'processor_ms': processor_ms, 'start_s': start_s,
            'mib': _resident_mib() - imports_mib}


def _demo_frame(crops: int, folder: str) -> tuple[NDArray[np.uint8], Observation]:
    """Return an image of the demo with enough boxes, and the demo networks' observation of it."""
    detector = load_detector(DetectorOptions(str(ASSETS / 'yolo.onnx')))
    for raw in posed(open_folder(str(ASSETS / 'sequence'))[1]):
        image_rgb, camera = raw.color()
        detections = detector.detect(image_rgb).usable(camera.width, camera.height, crops)
        if len(detections) == crops:
            break
    clip = ClipOptions(pretrained=str(ASSETS / 'clip'), cache_dir=folder)
    landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
    observer = Observer(*load_encoder_for_map(clip, landmark_map, [], 'text'))
    observed = observer.crops(image_rgb, detections.bboxes_xyxy, {})
    return image_rgb, Observation(camera, detections,
                                  observed.compare(np.arange(len(detections))))


def _resident_mib() -> float:
    match = re.search(r'VmRSS:\s+(\d+) kB', Path('/proc/self/status').read_text())
    assert match
    return int(match[1]) / 1024
