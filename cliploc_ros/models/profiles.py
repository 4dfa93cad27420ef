# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Profiles: detector and encoder for a device."""

import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cliploc_ros.errors import OptionsError
from cliploc_ros.models.devices import (
    needs_pytorch,
    resolve_device,
    resolve_inference,
    resolve_precision,
)

if TYPE_CHECKING:  # not at run time: nodes need the names of profiles before loading networks
    from cliploc_ros.models.clip_weights import ClipOptions
    from cliploc_ros.models.protocols import DetectorOptions, ObjectDetector


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
PROFILE_NAMES = ('auto', *PROFILES)
logger = logging.getLogger(__name__)


def resolve_profile(profile: str, device: str) -> Profile:
    """Return the profile of a name; 'auto' means 'accurate' on a GPU, 'balanced' on a CPU.

    OptionsError: the name is unknown, or the device is missing.
    """
    if profile not in PROFILE_NAMES:
        raise OptionsError(f"profile '{profile}' is not one of {', '.join(PROFILE_NAMES)}")
    if profile == 'auto':
        profile = 'balanced' if resolve_device(device) == 'cpu' else 'accurate'
    return PROFILES[profile]


def with_detector(options: 'DetectorOptions', profile: str) -> 'DetectorOptions':
    """Return options that name a detector: that of the profile if the model is ''."""
    if options.model:
        return options
    return replace(options, model=resolve_profile(profile, options.device).detector)


def with_encoder(options: 'ClipOptions', profile: str) -> 'ClipOptions':
    """Return options that name an encoder: that of the profile if they do not name one.

    If the options name a model, weights or a file, the missing ones are the defaults of
    ClipOptions, not those of the profile, because weights belong to a model.
    """
    if options.model or options.pretrained or options.checkpoint_path:
        defaults = type(options)
        return replace(options, model=options.model or defaults.model,
                       pretrained=options.pretrained or defaults.pretrained)
    chosen = resolve_profile(profile, options.device)
    return replace(options, model=chosen.clip_model, pretrained=chosen.clip_pretrained)


def load_detector(options: 'DetectorOptions') -> 'ObjectDetector':
    """Load a detector of any kind.

    Raises
    ------
    ModelError
        The weights are missing or damaged, or are not those of a detection model.
    OptionsError
        The device or the inference engine is missing.
    """
    from cliploc_ros.models.hub import is_hub_name
    from cliploc_ros.models.onnx_detector import OnnxDetector

    path = Path(options.model).expanduser()
    if path.suffix == '.onnx' or path.is_dir() or is_hub_name(options.model):
        return OnnxDetector(options)
    from cliploc_ros.models.yolo_weights import resolve_published

    file = resolve_published(options.model, options.cache_dir, 'model')
    device = resolve_device(options.device)
    if resolve_inference(options.inference, device,
                         resolve_precision(options.precision, device)) == 'openvino':
        exported = _exported(file, options)
        if exported is not None:
            return OnnxDetector(exported)
    with needs_pytorch(f'{file}, which is not an ONNX network,'):
        from cliploc_ros.models.yolo_detector import YoloDetector

        return YoloDetector(file, options)


def _exported(file: Path, options: 'DetectorOptions') -> 'DetectorOptions | None':
    """Export weights to ONNX once, and return options that name the ONNX file.

    If a network cannot be exported, return None with inference 'auto', and raise an ExportError
    with 'openvino'.
    """
    from cliploc_ros.models.exports import (
        DETECTOR,
        ExportError,
        detector_identity,
        find_export,
        keep_export,
    )

    identity = detector_identity(file, options)
    folder = find_export(options.cache_dir, 'YOLO', identity)
    if folder is None:
        with needs_pytorch(f'{file}, which is not an ONNX network,'):
            from cliploc_ros.models.yolo_detector import export_detector

            try:
                folder = keep_export(options.cache_dir, 'YOLO', identity,
                                     partial(export_detector, file, options))
            except ExportError as error:
                if options.inference == 'openvino':
                    raise
                logger.warning('%s; PyTorch runs it (set inference to pytorch to skip the '
                               'attempt)', error)
                return None
    return replace(options, model=str(folder / DETECTOR), prompts=())
