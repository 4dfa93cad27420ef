# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Load and run only the image tower or only the text tower of CLIP, in PyTorch."""

import contextlib
import logging
import pickle
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_weights import ClipWeights, is_torchscript
from cliploc_ros.models.crops import CropPreparation
from cliploc_ros.models.files import check_weights_file, damaged, first_line

if TYPE_CHECKING:
    import torch

# Checkpoints of Apple's MobileCLIP and Google's big_vision, which open_clip converts on loading.
_FOREIGN_PREFIX = 'image_encoder.'
_FOREIGN_SUFFIXES = ('.npz', '.npy')


class TorchTower:
    """An image tower in PyTorch; the precision is 'fp16' or 'fp32'."""

    inference = 'pytorch'

    def __init__(self, weights: ClipWeights, device: str, precision: str) -> None:
        import open_clip

        self._device = device
        self._dtype = open_clip.get_input_dtype(precision)
        self.model, crops = load_one_tower(weights, 'visual', device, precision)
        self.prepare = CropPreparation(crops)

    def __call__(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the features (n, d) of prepared crops (n, 3, s, s); ModelError: out of memory."""
        import torch

        try:
            with torch.inference_mode():
                features = self.model.encode_image(torch.from_numpy(batch).to(
                    self._device, dtype=self._dtype), normalize=False)
                return np.asarray(features.float().cpu().numpy())
        except torch.cuda.OutOfMemoryError as error:
            raise ModelError(f'the GPU does not have enough memory for {len(batch)} crops at '
                             'once: lower max_batch or choose a smaller model') from error


class TorchTextTower:
    """A text tower with its tokenizer in PyTorch, in fp32."""

    def __init__(self, weights: ClipWeights, device: str) -> None:
        import open_clip

        with quiet_root_logger():
            self._tokenizer = open_clip.get_tokenizer(weights.model)
        self.context = int(self._tokenizer.context_length)  #: Greatest number of tokens of a label
        self._device, self._model = device, load_one_tower(weights, 'text', device, 'fp32')[0]

    def count(self, label: str) -> int:
        """Return the number of tokens of a label, including start and end."""
        return len(self._tokenizer.encode(label)) + 2

    def __call__(self, labels: Sequence[str], batch: int) -> NDArray[np.float32]:
        """Return the features (L, d) of labels, encoded in batches."""
        import torch

        tokens = cut_padding(self._model, self._tokenizer(list(labels)))
        with torch.inference_mode():
            return np.concatenate([
                self._model.encode_text(part.to(self._device), normalize=False).cpu().numpy()
                for part in tokens.split(batch)])


# ---- loading a single tower ---------------------------------------------------------------------

def load_one_tower(weights: ClipWeights, tower: str, device: str, precision: str
                   ) -> tuple[Any, dict[str, Any]]:
    """Load a CLIP with one tower, 'visual' or 'text'; also return its preparation of crops.

    ModelError: the file does not hold the weights of the model.
    """
    from open_clip.transformer import TextTransformer

    model = _build_without_memory(weights, precision)
    crops = dict(model.visual.preprocess_cfg)
    state = {} if weights.file.suffix in _FOREIGN_SUFFIXES else read_state_dict(weights.file)
    is_foreign = not state or any(name.startswith(_FOREIGN_PREFIX) for name in state)
    module = getattr(model, tower)
    # tensors that the tower computes at construction, and that checkpoints lack
    unsaved = {name for name, _ in module.named_buffers()} - module.state_dict().keys()
    if isinstance(module, TextTransformer):
        unsaved -= {'attn_mask'}
    if is_foreign or unsaved:
        model = _load_by_open_clip(weights, device, precision)
    else:
        _fill(module, tower, state, weights, device)
    for name, _ in list(model.named_children()):
        if name != tower:
            delattr(model, name)
    return model.requires_grad_(False).eval(), crops


def _build_without_memory(weights: ClipWeights, precision: str) -> Any:
    """Build the model on torch's meta device, which has shapes and types but no memory.

    Random weights, which are overwritten later, take seconds and the memory of both towers.
    """
    import open_clip
    import torch

    with quiet_root_logger(), torch.device('meta'):
        model, _, _ = open_clip.create_model_and_transforms(
            weights.model, load_weights=False, precision=precision, device='meta',
            force_quick_gelu=weights.quick_gelu, force_custom_text=True, **weights.preprocess)
    return model


def _load_by_open_clip(weights: ClipWeights, device: str, precision: str) -> Any:
    """Load the model with open_clip, which is slower and takes twice the memory."""
    import open_clip

    try:
        with quiet_root_logger():
            return open_clip.create_model(
                weights.model, pretrained=str(weights.file), precision=precision, device=device,
                force_quick_gelu=weights.quick_gelu, force_custom_text=True)
    except Exception as error:  # open_clip has no exception classes
        raise ModelError(f'{weights.file} does not hold the weights of CLIP model '
                         f"'{weights.model}': {str(error)[:300]}") from error


def _fill(module: 'torch.nn.Module', tower: str, state: 'dict[str, torch.Tensor]',
          weights: ClipWeights, device: str) -> None:
    """Fill a tower on the meta device with its weights.

    The tower gets copies of the mapped tensors. If the old weights are overwritten, the mapped
    file is truncated for a moment, and a process that reads it then is killed.
    """
    found = {name.removeprefix(f'{tower}.'): tensor for name, tensor in state.items()
             if name.startswith(f'{tower}.')}
    wanted = module.state_dict()
    misfits = [f'{name} has shape {tuple(found[name].shape)} there and {tuple(tensor.shape)} in '
               'the model' for name, tensor in wanted.items()
               if found.get(name, tensor).shape != tensor.shape]
    misfits += [f'{name} is missing' for name in wanted if name not in found]
    misfits += [f'{name} is not part of the model' for name in found if name not in wanted]
    if misfits:
        more = f' (and {len(misfits) - 1} more)' if len(misfits) > 1 else ''
        raise ModelError(f'{weights.file} does not hold the weights of CLIP model '
                         f"'{weights.model}': {tower}.{misfits[0]}{more}")
    module.to_empty(device=device).load_state_dict(found)
    if getattr(module, 'attn_mask', None) is not None:
        module.attn_mask = module.build_causal_mask().to(device)  # type: ignore[operator]


def cut_padding(model: Any, tokens: 'torch.Tensor') -> 'torch.Tensor':
    """Return the tokens (L, context) of texts without the common padding, which is 0.

    A causal tower that takes its features at the end of a text does not depend on the padding
    after it. Twelve tokens instead of 77 take a quarter of the time. The attention mask of the
    text tower is cut too: afterwards, the tower can only encode these texts. The tokens of other
    towers are unchanged.
    """
    text = model.text
    if (getattr(text, 'pool_type', '') != 'argmax' or getattr(text, 'attn_mask', None) is None
            or getattr(text, 'cls_emb', None) is not None):
        return tokens
    longest = int(tokens.any(dim=0).nonzero().max()) + 1
    text.attn_mask = text.attn_mask[:longest, :longest]
    return tokens[:, :longest]


# ---- reading a checkpoint -----------------------------------------------------------------------

def read_state_dict(file: Path) -> 'dict[str, torch.Tensor]':
    """Read the tensors of a checkpoint, mapped from the file if its format allows.

    The names are those of open_clip's ``CustomTextCLIP``, 'visual.*' and 'text.*', for all formats
    of checkpoints. TorchScript archives (the files of OpenAI) and pickles of PyTorch before 1.6
    cannot be mapped, and are read into memory.

    ModelError: the file is missing or damaged, or holds something other than tensors.
    """
    import torch
    from open_clip.model import convert_to_custom_text_state_dict

    check_weights_file(file)
    try:
        state = _read(file)
    except pickle.UnpicklingError as error:
        # a line of torch's long message names the refused class
        lines = str(error).splitlines() or ['']
        cause = next((line.strip() for line in lines if 'Unsupported' in line), lines[0])
        raise ModelError(f'{file} is not a checkpoint of CLIP: {cause}') from error
    except OSError as error:
        raise ModelError(f'{file} cannot be read: {error.strerror}') from error
    except Exception as error:  # each format and version has different exceptions
        raise damaged(file, first_line(error)) from error
    tensors = state
    if isinstance(tensors, dict) and isinstance(tensors.get('state_dict'), dict):
        tensors = tensors['state_dict']  # the wrapper of training code
    tensors = {str(name).removeprefix('module.'): tensor for name, tensor in tensors.items()
               if isinstance(tensor, torch.Tensor)} if isinstance(tensors, dict) else {}
    if not tensors:
        # After ultralytics has loaded a detector, PyTorch's check of pickles accepts the classes
        # of ultralytics until the process ends, so that a detector's file gets here.
        values = state.values() if isinstance(state, dict) else [state]
        types = sorted({f'{type(value).__module__}.{type(value).__qualname__}'
                        for value in values})
        raise ModelError(f'{file} is not a checkpoint of CLIP: it holds no named tensors, but '
                         f'{", ".join(types[:8]) or "nothing"}')
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
    # PyTorch can map the zip archives that it has written since 1.6.
    return torch.load(file, map_location='cpu', weights_only=True, mmap=zipfile.is_zipfile(file))


@contextlib.contextmanager
def quiet_root_logger() -> Iterator[None]:
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
