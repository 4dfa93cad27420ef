# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare all crops with crops on demand: ``python -m cliploc_ros.benchmark.crops``.

Detector and CLIP run on each image of a TUM folder, by default the demo's, then the search. With
crops on demand, CLIP and search take turns, as in the relocalizer. Both run on the same boxes.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import cliploc_ros
from cliploc_ros.command import run_command
from cliploc_ros.core.geometry.tolerances import RIGHT_M
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.on_demand import crops_on_demand, localize_on_demand
from cliploc_ros.core.options import CROPS, RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.folders import tum_frames
from cliploc_ros.datasets.frames import Frame
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.map_rows import load_encoder_for_map
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.yolo_weights import YoloOptions

_ASSETS = Path(cliploc_ros.__file__).parent / 'demo' / 'assets'
_INFERENCES = ('pytorch', 'openvino')
_LIMITS_M = (0.25, 0.5, 1.0)
_MAX_DETECTIONS = 50


@dataclass(frozen=True)
class Answer:
    """The answer to one image.

    Parameters
    ----------
    error_m : float
        Of the best pose, infinite without one.
    accepted : bool
    crops, compared : int
        Number of crops, and of those that CLIP encoded.
    detect_s, wall_s, cpu_s : float
        Time of the detector, and from the image to the pose; the last one of the processor [s].
    """

    error_m: float
    accepted: bool
    crops: int
    compared: int
    detect_s: float
    wall_s: float
    cpu_s: float


class Robot:
    """Answers where an image was taken, with crops on demand or all of them."""

    def __init__(self, landmark_map: LandmarkMap, detector: YoloDetector, clip: ClipOptions,
                 map_file: str, options: RelocalizerOptions) -> None:
        self._map, self._detector = landmark_map, detector
        self._encoder, self._embeddings = load_encoder_for_map(clip, landmark_map, [map_file],
                                                               'image')
        self._relocalizer = Relocalizer(landmark_map, options)
        self._relocalizer.warm_up()

    def answer(self, frame: Frame, crops: str) -> Answer:
        """Localize with one image and nothing remembered of the images before it."""
        height, width = frame.image_rgb.shape[:2]
        start, cpu_start = time.perf_counter(), time.process_time()
        detections = self._detector.detect(frame.image_rgb).usable(width, height,
                                                                   _MAX_DETECTIONS)
        detect_s = time.perf_counter() - start
        searched, found = localize_on_demand(self._relocalizer, (),
                                             self._stages(frame, detections, crops))
        wall_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu_start
        assert frame.map_from_camera is not None
        error_m = np.inf if found.map_from_camera is None else \
            pose_error(found.map_from_camera, frame.map_from_camera)[0]
        return Answer(float(error_m), found.accepted, len(detections),
                      int((searched.observation.similarity_rows >= 0).sum()), detect_s, wall_s,
                      cpu_s)

    def _stages(self, frame: Frame, detections: Detections, crops: str) -> Iterator[Observation]:
        observer = Observer(self._encoder, self._embeddings)
        if crops == 'all':
            yield observer.observe(frame.image_rgb, frame.camera, detections, frame.stamp_ns)
            return
        observation = Observation(frame.camera, detections, stamp_ns=frame.stamp_ns)
        yield from crops_on_demand(self._map, observation, observer.crops(
            frame.image_rgb, detections.bboxes_xyxy).compare)


def describe(answers: Sequence[Answer]) -> str:
    """Return a row of the table."""
    errors = np.array([one.error_m for one in answers])
    accepted = np.array([one.accepted for one in answers])
    right = errors < RIGHT_M
    compared = sum(one.compared for one in answers) / max(sum(one.crops for one in answers), 1)
    wall, cpu, detect = (np.array([getattr(one, name) for one in answers])
                         for name in ('wall_s', 'cpu_s', 'detect_s'))
    success = ' / '.join(f'{(errors < limit).mean():.2f}' for limit in _LIMITS_M)
    both = int((accepted & right).sum())
    precision, recall = both / max(int(accepted.sum()), 1), both / max(int(right.sum()), 1)
    return (f'{success:<20} {accepted.sum():8d} {(accepted & ~right).sum():5d} {precision:9.3f} '
            f'{recall:6.3f} {compared:6.2f} {np.median(detect) * 1e3:7.0f} '
            f'{np.median(wall) * 1e3:8.0f} {wall.mean() * 1e3:6.0f} {wall.max() * 1e3:6.0f} '
            f'{cpu.mean() * 1e3:6.0f}')


def run(args: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(prog='crops', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--tum', type=Path, default=_ASSETS / 'sequence', metavar='DIR')
    parser.add_argument('--map', type=Path, default=_ASSETS / 'map.yaml', metavar='YAML')
    parser.add_argument('--model', default=str(_ASSETS / 'yolo.pt'), help='YOLO')
    parser.add_argument('--clip-model', default=str(_ASSETS / 'clip.json'))
    parser.add_argument('--clip-pretrained', default=str(_ASSETS / 'clip.safetensors'))
    parser.add_argument('--intrinsics', metavar='fr1|fr2|fr3|FILE')
    parser.add_argument('--inference', nargs='+', choices=_INFERENCES, default=['pytorch'])
    parser.add_argument('--every', type=int, default=1, metavar='N', help='(%(default)s)')
    options = parser.parse_args(args)
    landmark_map = LandmarkMap.from_file(options.map)
    sequence = read_tum(options.tum).every(options.every)
    frames = [one for one in tum_frames(
        sequence, find_camera(options.intrinsics, options.tum)[0]).read()
        if one.map_from_camera is not None]
    method = RelocalizerOptions()
    method = replace(method, k=min(method.k, len(landmark_map)))
    print(f'{len(frames)} images; times of one image [ms], networks warm\n'
          f'{"engine":<9} {"crops":<10} {"success .25/.5/1":<20} accepted false precision recall '
          f'encoded detect   median   mean    max    cpu')
    for inference in options.inference:
        clip = ClipOptions(model=options.clip_model, pretrained=options.clip_pretrained,
                           inference=inference)
        robot = Robot(landmark_map, YoloDetector(YoloOptions(model=options.model)), clip,
                      str(options.map), method)
        robot.answer(frames[0], 'all')  # warm
        answers: dict[str, list[Answer]] = {crops: [] for crops in CROPS}
        for frame in frames:  # in turn, so that other load disturbs both
            for crops in CROPS:
                answers[crops].append(robot.answer(frame, crops))
        for crops in CROPS:
            print(f'{inference:<9} {crops:<10} {describe(answers[crops])}', flush=True)
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(run)


if __name__ == '__main__':
    sys.exit(main())
