# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of the executables that run detector and CLIP."""

import argparse
from typing import TYPE_CHECKING, Any

from cliploc_ros.models.devices import INFERENCES
from cliploc_ros.models.profiles import PROFILE_NAMES, with_detector, with_encoder

if TYPE_CHECKING:
    from cliploc_ros.models.clip_weights import ClipOptions
    from cliploc_ros.models.yolo_weights import YoloOptions


def add_network_options(group: Any) -> None:
    """Add the options that name detector and CLIP to a group of a parser."""
    group.add_argument('--profile', choices=PROFILE_NAMES, default='auto',
                       help='detector and CLIP: that of the robot, as image embeddings are of one '
                       'CLIP (%(default)s: accurate on a GPU, balanced on a CPU)')
    group.add_argument('--model', default='', help="YOLO weights (the profile's)")
    group.add_argument('--clip-model', default='', help="(the profile's)")
    group.add_argument('--clip-pretrained', default='', help="tag or file (the profile's)")
    group.add_argument('--device', default='auto', help='(%(default)s)')
    group.add_argument('--inference', choices=INFERENCES, default='auto',
                       help='(%(default)s: OpenVINO on a CPU where it is installed)')


def yolo_options(options: argparse.Namespace, **more: Any) -> 'YoloOptions':
    """Return the detector that the command line names."""
    from cliploc_ros.models.yolo_weights import YoloOptions

    return with_detector(YoloOptions(model=options.model, device=options.device,
                                     inference=options.inference, **more), options.profile)


def clip_options(options: argparse.Namespace) -> 'ClipOptions':
    """Return the CLIP that the command line names."""
    from cliploc_ros.models.clip_weights import ClipOptions

    return with_encoder(ClipOptions(model=options.clip_model, pretrained=options.clip_pretrained,
                                    device=options.device, inference=options.inference),
                        options.profile)
