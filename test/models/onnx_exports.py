# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detectors as ONNX files: YOLO by ultralytics, a small D-FINE by transformers."""

import shutil
import warnings
from pathlib import Path

import numpy as np
import torch

from cliploc_ros.models.yolo_weights import import_ultralytics

NAMES = ('chair', 'cup', 'dining table')
_SMALL = {'encoder_hidden_dim': 32, 'encoder_ffn_dim': 32, 'd_model': 32, 'num_queries': 12,
          'decoder_ffn_dim': 32, 'decoder_attention_heads': 4, 'encoder_attention_heads': 4,
          'decoder_layers': 2, 'encoder_layers': 1, 'id2label': dict(enumerate(NAMES))}
SIDE = 128


def export_yolo(weights: Path, folder: Path, **settings: object) -> Path:
    """Return the result of ``yolo export format=onnx`` for a file of weights."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(weights, folder / 'yolo.pt')
    model = import_ultralytics().YOLO(folder / 'yolo.pt')
    return Path(model.export(format='onnx', simplify=False, verbose=False, **settings))


class _OnlyResults(torch.nn.Module):
    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixel_values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = self.network(pixel_values)
        return found.logits, found.pred_boxes


def make_d_fine(folder: Path) -> torch.nn.Module:
    """Write a small D-FINE with random weights in the hub's layout; return it in PyTorch."""
    import transformers

    torch.manual_seed(0)
    backbone = transformers.HGNetV2Config(
        stem_channels=[3, 8, 8], hidden_sizes=[16, 24, 32, 40], depths=[1, 1, 1, 1],
        stage_in_channels=[8, 16, 24, 32], stage_mid_channels=[8, 8, 8, 8],
        stage_out_channels=[16, 24, 32, 40], stage_num_blocks=[1, 1, 1, 1],
        stage_numb_of_layers=[1, 1, 1, 1], out_features=['stage2', 'stage3', 'stage4'])
    network = transformers.DFineForObjectDetection(transformers.DFineConfig(
        backbone_config=backbone, encoder_in_channels=[24, 32, 40], decoder_in_channels=[32] * 3,
        **_SMALL)).eval()
    for module in network.modules():  # else all places have nearly equal features
        if hasattr(module, 'running_var'):
            module.running_var.uniform_(0.1, 0.3)
            module.running_mean.normal_(0.0, 0.1)
    torch.nn.init.normal_(network.model.enc_score_head.weight, 0.0, 1.0)
    network.config.save_pretrained(folder)
    transformers.RTDetrImageProcessor(size={'height': SIDE, 'width': SIDE}).save_pretrained(folder)
    (folder / 'onnx').mkdir()
    # The exporter leaves all submodules of a module in its training mode.
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter('ignore')
        torch.onnx.export(
            _OnlyResults(network).eval(), (torch.from_numpy(pixels(an_image(SIDE, SIDE))),),
            folder / 'onnx/model.onnx', input_names=['pixel_values'],
            output_names=['logits', 'pred_boxes'], dynamo=False, opset_version=17)
    return network


def pixels(image_rgb: np.ndarray) -> np.ndarray:
    """Return an image at the input size of D-FINE, as its input."""
    return np.ascontiguousarray(image_rgb.transpose(2, 0, 1)[None], np.float32) / np.float32(255)


def an_image(height: int = 90, width: int = 160) -> np.ndarray:
    """Return an image of noise."""
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
