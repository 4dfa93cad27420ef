# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The towers of CLIP, each alone: the text tower; the image tower in PyTorch or OpenVINO."""

import contextlib
import json
import logging
import pickle
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_weights import ClipOptions, ClipWeights, is_torchscript
from cliploc_ros.models.devices import resolve_inference, resolve_precision
from cliploc_ros.models.files import check_weights_file, damaged, first_line
from cliploc_ros.models.openvino_networks import (
    FASTEST,
    FP32,
    Conversion,
    ConversionError,
    Network,
    convert_module,
    load_network,
)

if TYPE_CHECKING:
    import torch
    from PIL.Image import Image

# Apple's MobileCLIP and Google's big_vision: open_clip converts these into the model it fills.
_FOREIGN_PREFIX = 'image_encoder.'
_FOREIGN_SUFFIXES = ('.npz', '.npy')
logger = logging.getLogger(__name__)


def read_state_dict(file: Path) -> 'dict[str, torch.Tensor]':
    """Return the tensors of a checkpoint, mapped from the file where its format allows.

    The names are those of open_clip's ``CustomTextCLIP``, 'visual.*' and 'text.*', for every
    form of checkpoint. TorchScript archives (OpenAI's own files) and pickles of PyTorch before
    1.6 cannot be mapped and are read whole.

    Raises
    ------
    ModelError
        For a file that is missing, damaged, or holds something other than tensors.
    """
    from open_clip.model import convert_to_custom_text_state_dict

    check_weights_file(file)
    try:
        state = _read(file)
    except pickle.UnpicklingError as error:
        raise ModelError(f'{file} is no checkpoint of CLIP: {_first_cause(error)}') from error
    except OSError as error:
        raise ModelError(f'{file} cannot be read: {error.strerror}') from error
    except Exception as error:  # each format and version has exceptions of its own
        raise damaged(file, first_line(error)) from error
    tensors = _unwrap(state)
    if not tensors:
        raise ModelError(f'{file} is no checkpoint of CLIP: {_content(state)}')
    return convert_to_custom_text_state_dict(tensors)


def _read(file: Path) -> object:
    import safetensors.torch
    import torch

    if file.suffix == '.safetensors':
        return safetensors.torch.load_file(file)
    if is_torchscript(file):
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', FutureWarning)  # TorchScript is deprecated
            return torch.jit.load(file, map_location='cpu').state_dict()
    # PyTorch maps the zip archives that it writes since 1.6.
    return torch.load(file, map_location='cpu', weights_only=True, mmap=zipfile.is_zipfile(file))


def _unwrap(state: object) -> 'dict[str, torch.Tensor]':
    """Return the tensors of a state dict without the wrappers of training code."""
    import torch

    if isinstance(state, dict) and isinstance(state.get('state_dict'), dict):
        state = state['state_dict']
    if not isinstance(state, dict):
        return {}
    return {str(name).removeprefix('module.'): tensor for name, tensor in state.items()
            if isinstance(tensor, torch.Tensor)}


def _content(state: object) -> str:
    """Describe what the file holds instead of tensors.

    Once ultralytics has loaded a detector, PyTorch's check of pickles passes its classes until the
    process ends, and then reads a whole detector.
    """
    values = state.values() if isinstance(state, dict) else [state]
    types = sorted({f'{type(value).__module__}.{type(value).__qualname__}' for value in values})
    return f'it holds no named tensors, but {", ".join(types[:8]) or "nothing"}'


def _first_cause(error: pickle.UnpicklingError) -> str:
    """Return the line of torch's long message that names the refused class."""
    lines = str(error).splitlines() or ['']
    return next((line.strip() for line in lines if 'Unsupported' in line), lines[0])


def load_image_tower(
    weights: ClipWeights, device: 'torch.device', precision: str
) -> 'tuple[Any, Callable[[Image], torch.Tensor]]':
    """Return a CLIP with ``encode_image`` only, and open_clip's preprocessing for it.

    Parameters
    ----------
    weights : ClipWeights
        What to load.
    device : torch.device
        Where it runs.
    precision : str
        'fp16' or 'fp32'.

    Raises
    ------
    ModelError
        When the file does not hold the weights of the model.
    """
    model, preprocess = _load(weights, 'visual', device, precision)
    return model, preprocess


def load_preprocess(weights: ClipWeights) -> 'Callable[[Image], torch.Tensor]':
    """Return open_clip's preprocessing for a model, without the model."""
    return _build_without_memory(weights, 'fp32')[1]  # type: ignore[no-any-return]


def load_text_tower(weights: ClipWeights, device: 'torch.device') -> Any:
    """Return a CLIP with ``encode_text`` only, in fp32; see `load_image_tower`."""
    model, _ = _load(weights, 'text', device, 'fp32')
    return model


def cut_padding(model: Any, tokens: 'torch.Tensor') -> 'tuple[Any, torch.Tensor]':
    """Return a text tower for the longest of its texts, and their tokens without padding.

    In a causal tower that is read at a text's end, nothing depends on the padding after it. Twelve
    tokens instead of 77 take a quarter of the time. Any other tower stays as it is.

    Parameters
    ----------
    model : CLIP
        With a text tower, which is for these texts only afterwards.
    tokens : Tensor (L, context) of int
        The padding is 0.
    """
    text = model.text
    if (getattr(text, 'pool_type', '') != 'argmax' or getattr(text, 'attn_mask', None) is None
            or getattr(text, 'cls_emb', None) is not None):
        return model, tokens
    longest = int(tokens.any(dim=0).nonzero().max()) + 1
    text.attn_mask = text.attn_mask[:longest, :longest]
    return model, tokens[:, :longest]


def _load(
    weights: ClipWeights, tower: str, device: 'torch.device', precision: str
) -> tuple[Any, Any]:
    model, preprocess = _build_without_memory(weights, precision)
    state = {} if weights.file.suffix in _FOREIGN_SUFFIXES else read_state_dict(weights.file)
    module = getattr(model, tower)
    if _is_foreign(state) or _has_unsaved_buffers(module):
        model = _load_by_open_clip(weights, device, precision)
    else:
        _fill(module, tower, state, weights, device)
    for name, _ in list(model.named_children()):
        if name != tower:
            delattr(model, name)
    return model.requires_grad_(False).eval(), preprocess


def _build_without_memory(weights: ClipWeights, precision: str) -> tuple[Any, Any]:
    """Return the model on torch's meta device (shapes and types alone) and its preprocessing.

    Drawing random weights only to overwrite them takes seconds and the memory of both towers.
    """
    import open_clip
    import torch

    with quiet_root_logger(), torch.device('meta'):
        model, _, preprocess = open_clip.create_model_and_transforms(
            weights.model, load_weights=False, precision=precision, device='meta',
            force_quick_gelu=weights.quick_gelu, force_custom_text=True, **weights.preprocess)
    return model, preprocess


def _load_by_open_clip(weights: ClipWeights, device: 'torch.device', precision: str) -> Any:
    """Return the model as open_clip itself loads it: slower, with twice the memory."""
    import open_clip

    try:
        with quiet_root_logger():
            return open_clip.create_model(
                weights.model, pretrained=str(weights.file), precision=precision, device=device,
                force_quick_gelu=weights.quick_gelu, force_custom_text=True)
    except Exception as error:  # open_clip has no exceptions of its own
        raise ModelError(f'{weights.file} does not hold the weights of CLIP model '
                         f"'{weights.model}': {str(error)[:300]}") from error


def _is_foreign(state: 'dict[str, torch.Tensor]') -> bool:
    return not state or any(name.startswith(_FOREIGN_PREFIX) for name in state)


def _has_unsaved_buffers(module: 'torch.nn.Module') -> bool:
    """Return whether a tower computes tensors at construction that no checkpoint holds."""
    from open_clip.transformer import TextTransformer

    unsaved = {name for name, _ in module.named_buffers()} - module.state_dict().keys()
    return bool(unsaved - ({'attn_mask'} if isinstance(module, TextTransformer) else set()))


def _fill(
    module: 'torch.nn.Module',
    tower: str,
    state: 'dict[str, torch.Tensor]',
    weights: ClipWeights,
    device: 'torch.device',
) -> None:
    """Fill a tower on the meta device with all of its weights.

    The tower gets copies, not the mapped tensors: a process dies when a file that it has mapped is
    cut short, as a copy over the old weights does.
    """
    found = {name.removeprefix(f'{tower}.'): tensor for name, tensor in state.items()
             if name.startswith(f'{tower}.')}
    misfits = [f'{tower}.{misfit}' for misfit in _misfits(module.state_dict(), found)]
    if misfits:
        more = f' (and {len(misfits) - 1} more)' if len(misfits) > 1 else ''
        raise ModelError(f'{weights.file} does not hold the weights of CLIP model '
                         f"'{weights.model}': {misfits[0]}{more}")
    module.to_empty(device=device).load_state_dict(found)
    if getattr(module, 'attn_mask', None) is not None:
        module.attn_mask = module.build_causal_mask().to(device)  # type: ignore[operator]


def _misfits(
    wanted: 'dict[str, torch.Tensor]', found: 'dict[str, torch.Tensor]'
) -> list[str]:
    """List how the tensors of a checkpoint differ from those of a tower, in names and shapes."""
    return ([f'{name} has shape {tuple(found[name].shape)} there and {tuple(tensor.shape)} in the '
             'model' for name, tensor in wanted.items()
             if found.get(name, tensor).shape != tensor.shape]
            + [f'{name} is missing' for name in wanted if name not in found]
            + [f'{name} is not part of the model' for name in found if name not in wanted])


@contextlib.contextmanager
def quiet_root_logger() -> Iterator[None]:
    """Suppress open_clip's warnings of random weights and its handler on the root logger.

    It logs through ``logging.warning``, which adds a handler to a root logger without one.
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


if TYPE_CHECKING:
    import torch
    from PIL.Image import Image


class TorchTower:
    """An image tower in PyTorch.

    Parameters
    ----------
    precision : str
        'fp16' or 'fp32'.
    """

    inference = 'pytorch'

    def __init__(self, weights: ClipWeights, device: 'torch.device', precision: str) -> None:
        import open_clip

        self._device = device
        self._dtype = open_clip.get_input_dtype(precision)
        self.model, self.preprocess = load_image_tower(weights, device, precision)

    def __call__(self, batch: 'torch.Tensor') -> 'torch.Tensor':
        """Return the features (n, d) of preprocessed crops (n, 3, s, s)."""
        features: torch.Tensor = self.model.encode_image(
            batch.to(self._device, dtype=self._dtype), normalize=False)
        return features


class OpenVinoTower:
    """An image tower in OpenVINO on a CPU, for batches of any size.

    Parameters
    ----------
    preprocess : callable
        Prepares a crop.
    """

    inference = 'openvino'

    def __init__(self, network: Network, preprocess: 'Callable[[Image], torch.Tensor]') -> None:
        self._network = network
        self.preprocess = preprocess

    def __call__(self, batch: 'torch.Tensor') -> 'torch.Tensor':
        """Return the features (n, d) of preprocessed crops (n, 3, s, s)."""
        import torch

        return torch.from_numpy(self._network(batch.numpy()))


def load_tower(weights: ClipWeights, options: ClipOptions, device: 'torch.device'
               ) -> TorchTower | OpenVinoTower:
    """Load the image tower for the inference engine that the options choose.

    With 'auto', PyTorch runs a tower that OpenVINO cannot run as PyTorch does.

    Raises
    ------
    ModelError, OptionsError
        See ClipEncoder.
    """
    precision = resolve_precision(options.precision, device)
    if resolve_inference(options.inference, device, precision) == 'openvino':
        try:
            network = load_network(options.cache_dir, weights.model, _identity(weights),
                                   lambda: _convert(weights, device),
                                   FP32 if options.precision == 'fp32' else FASTEST)
            return OpenVinoTower(network, load_preprocess(weights))
        except ConversionError as error:
            if options.inference == 'openvino':
                raise
            logger.warning('%s; PyTorch runs it (inference: pytorch saves the attempt)', error)
    return TorchTower(weights, device, precision)


def _identity(weights: ClipWeights) -> list[str]:
    """Return what determines an image tower: weights, architecture, and the code that has it."""
    import open_clip
    import timm

    return [weights.key, json.dumps(open_clip.get_model_config(weights.model), sort_keys=True),
            open_clip.__version__, timm.__version__]


def _convert(weights: ClipWeights, device: 'torch.device') -> Conversion:
    import torch

    model, _ = load_image_tower(weights, device, 'fp32')
    size: Any = model.visual.image_size
    shape = (3, size, size) if isinstance(size, int) else (3, *size)
    probe = np.random.default_rng(0).standard_normal((3, *shape)).astype(np.float32)
    with torch.inference_mode():
        expected = model.visual(torch.from_numpy(probe)).numpy()
    network = convert_module(model.visual, torch.zeros(2, *shape), (-1, *shape))
    return Conversion(network, probe, expected, {})
