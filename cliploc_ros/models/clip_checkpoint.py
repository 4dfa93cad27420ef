# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of CLIP, read tensor by tensor and never by running pickled code."""

import pickle
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_weights import is_torchscript
from cliploc_ros.models.files import check_weights_file, damaged

if TYPE_CHECKING:
    import torch

# So much of a mapped file may be in memory beside the copies made of it.
_MAPPED_BYTES = 128 * 2**20


def read_state_dict(file: Path) -> 'dict[str, torch.Tensor]':
    """Return the tensors of a checkpoint, mapped from the file where its format allows.

    The names are those of open_clip's ``CustomTextCLIP``: 'visual.*' and 'text.*', whatever
    form the checkpoint has. TorchScript archives (OpenAI's own files) and pickles of PyTorch
    before 1.6 cannot be mapped and are read whole.

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
        raise damaged(file, _first_line(error)) from error
    tensors = _unwrap(state)
    if not tensors:
        raise ModelError(f'{file} is no checkpoint of CLIP: {_content(state)}')
    return convert_to_custom_text_state_dict(tensors)


def copy_tensors(
    file: Path,
    state: 'dict[str, torch.Tensor]',
    wanted: 'dict[str, torch.Tensor]',
    device: 'torch.device',
) -> 'dict[str, torch.Tensor]':
    """Copy tensors of a checkpoint into memory.

    The copies outlive the file: a process dies when a file that it has mapped is cut short. They
    are made a few at a time, so that the peak is little above what stays.

    Parameters
    ----------
    file : Path
        The checkpoint.
    state : dict of str to Tensor
        What `read_state_dict` made of it; empty afterwards.
    wanted : dict of str to Tensor
        The names to copy, each with a tensor of the type that the copy shall have.
    device : torch.device
        Where the copies go.
    """
    copies: dict[str, torch.Tensor] = {}
    mapped = _is_mapped(file)
    for group in _groups(wanted, state, _MAPPED_BYTES) if mapped else [list(wanted)]:
        if copies:
            state.clear()  # the last reference: the mapped pages leave the memory
            state.update(read_state_dict(file))
        for name in group:
            copies[name] = state.pop(name).to(device, dtype=wanted[name].dtype, copy=mapped)
    state.clear()
    return copies


def _read(file: Path) -> object:
    import safetensors.torch
    import torch

    if file.suffix == '.safetensors':
        return safetensors.torch.load_file(file)
    if is_torchscript(file):
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', FutureWarning)  # TorchScript is deprecated
            return torch.jit.load(file, map_location='cpu').state_dict()
    return torch.load(file, map_location='cpu', weights_only=True, mmap=_is_mapped(file))


def _is_mapped(file: Path) -> bool:
    with file.open('rb') as opened:
        is_zip = opened.read(2) == b'PK'
    return file.suffix == '.safetensors' or (is_zip and not is_torchscript(file))


def _unwrap(state: object) -> 'dict[str, torch.Tensor]':
    """Return the tensors of a state dict, out of the wrappings that training code puts on."""
    import torch

    if isinstance(state, dict) and isinstance(state.get('state_dict'), dict):
        state = state['state_dict']
    if not isinstance(state, dict):
        return {}
    return {str(name).removeprefix('module.'): tensor for name, tensor in state.items()
            if isinstance(tensor, torch.Tensor)}


def _content(state: object) -> str:
    """Say what was read instead of tensors.

    Once ultralytics has loaded a detector, its classes pass PyTorch's check of pickles for as long
    as the process lives, and a detector is read whole.
    """
    values = state.values() if isinstance(state, dict) else [state]
    types = sorted({f'{type(value).__module__}.{type(value).__qualname__}' for value in values})
    return f'it holds no tensors by name, but {", ".join(types[:8]) or "nothing"}'


def _groups(
    names: Iterable[str], state: 'dict[str, torch.Tensor]', limit: int
) -> Iterator[list[str]]:
    """Split names into groups of at most so many bytes, or of one tensor."""
    group: list[str] = []
    size = 0
    for name, added in [(name, _bytes(state[name])) for name in names]:
        if group and size + added > limit:
            yield group
            group, size = [], 0
        group.append(name)
        size += added
    yield group


def _bytes(tensor: 'torch.Tensor') -> int:
    return tensor.numel() * tensor.element_size()


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _first_cause(error: pickle.UnpicklingError) -> str:
    """Return the line of torch's long message that names what it refused."""
    lines = str(error).splitlines() or ['']
    return next((line.strip() for line in lines if 'Unsupported' in line), lines[0])
