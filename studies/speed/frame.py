# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure a request by stage for each profile: ``python -m studies.speed frame``.

Each profile runs in two processes, one with PyTorch and one with OpenVINO, which take turns. The
image, its boxes and the map are the demo's. The search uses the similarities of the demo's own
CLIP, since those of random weights mean nothing. Weights that are not in the cache are random:
then the times hold, and the detections and embeddings do not.
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

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import ModelError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_encoder import ClipEncoder, load_encoder
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.devices import free_memory
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.profiles import PROFILES, load_detector
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_weights import import_ultralytics
from cliploc_ros.offline.datasets.intrinsics import find_camera
from demo import ASSETS

ENGINES = ('pytorch', 'openvino')
STAGES = ('detection', 'CLIP', 'search', 'total')
# The node's default.
_TIME_BUDGET_S = 0.05


def run(arguments: Sequence[str]) -> int:
    """Print the table, or serve as one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--profiles', nargs='+', choices=PROFILES, default=list(PROFILES))
    parser.add_argument('--crops', type=int, default=12, metavar='N', help='(%(default)s)')
    parser.add_argument('--rounds', type=int, default=5, metavar='N', help='(%(default)s)')
    parser.add_argument('--threads', type=int, default=2, metavar='N', help='(%(default)s)')
    parser.add_argument('--device', default='cpu', help='with a GPU, PyTorch alone (%(default)s)')
    parser.add_argument('--child', nargs=4, metavar='X', help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.child:
        _serve(*options.child, crops=options.crops, device=options.device)
        return 0
    engines = ENGINES if options.device == 'cpu' else ENGINES[:1]
    print(f'{options.crops} crops of 640 x 480 px, all embedded; {options.threads} threads, device'
          f' {options.device}; median of {options.rounds} rounds: ms (ms of processor time)')
    print(f'{"profile":9} {"engine":9}' + ''.join(f'{stage:>16}' for stage in STAGES)
          + f'{"start s":>9}{"MiB":>7}  weights')
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_frame_') as folder:
        for name in options.profiles:
            _print_profile(name, engines, options, Path(folder))
    return 0


def _print_profile(name: str, engines: tuple[str, ...], options: argparse.Namespace,
                   folder: Path) -> None:
    yolo, clip, kind = _weights(name, folder)
    children = {engine: _start(options, engine, yolo, clip, str(folder)) for engine in engines}
    started = {engine: _read(child) for engine, child in children.items()}
    rounds: dict[str, list[Any]] = {engine: [] for engine in engines}
    for _ in range(options.rounds):
        for engine, child in children.items():
            assert child.stdin
            print('next', file=child.stdin, flush=True)
            rounds[engine].append(_read(child))
    for engine, child in children.items():
        child.communicate()
        wall, cpu = ({stage: median(one[clock][stage] for one in rounds[engine])
                      for stage in STAGES} for clock in ('wall', 'cpu'))
        print(f'{name:9} {engine:9}' + ''.join(
            f'{wall[stage]:8.0f} {f"({cpu[stage]:.0f})":>7}' for stage in STAGES)
            + f'{started[engine]["seconds"]:9.1f}{rounds[engine][-1]["mib"]:7.0f}  {kind}',
            flush=True)
    if len(engines) == 2:
        _print_ratios(name, rounds)


def _print_ratios(name: str, rounds: dict[str, list[Any]]) -> None:
    """Print PyTorch's time divided by OpenVINO's, round by round."""
    first, second = (rounds[engine] for engine in ENGINES)
    ratios = {(clock, stage): median(one[clock][stage] / max(other[clock][stage], 1e-3)
                                     for one, other in zip(first, second, strict=True))
              for clock in ('wall', 'cpu') for stage in STAGES}
    print(f'{name:9} {"ratio":9}' + ''.join(
        f'{ratios["wall", stage]:8.1f} {f"({ratios['cpu', stage]:.1f})":>7}' for stage in STAGES),
        flush=True)


def _weights(name: str, folder: Path) -> tuple[str, str, str]:
    """Return the file of the detector, the encoder as JSON, and what they are."""
    profile = PROFILES[name]
    kept = resolve_cache_dir('') / 'weights' / profile.detector
    yolo, clip = str(kept), ''
    if not kept.exists():
        yolo = str(folder / profile.detector)
        file = Path(yolo)
        import torch

        torch.manual_seed(0)
        model = import_ultralytics().YOLO(Path(profile.detector).with_suffix('.yaml').name)
        torch.save({'model': model.model}, file)
    os.environ['HF_HUB_OFFLINE'] = '1'  # before huggingface_hub is imported
    try:
        resolve_clip_weights(ClipOptions(profile.clip_model, profile.clip_pretrained))
    except ModelError:
        clip = str(folder / f'{profile.clip_model}.pt')
        code = ('import sys, open_clip, torch; torch.manual_seed(0); '
                'torch.save(open_clip.create_model(sys.argv[1]).state_dict(), sys.argv[2])')
        subprocess.run([sys.executable, '-c', code, profile.clip_model, clip], check=True,
                       stderr=subprocess.DEVNULL)
    kinds = {'detector': kept.exists(), 'CLIP': not clip}
    random = [what for what, is_real in kinds.items() if not is_real]
    encoder = json.dumps([profile.clip_model, profile.clip_pretrained, clip])
    return yolo, encoder, f'random: {", ".join(random)}' if random else 'published'


def _start(options: argparse.Namespace, *child: str) -> 'subprocess.Popen[str]':
    command = [sys.executable, '-m', 'studies.speed', 'frame', '--crops', str(options.crops),
               '--device', options.device, '--child', *child]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                            env=os.environ | {'OMP_NUM_THREADS': str(options.threads)})


def _read(child: 'subprocess.Popen[str]') -> Any:
    assert child.stdout
    line = child.stdout.readline()
    if not line:
        raise SystemExit(f'a process of the benchmark ended with {child.wait()}')
    return json.loads(line)


def _serve(engine: str, yolo: str, clip: str, folder: str, *, crops: int, device: str) -> None:
    """Load a profile's networks and answer each line of the standard input with a request."""
    import open_clip  # noqa: F401  (before the measurements)

    import_ultralytics()
    image_rgb, observation = _demo_frame(crops, folder)
    bboxes_xyxy = observation.detections.bboxes_xyxy
    relocalizer = Relocalizer(LandmarkMap.from_file(ASSETS / 'map.yaml'),
                              RelocalizerOptions(time_budget_s=_TIME_BUDGET_S))
    relocalizer.warm_up()
    free_memory()
    imports_mib = _resident_mib()
    started = time.perf_counter()
    detector = load_detector(
        DetectorOptions(yolo, device=device, inference=engine, cache_dir=folder))
    model, pretrained, file = json.loads(clip)
    options = ClipOptions(model, pretrained, file, device=device, inference=engine,
                          cache_dir=folder)
    encoder = ClipEncoder(resolve_clip_weights(options), options)
    stages: dict[str, Callable[[], Any]] = {
        'detection': lambda: detector.detect(image_rgb),
        'CLIP': lambda: encoder.encode_crops(image_rgb, bboxes_xyxy),
        'search': lambda: relocalizer.relocalize([observation])}
    print(json.dumps({'seconds': time.perf_counter() - started}), flush=True)
    for run in stages.values():
        run()  # kernels and memory for these sizes
    for _ in sys.stdin:
        print(json.dumps(_timed(stages) | {'mib': _resident_mib() - imports_mib}), flush=True)


def _demo_frame(crops: int, folder: str) -> tuple[NDArray[np.uint8], Observation]:
    """Return an image of the demo with enough boxes, and what the demo's networks say of it."""
    detector = load_detector(DetectorOptions(str(ASSETS / 'yolo.pt'), inference='pytorch'))
    camera, _ = find_camera(None, ASSETS / 'sequence')
    for file in sorted((ASSETS / 'sequence' / 'rgb').iterdir()):
        pixels_bgr = cv2.imread(str(file))
        assert pixels_bgr is not None
        image_rgb = np.ascontiguousarray(pixels_bgr[..., ::-1], dtype=np.uint8)
        detections = detector.detect(image_rgb).usable(camera.width, camera.height, crops)
        if len(detections) == crops:
            break
    clip = ClipOptions(str(ASSETS / 'clip.json'), str(ASSETS / 'clip.safetensors'),
                       inference='pytorch', cache_dir=folder)
    landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
    observer = Observer(*load_encoder(clip, landmark_map.weighted_labels))
    return image_rgb, observer.observe(image_rgb, camera, detections, 0)


def _timed(stages: dict[str, Callable[[], Any]]) -> dict[str, dict[str, float]]:
    """Run the stages; return wall time and processor time of each, and their sums [ms]."""
    wall, cpu = {}, {}
    for stage, run in stages.items():
        started, used = time.perf_counter(), time.process_time()
        run()
        wall[stage] = (time.perf_counter() - started) * 1e3
        cpu[stage] = (time.process_time() - used) * 1e3
    return {'wall': wall | {'total': sum(wall.values())},
            'cpu': cpu | {'total': sum(cpu.values())}}


def _resident_mib() -> float:
    match = re.search(r'VmRSS:\s+(\d+) kB', Path('/proc/self/status').read_text())
    assert match
    return int(match[1]) / 1024
