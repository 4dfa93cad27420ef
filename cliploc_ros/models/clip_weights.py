# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find the CLIP named by the options: a folder with its two towers as ONNX files."""

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from cliploc_ros.errors import ModelError
from cliploc_ros.models.exports import (
    BESIDE,
    CONFIG,
    IMAGE_TOWERS,
    TEXT_TOWERS,
    WITHOUT_CLIP,
    export_key,
    exported,
)
from cliploc_ros.models.files import fingerprint_file
from cliploc_ros.models.hub import find_network, is_hub_name, resolve_folder
from cliploc_ros.models.onnx_network import read_config
from cliploc_ros.models.protocols import ClipOptions


@dataclass(frozen=True)
class ClipWeights:
    """The weights of a CLIP in ONNX files."""

    model: str  #: For messages: the architecture, or the name of the folder
    folder: Path
    image_tower: Path
    text_tower: Path
    embed_dim: int  #: Length of an embedding
    key: str  #: Identifies model and weights


def resolve_clip_weights(options: ClipOptions) -> ClipWeights:
    """Find the weights named by the options; download and export them if necessary.

    After the weights have been exported, neither PyTorch nor the file of a tag is needed.
    ModelError: the model or tag is unknown (the message lists similar names), a file is missing or
    damaged, or the download or export failed.
    """
    named = options.checkpoint_path or options.pretrained
    if names_onnx(options):
        name, folder = named, resolve_folder(named, [IMAGE_TOWERS, TEXT_TOWERS], BESIDE,
                                             options.cache_dir)
    else:
        given, config = Path(named).expanduser().absolute(), ''
        name = options.model.replace('/', '-')  # OpenAI's spelling is ViT-L/14
        if name.endswith('.json') and (file := Path(options.model).expanduser()).is_file():
            name, config = file.stem, fingerprint_file(file)
        tag = options.pretrained if options.checkpoint_path or not given.is_file() else ''

        from cliploc_ros.models.export import export_clip
        folder = exported(options.cache_dir, name, f'CLIP {name}', (
            'CLIP', name, config, tag, fingerprint_file(given) if given.is_file() else ''),
            partial(export_clip, options), WITHOUT_CLIP)
    image_tower = find_network(folder, named, IMAGE_TOWERS)
    text_tower = find_network(folder, '', TEXT_TOWERS)
    about = read_config(folder / CONFIG, 'it has the length of an embedding')
    vision = about.get('vision_config')
    embed_dim = (about.get('projection_dim') or about.get('embed_dim')
                 or (vision.get('hidden_size') if isinstance(vision, dict) else None))
    if type(embed_dim) is not int or not 0 < embed_dim < 2**16:  # a boolean is an int, too
        raise ModelError(f"{folder / CONFIG} has the length of an embedding neither in "
                         "'projection_dim' nor in 'embed_dim': add it")
    key = export_key(folder) or (
        f'onnx:{fingerprint_file(image_tower)}:{fingerprint_file(text_tower)}')
    return ClipWeights(name, folder, image_tower, text_tower, embed_dim, key)


def names_onnx(options: ClipOptions) -> bool:
    """Return whether the options name ONNX files: a folder, or OWNER/NAME of the hub.

    A folder with the name of a tag, such as 'openai', is only used if it contains the files.
    """
    named = options.checkpoint_path or options.pretrained
    folder = Path(named).expanduser()
    return bool(named) and (is_hub_name(named) or (folder.is_dir() and (
        os.sep in named or any((folder / file).exists() for file in IMAGE_TOWERS))))
