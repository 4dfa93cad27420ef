# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""YOLO through ultralytics, without its network requests, installations and files in the home.

This is the only module that imports ultralytics (AGPL-3.0). It sets environment variables before
the import, so nothing else may import ultralytics first.
"""

import atexit
import difflib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.models.devices import check_precision, resolve_device, resolve_precision
from cliploc_ros.models.download import download, first_line
from cliploc_ros.models.files import check_weights_file, resolve_cache_dir
from cliploc_ros.models.images import check_image_rgb

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class YoloOptions:
    """Which YOLO to load, and how to run it. The names are ultralytics' own.

    Parameters
    ----------
    model : str
        Path of a ``.pt`` file, or the name of a published one, which is then downloaded once.
    conf : float
        Least confidence of a detection, 0 to 1.
    iou : float
        IoU from which the weaker of two boxes of a class is dropped, 0 to 1.
    imgsz : int
        The network sees the image with its longer side scaled to this [px].
    max_det : int
        Greatest number of detections in an image; the most confident are kept.
    device : str
        'auto' (a GPU if there is one), 'cpu', 'cuda' or 'cuda:N'.
    precision : str
        'auto' (fp16 on a GPU, fp32 on a CPU), 'fp16' or 'fp32'.
    cache_dir : str
        Folder for downloads; '' is the user's cache.

    Raises
    ------
    OptionsError
        For values out of range.
    """

    model: str = 'yolov8x.pt'
    conf: float = 0.1
    iou: float = 0.7
    imgsz: int = 640
    max_det: int = 300
    device: str = 'auto'
    precision: str = 'auto'
    cache_dir: str = ''

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_precision(self.precision)
        for name in ('conf', 'iou'):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise OptionsError(f'{name} must be 0 to 1, not {getattr(self, name)}')
        for name in ('imgsz', 'max_det'):
            if getattr(self, name) < 1:
                raise OptionsError(f'{name} must be at least 1, not {getattr(self, name)}')


class YoloDetector:
    """An `ObjectDetector`: a detection model of ultralytics.

    Ultralytics' checkpoints are pickles, which can run code. This class reads them in ultralytics'
    restricted mode (``weights_only=True`` and a list of known classes), which refuses code. An
    ultralytics without this mode, or a PyTorch before 2.6, falls back to plain pickles: then only
    a file that the options name by its path is loaded, with a warning to load trusted files only.

    Parameters
    ----------
    options : YoloOptions
        Which YOLO, and how to run it.

    Raises
    ------
    ModelError
        When the weights are missing or damaged, or are no detection model.
    OptionsError
        When the device is missing.
    """

    def __init__(self, options: YoloOptions) -> None:
        import torch

        device = resolve_device(options.device)
        file = _resolve_file(options)
        threads = torch.get_num_threads()
        self._model = _load(file)
        self._stride = int(self._model.model.stride.max())
        self._device = device
        self.configure(options)
        # The first pass sets up the predictor: do it before the first image.
        self.detect(np.zeros((self._stride, self._stride, 3), dtype=np.uint8))
        # Ultralytics leaves one core free on a CPU, for the whole process.
        torch.set_num_threads(threads)

    def configure(self, options: YoloOptions) -> None:
        """Change the options, except for model and device."""
        self._settings = {
            'conf': options.conf, 'iou': options.iou, 'max_det': options.max_det,
            'imgsz': -(-options.imgsz // self._stride) * self._stride,
            'device': str(self._device), 'verbose': False}
        if resolve_precision(options.precision, self._device) == 'fp16':
            self._settings |= _half_precision()

    @property
    def device(self) -> str:
        """Return where the network runs."""
        return str(self._device)

    @property
    def class_names(self) -> tuple[str, ...]:
        """Return the names of all classes that the model knows."""
        return tuple(self._model.names.values())

    def detect(self, image_rgb: NDArray[np.uint8]) -> Detections:
        """Return the objects in an image (h, w, 3) uint8, the most confident first.

        Raises
        ------
        ImageError
            For an image of another shape or type, or without pixels.
        """
        check_image_rgb(image_rgb)
        image_bgr = np.ascontiguousarray(image_rgb[..., ::-1])
        boxes = self._model.predict(image_bgr, **self._settings)[0].boxes.cpu().numpy()
        return Detections(
            bboxes_xyxy=boxes.xyxy.astype(np.float64).reshape(-1, 4),
            class_ids=tuple(self._model.names[int(index)] for index in boxes.cls),
            scores=boxes.conf.astype(np.float64))


@cache
def import_ultralytics() -> Any:
    """Import ultralytics without network requests, installations and files in the home."""
    import torch  # first: it reads OMP_NUM_THREADS, which ultralytics sets to 1

    if 'ultralytics' in sys.modules:
        logger.warning('ultralytics was imported before the detector: it may use the network')
    folder = tempfile.mkdtemp(prefix='cliploc_ros_ultralytics_')
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    threads = os.environ.get('OMP_NUM_THREADS')
    os.environ.update(
        YOLO_OFFLINE='true',  # no look-ups of DNS servers, no analytics
        YOLO_AUTOINSTALL='false',  # no pip
        YOLO_CONFIG_DIR=folder,  # its settings.json, else in ~/.config
        YOLO_VERBOSE='false',
        ULTRALYTICS_SAFE_LOAD='true')
    import ultralytics

    if threads is None:
        os.environ.pop('OMP_NUM_THREADS', None)
    ultralytics.settings.update({'sync': False})
    # It logs to the standard output instead of the loggers of the process.
    ultralytics_logger = logging.getLogger('ultralytics')
    ultralytics_logger.handlers.clear()
    ultralytics_logger.propagate = True
    ultralytics_logger.setLevel(logging.WARNING)
    if not _is_restricted(ultralytics):
        logger.warning('ultralytics %s with torch %s runs code in files of weights: load trusted '
                       'files only', ultralytics.__version__, torch.__version__)
    return ultralytics


def _is_restricted(ultralytics: Any) -> bool:
    """Return whether ultralytics reads weights only and refuses code in their files."""
    import torch

    return (getattr(ultralytics.utils, 'SAFE_LOAD', False)
            and hasattr(torch.serialization, 'get_unsafe_globals_in_checkpoint'))


def _resolve_file(options: YoloOptions) -> Path:
    """Return the file of weights that the options name; download it if necessary."""
    file = Path(options.model).expanduser().absolute()
    if file.exists() or Path(options.model).name != options.model:
        check_weights_file(file)
        return file
    name = options.model if options.model.endswith('.pt') else f'{options.model}.pt'
    folder = resolve_cache_dir(options.cache_dir) / 'weights'
    if not _is_restricted(import_ultralytics()):
        raise ModelError(f'this ultralytics or PyTorch would run code that {name} may hold: '
                         'update them, or set the model to the path of a file that you trust')
    if (folder / name).exists():
        check_weights_file(folder / name)
        return folder / name
    from ultralytics.utils.downloads import GITHUB_ASSETS_NAMES, attempt_download_asset

    if name not in GITHUB_ASSETS_NAMES:
        raise ModelError(f"'{options.model}' is neither a file here nor a published YOLO model"
                         f'{_nearest(name, GITHUB_ASSETS_NAMES)}')

    def fetch() -> Path:
        # Ultralytics' early versions write to the final path: only a whole file is moved there.
        with tempfile.TemporaryDirectory(dir=folder) as desk:
            whole = attempt_download_asset(Path(desk) / name, progress=False)
            return Path(whole).replace(folder / name)

    return download(name, folder, (
        f'Without a network: download {name} from https://github.com/ultralytics/assets/releases '
        'on another machine and set the model to the path of the file'), fetch)


def _nearest(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, known, n=4, cutoff=0.5)
    return f': did you mean {", ".join(near)}?' if near else ''


def _half_precision() -> dict[str, Any]:
    from ultralytics.utils import DEFAULT_CFG_DICT

    # The name changed within 8.4, and the old one warns with every image.
    return {'quantize': 16} if 'quantize' in DEFAULT_CFG_DICT else {'half': True}


def _load(file: Path) -> Any:
    """Return ultralytics' model of a file of weights."""
    ultralytics = import_ultralytics()
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_yolo_') as desk:
        # Ultralytics rewrites some paths (quotes, yolov5) and requires the suffix.
        neutral = Path(desk) / 'weights.pt'
        neutral.symlink_to(file.resolve())
        try:
            model = ultralytics.YOLO(neutral)
        except Exception as error:  # ultralytics has no exceptions of its own
            reason = first_line(error).removeprefix('ERROR').strip()
            raise ModelError(f'{file} is no detection model of YOLO: '
                             f'{reason.replace(str(neutral), "it")}') from error
    if model.task != 'detect':
        raise ModelError(f"{file} is a YOLO model for the task '{model.task}': one for 'detect' "
                         'is needed')
    return model
