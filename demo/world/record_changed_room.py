# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make the test files of a changed room: ``python -m demo.world.record_changed_room ROOM OUT``.

ROOM comes from demo.world.make_changed_room. The demo's networks process both walks once; their
output is stored next to the walks. The program writes the input of an update to OUT: the exact map
of the room before the changes, its image embeddings from the first walk, the output of the
networks for the second walk, and the changes. Embeddings are rounded to 1/128 to keep the files
small.
"""

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from cliploc_ros.core.map.landmark_embeddings import embeddings_path, save_landmark_embeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.observations import save_observations
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.labelling import embed_landmarks
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.views import make_views
from cliploc_ros.offline.recording.recorder import KeyframeOptions, RecordingOptions, record_once
from demo import ASSETS

_ROUNDING = 128
_SHOWN_IOU = 0.3


def record_changed_room(room: Path, out: Path) -> None:
    """Write the files of a changed room to a folder."""
    before, after = (_look(room / name) for name in ('before', 'after'))
    landmark_map = LandmarkMap.from_file(room / 'map.yaml')
    shown = associate(make_views(before),
                      landmarks_of_map(landmark_map, before.class_names), _SHOWN_IOU)
    out.mkdir(parents=True, exist_ok=True)
    for name in ('map.yaml', 'changes.json'):
        shutil.copyfile(room / name, out / name)
    embeddings = embed_landmarks(landmark_map.landmark_ids, before, shown)
    save_landmark_embeddings(embeddings_path(out / 'map.yaml'), embeddings)
    assert after.embeddings is not None
    save_observations(out / 'after.npz', replace(
        after, bboxes_xyxy=after.bboxes_xyxy.round(1),
        embeddings=(np.round(after.embeddings * _ROUNDING) / _ROUNDING).astype(np.float16)))
    with np.load(out / 'after.npz') as arrays:
        small = dict(arrays)
    np.savez_compressed(out / 'after.npz', **small)


def _look(walk: Path) -> PosedDetections:
    """Return the output of the demo's networks for each image of a walk."""
    clip = ClipOptions(pretrained=str(ASSETS / 'clip'))
    networks = RecordingOptions(DetectorOptions(model=str(ASSETS / 'yolo.onnx')), clip,
                                KeyframeOptions(0.0, 0.0), '')
    return record_once(read_folder(walk, FolderOptions(layout='tum')), networks,
                       walk.with_suffix('.npz'))


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog='record_changed_room', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('room', type=Path, metavar='ROOM')
    parser.add_argument('out', type=Path, metavar='OUT')
    options = parser.parse_args()
    record_changed_room(options.room, options.out)


if __name__ == '__main__':
    main()
