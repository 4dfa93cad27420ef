# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Export a CLIP of open_clip to ONNX, and helpers for all exports. Needs PyTorch."""

import contextlib
import gzip
import json
import logging
import os
import pickle
import warnings
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import ModelError, did_you_mean, first_line
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models import exports
from cliploc_ros.models.files import check_weights_file, download, fingerprint_file
from cliploc_ros.models.onnx_network import CompiledNetwork, import_openvino, read_config
from cliploc_ros.models.protocols import ClipOptions

if TYPE_CHECKING:
    import torch

#: The newest version that OpenVINO and the exporters support.
OPSET = 17
# Greatest error of an output, relative to its norm; measured: 1e-5.
_TOLERANCE = 1e-3
# Smaller tensors stay in fp32.
_LEAST_HALVED = 1024
_TEXTS = ['a photo of a red mug', "the dog's 2 bowls!", '']
_CONFIG_PARTS = ('embed_dim', 'vision_cfg', 'text_cfg')
_WEIGHT_SUFFIXES = ('.pt', '.pth', '.bin', '.safetensors')


def export_clip(options: ClipOptions, folder: Path, half: bool = False) -> None:
    """Export both towers of a CLIP of open_clip, with tokenizer and configuration, into a folder.

    With ``half``, weights are stored in half precision, but the towers run in fp32.

    ExportError: the results of a tower differ from those in PyTorch, or the tokenizer is not that
    of CLIP. ModelError: model or tag are unknown, the download failed, or the file does not hold
    the weights of the model.
    """
    os.environ.setdefault('HF_HUB_DISABLE_TELEMETRY', '1')  # read on import
    import open_clip
    import torch

    weights = _find(options)
    model = _load(weights)
    with _quiet_root_logger():
        tokenizer = open_clip.get_tokenizer(weights.model)
    crops = dict(model.visual.preprocess_cfg)
    size: Any = crops['size']
    sides = (size, size) if isinstance(size, int) else tuple(size)
    images = torch.from_numpy(np.random.default_rng(0).standard_normal(
        (3, 3, *sides)).astype(np.float32))
    for towers, name, example in ((exports.IMAGE_TOWERS, 'visual', images),
                                  (exports.TEXT_TOWERS, 'text', tokenizer(_TEXTS))):
        file = folder / towers[-1]
        file.parent.mkdir(parents=True)
        tower = getattr(model, name)
        with quiet_export():
            torch.onnx.export(tower, (example[:2],), file, input_names=[name], dynamo=False,
                              output_names=['embedding'], dynamic_axes={name: {0: 'n'}},
                              opset_version=OPSET)
            expected = tower(example)
        if half:
            halve(file)
        compare(file, example.numpy(), expected, half)
        delattr(model, name)  # frees its memory
        del tower
    (folder / exports.PREPROCESS).write_text(json.dumps(crops))
    (folder / 'textual' / exports.TOKENIZER).write_text(_tokenizer_of(tokenizer))
    config = open_clip.get_model_config(weights.model)
    (folder / exports.CONFIG).write_text(json.dumps({
        'embed_dim': config['embed_dim'], 'text_cfg': {
            'context_length': tokenizer.context_length, 'vocab_size': tokenizer.vocab_size}}))
    activation = 'quick_gelu' if weights.quick_gelu else 'gelu'
    exports.describe_export(
        folder, f'{weights.model}:{activation}:{fingerprint_file(weights.file)}')


# ---- finding and loading the weights ------------------------------------------------------------

class _Weights(NamedTuple):
    """The weights of a CLIP of open_clip."""

    model: str
    file: Path
    quick_gelu: bool  #: Whether they were trained with OpenAI's approximate GELU
    #: ``image_mean``, ``image_std``, ``image_interpolation`` and ``image_resize_mode`` as
    #: ``open_clip.create_model_and_transforms`` takes them; empty for its defaults
    preprocess: dict[str, Any]


def _find(options: ClipOptions) -> _Weights:
    """Find the weights that the options name; download them if necessary."""
    import open_clip

    name = options.pretrained
    # OpenAI's spelling is ViT-L/14.
    model = (_add_config(options.model) if options.model.endswith('.json')
             else options.model.replace('/', '-'))
    config = open_clip.get_model_config(model) if model in open_clip.list_models() else None
    if config is None:
        raise ModelError(f"unknown CLIP model '{options.model}'"
                         f'{did_you_mean(model, open_clip.list_models(), 4, 0.5)} '
                         '(open_clip.list_models() lists all)')
    if {'hf_model_name', 'hf_tokenizer_name'} & config['text_cfg'].keys():
        raise ModelError(f"CLIP model '{options.model}' takes its tokenizer from the transformers "
                         "library, which is not supported: choose one like ViT-L-14 or RN50")
    tag = open_clip.get_pretrained_cfg(model, name)
    file = Path(options.checkpoint_path or name).expanduser().absolute()
    if not tag and (options.checkpoint_path or not file.exists()):
        if os.sep in name or name.endswith(_WEIGHT_SUFFIXES):
            raise ModelError(f'{name} does not exist: check the path of the weights')
        tags = open_clip.list_pretrained_tags_by_model(model)
        raise ModelError(f"unknown weights '{name}' for CLIP model '{model}'"
                         f'{did_you_mean(name, tags, 4, 0.5)} (known: '
                         f"{', '.join(tags) or 'none'})")
    if tag and not options.checkpoint_path:
        own, where = resolve_cache_dir(options.cache_dir) / 'weights', tag.get('hf_hub', '')
        address = f'https://huggingface.co/{where}' if where else tag.get('url')
        file = download(f"the weights '{name}' of CLIP model '{model}'", own, (
            f'Without a network: download {address} on another machine and set '
            f'{exports.CHECKPOINT}'),
            partial(open_clip.download_pretrained, tag, cache_dir=str(own)))
    check_weights_file(file)
    quick_gelu = bool(config.get('quick_gelu') or tag.get('quick_gelu') or _is_torchscript(file))
    return _Weights(model, file, quick_gelu, {
        f'image_{name}': tag[name] for name in ('mean', 'std', 'interpolation', 'resize_mode')
        if name in tag})


def _add_config(name: str) -> str:
    """Register a model config of the user with open_clip; return the model's name."""
    import open_clip

    file = Path(name).expanduser().absolute()
    config = read_config(file, 'it is the model config')
    missing = [part for part in _CONFIG_PARTS if part not in config]
    if missing:
        raise ModelError(f'{file} is not a model config of open_clip: it lacks '
                         f'{", ".join(missing)}')
    if file.stem in open_clip.list_models() and config != open_clip.get_model_config(file.stem):
        raise ModelError(f"open_clip has another model named '{file.stem}': rename {file}")
    open_clip.add_model_config(file)
    return file.stem


def _load(weights: _Weights) -> Any:
    """Load a CLIP of open_clip; no code in a file of weights is run.

    ModelError: the file is damaged, or does not hold the weights of the model.
    """
    import open_clip
    from open_clip.convert import convert_state_dict
    from open_clip.model import convert_to_custom_text_state_dict

    file = weights.file
    with _quiet_root_logger():
        model, _, _ = open_clip.create_model_and_transforms(
            weights.model, load_weights=False, force_quick_gelu=weights.quick_gelu,
            force_custom_text=True, **weights.preprocess)
    try:
        state = _read(file)
    except pickle.UnpicklingError as error:
        # a line of torch's long message names the refused class
        lines = str(error).splitlines() or ['']
        cause = next((line.strip() for line in lines if 'Unsupported' in line), lines[0])
        raise ModelError(f'{file} is not a checkpoint of CLIP: {cause}') from error
    except Exception as error:  # each format and version has different exceptions
        raise ModelError(f'{file} is truncated or corrupt ({first_line(error)}): download it again'
                         ) from error
    try:
        state = convert_to_custom_text_state_dict(convert_state_dict(model, state))
        for tower in ('visual', 'text'):
            getattr(model, tower).load_state_dict({
                name.removeprefix(f'{tower}.'): tensor for name, tensor in state.items()
                if name.startswith(f'{tower}.')})
    except Exception as error:  # an object without tensors, or other tensors
        raise ModelError(f"{file} does not hold the weights of CLIP model '{weights.model}': "
                         f'{" ".join(str(error).split())[:300]}') from error
    return model.requires_grad_(False).eval()


def _read(file: Path) -> Any:
    from open_clip.factory import load_state_dict

    if not _is_torchscript(file):
        return load_state_dict(str(file))
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter('ignore', FutureWarning)  # TorchScript is deprecated
        return torch.jit.load(file, map_location='cpu').state_dict()


def _is_torchscript(file: Path) -> bool:
    """Return whether a file is a TorchScript archive, the format of OpenAI's CLIP."""
    if not zipfile.is_zipfile(file):
        return False
    with zipfile.ZipFile(file) as archive:
        return any(name.endswith('/constants.pkl') for name in archive.namelist())


@contextlib.contextmanager
def _quiet_root_logger() -> Iterator[None]:
    """Suppress open_clip's warnings of random weights, and its handler on the root logger.

    open_clip logs through ``logging.warning``, which adds a handler to a root logger without one.
    """
    root = logging.getLogger()
    handler = logging.NullHandler()

    def is_from_elsewhere(record: logging.LogRecord) -> bool:
        return 'open_clip' not in record.pathname or record.levelno >= logging.ERROR

    root.addHandler(handler)
    root.addFilter(is_from_elsewhere)
    try:
        yield
    finally:
        root.removeFilter(is_from_elsewhere)
        root.removeHandler(handler)


def _tokenizer_of(tokenizer: Any) -> str:
    """Convert CLIP's byte-pair tokenizer (Sennrich et al., 2016) to a tokenizer.json."""
    import open_clip
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors

    start, end = '<start_of_text>', '<end_of_text>'
    lines = gzip.decompress(Path(open_clip.tokenizer.default_bpe()).read_bytes()).decode()
    vocabulary = dict(getattr(tokenizer, 'encoder', {}))
    # The first line describes the table. The 49,408 tokens are 256 bytes within a word, 256 bytes
    # at its end, the merges, and two special tokens.
    merges = [(line.split()[0], line.split()[1])
              for line in lines.split('\n')[1:49_152 - 256 - 2 + 1]]
    found = Tokenizer(models.BPE(vocabulary, merges, end_of_word_suffix='</w>',
                                 continuing_subword_prefix=''))
    found.add_special_tokens([start, end])
    found.normalizer = normalizers.Lowercase()
    found.pre_tokenizer = pre_tokenizers.Sequence([
        pre_tokenizers.Split(Regex(r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"),
                             'removed', invert=True),
        pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)])
    found.post_processor = processors.TemplateProcessing(
        single=f'{start} $0 {end}',
        special_tokens=[(name, vocabulary.get(name, 0)) for name in (start, end)])
    for text, row in zip(_TEXTS, tokenizer(_TEXTS).tolist(), strict=True):
        ids = found.encode(text).ids
        if row != ids + [0] * (len(row) - len(ids)):
            raise exports.ExportError('its tokenizer is not that of CLIP')
    return str(found.to_str())


# ---- helpers for all networks -------------------------------------------------------------------

@contextlib.contextmanager
def quiet_export() -> Iterator[None]:
    """Suppress warnings of constants in a trace; `compare` tests the export instead."""
    import torch

    fast, threads = torch.backends.mha.get_fastpath_enabled(), torch.get_num_threads()
    torch.backends.mha.set_fastpath_enabled(False)  # ONNX has no such operation
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter('ignore')
            yield
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)
        torch.set_num_threads(threads)  # ultralytics sets it to 1 for an export


def halve(file: Path) -> None:
    """Store large tensors of an ONNX file in half precision, and add casts to fp32."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    network = onnx.load(str(file))
    casts = []
    for tensor in network.graph.initializer:
        array = numpy_helper.to_array(tensor)
        if array.dtype != np.float32 or array.size < _LEAST_HALVED:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(array.astype(np.float16), f'{name}_half'))
        casts.append(helper.make_node('Cast', [f'{name}_half'], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *network.graph.node]
    del network.graph.node[:]
    network.graph.node.extend(nodes)
    onnx.save(network, str(file))


def compare(file: Path, probe: NDArray[Any], expected: 'torch.Tensor', half: bool) -> None:
    """Raise an ExportError if OpenVINO's first output for a probe differs from PyTorch's."""
    wanted = expected.numpy()
    try:
        found = CompiledNetwork.of(import_openvino().Core().read_model(file))(probe)[0]
    except Exception as error:  # OpenVINO has no exception classes
        raise exports.ExportError(f'OpenVINO cannot run its export: {error}') from error
    if found.shape != wanted.shape:
        raise exports.ExportError(
            f'its export gives the shape {found.shape}, PyTorch {wanted.shape}')
    rows = len(wanted)
    off = float(np.max(np.linalg.norm((found - wanted).reshape(rows, -1), axis=1)
                       / np.linalg.norm(wanted.reshape(rows, -1), axis=1)))
    if not off <= _TOLERANCE * (10 if half else 1):  # also for NaN
        raise exports.ExportError(f'its export has a relative error of {off:.2g}')
