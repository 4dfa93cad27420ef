# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Paint textures for objects, walls and furniture."""

import cv2
import numpy as np
import numpy.typing as npt

from demo.world.appearance import COLORS, Appearance

SIZE_PX = 256


def paint(look: Appearance, repeats: int, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Paint the texture of an object.

    Parameters
    ----------
    look : Appearance
        Its look.
    repeats : int
        Number of labels around the object: a round object shows one on every side.
    rng : numpy.random.Generator
        For the irregularities of the paint.

    Returns
    -------
    (256, 256 * repeats, 3) array of uint8
        RGB, row 0 at the top.
    """
    height, width = SIZE_PX, SIZE_PX * repeats
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = COLORS[look.color]
    second = COLORS[look.second_color]
    if look.pattern == 'dots':
        for row, y in enumerate(range(32, height, 64)):
            for x in range(32 * (row % 2), width + 32, 64):
                cv2.circle(image, (x, y), 17, second, -1, cv2.LINE_AA)
    elif look.pattern == 'stripes':
        for x in range(0, width, 64):
            image[:, x:x + 26] = second
    elif look.pattern == 'bands':
        for y in range(24, height, 72):
            image[y:y + 32] = second
    elif look.pattern == 'checks':
        rows, columns = np.indices((height, width)) // 43
        image[(rows + columns) % 2 == 0] = second
    elif look.pattern == 'label':
        for x in range(0, width, SIZE_PX):
            image[72:190, x + 18:x + 238] = second
            _print_word(image[72:190, x + 18:x + 238], look.word, second)
    noise = cv2.GaussianBlur(rng.normal(0, 1, image.shape[:2]).astype(np.float32), (0, 0), 6)
    return np.clip(image * (1 + 0.25 * noise[..., None]), 0, 255).astype(np.uint8)


def _print_word(field: npt.NDArray[np.uint8], word: str, paper: tuple[int, int, int]) -> None:
    ink = (20, 20, 20) if sum(paper) > 300 else (240, 240, 240)
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, 9
    if not word:
        return
    (width, height), _ = cv2.getTextSize(word, font, 1.0, thickness)
    scale = min((field.shape[1] - 24) / width, (field.shape[0] - 30) / height)
    (width, height), _ = cv2.getTextSize(word, font, scale, thickness)
    at = (field.shape[1] - width) // 2, (field.shape[0] + height) // 2
    patch = np.ascontiguousarray(field)
    cv2.putText(patch, word, at, font, scale, ink, thickness, cv2.LINE_AA)
    field[:] = patch


def paint_wood(color: tuple[int, int, int], rng: np.random.Generator,
               planks: int = 1) -> npt.NDArray[np.uint8]:
    """Paint wood: grain along x, and planks of slightly different shades."""
    grain = rng.normal(0, 1, (SIZE_PX, SIZE_PX)).astype(np.float32)
    grain = cv2.GaussianBlur(grain, (0, 0), sigmaX=30, sigmaY=1.2)
    shade = 1 + 0.12 * grain / max(float(grain.std()), 1e-6)
    shade *= np.repeat(rng.uniform(0.85, 1.1, planks), -(-SIZE_PX // planks))[:SIZE_PX, None]
    image = np.clip(np.array(color) * shade[..., None], 0, 255).astype(np.uint8)
    for row in range(0, SIZE_PX, SIZE_PX // planks) if planks > 1 else ():
        image[row:row + 2] = image[row:row + 2] // 2
    return image


def paint_wall(color: tuple[int, int, int], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Paint plaster: a colour with soft clouds, sometimes papered with faint stripes."""
    clouds = cv2.GaussianBlur(rng.normal(0, 1, (SIZE_PX, SIZE_PX)).astype(np.float32), (0, 0), 12)
    image = np.array(color) * (1 + 0.03 * clouds[..., None] / max(float(clouds.std()), 1e-6))
    if rng.random() < 0.5:
        image[:, (np.arange(SIZE_PX) // 16) % 2 == 0] *= 0.96
    return np.clip(image, 0, 255).astype(np.uint8)
