# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with posed detections: errors where no map is possible, else notes."""

import numpy as np

from cliploc_ros.errors import MappingError
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.views import Views

# No robot or person with a camera is faster.
_MAX_SPEED_M_PER_S = 10.0
_MAX_TURN_DEG_PER_S = 720.0
_LEAST_JUMP_M, _LEAST_JUMP_DEG = 0.5, 30.0
_MAX_EMPTY_SHARE = 0.5


def check_input(detections: PosedDetections, views: Views, options: MappingOptions) -> list[str]:
    """Return notes on the input.

    Raises
    ------
    MappingError
        No map can be made of it; the message says what to correct.
    """
    if len(detections.classes) == 0:
        raise MappingError(f'the {len(detections)} frames have no detections; check the detector, '
                           'its classes and its confidence threshold')
    viewpoints = int(views.viewpoints[-1]) + 1
    if viewpoints < options.min_viewpoints:
        raise MappingError(f'the camera took {viewpoints} viewpoints, at least '
                           f'{options.min_viewpoints} are needed; move it around the objects, and '
                           'check that the poses are those of the images')
    notes = []
    if jumps := _jumps(detections):
        notes.append(f'the poses jump {len(jumps)} times, first at {jumps[0]:.2f} s; check the '
                     'localization that they come from')
    empty = float(np.mean(np.diff(detections.frame_offsets) == 0))
    if empty > _MAX_EMPTY_SHARE:
        notes.append(f'{empty:.0%} of the frames have no detections; check the detector')
    if len(detections.class_names) == 1:
        notes.append(f"all boxes are of the class '{detections.class_names[0]}'; maps with more "
                     'classes relocalize better')
    return notes


def _jumps(detections: PosedDetections) -> list[float]:
    """Return the times [s] at which the pose moves faster than any camera does."""
    poses, stamps = detections.map_from_camera, detections.stamps_s
    seconds = np.maximum(np.diff(stamps), 1e-3)
    distances = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    traces = np.einsum('fij,fij->f', poses[1:, :3, :3], poses[:-1, :3, :3])
    angles = np.degrees(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))
    far = (distances > _LEAST_JUMP_M) & (distances > _MAX_SPEED_M_PER_S * seconds)
    far |= (angles > _LEAST_JUMP_DEG) & (angles > _MAX_TURN_DEG_PER_S * seconds)
    return [float(stamp) for stamp in stamps[1:][far]]
