# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Export a CLIP of open_clip to ONNX, and helpers for all exports. Needs PyTorch."""

import contextlib
import gzip
import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.models.clip_towers import load_one_tower, quiet_root_logger
from cliploc_ros.models.clip_weights import (
    CONFIG,
    IMAGE_TOWERS,
    PREPROCESS,
    TEXT_TOWERS,
    TOKENIZER,
    ClipWeights,
)
from cliploc_ros.models.devices import import_openvino
from cliploc_ros.models.exports import ExportError, describe_export
from cliploc_ros.models.onnx_network import CompiledNetwork

if TYPE_CHECKING:
    import torch

#: The newest version that OpenVINO and the exporters support.
OPSET = 17
# Greatest error of an output, relative to its norm; measured: 1e-5.
_TOLERANCE = 1e-3
# Smaller tensors stay in fp32.
_LEAST_HALVED = 1024
_TEXTS = ['a photo of a red mug', "the dog's 2 bowls!", '']


def export_clip(weights: ClipWeights, folder: Path, half: bool = False) -> None:
    """Export both towers of a CLIP of open_clip, with tokenizer and configuration, into a folder.

    With ``half``, weights are stored in half precision, but the towers run in fp32.

    ExportError: the results of a tower differ from those in PyTorch, or the tokenizer is not that
    of CLIP. ModelError: the file does not hold the weights of the model.
    """
    import open_clip
    import torch

    with quiet_root_logger():
        tokenizer = open_clip.get_tokenizer(weights.model)
    for towers, name, example in ((IMAGE_TOWERS, 'visual', None),
                                  (TEXT_TOWERS, 'text', tokenizer(_TEXTS))):
        model, crops = load_one_tower(weights, name, 'cpu', 'fp32')
        if example is None:
            size: Any = crops['size']
            sides = (size, size) if isinstance(size, int) else tuple(size)
            example = torch.from_numpy(np.random.default_rng(0).standard_normal(
                (3, 3, *sides)).astype(np.float32))
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
        del model, tower
    (folder / PREPROCESS).write_text(json.dumps(crops))
    (folder / 'textual' / TOKENIZER).write_text(_tokenizer_of(tokenizer))
    (folder / CONFIG).write_text(json.dumps({
        'embed_dim': weights.embed_dim, 'text_cfg': {
            'context_length': tokenizer.context_length, 'vocab_size': tokenizer.vocab_size}}))
    describe_export(folder, weights.key)


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
            raise ExportError('its tokenizer is not that of CLIP')
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
        raise ExportError(f'OpenVINO cannot run its export: {error}') from error
    if found.shape != wanted.shape:
        raise ExportError(f'its export gives the shape {found.shape}, PyTorch {wanted.shape}')
    rows = len(wanted)
    off = float(np.max(np.linalg.norm((found - wanted).reshape(rows, -1), axis=1)
                       / np.linalg.norm(wanted.reshape(rows, -1), axis=1)))
    if not off <= _TOLERANCE * (10 if half else 1):  # also for NaN
        raise ExportError(f'its export has a relative error of {off:.2g}')
