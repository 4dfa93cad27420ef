# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Profiles: detector and encoder by name; the detector that options name."""

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cliploc_ros.errors import OptionsError

if TYPE_CHECKING:  # not at run time: nodes need the names of profiles before loading networks
    from cliploc_ros.models.protocols import ClipOptions, DetectorOptions, ObjectDetector


@dataclass(frozen=True)
class Profile:
    """A detector and an encoder."""

    detector: str  #: See DetectorOptions.model
    #: See ClipOptions; an ONNX network needs no model
    clip_model: str
    clip_pretrained: str


# OpenAI's ViT-B-32.
_CLIP = 'Xenova/clip-vit-base-patch32'
#: doc/install.md has their accuracy, time, memory and licences.
PROFILES = {
    'accurate': Profile('yolov8x.pt', 'ViT-L-14', 'openai'),  # the paper's
    'balanced': Profile('onnx-community/dfine_m_obj365-ONNX', '', _CLIP),
    'fast': Profile('onnx-community/dfine_n_coco-ONNX', '', _CLIP),
}
PROFILE_NAMES = tuple(PROFILES)


def _profile(name: str) -> Profile:
    if name not in PROFILES:
        raise OptionsError(f"profile '{name}' is not one of {', '.join(PROFILES)}")
    return PROFILES[name]


def with_detector(options: 'DetectorOptions', profile: str) -> 'DetectorOptions':
    """Return options that name a detector: that of the profile if the model is ''.

    OptionsError: the profile is unknown.
    """
    return options if options.model else replace(options, model=_profile(profile).detector)


def with_encoder(options: 'ClipOptions', profile: str) -> 'ClipOptions':
    """Return options that name an encoder: that of the profile if they do not name one.

    If the options name a model, weights or a file, the missing ones are the defaults of
    ClipOptions, not those of the profile, because weights belong to a model. OptionsError: the
    profile is unknown.
    """
    if options.model or options.pretrained or options.checkpoint_path:
        defaults = type(options)
        return replace(options, model=options.model or defaults.model,
                       pretrained=options.pretrained or defaults.pretrained)
    chosen = _profile(profile)
    return replace(options, model=chosen.clip_model, pretrained=chosen.clip_pretrained)


def load_detector(options: 'DetectorOptions') -> 'ObjectDetector':
    """Load a detector; weights of ultralytics are exported to ONNX at their first use.

    Raises
    ------
    ModelError
        The weights are missing or damaged, are not those of a detection model, or cannot be
        exported, for example without PyTorch.
    OptionsError
        The options name prompts for a network with fixed classes.
    """
    from cliploc_ros.models.files import fingerprint_file
    from cliploc_ros.models.hub import is_hub_name
    from cliploc_ros.models.onnx_detector import OnnxDetector

    path = Path(options.model).expanduser()
    if path.suffix == '.onnx' or path.is_dir() or is_hub_name(options.model):
        return OnnxDetector(options)
    from cliploc_ros.models.exports import DETECTOR, exported
    from cliploc_ros.models.yolo_weights import export_detector, resolve_published

    file = resolve_published(options.model, options.cache_dir, 'model')
    identity = [fingerprint_file(file)]
    if options.prompts:
        tower = Path(options.text_model).expanduser()
        identity += [fingerprint_file(tower) if tower.is_file() else options.text_model,
                     json.dumps(options.prompts)]

    folder = exported(options.cache_dir, 'YOLO', str(file), identity,
                      partial(export_detector, file, options))
    return OnnxDetector(replace(options, model=str(folder / DETECTOR), prompts=()))
