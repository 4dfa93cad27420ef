# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cache of networks exported to ONNX: folders that are written once and checked before use."""

import contextlib
import hashlib
import json
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from cliploc_ros.errors import CliplocError, ModelError, first_line
from cliploc_ros.files import storage
from cliploc_ros.models.files import digest_file, fingerprint_file, remove_unused
from cliploc_ros.models.onnx_network import free_memory

# Version of these folders and of the export; a change makes new folders.
_FORMAT = 1
_MOST_EXPORTS = 8
_ABOUT = 'export.json'
#: The file of an exported detector in its folder.
DETECTOR = 'model.onnx'
#: Remedy without CLIP, and the option for a file of weights, of nodes: run_command shows others.
WITHOUT_CLIP = ', or do without CLIP: `matching: class`'
CHECKPOINT = '`clip_checkpoint_path` to the file'
#: The files of a published CLIP, first in the layout of transformers, then in that of open_clip.
IMAGE_TOWERS = ('vision_model.onnx', 'onnx/vision_model.onnx', 'visual/model.onnx')
TEXT_TOWERS = ('text_model.onnx', 'onnx/text_model.onnx', 'textual/model.onnx')
CONFIG, PREPROCESSOR, PREPROCESS, TOKENIZER = (
    'config.json', 'preprocessor_config.json', 'visual/preprocess_cfg.json', 'tokenizer.json')
BESIDE = (CONFIG, PREPROCESSOR, PREPROCESS, TOKENIZER, f'textual/{TOKENIZER}')

logger = logging.getLogger(__name__)


class ExportError(ModelError):
    """A network cannot be exported, or its results differ from those in PyTorch."""


@contextlib.contextmanager
def needs_pytorch(what: str, otherwise: str = '') -> Iterator[None]:
    """Raise a ModelError instead of an import error; ``what`` is the network that needs PyTorch.

    ``otherwise`` is a further remedy, after ONNX networks and PyTorch.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModelError(
            f'{error.name} is not installed, but {what} needs it: name ONNX files instead (a '
            f"published network, or export_network on a machine with the extra 'models'), or "
            f'install that extra (script/setup models){otherwise}, see doc/install.md'
        ) from error


def describe_export(folder: Path, key: str) -> None:
    """Complete a folder: write the SHA-256 of its files, and the key of the weights."""
    files = sorted(file for file in folder.rglob('*') if file.is_file())
    (folder / _ABOUT).write_text(json.dumps({'key': key, 'files': {
        str(file.relative_to(folder)): digest_file(file) for file in files}}))


def export_key(folder: Path, cache_dir: str) -> str:
    """Return the key of the weights in an export; '' for other folders and changed exports.

    A changed export causes a warning. Exports of older versions have fingerprints.
    """
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError,
                             RecursionError, ModelError):
        about: dict[str, Any] = storage.parse_json(storage.read_file(folder / _ABOUT))
        changed = [name for name, digest in about['files'].items()
                   if digest != digest_file(folder / name, cache_dir)
                   and digest != fingerprint_file(folder / name)]
        if not changed:
            return str(about['key'])
        logger.warning('%s differs from its digest in %s: it is damaged or was edited; export the '
                       'network again, or remove %s', folder / changed[0], _ABOUT, _ABOUT)
    return ''


def exported(cache_dir: str, kind: str, name: str, identity: Sequence[str],
             export: Callable[[Path], None], otherwise: str = '') -> Path:
    """Return the folder of an export; export the network if the cache does not have it.

    The name of the folder begins with ``kind`` and contains a hash of all inputs of the export.
    The folder is written under another name and renamed, so that any number of processes can share
    the cache.

    ModelError, ExportError: see run_export, or the folder cannot be written.
    """
    digest = hashlib.sha256(json.dumps([_FORMAT, *identity]).encode()).hexdigest()
    cache = storage.resolve_cache_dir(cache_dir) / 'onnx'
    folder, started = cache / f'{kind}-{digest[:32]}', time.monotonic()
    if export_key(folder, cache_dir):
        with contextlib.suppress(OSError):  # a read-only cache works too
            os.utime(folder)
        return folder
    if folder.exists():
        logger.warning('%s is damaged: exporting %s again', folder, name)
    logger.info('exporting %s to ONNX: once, into %s', name, folder)
    # On a full disk, the libraries raise the same errors as for networks that cannot be exported.
    # To distinguish the two, the export is written to a temporary folder first.
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_export_') as desk:
        written = Path(desk) / folder.name
        run_export(name, export, written, otherwise)
        try:
            cache.mkdir(parents=True, exist_ok=True)
            remove_unused(cache, _MOST_EXPORTS - 1)
            with storage.unfinished(folder, Path.mkdir) as beside:
                whole = Path(shutil.copytree(written, beside / folder.name))
                if folder.exists():  # damaged, or from another process
                    folder.rename(beside / 'old')
                whole.rename(folder)
        except OSError as error:
            reason = error.strerror or 'is the disk full?'  # copytree joins many errors
            raise ModelError(f'the export of {name} cannot be written to {folder}: {reason}; '
                             f'{storage.MAKE_ROOM} (cache_dir)') from error
    free_memory()
    logger.info('exported %s in %.0f s', name, time.monotonic() - started)
    return folder


def run_export(name: str, export: Callable[[Path], None], folder: Path, otherwise: str = ''
               ) -> None:
    """Export a network into a new folder.

    ``export`` gets the folder, and ends with `describe_export`. ``otherwise`` is a remedy for a
    missing PyTorch.

    ExportError: the export failed. ModelError: PyTorch is missing, or from ``export``.
    """
    folder.mkdir()  # readable by other users, unlike a temporary folder
    try:
        with needs_pytorch(f'{name}, which is not an ONNX network,', otherwise):
            export(folder)
    except ExportError as error:
        raise ExportError(f'{name}: {error}') from error
    except CliplocError:
        raise
    except Exception as error:  # tracing and exporting raise exceptions of all kinds
        raise ExportError(f'{name} cannot be exported to ONNX: {first_line(error)}') from error
