# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read checkpoints of CLIP as tensors only, never by running pickled code."""

import pickle
import warnings
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_weights import is_torchscript
from cliploc_ros.models.download import first_line
from cliploc_ros.models.files import check_weights_file, damaged

if TYPE_CHECKING:
    import torch


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
