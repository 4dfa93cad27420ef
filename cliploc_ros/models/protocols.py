# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detectors and encoders, independent of their networks: protocols, options, prompts, profiles."""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from cliploc_ros.errors import OptionsError

# not at run time, for a fast --help: nodes need the names of profiles before loading networks
if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.core.observation import Detections

#: Texts that a detector looks for, each with the class that it reports.
Prompts = tuple[tuple[str, str], ...]
#: Greatest number of texts of a vocabulary (not measured): LVIS has 1,203 classes, a room dozens.
MOST_TEXTS = 300

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DetectorOptions:
    """The detector to load, and how to run it. The names are those of ultralytics."""

    #: Path of an ONNX file, of a folder with one or of a ``.pt`` file; or a network that is
    #: downloaded once: OWNER/NAME[@REVISION][:FILE] of the hub, or a published ``.pt`` file.
    #: PyTorch exports a ``.pt`` file to ONNX at its first use
    model: str = 'yolov8x.pt'
    conf: float = 0.1  #: Least confidence of a detection, 0 to 1
    iou: float = 0.7  #: Above this IoU, the weaker of two boxes of a class is dropped, 0 to 1
    imgsz: int = 640  #: Longer side of the scaled image that the network gets [px]
    max_det: int = 300  #: Greatest number of detections in an image; the most confident are kept
    #: Folder for downloads, exported and compiled networks; '': the user's cache
    cache_dir: str = ''
    #: Texts that a YOLO-World or YOLOE looks for; empty: the classes stored in its file
    prompts: Prompts = ()
    #: File of the text tower for prompts: CLIP ViT-B-32 for YOLO-World, mobileclip_blt.ts for
    #: YOLOE; '': downloaded once. Any other tower must be a TorchScript file (.ts) that converts
    #: CLIP's tokens to embeddings
    text_model: str = ''


@dataclass(frozen=True)
class ClipOptions:
    """The CLIP to load."""

    #: Architecture: a name of ``open_clip.list_models()``, or the path of an open_clip model
    #: config (.json), which gets the name of the file
    model: str = 'ViT-L-14'
    #: A folder with ONNX files, or OWNER/NAME[@REVISION] of the hub; both need no model. Otherwise
    #: a tag of ``open_clip.list_pretrained()``, or the path of a checkpoint, which PyTorch exports
    #: to ONNX at its first use. A tag also determines activation and colour normalization; a
    #: checkpoint has those of the architecture.
    pretrained: str = 'openai'
    #: Local file with the weights of the tag; '': download them
    checkpoint_path: str = ''
    #: Folder for downloads, label embeddings, exported and compiled networks; '': the user's cache
    cache_dir: str = ''


class ImageTextEncoder(Protocol):
    """Embeds image crops in the space of label embeddings, with cosine similarity."""

    key: str  #: Identifies model and weights: equal keys give equal embeddings

    def encode_crops(self, image_rgb: 'NDArray[np.uint8]', bboxes_xyxy: 'NDArray[np.float64]'
                     ) -> 'NDArray[np.float32]':
        """Return the embeddings (n, d) of n boxes in an image (h, w, 3) uint8, RGB.

        The boxes (n, 4) are left, top, right, bottom [px]; each must overlap the image. The
        embeddings have unit length.
        """


class ObjectDetector(Protocol):
    """Finds the objects in an image."""

    class_names: tuple[str, ...]  #: All classes of the network

    def configure(self, options: DetectorOptions) -> None:
        """Change the options, except for the model."""

    def detect(self, image_rgb: 'NDArray[np.uint8]') -> 'Detections':
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        Boxes are in pixels of that image, which has at least one pixel.
        """


def prompts_of_names(names: str) -> Prompts:
    """Return the prompts of a list of names, such as 'mug, office chair'.

    OptionsError: there are no names, or too many.
    """
    texts = dict.fromkeys(filter(None, map(str.strip, names.split(','))))
    return _checked([(text, text) for text in texts], 'the vocabulary')


def prompts_of_map(landmark_map: 'LandmarkMap', source: str) -> Prompts:
    """Return the prompts of a map: its classes, and its labels with the class of their landmarks.

    A label shared by landmarks of several classes gets the most frequent class. If there are too
    many labels, the prompts are only the classes. OptionsError: there are no classes, or too many.
    """
    found = [(name, name) for name in dict.fromkeys(landmark_map.class_ids) if name.strip()]
    classes = {name for name, _ in found}
    owners: dict[str, Counter[str]] = {}
    for name, labels in zip(landmark_map.class_ids, landmark_map.weighted_labels, strict=True):
        for text, _ in labels:
            if name in classes and text.strip() and text not in classes:
                owners.setdefault(text, Counter())[name] += 1
    if len(found) + len(owners) <= MOST_TEXTS:
        found += [(text, names.most_common(1)[0][0]) for text, names in owners.items()]
    else:
        logger.warning('%s has %d classes and %d other labels, more than %d texts: the detector '
                       'looks only for the classes', source, len(found), len(owners), MOST_TEXTS)
    return _checked(found, source)


def _checked(prompts: Sequence[tuple[str, str]], source: str) -> Prompts:
    if not prompts:
        raise OptionsError(f'{source} names no class for the detector')
    if len(prompts) > MOST_TEXTS:
        raise OptionsError(f'{source} has {len(prompts)} classes for the detector, expected at '
                           f'most {MOST_TEXTS}: name the important ones in vocabulary')
    return tuple(prompts)


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


def with_detector(options: DetectorOptions, profile: str) -> DetectorOptions:
    """Return options that name a detector: that of the profile if the model is ''.

    OptionsError: the profile is unknown.
    """
    return options if options.model else replace(options, model=_profile(profile).detector)


def with_encoder(options: ClipOptions, profile: str) -> ClipOptions:
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
