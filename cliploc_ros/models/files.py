# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of weights: whether they are intact, their fingerprint."""

import hashlib
import struct
import zipfile
from pathlib import Path

from cliploc_ros.errors import ModelError

_BLOCK_BYTES = 64 * 1024
_BLOCK_COUNT = 66
# A zip archive, a bare pickle (PyTorch before 1.6), a NumPy array.
_HEADS = (b'PK', b'\x80', b'\x93NUMPY')


def fingerprint_file(path: Path) -> str:
    """Return a hash that distinguishes files of weights, within milliseconds.

    It is the SHA-256 of the size and of 66 blocks of 64 KiB: head, tail and 64 evenly spaced
    between them. Training changes every tensor and so the blocks. The hash misses an edit of a few
    bytes between the blocks.
    """
    size = path.stat().st_size
    last = max(size - _BLOCK_BYTES, 0)
    offsets = sorted({last * index // (_BLOCK_COUNT - 1) for index in range(_BLOCK_COUNT)})
    digest = hashlib.sha256(str(size).encode())
    with path.open('rb') as file:
        for offset in offsets:
            file.seek(offset)
            digest.update(file.read(_BLOCK_BYTES))
    return digest.hexdigest()


def check_weights_file(path: Path) -> None:
    """Raise a ModelError for a file that is missing, unreadable, cut off or no weights at all.

    This looks at head and end of the file only; the loader checks the content.
    """
    if path.is_dir():
        raise ModelError(f'{path} is a folder: name the file with the weights')
    if not path.exists():
        raise ModelError(f'{path} does not exist: check the path of the weights')
    try:
        size = path.stat().st_size
        with path.open('rb') as file:
            head = file.read(512)
    except OSError as error:
        raise ModelError(f'{path} cannot be read: {error.strerror}') from error
    if not size:
        raise ModelError(f'{path} is empty: download it again')
    if head.startswith(b'version https://git-lfs'):
        raise ModelError(f"{path} is a pointer of git-lfs, not the weights: run 'git lfs pull'")
    if head.lstrip().lower().startswith((b'<!doctype', b'<html')):
        raise ModelError(f'{path} is a web page, not weights: download the file behind it')
    if head.startswith(b'PK') and not zipfile.is_zipfile(path):
        raise damaged(path, 'the end of the archive is missing')
    if path.suffix != '.safetensors' and not head.startswith(_HEADS):
        raise ModelError(f'{path} holds no weights: it is neither a file of PyTorch nor, by its '
                         'name, of safetensors')
    # The format: eight bytes with the length of a JSON header, the header, the tensors.
    if path.suffix == '.safetensors' and (
            len(head) < 8 or struct.unpack('<Q', head[:8])[0] + 8 > size):
        raise damaged(path, 'its header is longer than the file')


def damaged(path: Path, reason: object) -> ModelError:
    """Return the error for weights that are truncated or corrupt."""
    return ModelError(f'{path} is truncated or corrupt ({reason}): download it again')
