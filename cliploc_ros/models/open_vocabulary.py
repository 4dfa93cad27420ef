# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Open-vocabulary detectors: YOLO-World and YOLOE of ultralytics.

These networks take embeddings of texts from the text tower that they were trained with: YOLO-World
from OpenAI's CLIP ViT-B-32, YOLOE from MobileCLIP. Embeddings are cached, so that a start with the
same texts does not need the text tower.
"""

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_encoder import encode_labels
from cliploc_ros.models.clip_weights import (
    CHECKPOINT,
    WITHOUT_CLIP,
    ClipOptions,
    resolve_clip_weights,
)
from cliploc_ros.models.files import fingerprint_file, first_line
from cliploc_ros.models.label_embeddings import LabelCache
from cliploc_ros.models.protocols import DetectorOptions, Prompts
from cliploc_ros.models.yolo_weights import import_ultralytics, resolve_published

#: Greatest number of texts of a vocabulary (not measured): LVIS has 1,203 classes, a room dozens.
MOST_TEXTS = 300
# Length of an embedding in all these networks.
_EMBED_DIM = 512
_TOWERS = {'mobileclip:blt': 'mobileclip_blt.ts', 'mobileclip2:b': 'mobileclip2_b.ts'}

logger = logging.getLogger(__name__)


def prompts_of_names(names: str) -> Prompts:
    """Return the prompts of a list of names, such as 'mug, office chair'.

    OptionsError: there are no names, or too many.
    """
    texts = dict.fromkeys(filter(None, map(str.strip, names.split(','))))
    return _checked([(text, text) for text in texts], 'the vocabulary')


def prompts_of_map(landmark_map: LandmarkMap, source: str) -> Prompts:
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


def set_prompts(model: Any, options: DetectorOptions) -> str:
    """Set the options' prompts in a network of ultralytics; return the key of the text tower.

    Raises
    ------
    OptionsError
        The network does not take texts.
    ModelError
        The text tower is missing or damaged, or belongs to another network.
    """
    import torch

    ultralytics = import_ultralytics()
    network, texts = model.model, [text for text, _ in options.prompts]
    is_yoloe, head = isinstance(model, ultralytics.YOLOE), model.model.model[-1]
    if (not is_yoloe and not isinstance(model, ultralytics.YOLOWorld)) or hasattr(head, 'lrpc'):
        raise OptionsError(f'{options.model} takes no texts: a vocabulary needs a YOLO-World or a '
                           'YOLOE with prompts, such as yolov8s-worldv2.pt')
    key, encode = _tower(getattr(network, 'text_model', 'mobileclip:blt') if is_yoloe else 'clip',
                         options)
    cache = LabelCache(resolve_cache_dir(options.cache_dir) / 'labels')
    rows = cache.load(key, texts, _EMBED_DIM)
    if rows is None:
        rows = encode(texts)
        cache.store(key, texts, rows)
    embedded = torch.from_numpy(rows)[None]
    if is_yoloe:
        with torch.no_grad():
            network.set_classes(texts, head.get_tpe(embedded))
    else:  # as in WorldModel.set_classes, which would load its own text tower
        network.txt_feats, head.nc, network.names = embedded, len(texts), dict(enumerate(texts))
    return key


def _tower(name: str, options: DetectorOptions
           ) -> tuple[str, Callable[[Sequence[str]], NDArray[np.float32]]]:
    """Return the key of a text tower, and a function that embeds texts; see set_prompts."""
    if name == 'clip' and not options.text_model.endswith('.ts'):
        try:
            clip = ClipOptions('ViT-B-32', 'openai', checkpoint_path=options.text_model,
                               device=options.device, cache_dir=options.cache_dir)
            weights = resolve_clip_weights(clip)
        except ModelError as error:
            remedy = str(error).replace(f'{CHECKPOINT}{WITHOUT_CLIP}', 'text_model to the file')
            raise ModelError(f'text tower of {options.model}: {remedy}') from error
        return weights.key, lambda texts: encode_labels(weights, texts, clip)
    if name not in ('clip', *_TOWERS):
        raise ModelError(f"{options.model} needs the text tower '{name}', which is unknown: "
                         f'expected {", ".join(_TOWERS)}')
    file = resolve_published(options.text_model or _TOWERS[name], options.cache_dir, 'text_model')
    return f'torchscript:{fingerprint_file(file)}', lambda texts: _run_torchscript(file, texts)


def _run_torchscript(file: Path, texts: Sequence[str]) -> NDArray[np.float32]:
    """Return the embeddings (n, _EMBED_DIM) of texts, unit rows, by a tower in TorchScript."""
    import open_clip
    import torch

    tokens = open_clip.get_tokenizer('ViT-B-32')(list(texts))
    try:
        with torch.inference_mode():
            found = torch.jit.load(file, map_location='cpu')(tokens).float().numpy()
    except Exception as error:  # PyTorch has no exception classes
        raise ModelError(f'{file} is not a text tower in TorchScript: {first_line(error)}'
                         ) from error
    lengths = np.linalg.norm(found, axis=-1, keepdims=True)
    if found.shape != (len(texts), _EMBED_DIM) or not (np.isfinite(lengths) & (lengths > 0)).all():
        raise ModelError(f'{file} gives embeddings of shape {found.shape} or length 0, expected '
                         f'{(len(texts), _EMBED_DIM)}: it is not the text tower of this detector')
    return np.asarray(found / lengths, dtype=np.float32)
