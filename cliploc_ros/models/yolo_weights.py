# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights of YOLO, and the import of ultralytics (AGPL-3.0).

`import_ultralytics` must be called before any other import of ultralytics: it sets environment
variables that prevent network requests, installations and files in the home directory.
"""

import atexit
import logging
import os
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from cliploc_ros.errors import ModelError, did_you_mean
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.devices import needs_pytorch
from cliploc_ros.models.files import check_weights_file, download, first_line

_LEAST_STRIDE = 32

logger = logging.getLogger(__name__)


@cache
def import_ultralytics() -> Any:
    """Import ultralytics without network requests, installations and files in the home."""
    import torch  # before ultralytics, which sets OMP_NUM_THREADS to 1

    if 'ultralytics' in sys.modules:
        logger.warning('ultralytics was imported before the detector: it may use the network')
    folder = tempfile.mkdtemp(prefix='cliploc_ros_ultralytics_')
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    threads = os.environ.get('OMP_NUM_THREADS')
    os.environ.update(
        YOLO_OFFLINE='true',  # no look-ups of DNS servers, no analytics
        YOLO_AUTOINSTALL='false',  # no pip
        YOLO_CONFIG_DIR=folder,  # its settings.json, by default in ~/.config
        YOLO_VERBOSE='false',
        ULTRALYTICS_SAFE_LOAD='true')
    import ultralytics

    if threads is None:
        os.environ.pop('OMP_NUM_THREADS', None)
    ultralytics.settings.update({'sync': False})
    # By default, it logs to the standard output instead of the loggers of the process.
    ultralytics_logger = logging.getLogger('ultralytics')
    ultralytics_logger.handlers.clear()
    ultralytics_logger.propagate = True
    ultralytics_logger.setLevel(logging.WARNING)
    if not _is_restricted(ultralytics):
        logger.warning('ultralytics %s with torch %s runs code in files of weights: load only '
                       'trusted files', ultralytics.__version__, torch.__version__)
    return ultralytics


def _is_restricted(ultralytics: Any) -> bool:
    """Return whether ultralytics reads only weights, and refuses code in their files."""
    import torch

    return (getattr(ultralytics.utils, 'SAFE_LOAD', False)
            and hasattr(torch.serialization, 'get_unsafe_globals_in_checkpoint'))


def resolve_published(given: str, cache_dir: str, option: str) -> Path:
    """Return a file of weights, by its path or its name in the releases of ultralytics.

    ModelError: the file is missing, damaged or unknown, or the download fails; the message names
    the option.
    """
    file = Path(given).expanduser().absolute()
    if file.exists() or Path(given).name != given:
        check_weights_file(file)
        return file
    name = given if file.suffix in ('.pt', '.ts') else f'{given}.pt'
    folder = resolve_cache_dir(cache_dir) / 'weights'
    if (folder / name).exists():
        check_weights_file(folder / name)
        return folder / name
    with needs_pytorch(f'{name}, which is not a local file and not in {folder},'):
        _refuse_code(folder / name)
    from ultralytics.utils.downloads import GITHUB_ASSETS_NAMES, attempt_download_asset

    if name not in GITHUB_ASSETS_NAMES:
        raise ModelError(f"'{given}' is neither a local file nor a published YOLO model"
                         f'{did_you_mean(name, GITHUB_ASSETS_NAMES, 4, 0.5)}')

    def fetch() -> Path:
        # Old versions of ultralytics download to the final path; move only complete files there.
        with tempfile.TemporaryDirectory(dir=folder) as desk:
            whole = attempt_download_asset(Path(desk) / name, progress=False)
            return Path(whole).replace(folder / name)

    return download(name, folder, (
        f'Without a network: download {name} from https://github.com/ultralytics/assets/releases '
        f'on another machine and set the {option} to the path of the file'), fetch)


def _refuse_code(file: Path) -> None:
    """Raise a ModelError if a downloaded file could run code."""
    if not _is_restricted(import_ultralytics()):
        raise ModelError(f'this ultralytics or PyTorch would run code in {file.name}: update '
                         'them, or give the path of a file that you trust')


def stride_of(model: Any) -> int:
    """Return the stride of a model: sides of an input must be multiples of it."""
    return max(int(model.stride.max()), _LEAST_STRIDE)


def load_yolo(file: Path, is_download: bool = False) -> Any:
    """Load the detection model of ultralytics in a ``.pt`` file.

    The file is a pickle, which can run code. This function reads it in the restricted mode of
    ultralytics (``weights_only=True`` and a list of known classes), which refuses code. Versions
    of ultralytics without this mode, and PyTorch before 2.6, read plain pickles: in this case,
    only a file that the options name by its path is loaded, with a warning to load only trusted
    files.

    ModelError: the file is damaged or not a detection model.
    """
    ultralytics = import_ultralytics()
    if is_download:
        _refuse_code(file)
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_yolo_') as desk:
        # Ultralytics changes some paths (quotes, yolov5) and requires the suffix.
        neutral = Path(desk) / 'weights.pt'
        neutral.symlink_to(file.resolve())
        try:
            model = ultralytics.YOLO(neutral)
        except Exception as error:  # ultralytics has no exception classes
            reason = first_line(error).removeprefix('ERROR').strip()
            raise ModelError(f'{file} is not a detection model of YOLO: '
                             f'{reason.replace(str(neutral), "it")}') from error
    # YOLOE is published with a head for masks; its boxes are those of a detector.
    if model.task != 'detect' and not isinstance(model, ultralytics.YOLOE):
        raise ModelError(f"{file} is a YOLO model for the task '{model.task}': give a model for "
                         "'detect'")
    return model
