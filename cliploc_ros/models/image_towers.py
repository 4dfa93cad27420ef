# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP's image tower, run by PyTorch or by OpenVINO."""

import json
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from cliploc_ros.models.clip_towers import load_image_tower, load_preprocess
from cliploc_ros.models.clip_weights import ClipOptions, ClipWeights
from cliploc_ros.models.devices import resolve_inference, resolve_precision
from cliploc_ros.models.openvino_networks import (
    FASTEST,
    FP32,
    Conversion,
    ConversionError,
    Network,
    convert_module,
    load_network,
)

if TYPE_CHECKING:
    import torch
    from PIL.Image import Image

logger = logging.getLogger(__name__)


class TorchTower:
    """An image tower in PyTorch.

    Parameters
    ----------
    precision : str
        'fp16' or 'fp32'.
    """

    inference = 'pytorch'

    def __init__(self, weights: ClipWeights, device: 'torch.device', precision: str) -> None:
        import open_clip

        self._device = device
        self._dtype = open_clip.get_input_dtype(precision)
        self.model, self.preprocess = load_image_tower(weights, device, precision)

    def __call__(self, batch: 'torch.Tensor') -> 'torch.Tensor':
        """Return the features (n, d) of preprocessed crops (n, 3, s, s)."""
        features: torch.Tensor = self.model.encode_image(
            batch.to(self._device, dtype=self._dtype), normalize=False)
        return features


class OpenVinoTower:
    """An image tower in OpenVINO on a CPU, for batches of any size.

    Parameters
    ----------
    preprocess : callable
        Prepares a crop.
    """

    inference = 'openvino'

    def __init__(self, network: Network, preprocess: 'Callable[[Image], torch.Tensor]') -> None:
        self._network = network
        self.preprocess = preprocess

    def __call__(self, batch: 'torch.Tensor') -> 'torch.Tensor':
        """Return the features (n, d) of preprocessed crops (n, 3, s, s)."""
        import torch

        return torch.from_numpy(self._network(batch.numpy()))


def load_tower(weights: ClipWeights, options: ClipOptions, device: 'torch.device'
               ) -> TorchTower | OpenVinoTower:
    """Load the image tower for the inference engine that the options choose.

    With 'auto', PyTorch runs a tower that OpenVINO cannot run as PyTorch does.

    Raises
    ------
    ModelError, OptionsError
        See ClipEncoder.
    """
    precision = resolve_precision(options.precision, device)
    if resolve_inference(options.inference, device, precision) == 'openvino':
        try:
            network = load_network(options.cache_dir, weights.model, _identity(weights),
                                   lambda: _convert(weights, device),
                                   FP32 if options.precision == 'fp32' else FASTEST)
            return OpenVinoTower(network, load_preprocess(weights))
        except ConversionError as error:
            if options.inference == 'openvino':
                raise
            logger.warning('%s; PyTorch runs it (inference: pytorch saves the attempt)', error)
    return TorchTower(weights, device, precision)


def _identity(weights: ClipWeights) -> list[str]:
    """Return what determines an image tower: weights, architecture, and the code that has it."""
    import open_clip
    import timm

    return [weights.key, json.dumps(open_clip.get_model_config(weights.model), sort_keys=True),
            open_clip.__version__, timm.__version__]


def _convert(weights: ClipWeights, device: 'torch.device') -> Conversion:
    import torch

    model, _ = load_image_tower(weights, device, 'fp32')
    size: Any = model.visual.image_size
    shape = (3, size, size) if isinstance(size, int) else (3, *size)
    probe = np.random.default_rng(0).standard_normal((3, *shape)).astype(np.float32)
    with torch.inference_mode():
        expected = model.visual(torch.from_numpy(probe)).numpy()
    network = convert_module(model.visual, torch.zeros(2, *shape), (-1, *shape))
    return Conversion(network, probe, expected, {})
