# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP with random weights as a local checkpoint, and open_clip's embeddings for it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open_clip
import torch
from PIL import Image

# CLIP's architecture at a small size.
SMALL_CONFIG = {
    'embed_dim': 64,
    'vision_cfg': {'image_size': 224, 'layers': 2, 'width': 64, 'head_width': 32,
                   'patch_size': 32},
    'text_cfg': {'context_length': 77, 'vocab_size': 49408, 'width': 64, 'heads': 2, 'layers': 2},
}


@dataclass(frozen=True)
class Reference:
    """The model that open_clip loads from a checkpoint."""

    name: str
    file: Path
    model: Any
    preprocess: Any
    tokenizer: Any

    def crops(self, image_rgb: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Embed pixels left, top, right, bottom of an image."""
        images = [Image.fromarray(np.ascontiguousarray(image_rgb[top:bottom, left:right]))
                  for left, top, right, bottom in bounds]
        with torch.inference_mode():
            batch = torch.stack([self.preprocess(image) for image in images])
            return self.model.encode_image(batch, normalize=True).numpy()

    def labels(self, labels: list[str]) -> np.ndarray:
        with torch.inference_mode():
            return self.model.encode_text(self.tokenizer(labels), normalize=True).numpy()


def make_reference(name: str, folder: Path) -> Reference:
    torch.manual_seed(0)
    model, _, preprocess = open_clip.create_model_and_transforms(name)
    file = folder / f'{name}.pt'
    torch.save(model.state_dict(), file)
    return Reference(name, file, model.eval(), preprocess, open_clip.get_tokenizer(name))


def make_small_reference(name: str, config: dict, folder: Path) -> Reference:
    """Make the reference for an architecture that open_clip does not know yet."""
    (folder / f'{name}.json').write_text(json.dumps(config))
    open_clip.add_model_config(folder / f'{name}.json')
    return make_reference(name, folder)
