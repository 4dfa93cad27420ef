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
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cliploc_ros.errors import CliplocError, ModelError
from cliploc_ros.files.storage import parse_json, read_file, resolve_cache_dir, warn_not_kept
from cliploc_ros.models.devices import free_memory
from cliploc_ros.models.files import fingerprint_file, first_line, keep_folder
from cliploc_ros.models.protocols import DetectorOptions

# Version of these folders and of the export; a change makes new folders.
_FORMAT = 1
_MOST_EXPORTS = 8
_ABOUT = 'export.json'
#: The file of an exported detector in its folder.
DETECTOR = 'model.onnx'

logger = logging.getLogger(__name__)
# Exports that could not be written to the cache, removed when the process ends.
_unkept: dict[Path, tempfile.TemporaryDirectory[str]] = {}


class ExportError(ModelError):
    """A network cannot be exported, or its results differ from those in PyTorch."""


def detector_identity(file: Path, options: DetectorOptions) -> list[str]:
    """Return the inputs of a detector's export: its weights and its prompts."""
    identity = [fingerprint_file(file)]
    if options.prompts:
        tower = Path(options.text_model).expanduser()
        identity += [fingerprint_file(tower) if tower.is_file() else options.text_model,
                     json.dumps(options.prompts)]
    return identity


def describe_export(folder: Path, key: str) -> None:
    """Complete a folder: write the fingerprints of its files, and the key of the weights."""
    files = sorted(file for file in folder.rglob('*') if file.is_file())
    (folder / _ABOUT).write_text(json.dumps({'key': key, 'files': {
        str(file.relative_to(folder)): fingerprint_file(file) for file in files}}))


def export_key(folder: Path) -> str:
    """Return the key of the weights in an export; '' for other folders and changed exports."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError,
                             RecursionError):
        about: dict[str, Any] = parse_json(read_file(folder / _ABOUT))
        if all(fingerprint_file(folder / name) == fingerprint
               for name, fingerprint in about['files'].items()):
            return str(about['key'])
    return ''


def find_export(cache_dir: str, name: str, identity: Sequence[str]) -> Path | None:
    """Return the folder of an export in the cache; None if it is missing or damaged."""
    folder = _folder(cache_dir, name, identity)
    if folder in _unkept:
        return Path(_unkept[folder].name) / folder.name
    if not folder.exists():
        return None
    if not export_key(folder):
        logger.warning('%s is damaged: exporting %s again', folder, name)
        return None
    with contextlib.suppress(OSError):  # a read-only cache works too
        os.utime(folder)
    return folder


def keep_export(cache_dir: str, name: str, identity: Sequence[str],
                export: Callable[[Path], None]) -> Path:
    """Return the folder of an export; export the network if the cache does not have it.

    The name of the folder contains a hash of all inputs of the export. The folder is written under
    another name and renamed, so that any number of processes can share the cache. ``export`` must
    write into the folder that it is given, and end with `describe_export`.

    ExportError: the export failed. ModelError, ModuleNotFoundError: from ``export``.
    """
    folder, started = _folder(cache_dir, name, identity), time.monotonic()
    if folder in _unkept:
        return Path(_unkept[folder].name) / folder.name
    if export_key(folder):
        return folder
    logger.info('exporting %s to ONNX: once, into %s', name, folder)
    # On a full disk, the libraries raise the same errors as for networks that cannot be exported.
    # To distinguish the two, the export is written to a temporary folder first.
    desk = tempfile.TemporaryDirectory(prefix='cliploc_ros_export_')
    written = Path(desk.name) / folder.name
    run_export(name, export, written)
    try:
        keep_folder(folder, _MOST_EXPORTS, partial(shutil.copytree, written))
    except OSError as error:
        warn_not_kept('the exported network is not cached and the next start is slow again: '
                      f'cannot write {folder} ({first_line(error)}); make room, or choose a '
                      'writable cache_dir')
        _unkept[folder], folder = desk, written
    free_memory()
    logger.info('exported %s in %.0f s', name, time.monotonic() - started)
    return folder


def run_export(name: str, export: Callable[[Path], None], folder: Path) -> None:
    """Export a network into a new folder; errors as in keep_export, with the network's name."""
    folder.mkdir()  # readable by other users, unlike a temporary folder
    try:
        export(folder)
    except ExportError as error:
        raise ExportError(f'{name}: {error}') from error
    except (CliplocError, ModuleNotFoundError):
        raise
    except Exception as error:  # tracing and exporting raise exceptions of all kinds
        raise ExportError(f'{name} cannot be exported to ONNX: {first_line(error)}') from error


def _folder(cache_dir: str, name: str, identity: Sequence[str]) -> Path:
    digest = hashlib.sha256(json.dumps([_FORMAT, *identity]).encode()).hexdigest()
    return resolve_cache_dir(cache_dir) / 'onnx' / f'{Path(name).name}-{digest[:32]}'
