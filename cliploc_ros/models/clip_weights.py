# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find the CLIP named by the options: architecture, file of weights, activation."""

import os
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cliploc_ros.errors import ModelError, OptionsError, did_you_mean
from cliploc_ros.files.storage import parse_json, read_file, resolve_cache_dir
from cliploc_ros.models.devices import (
    check_run,
    needs_pytorch,
    resolve_device,
    resolve_inference,
    resolve_precision,
)
from cliploc_ros.models.exports import export_key, find_export
from cliploc_ros.models.files import check_weights_file, download, fingerprint_file
from cliploc_ros.models.hub import find_network, is_hub_name, resolve_folder
from cliploc_ros.models.onnx_network import read_config

#: Remedy without CLIP, with the options of the nodes and of the programs.
WITHOUT_CLIP = ", or do without CLIP ('matching: class', --no-clip)"
#: The option for a file of weights, as named in messages.
CHECKPOINT = 'clip_checkpoint_path (of programs: --clip-pretrained) to the file'
#: The files of a published CLIP, first in the layout of transformers, then in that of open_clip.
IMAGE_TOWERS = ('vision_model.onnx', 'onnx/vision_model.onnx', 'visual/model.onnx')
TEXT_TOWERS = ('text_model.onnx', 'onnx/text_model.onnx', 'textual/model.onnx')
CONFIG, PREPROCESSOR, PREPROCESS, TOKENIZER = (
    'config.json', 'preprocessor_config.json', 'visual/preprocess_cfg.json', 'tokenizer.json')
BESIDE = (CONFIG, PREPROCESSOR, PREPROCESS, TOKENIZER, f'textual/{TOKENIZER}')
_CONFIG_PARTS = ('embed_dim', 'vision_cfg', 'text_cfg')
_WEIGHT_SUFFIXES = ('.pt', '.pth', '.bin', '.safetensors', '.npz', '.npy')


@dataclass(frozen=True)
class ClipOptions:
    """The CLIP to load, and how to run it.

    OptionsError: a value is out of range.
    """

    #: Architecture: a name of ``open_clip.list_models()``, or the path of an open_clip model
    #: config (.json), which gets the name of the file
    model: str = 'ViT-L-14'
    #: A folder with ONNX files, or OWNER/NAME[@REVISION] of the hub; both need no model. Otherwise
    #: a tag of ``open_clip.list_pretrained()``, or the path of a checkpoint. A tag also determines
    #: activation and colour normalization; a checkpoint has those of the architecture.
    pretrained: str = 'openai'
    #: Local file with the weights of the tag; '': download them
    checkpoint_path: str = ''
    device: str = 'auto'  #: 'auto' (a GPU if there is one), 'cpu', 'cuda' or 'cuda:N'
    #: Precision of the image tower: 'auto' (fp16 on a GPU; on a CPU fp32, or bf16 if OpenVINO runs
    #: it and the CPU supports it), 'fp16' or 'fp32'
    precision: str = 'auto'
    max_batch: int = 64  #: Greatest number of crops in a forward pass; limits the memory
    #: Folder for downloads, label embeddings and compiled networks; '': the user's cache
    cache_dir: str = ''
    #: Inference engine of the image tower: 'auto' (OpenVINO on a CPU if it is installed),
    #: 'pytorch' or 'openvino'
    inference: str = 'auto'

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_run(self.precision, self.inference)
        if self.max_batch < 1:
            raise OptionsError(f'max_batch must be at least 1, not {self.max_batch}')


@dataclass(frozen=True)
class ClipWeights:
    """The weights of a CLIP, in ONNX files or for PyTorch, and their settings."""

    #: Architecture, a name of ``open_clip.list_models()``, or the name of the folder
    model: str
    file: Path  #: The weights, or the folder with ONNX files
    embed_dim: int  #: Length of an embedding
    key: str  #: Identifies model and weights
    is_onnx: bool = False
    #: The following fields are for PyTorch only. Whether the weights were trained with OpenAI's
    #: approximate GELU
    quick_gelu: bool = False
    #: ``image_mean``, ``image_std``, ``image_interpolation`` and ``image_resize_mode`` as
    #: ``open_clip.create_model_and_transforms`` takes them; empty for its defaults
    preprocess: dict[str, Any] = field(default_factory=dict)
    identity: tuple[str, ...] = ()  #: Key of their export in the cache


def resolve_clip_weights(options: ClipOptions) -> ClipWeights:
    """Find the weights named by the options; download them if necessary.

    After the weights have been exported, neither open_clip nor the file of a tag is needed.
    ModelError: the model or tag is unknown (the message lists similar names), a file is missing or
    damaged, or the download failed.
    """
    named = options.checkpoint_path or options.pretrained
    given = Path(named).expanduser().absolute()
    if names_onnx(options):
        return _of_onnx(resolve_folder(named, [IMAGE_TOWERS, TEXT_TOWERS], BESIDE,
                                       options.cache_dir), named)
    identity = _identity_of(options, given)
    if runs_in_openvino(options):
        folder = find_export(options.cache_dir, identity[1], identity)
        if folder is not None:
            return _of_onnx(folder, identity[1])
    with needs_pytorch(f'CLIP {identity[1]}, which is not an ONNX network,', WITHOUT_CLIP):
        return _resolve_by_open_clip(options, identity)


def names_onnx(options: ClipOptions) -> bool:
    """Return whether the options name ONNX files: a folder, or OWNER/NAME of the hub.

    A folder with the name of a tag, such as 'openai', is only used if it contains the files.
    """
    named = options.checkpoint_path or options.pretrained
    folder = Path(named).expanduser()
    return bool(named) and (is_hub_name(named) or (folder.is_dir() and (
        os.sep in named or any((folder / file).exists() for file in IMAGE_TOWERS))))


def runs_in_openvino(options: ClipOptions) -> bool:
    """Return whether OpenVINO runs the towers; OptionsError: see resolve_inference."""
    device = resolve_device(options.device)
    return resolve_inference(options.inference, device,
                             resolve_precision(options.precision, device)) == 'openvino'


def _of_onnx(folder: Path, name: str) -> ClipWeights:
    """Return the weights of a folder with ONNX files; ModelError: a file or field is missing."""
    files = [find_network(folder, name, towers) for towers in (IMAGE_TOWERS, TEXT_TOWERS)]
    config = read_config(folder / CONFIG, 'it has the length of an embedding')
    vision = config.get('vision_config')
    embed_dim = (config.get('projection_dim') or config.get('embed_dim')
                 or (vision.get('hidden_size') if isinstance(vision, dict) else None))
    if type(embed_dim) is not int or not 0 < embed_dim < 2**16:  # a boolean is an int, too
        raise ModelError(f"{folder / CONFIG} has the length of an embedding neither in "
                         "'projection_dim' nor in 'embed_dim': add it")
    key = export_key(folder) or 'onnx:' + ':'.join(map(fingerprint_file, files))
    return ClipWeights(name, folder, embed_dim, key, is_onnx=True)


def _identity_of(options: ClipOptions, given: Path) -> tuple[str, ...]:
    """Return the identity of a CLIP, without importing open_clip: architecture, tag, file."""
    model, config = options.model.replace('/', '-'), ''
    if options.model.endswith('.json') and (file := Path(options.model).expanduser()).is_file():
        model, config = file.stem, fingerprint_file(file)
    tag = options.pretrained if options.checkpoint_path or not given.is_file() else ''
    return ('CLIP', model, config, tag, fingerprint_file(given) if given.is_file() else '')


def _resolve_by_open_clip(options: ClipOptions, identity: tuple[str, ...]) -> ClipWeights:
    import open_clip

    own = options.model.endswith('.json')
    # OpenAI's spelling is ViT-L/14.
    model = _add_config(options.model) if own else options.model.replace('/', '-')
    config = open_clip.get_model_config(model) if model in open_clip.list_models() else None
    if config is None:
        raise ModelError(f"unknown CLIP model '{options.model}'"
                         f'{did_you_mean(model, open_clip.list_models(), 4, 0.5)} '
                         '(open_clip.list_models() lists all)')
    if {'hf_model_name', 'hf_tokenizer_name'} & config['text_cfg'].keys():
        raise ModelError(f"CLIP model '{options.model}' takes its tokenizer from the transformers "
                         "library, which is not supported: choose one like ViT-L-14 or RN50")
    tag = open_clip.get_pretrained_cfg(model, options.pretrained)
    file = Path(options.checkpoint_path or options.pretrained).expanduser().absolute()
    if not tag and (options.checkpoint_path or not file.exists()):
        name = options.pretrained
        if os.sep in name or name.endswith(_WEIGHT_SUFFIXES):
            raise ModelError(f'{name} does not exist: check the path of the weights')
        tags = open_clip.list_pretrained_tags_by_model(model)
        raise ModelError(f"unknown weights '{name}' for CLIP model '{model}'"
                         f'{did_you_mean(name, tags, 4, 0.5)} (known: '
                         f"{', '.join(tags) or 'none'})")
    if tag and not options.checkpoint_path:
        file = _downloaded(model, tag, options)
    check_weights_file(file)
    quick_gelu = bool(config.get('quick_gelu') or tag.get('quick_gelu') or is_torchscript(file))
    return ClipWeights(
        model, file, config['embed_dim'],
        f'{model}:{"quick_gelu" if quick_gelu else "gelu"}:{fingerprint_file(file)}',
        quick_gelu=quick_gelu, identity=identity,
        preprocess={f'image_{name}': tag[name] for name in
                    ('mean', 'std', 'interpolation', 'resize_mode') if name in tag})


def _add_config(name: str) -> str:
    """Register a model config of the user with open_clip; return the model's name."""
    import open_clip

    file = Path(name).expanduser().absolute()
    if not file.exists():
        raise ModelError(f'{file} does not exist: check the path of the model config')
    try:
        config = parse_json(read_file(file))
    except (OSError, ValueError) as error:
        raise ModelError(f'{file}, a model config, cannot be read as JSON: {error}') from None
    missing = ([part for part in _CONFIG_PARTS if part not in config]
               if isinstance(config, dict) else _CONFIG_PARTS)
    if missing:
        raise ModelError(f'{file} is not a model config of open_clip: it lacks '
                         f'{", ".join(missing)}')
    if file.stem in open_clip.list_models() and config != open_clip.get_model_config(file.stem):
        raise ModelError(f"open_clip has another model named '{file.stem}': rename {file}")
    open_clip.add_model_config(file)
    return file.stem


def is_torchscript(file: Path) -> bool:
    """Return whether a file is a TorchScript archive, the format of OpenAI's CLIP."""
    if not zipfile.is_zipfile(file):
        return False
    with zipfile.ZipFile(file) as archive:
        return any(name.endswith('/constants.pkl') for name in archive.namelist())


def _downloaded(model: str, tag: dict[str, Any], options: ClipOptions) -> Path:
    """Return the file of an earlier download, from our cache or the hub's, or download it.

    `hf_hub_download` would first send a request, and a robot without a network would wait at each
    start.
    """
    import huggingface_hub
    from open_clip.constants import HF_SAFE_WEIGHTS_NAME, HF_WEIGHTS_NAME

    what = f"the weights '{options.pretrained}' of CLIP model '{model}'"
    repository, name = os.path.split(tag.get('hf_hub', ''))
    if not repository:
        raise ModelError(f'{what} are not on a model hub: download {tag.get("url", "them")} and '
                         f'set {CHECKPOINT}{WITHOUT_CLIP}')
    newer, older = ((str(Path(name).with_suffix('.safetensors')), name) if name
                    else (HF_SAFE_WEIGHTS_NAME, HF_WEIGHTS_NAME))
    own = resolve_cache_dir(options.cache_dir) / 'weights'
    for folder in (own, None):
        for candidate in (newer, older):
            found = huggingface_hub.try_to_load_from_cache(repository, candidate, folder)
            if isinstance(found, str):
                return Path(found)

    def fetch() -> str:
        # If packets are dropped, this times out after 10 s, hf_hub_download after 6 minutes.
        wanted = newer if huggingface_hub.file_exists(repository, newer) else older
        return str(huggingface_hub.hf_hub_download(repository, wanted, cache_dir=own))

    return download(what, own, (
        f'Without a network: download {newer} or {older} from https://huggingface.co/{repository} '
        f'on another machine and set {CHECKPOINT}{WITHOUT_CLIP}'), fetch)
