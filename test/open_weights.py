# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""YOLO-World and YOLOE from ultralytics with random weights, and a small text tower."""

from pathlib import Path

import torch

from cliploc_ros.models.yolo_weights import import_ultralytics


def write_open_yolo(file: Path, config: str, task: str = 'detect') -> Path:
    """Write random weights of an architecture, such as yolov8n-worldv2.yaml."""
    ultralytics = import_ultralytics()
    from ultralytics.nn import tasks

    torch.manual_seed(0)
    kind = tasks.WorldModel if 'world' in config else {
        'detect': tasks.YOLOEModel, 'segment': tasks.YOLOESegModel}[task]
    model = kind(config, verbose=False)
    for module in model.modules():  # otherwise all boxes have nearly the same score
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_var.uniform_(0.1, 0.3)
            module.running_mean.normal_(0.0, 0.1)
    model.names, model.task = {i: f'class {i}' for i in range(model.model[-1].nc)}, task
    torch.save({'model': model.half(), 'version': ultralytics.__version__,
                'train_args': {'imgsz': 640, 'task': task}}, file)
    return file


class TextTower(torch.nn.Module):
    """Maps CLIP's tokens (n, 77) to embeddings (n, d)."""

    def __init__(self, embed_dim: int) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.words = torch.nn.Embedding(49408, embed_dim)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        is_word = (tokens > 0) & (tokens < 49406)
        return (self.words(tokens) * is_word[..., None]).sum(dim=1)


def write_tower(file: Path, embed_dim: int = 512) -> Path:
    """Write a small text tower as TorchScript."""
    torch.jit.script(TextTower(embed_dim)).save(file)
    return file


class OnlyResults(torch.nn.Module):
    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixel_values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = self.network(pixel_values)
        return found.logits, found.pred_boxes
