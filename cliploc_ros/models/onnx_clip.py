# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The CLIP named by the options: a folder with its two towers as ONNX files.

Beside them are the tokenizer and the preparation of crops.

The meaning of inputs and outputs is read from the files and the configurations next to them.
"""

import contextlib
import html
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cliploc_ros.errors import ModelError, first_line
from cliploc_ros.files.storage import parse_json, read_file
from cliploc_ros.models import exports, files
from cliploc_ros.models.onnx_network import ANY, OnnxNetwork, colours, numbers, one_of, read_config
from cliploc_ros.models.protocols import ClipOptions

# Pillow's numbers of filters by open_clip's names, the default first.
_FILTERS = {'bicubic': 3, 'random': 3, 'bilinear': 2}
# Defaults of CLIP's configuration.
_DEFAULTS = {'max_position_embeddings': 77, 'vocab_size': 49_408}
# Greatest side of an input; the largest published towers take 1024 px.
_MOST_PX = 2048
# Least size of a tokenizer's vocabulary, as a share of the text tower's.
_LEAST_SHARE = 0.9
_EMBEDDINGS = ('image_embeds', 'text_embeds', 'embedding')
# Crops with a greater ratio of sides are cut first: CLIP sees only the central square.
_MAX_ASPECT = 16


@dataclass(frozen=True)
class ClipWeights:
    """The weights of a CLIP in ONNX files."""

    model: str  #: For messages: the architecture, or the name of the folder
    folder: Path
    image_tower: Path
    text_tower: Path
    embed_dim: int  #: Length of an embedding
    key: str  #: Identifies model and weights, in maps
    text_key: str  #: Identifies each byte of the text tower, for the cache of label embeddings


def resolve_clip_weights(options: ClipOptions) -> ClipWeights:
    """Find the weights named by the options; download and export them if necessary.

    After the weights have been exported, neither PyTorch nor the file of a tag is needed.
    ModelError: the model or tag is unknown (the message lists similar names), a file is missing or
    damaged, or the download or export failed.
    """
    named = options.checkpoint_path or options.pretrained
    if names_onnx(options):
        name, folder = named, files.resolve_folder(
            named, [exports.IMAGE_TOWERS, exports.TEXT_TOWERS], exports.BESIDE,
            options.cache_dir, 'clip_pretrained')
    else:
        given, config = Path(named).expanduser().absolute(), ''
        name = options.model.replace('/', '-')  # OpenAI's spelling is ViT-L/14
        if name.endswith('.json') and (file := Path(options.model).expanduser()).is_file():
            name, config = file.stem, files.digest_file(file)
        tag = options.pretrained if options.checkpoint_path or not given.is_file() else ''

        from cliploc_ros.models.export import export_clip
        folder = exports.exported(options.cache_dir, name, f'CLIP {name}', (
            'CLIP', name, config, tag,
            files.digest_file(given, options.cache_dir) if given.is_file() else ''),
            partial(export_clip, options), exports.WITHOUT_CLIP)
    image_tower = files.find_network(folder, named, exports.IMAGE_TOWERS)
    text_tower = files.find_network(folder, '', exports.TEXT_TOWERS)
    about = read_config(folder / exports.CONFIG, 'it has the length of an embedding')
    vision = about.get('vision_config')
    embed_dim = (about.get('projection_dim') or about.get('embed_dim')
                 or (vision.get('hidden_size') if isinstance(vision, dict) else None))
    if type(embed_dim) is not int or not 0 < embed_dim < 2**16:  # a boolean is an int, too
        raise ModelError(f"{folder / exports.CONFIG} has the length of an embedding neither in "
                         "'projection_dim' nor in 'embed_dim': add it")
    key = exports.export_key(folder, options.cache_dir) or (
        f'onnx:{files.fingerprint_file(image_tower)}:{files.fingerprint_file(text_tower)}')
    return ClipWeights(name, folder, image_tower, text_tower, embed_dim, key,
                       f'{key}:{files.digest_network(text_tower, options.cache_dir)}')


def names_onnx(options: ClipOptions) -> bool:
    """Return whether the options name ONNX files: a folder, or OWNER/NAME of the hub.

    A folder with the name of a tag, such as 'openai', is only used if it contains the files.
    """
    named = options.checkpoint_path or options.pretrained
    folder = Path(named).expanduser()
    return bool(named) and (files.is_hub_name(named) or (folder.is_dir() and (
        os.sep in named or any((folder / file).exists() for file in exports.IMAGE_TOWERS))))


class OnnxTower:
    """An image tower in OpenVINO on a CPU, for batches of any size.

    ModelError: the files do not hold an image tower of these weights.
    """

    def __init__(self, weights: ClipWeights, cache_dir: str) -> None:
        network = OnnxNetwork(weights.image_tower, cache_dir, None)
        self._network, self._input = network, network.image_input()
        self.prepare = CropPreparation(weights.folder, self._input.shape[2:])
        probe = self.prepare(np.zeros((32, 32, 3), dtype=np.uint8))[None]
        self._output = _embedding(network, self._run(probe), weights)

    def __call__(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the features (n, d) of prepared crops (n, 3, s, s)."""
        at_once = len(batch) if self._input.shape[0] == ANY else 1
        return np.concatenate([self._run(batch[start:start + at_once])[self._output]
                               for start in range(0, len(batch), at_once)])

    def _run(self, batch: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        return self._network(**{self._input.name: batch.astype(self._input.type, copy=False)})


class CropPreparation:
    """Scales crops to the input of a tower, as in open_clip.

    The configuration is that of transformers or open_clip's ``PreprocessCfg``: size, mean, std,
    interpolation, resize_mode ('shortest', 'longest' or 'squash') and fill_color. ``fixed`` has
    height and width of the network's input, ANY where they vary. ModelError: the configuration is
    missing, incomplete, or from another network.
    """

    def __init__(self, folder: Path, fixed: Sequence[int]) -> None:
        is_open_clip = (folder / exports.PREPROCESS).exists()
        file = folder / (exports.PREPROCESS if is_open_clip else exports.PREPROCESSOR)
        about = read_config(file, 'it defines the preparation of images')
        size = about.get('size')
        if is_open_clip:
            about |= {'image_mean': about.get('mean'), 'image_std': about.get('std')}
            self._mode = one_of(about, file, 'resize_mode', ('shortest', 'longest', 'squash'))
            number = _FILTERS[one_of(about, file, 'interpolation', tuple(_FILTERS))]
        else:
            crops = isinstance(size, dict) and 'shortest_edge' in size
            crops = one_of(about, file, 'do_center_crop', (crops, not crops))
            size, self._mode = (about.get('crop_size'), 'shortest') if crops else (size, 'squash')
            number = one_of(about, file, 'resample', (3, 0, 1, 2, 4, 5))
        if isinstance(size, dict):
            size = size.get('shortest_edge', [size.get('height'), size.get('width')])
        height, width = map(int, numbers({'size': size}, file, 'size', 2, 1, _MOST_PX))
        scale, mean, std = (found[:, None, None] for found in colours(about, file))
        self._range, self._mean, self._std = map(np.float32, (1 / scale, mean, std))
        if any(want not in (ANY, has) for want, has in zip(fixed, (height, width), strict=True)):
            raise ModelError(f'{file} has an image size of {height} x {width}, but the network '
                             f'takes {fixed[0]} x {fixed[1]}: they are not from the same CLIP')
        self._height, self._width, self._filter = height, width, Image.Resampling(number)
        self._fill = int(numbers({'fill_color': 0} | about, file, 'fill_color', 1, 0, 255)[0])

    def __call__(self, crop_rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Convert a crop (h, w, 3) to the input (3, H, W) of the tower.

        A very long crop is first cut to its middle: the short side is scaled to the tower's input
        before the central square is cut out, and a crop of 1 x 2000 pixels would become an image
        of 224 x 448,000.
        """
        if self._mode == 'shortest':
            height, width = crop_rgb.shape[:2]
            longest = _MAX_ASPECT * min(height, width)
            cut_x, cut_y = max(width - longest, 0) // 2, max(height - longest, 0) // 2
            crop_rgb = crop_rgb[cut_y:height - cut_y, cut_x:width - cut_x]
        image = Image.fromarray(np.ascontiguousarray(crop_rgb))
        image = image.resize(self._scaled(*image.size), self._filter)
        left, top = (round((has - wants) / 2.0) for has, wants in
                     zip(image.size, (self._width, self._height), strict=True))
        if left < 0 or top < 0:
            frame = Image.new('RGB', (self._width, self._height), (self._fill,) * 3)
            frame.paste(image, (max(self._width - image.width, 0) // 2,
                                max(self._height - image.height, 0) // 2))
            image, left, top = frame, 0, 0
        image = image.crop((left, top, left + self._width, top + self._height))
        pixels = np.asarray(image, dtype=np.float32).transpose(2, 0, 1) / self._range
        return np.asarray((pixels - self._mean) / self._std)

    def _scaled(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height that a crop is scaled to."""
        if self._mode == 'squash':
            return self._width, self._height
        ratios = height / self._height, width / self._width
        if self._mode == 'shortest' and self._height == self._width:
            short, side = min(width, height), self._height
            return ((side, int(side * height / short)) if width <= height
                    else (int(side * width / short), side))
        ratio = max(ratios) if self._mode == 'longest' else min(ratios)
        return round(width / ratio), round(height / ratio)


class OnnxTextTower:
    """A text tower with its tokenizer, in OpenVINO on a CPU.

    ModelError: the files do not hold a text tower of these weights.
    """

    def __init__(self, weights: ClipWeights, cache_dir: str) -> None:
        network = OnnxNetwork(weights.text_tower, cache_dir)
        self._network, self._weights = network, weights
        masks = [port for port in network.inputs if 'mask' in port.name]
        texts = [port for port in network.inputs if 'mask' not in port.name]
        if len(texts) != 1 or len(masks) > 1 or any(
                len(port.shape) != 2 or port.type not in (np.int32, np.int64)
                or port.shape[1] in (0, 1, 2) for port in network.inputs):
            raise ModelError(f'{network.file} takes no tokens: its inputs are '
                             f'{network.described_inputs()}, expected (texts, tokens)')
        self._text, self._masks = texts[0], masks
        #: Greatest number of tokens of a label
        self.context = self._text.shape[1] if self._text.shape[1] != ANY else _of_text(
            weights.folder, 'max_position_embeddings', 'context_length')
        self._tokenizer, self._padding = _read_tokenizer(weights.folder)

    def count(self, label: str) -> int:
        """Return the number of tokens of a label, including start and end."""
        self._tokenizer.no_truncation()
        return len(self._tokenizer.encode(clean(label)).ids)

    def tokens(self, labels: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the tokens (L, context) of labels, and a mask that is 0 for padding."""
        self._tokenizer.enable_truncation(self.context)
        found = np.full((len(labels), self.context), self._padding, dtype=np.int64)
        mask = np.zeros_like(found)
        for row, encoded in enumerate(self._tokenizer.encode_batch([*map(clean, labels)])):
            found[row, :len(encoded.ids)], mask[row, :len(encoded.ids)] = encoded.ids, 1
        return found, mask

    def __call__(self, labels: Sequence[str], batch: int) -> NDArray[np.float32]:
        """Return the features (L, d) of labels, encoded in batches."""
        at_once = batch if self._text.shape[0] == ANY else 1
        tokens, mask = self.tokens(labels)
        found = []
        for start in range(0, len(tokens), at_once):
            rows = slice(start, start + at_once)
            outputs = self._network(
                **{self._text.name: tokens[rows].astype(self._text.type)},
                **{port.name: mask[rows].astype(port.type) for port in self._masks})
            found.append(outputs[_embedding(self._network, outputs, self._weights)])
        return np.concatenate(found)


def clean(label: str) -> str:
    """Clean a label as in CLIP's training: repair HTML entities, full-width letters and others."""
    import ftfy

    return ' '.join(html.unescape(html.unescape(ftfy.fix_text(label))).split())


def _embedding(network: OnnxNetwork, outputs: dict[str, NDArray[np.float32]],
               weights: ClipWeights) -> str:
    """Return the name of the output with embeddings (n, d)."""
    flat = [name for name, output in outputs.items() if output.ndim == 2]
    names = [name for name in flat if name in _EMBEDDINGS] or flat
    if len(names) != 1 or outputs[names[0]].shape[1] != weights.embed_dim:
        shapes = {name: output.shape for name, output in outputs.items()}
        raise ModelError(f'{network.file} has the outputs {shapes}, expected one output (n, '
                         f'{weights.embed_dim}) by {exports.CONFIG}: export a tower with its '
                         'projection')
    return names[0]


def _of_text(folder: Path, *names: str) -> int:
    """Read a size of the text tower, by its names in transformers and open_clip.

    ModelError: the configuration does not have it.
    """
    config = read_config(folder / exports.CONFIG, 'it has the sizes of the text tower')
    text: dict[str, Any] = next((config[name] for name in ('text_config', 'text_cfg')
                                 if isinstance(config.get(name), dict)), {})
    size = next((text[name] for name in names if name in text), None)
    if size is None and (config.get('model_type') == 'clip' or 'text_cfg' in config):
        size = _DEFAULTS[names[0]]  # values equal to the default are omitted
    if not isinstance(size, int) or not 2 < size < 2**24:
        raise ModelError(f"{folder / exports.CONFIG} lacks '{names[0]}' of the text tower: add it")
    return size


def _read_tokenizer(folder: Path) -> tuple[Any, int]:
    """Read the tokenizer of a folder, and the token used for padding."""
    try:
        import ftfy  # noqa: F401
        import tokenizers
    except ModuleNotFoundError as error:
        raise ModelError(f"{error.name} is not installed, but labels need it: pip install "
                         f"{error.name}, or the extra 'runtime'") from error
    found = [file for file in (folder / exports.TOKENIZER, folder / 'textual' / exports.TOKENIZER)
             if file.exists()]
    if not found:
        raise ModelError(f'{folder / exports.TOKENIZER} is missing; it splits labels into tokens: '
                         'put the file of the published network there')
    try:
        text = read_file(found[0]).decode()
        about = parse_json(text)
        # on a prefix that its merges lack, the library ends the process
        if 'merges' in about['model'] and about['model'].get('continuing_subword_prefix'):
            raise ValueError('its words are continued with a prefix')
        tokenizer = tokenizers.Tokenizer.from_str(text)
        if len(tokenizer.encode('a cup').ids) < 3:
            raise ValueError('it does not mark the end of a text')
        known, size = _of_text(folder, 'vocab_size'), tokenizer.get_vocab_size()
        if not _LEAST_SHARE * known <= size <= known:
            raise ValueError(f'it has {size} tokens, but the text tower has {known}')
    except Exception as error:  # the library has no exception classes
        raise ModelError(f'{found[0]} is not a tokenizer of a CLIP: {first_line(error)}'
                         ) from error
    padding = 0
    with contextlib.suppress(ValueError, LookupError, TypeError):
        padding = int(about['padding']['pad_id'])
    tokenizer.no_padding()
    return tokenizer, padding
