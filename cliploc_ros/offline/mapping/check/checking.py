# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of checking: a map and, if there is one, a recording in, a report out."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.building import Progress
from cliploc_ros.offline.mapping.check.advice import give_advice
from cliploc_ros.offline.mapping.check.landmark_faults import (
    Witness,
    check_landmarks,
    find_map_overlaps,
    hear_witness,
)
from cliploc_ros.offline.mapping.check.places import find_look_alikes, make_grid
from cliploc_ros.offline.mapping.check.relocalization import (
    ImageOf,
    RecordedKeyframes,
    Tell,
    Trial,
    each_pose,
    make_folds,
    measure_detector,
    sample_frames,
    try_recording,
)
from cliploc_ros.offline.mapping.check.report import (
    CheckReport,
    GridCheck,
    RecordingCheck,
    check_keyframes,
    find_measures,
)
from cliploc_ros.offline.mapping.evidence import BoxQuality, best_ious, explained_boxes
from cliploc_ros.offline.mapping.options import CheckOptions, Thresholds
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.sizes import scale_by_sizes
from cliploc_ros.offline.mapping.systematic import find_corrections
from cliploc_ros.offline.mapping.tilt import tilt_note
from cliploc_ros.offline.mapping.views import Views, check_input, make_views
from cliploc_ros.offline.simulation import DetectorModel, guess_detector

_NOTES = (
    'similarities of crops and labels are simulated: labels of equal text look equal, and labels '
    'that share words look alike',
    'the grid assumes that the map is correct and that walls hide only landmarks that were hidden '
    'in the recording')
_NO_RECORDING = (
    'no recording: the detector is assumed to find 60 % of the objects in view within 5 m, in '
    'images of 640 x 480 px with a focal length of 525 px')
# Greatest difference in height between a robot's camera and those of the recording [m]. Chosen.
_HEIGHT_MARGIN_M = 0.3


def check_map(landmark_map: LandmarkMap, detections: PosedDetections | None = None,
              options: CheckOptions | None = None, thresholds: Thresholds | None = None,
              progress: Progress | None = None, layer: KeyframeLayer | None = None,
              image_of: ImageOf | None = None) -> CheckReport:
    """Check a map.

    Parameters
    ----------
    detections : PosedDetections, optional
        A recording of the place. Without one, the report is shorter.
    thresholds : Thresholds, optional
        The thresholds that the map has to reach.
    layer : KeyframeLayer, optional
        The keyframes next to the map.
    image_of : callable, optional
        Returns the undistorted image (h, w, 3), RGB, of a frame of the recording; None if it is
        missing. With a layer, frames are relocalized by keyframes, too.

    Raises
    ------
    MappingError
        The recording does not fit this map; the message says what to correct.
    """
    options, tell = options or CheckOptions(), progress or (lambda stage, share: None)
    notes, views, witness, recording = [*_NOTES], None, None, None
    recorded = None if detections is None else detections.map_from_camera
    if detections is None:
        notes.append(_NO_RECORDING)
        model = guess_detector(landmark_map)
    else:
        tell('judging landmarks', 0.0)
        views = make_views(detections)
        notes += check_input(detections, views)
        witness = hear_witness(views, landmark_map, detections.class_names)
        if not (witness.shown >= 0).any():
            raise MappingError(_unrelated(landmark_map, detections))
        models = [measure_detector(landmark_map, detections, views, witness, number)
                  for number in range(len(detections.cameras))]
        model = models[0]
        if len(models) > 1:
            notes.append(f'the grid uses one camera, {detections.camera_names[0]}, the first of '
                         f'{len(models)}')
        recording = _check_recording(
            landmark_map, detections, views, witness, models, options, tell,
            None if layer is None or image_of is None else RecordedKeyframes(layer, image_of))
        notes += _notes_on(recording)
    tilt = '' if detections is None else tilt_note(detections.map_from_camera)
    notes.append(tilt or _where_cameras_can_be(recorded))  # a tilted map has no true heights
    overlaps = find_map_overlaps(landmark_map, witness, views)
    places = make_grid(landmark_map, None if detections is None else detections.of_first_camera,
                       options)
    trials = _told(each_pose(model, landmark_map, places.poses, options), len(places.poses),
                   partial(tell, 'relocalizing on the grid'))
    verdicts = np.array([trial.verdict for trial in trials], dtype=np.str_)
    verdicts = verdicts.reshape(-1, options.headings)
    grid = GridCheck(
        **vars(places), accepted=(verdicts == 'accepted').sum(axis=1),
        misled=(verdicts == 'misled').sum(axis=1), trials=tuple(trials), visible=np.array(
            [model.expected_detections(pose) for pose in places.poses]).reshape(verdicts.shape))
    report = CheckReport(
        landmarks=tuple(check_landmarks(landmark_map, witness, overlaps)),
        overlaps=tuple(overlaps), look_alikes=tuple(find_look_alikes(landmark_map)),
        grid=grid, recording=recording,
        notes=tuple(notes), map_ids=landmark_map.landmark_ids,
        keyframes=None if layer is None else check_keyframes(layer, grid, recorded),
        scale=scale_by_sizes(landmark_map))
    tell('done', 1.0)
    return replace(report, to_do=tuple(give_advice(report)),
                   measures=tuple(find_measures(report, thresholds or Thresholds())))


def _told(trials: Iterator[Trial], count: int, tell: Tell) -> list[Trial]:
    """Collect `count` trials and report progress."""
    done = []
    for trial in trials:
        done.append(trial)
        tell(len(done) / count)
    return done


def _check_recording(landmark_map: LandmarkMap, detections: PosedDetections, views: Views,
                     witness: Witness, models: Sequence[DetectorModel], options: CheckOptions,
                     tell: Progress, keyframes: RecordedKeyframes | None) -> RecordingCheck:
    tell('cross-validating', 0.0)
    folds, held_out = [], []
    for fold in make_folds(views, witness, options):
        # a box whose landmark no other part of the recording shows does not test the map
        is_known = (witness.shown < 0) | np.isin(witness.shown, fold.rows)
        ious = best_ious(views, fold.landmarks)[np.isin(views.frames, fold.frames) & is_known]
        folds.append(fold)
        held_out.append(ious)
        tell('cross-validating', len(folds) / options.folds)
    trials = try_recording(landmark_map, detections, witness.shown, folds, options,
                           partial(tell, 'relocalizing recorded frames'), keyframes)
    sampled = sample_frames(detections, options.frames)
    own = [sampled[detections.frame_cameras[sampled] == number] for number in range(len(models))]
    simulated = [trial for model, frames in zip(models, own, strict=True) for trial in _told(
        each_pose(model, landmark_map, detections.map_from_camera[frames], options), len(frames),
        partial(tell, 'relocalizing simulated frames'))]
    tell('looking for systematic errors', 0.0)
    return RecordingCheck(
        frames=len(detections), boxes=len(detections.classes),
        duration_s=float(detections.stamps_s[-1] - detections.stamps_s[0]),
        path_xyz=detections.map_from_camera[:, :3, 3],
        as_given=explained_boxes(views, witness.landmarks),
        held_out=BoxQuality.of(np.concatenate(held_out)),
        trials=tuple(trials), simulated=tuple(simulated),
        corrections=tuple(find_corrections(detections, views, witness.fitted, witness.shown)),
        edge_scale=models[0].edge_scale)


def _where_cameras_can_be(recorded: NDArray[np.float64] | None) -> str:
    """Return a note on the range of accepted poses, given recorded poses (F, 4, 4)."""
    known = 'accepted poses may lie anywhere: the map does not limit where cameras can be'
    if recorded is None:
        return f'{known}, and there is no recording with their heights: set `height_range_m`'
    low, high = recorded[:, 2, 3].min(), recorded[:, 2, 3].max()
    return (f'{known}; those of the recording were {low:.2f} to {high:.2f} m high. For a camera '
            f'at this height, set `height_range_m` to [{low - _HEIGHT_MARGIN_M:.1f}, '
            f'{high + _HEIGHT_MARGIN_M:.1f}]')


def _notes_on(recording: RecordingCheck) -> list[str]:
    """Return notes on the figures that cannot be judged by this recording."""
    notes = []
    if not recording.can_judge_boxes:
        notes.append('cross-validation cannot judge boxes: other parts of the recording show the '
                     f'objects of {recording.held_out.boxes} of {recording.as_given.boxes}')
    if not recording.can_judge_frames:
        notes.append(f'cross-validation cannot judge frames: other parts of the recording show '
                     f'the objects of {len(recording.judged)} of {len(recording.trials)}; the '
                     'verdict uses simulated boxes; pass each place twice for a better test')
    return notes


def _unrelated(landmark_map: LandmarkMap, detections: PosedDetections) -> str:
    shared = set(landmark_map.class_ids) & set(detections.class_names)
    if not shared:
        return ('the recording has none of the classes of the map '
                f'({", ".join(sorted(set(landmark_map.class_ids))[:3])}): use the detector that '
                'the map was made with')
    return ('no box of the recording overlaps a landmark of its class: check that poses and map '
            'have the same coordinate frame, and that the poses are of the camera (z forward)')
