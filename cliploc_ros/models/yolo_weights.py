# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights of YOLO: find them, and export them to ONNX with ultralytics (AGPL-3.0).

`import_ultralytics` must be called before any other import of ultralytics: it sets environment
variables that prevent network requests, installations and files in the home directory.

YOLO-World and YOLOE take embeddings of texts from the text tower that they were trained with:
YOLO-World from OpenAI's CLIP ViT-B-32, YOLOE from MobileCLIP. Embeddings are cached.
"""

import atexit
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import ModelError, OptionsError, did_you_mean, first_line
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_encoder import encode_labels, encoded_once
from cliploc_ros.models.export import OPSET, compare, halve, quiet_export
from cliploc_ros.models.exports import CHECKPOINT, DETECTOR, describe_export, needs_pytorch
from cliploc_ros.models.files import check_weights_file, digest_file, download
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions

# Sides of an input must be multiples of the stride.
_LEAST_STRIDE = 32
# Length of an embedding of a text in all networks that take texts, and the towers of YOLOE.
_EMBED_DIM = 512
_TOWERS = {'mobileclip:blt': 'mobileclip_blt.ts', 'mobileclip2:b': 'mobileclip2_b.ts'}


@cache
def import_ultralytics() -> Any:
    """Import ultralytics without network requests, installations and files in the home."""
    import torch  # noqa: F401  before ultralytics, which sets OMP_NUM_THREADS to 1

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
    return ultralytics


def resolve_published(given: str, cache_dir: str, option: str) -> Path:
    """Return a file of weights, by its path or its name in the releases of ultralytics.

    ModelError: the file is missing, damaged or unknown, or the download fails; the message names
    the option.
    """
    file, folder = Path(given).expanduser().absolute(), resolve_cache_dir(cache_dir) / 'weights'
    name = given if file.suffix in ('.pt', '.ts') else f'{given}.pt'
    if not file.exists() and Path(given).name == given:
        file = folder / name
    if file.exists() or file.parent != folder:
        check_weights_file(file)
        return file
    with needs_pytorch(f'{name}, which is not a local file and not in {folder},'):
        import_ultralytics()
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
        f'on another machine and set `{option}` to the path of the file'), fetch)


def load_yolo(file: Path) -> Any:
    """Load the detection model of ultralytics in a ``.pt`` file.

    The file is a pickle, which can run code. This function reads it in the restricted mode of
    ultralytics (``weights_only=True`` and a list of known classes), which refuses code.

    ModelError: the file is damaged or not a detection model, or the installed ultralytics or
    PyTorch (before 2.6) lacks this mode.
    """
    import torch

    ultralytics = import_ultralytics()
    if not (getattr(ultralytics.utils, 'SAFE_LOAD', False)
            and hasattr(torch.serialization, 'get_unsafe_globals_in_checkpoint')):
        raise ModelError(f'ultralytics {ultralytics.__version__} with torch {torch.__version__} '
                         f'would run code in {file}: update them')
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


def export_detector(file: Path, options: DetectorOptions, folder: Path, half: bool = False
                    ) -> None:
    """Export a YOLO of ultralytics into a folder, with the classes of the options' prompts.

    ``half``: see export_clip.

    ExportError: the results differ from those in PyTorch. ModelError: the file is damaged or not a
    detection model. OptionsError: the network does not take texts.
    """
    import torch

    loaded = load_yolo(file)
    if options.prompts:
        set_prompts(loaded, options)
        classes = dict(options.prompts)
        loaded.model.names = {number: classes[name] for number, name in loaded.names.items()}
    model = loaded.model.float().eval()
    model.pt_path = str(folder / 'model.pt')
    with quiet_export():
        loaded.export(format='onnx', dynamic=True, simplify=False, opset=OPSET, verbose=False)
    if half:
        halve(folder / DETECTOR)
    stride = max(int(model.stride.max()), _LEAST_STRIDE)
    probe = np.random.default_rng(0).random((1, 3, 2 * stride, 3 * stride), dtype=np.float32)
    with torch.inference_mode():
        outputs = model(torch.from_numpy(probe))
    expected = outputs[0] if isinstance(outputs, tuple | list) else outputs
    compare(folder / DETECTOR, probe, expected[0] if isinstance(expected, tuple) else expected,
            half)
    describe_export(folder, 'detector')


def set_prompts(model: Any, options: DetectorOptions) -> None:
    """Set the options' prompts in a network of ultralytics.

    Raises
    ------
    OptionsError
        The network does not take texts.
    ModelError
        The text tower is missing or damaged, or belongs to another network.
    """
    import torch

    ultralytics = import_ultralytics()
    network, texts = model.model, [text for text, _ in options.prompts]
    is_yoloe, head = isinstance(model, ultralytics.YOLOE), model.model.model[-1]
    if (not is_yoloe and not isinstance(model, ultralytics.YOLOWorld)) or hasattr(head, 'lrpc'):
        raise OptionsError(f'{options.model} takes no texts: a vocabulary needs a YOLO-World or a '
                           'YOLOE with prompts, such as yolov8s-worldv2.pt')
    key, encode = _tower(getattr(network, 'text_model', 'mobileclip:blt') if is_yoloe else 'clip',
                         options)
    embedded = torch.from_numpy(
        encoded_once(key, texts, _EMBED_DIM, options.cache_dir, encode))[None]
    if is_yoloe:
        with torch.no_grad():
            network.set_classes(texts, head.get_tpe(embedded))
    else:  # as in WorldModel.set_classes, which would load its own text tower
        network.txt_feats, head.nc, network.names = embedded, len(texts), dict(enumerate(texts))


def _tower(name: str, options: DetectorOptions
           ) -> tuple[str, Callable[[Sequence[str]], NDArray[np.float32]]]:
    """Return the key of a text tower, and a function that embeds texts; see set_prompts."""
    if name == 'clip' and not options.text_model.endswith('.ts'):
        try:
            clip = ClipOptions('ViT-B-32', 'openai', checkpoint_path=options.text_model,
                               cache_dir=options.cache_dir)
            weights = resolve_clip_weights(clip)
        except ModelError as error:
            remedy = str(error).replace(CHECKPOINT, '`text_model` to the file')
            raise ModelError(f'text tower of {options.model}: {remedy}') from error
        return weights.text_key, lambda texts: encode_labels(weights, texts, clip)
    if name not in ('clip', *_TOWERS):
        raise ModelError(f"{options.model} needs the text tower '{name}', which is unknown: "
                         f'expected {", ".join(_TOWERS)}')
    file = resolve_published(options.text_model or _TOWERS[name], options.cache_dir, 'text_model')
    return f'torchscript:{digest_file(file)}', lambda texts: _run_torchscript(file, texts)


def _run_torchscript(file: Path, texts: Sequence[str]) -> NDArray[np.float32]:
    """Return the embeddings (n, _EMBED_DIM) of texts, unit rows, by a tower in TorchScript."""
    import open_clip
    import torch

    tokens = open_clip.get_tokenizer('ViT-B-32')(list(texts))
    try:
        with torch.inference_mode():
            found = torch.jit.load(file, map_location='cpu')(tokens).float().numpy()
    except Exception as error:  # PyTorch has no exception classes
        raise ModelError(f'{file} is not a text tower in TorchScript: {first_line(error)}'
                         ) from error
    lengths = np.linalg.norm(found, axis=-1, keepdims=True)
    if found.shape != (len(texts), _EMBED_DIM) or not (np.isfinite(lengths) & (lengths > 0)).all():
        raise ModelError(f'{file} gives embeddings of shape {found.shape} or length 0, expected '
                         f'{(len(texts), _EMBED_DIM)}: it is not the text tower of this detector')
    return np.asarray(found / lengths, dtype=np.float32)
