# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train the demo's CLIP: ``python -m demo.world.train_clip WORLDS --out clip.safetensors``.

This trains a small open_clip model from scratch on crops of rendered worlds and their labels. All
crops of a batch with equal labels are positives of each other.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.files.storage import write_file
from demo import ASSETS
from demo.truth import read_frames
from demo.world.worlds import find_worlds, hold_out

CONFIG = ASSETS / 'clip.json'
_SMALLEST_PX = 14
#: Margin kept around a box, as a share of its size: room for perturbed boxes.
_MARGIN = 0.15
Preprocess = Callable[[Image.Image], torch.Tensor]


@dataclass(frozen=True)
class Crop:
    """An object in an image with some margin, and its box [px] in that crop."""

    image: Image.Image
    bbox_xyxy: npt.NDArray[np.float64]
    label: str


def read_crops(world: Path) -> dict[str, list[Crop]]:
    """Crop the objects of a world from its images; return the crops by object."""
    crops = defaultdict(list)
    for frame in read_frames(world):
        image = Image.open(frame.image).convert('RGB')
        for box in frame.boxes:
            size = box.bbox_xyxy[2:] - box.bbox_xyxy[:2]
            if size.min() < _SMALLEST_PX:
                continue
            corner = np.floor(np.maximum(box.bbox_xyxy[:2] - _MARGIN * size, 0))
            end = np.ceil(np.minimum(box.bbox_xyxy[2:] + _MARGIN * size + 1, image.size))
            crops[box.object_id].append(Crop(
                image.crop((*corner.astype(int), *end.astype(int))),
                box.bbox_xyxy - np.tile(corner, 2), box.label))
    return dict(crops)


def scatter(crop: Crop, rng: np.random.Generator) -> Image.Image:
    """Cut a crop along a box perturbed like a detector's, and change its light slightly."""
    size = np.tile(crop.bbox_xyxy[2:] - crop.bbox_xyxy[:2], 2)
    bounds = crop.bbox_xyxy + rng.normal(0, 0.04, 4) * size
    x0, y0 = np.clip(np.floor(bounds[:2]), 0, None)
    x1, y1 = np.minimum(np.ceil(bounds[2:] + 1), crop.image.size)
    cut = crop.image.crop((int(x0), int(y0), int(x1), int(y1)))
    gain = np.exp(rng.normal(0, 0.15)) * np.exp(rng.normal(0, 0.02, 3))
    return Image.fromarray(np.clip(np.asarray(cut) * gain, 0, 255).astype(np.uint8))


def contrastive_loss(images: torch.Tensor, texts: torch.Tensor, scale: torch.Tensor,
                     labels: list[str]) -> torch.Tensor:
    """Return the symmetric contrastive loss; all texts equal to a crop's label are positives."""
    ids = torch.tensor(np.unique(labels, return_inverse=True)[1])
    right = (ids[:, None] == ids[None, :]).float()
    right /= right.sum(1, keepdim=True)
    logits = scale * images @ texts.T
    return (torch.nn.functional.cross_entropy(logits, right)
            + torch.nn.functional.cross_entropy(logits.T, right)) / 2


def train(objects: list[list[Crop]], model: Any, tokenizer: Any, preprocess: Preprocess, *,
          steps: int, batch: int, seed: int) -> list[float]:
    """Train a model on crops, given by object; return the loss of each step."""
    rng = np.random.default_rng(seed)
    plain = [p for p in model.parameters() if p.ndim < 2]
    decayed = [p for p in model.parameters() if p.ndim >= 2]
    optimizer = torch.optim.AdamW([{'params': decayed, 'weight_decay': 0.05},
                                   {'params': plain, 'weight_decay': 0.0}], lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, total_steps=steps,
                                                   pct_start=0.08)
    losses: list[float] = []
    model.train()
    with tqdm(total=steps, unit='step', mininterval=2.0) as bar:
        for _ in range(steps):
            chosen = rng.choice(len(objects), batch, replace=len(objects) < batch)
            crops = [objects[i][int(rng.integers(len(objects[i])))] for i in chosen]
            images = torch.stack([preprocess(scatter(crop, rng)) for crop in crops])
            labels = [crop.label for crop in crops]
            found, meant, scale = model(images, tokenizer(labels))[:3]
            loss = contrastive_loss(found, meant, scale, labels)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                model.logit_scale.clamp_(0, np.log(100))
            losses.append(float(loss.detach()))
            bar.set_postfix(loss=f'{np.mean(losses[-50:]):.3f}', refresh=False)
            bar.update()
    return losses


@torch.no_grad()
def score(worlds: Iterable[dict[str, list[Crop]]], model: Any, tokenizer: Any,
          preprocess: Preprocess) -> tuple[float, float]:
    """Return top-1 and top-3 accuracy of each crop's label among all labels of its world."""
    model.eval()
    ranks = []
    for world in worlds:
        crops = [crop for views in world.values() for crop in views]
        labels = sorted({crop.label for crop in crops})
        texts = model.encode_text(tokenizer(labels), normalize=True)
        own = torch.tensor([labels.index(crop.label) for crop in crops])
        rng = np.random.default_rng(0)
        images = model.encode_image(torch.stack([preprocess(scatter(crop, rng))
                                                 for crop in crops]), normalize=True)
        similarities = images @ texts.T
        best = similarities.gather(1, own[:, None])
        ranks.append((similarities > best).sum(1))
    all_ranks = torch.cat(ranks)
    return float((all_ranks < 1).float().mean()), float((all_ranks < 3).float().mean())


def make_model(config: Path, seed: int) -> tuple[Any, Any, Preprocess]:
    """Make a model with random weights, its tokenizer and its preprocessing."""
    import open_clip

    torch.manual_seed(seed)
    open_clip.add_model_config(config)
    model, _, preprocess = open_clip.create_model_and_transforms(
        config.stem, load_weights=False, force_custom_text=True)
    return model, open_clip.get_tokenizer(config.stem), preprocess


def save(model: Any, path: Path) -> None:
    """Write the weights atomically, in half precision."""
    from safetensors.torch import save_file

    state = {name: (tensor.half() if tensor.is_floating_point() else tensor).contiguous()
             for name, tensor in model.state_dict().items()}
    write_file(path, lambda partial: save_file(state, partial))


def run(arguments: list[str]) -> int:
    """Train, save, and score on held-out worlds."""
    parser = argparse.ArgumentParser(prog='train_clip', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('worlds', type=Path, metavar='WORLDS', help='folder of make_worlds')
    parser.add_argument('--out', type=Path, required=True, help='.safetensors file to write')
    parser.add_argument('--config', type=Path, default=CONFIG, help='open_clip model config')
    parser.add_argument('--steps', type=int, default=1500)
    parser.add_argument('--batch', type=int, default=192, help='crops per step')
    parser.add_argument('--threads', type=int, default=2)
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    training, held_out = hold_out(find_worlds(options.worlds))
    model, tokenizer, preprocess = make_model(options.config, options.seed)
    objects = [views for world in tqdm(training, 'reading', unit='world')
               for views in read_crops(world).values()]
    print(f'{sum(map(len, objects))} crops of {len(objects)} objects in {len(training)} worlds')
    train(objects, model, tokenizer, preprocess, steps=options.steps, batch=options.batch,
          seed=options.seed)
    save(model, options.out)
    first, third = score([read_crops(world) for world in held_out], model, tokenizer, preprocess)
    print(f'{len(held_out)} worlds held out: top-1 {first:.3f}, top-3 {third:.3f}')
    print(f'wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB)')
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
