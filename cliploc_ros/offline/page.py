# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""HTML pages: a common style and common parts, without scripts or network requests.

Functions escape the texts in their arguments. Parts are already HTML.
"""

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

#: Colours of Okabe and Ito, which colour-blind readers can distinguish.
ACCEPTED, REFUSED, MISLED = '#0072B2', '#E69F00', '#D55E00'
LOOK_ALIKE, GOOD, BAD = '#CC79A7', ACCEPTED, MISLED
_QUALITY = 85
_COLORS = f':root {{ --accepted: {ACCEPTED}; --refused: {REFUSED}; --misled: {MISLED} }}'
_TYPES = {b'\x89PNG': 'png', b'\xff\xd8\xff\xe0': 'jpeg'}


def page(title: str, *parts: str) -> str:
    """Return a page."""
    style = Path(__file__).with_suffix('.css').read_text()
    return '\n'.join([
        '<!DOCTYPE html>', '<html lang="en">', '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width">', f'<title>{escape(title)}</title>',
        f'<style>{_COLORS}\n{style}</style>', f'<h1>{escape(title)}</h1>', *parts, '</html>', ''])


def first_screen(left: Iterable[str], right: Iterable[str]) -> str:
    """Return two columns that fill a screen, or one if the other would be empty."""
    columns = map(''.join, (left, right))
    return f'<div class="first">{"".join(f"<div>{one}</div>" for one in columns if one)}</div>'


def verdict(text: str, is_good: bool) -> str:
    """Return the verdict of a page."""
    return f'<p class="verdict {"good" if is_good else "bad"}"><b>{escape(text)}</b></p>'


def tiles(numbers: Iterable[tuple[str, str, bool]]) -> str:
    """Return numbers in large type, each with a caption, and whether it is good."""
    return '<div class="tiles">' + ''.join(
        f'<div class="{"good" if is_good else "bad"}"><b>{escape(number)}</b>{escape(words)}</div>'
        for number, words, is_good in numbers) + '</div>'


def bars(rows: Iterable[tuple[str, str, float, float, bool]]) -> str:
    """Return a chart of bars, each with a mark at its threshold.

    A row has a name, value and threshold in words, both as shares of the bar's length, and whether
    the value is good.
    """
    return '<div class="bars">' + ''.join(
        f'<span>{escape(name)}</span><span class="bar">'
        f'<i{"" if is_good else " class=over"} style="width:{_percent(value)}"></i>'
        f'<u style="left:{_percent(limit)}"></u></span>'
        f'<span>{"✓" if is_good else "✗"} {escape(shown)}</span>'
        for name, shown, value, limit, is_good in rows) + '</div>'


def _percent(share: float) -> str:
    return f'{100.0 * min(1.0, max(0.0, share)):.1f}%'


def card(text: str, image: bytes | None = None, caption: str = '') -> str:
    """Return a text and a caption, next to an optional picture."""
    picture = '' if image is None else f'<img alt="a view" src="{_embedded(image)}">'
    return f'<div class="card">{picture}<div><p>{escape(text)}</p>{note(caption)}</div></div>'


def fold(heading: str, *parts: str, is_open: bool = False) -> str:
    """Return parts that fold out at a click on their heading."""
    return (f'<details{" open" if is_open else ""}><summary>{escape(heading)}</summary>'
            f'{"".join(parts)}</details>')


def figure(image: bytes | str, caption: str, name: str = '') -> str:
    """Return a picture, embedded (PNG or JPEG) or by the name of a file next to the page."""
    source = escape(image) if isinstance(image, str) else _embedded(image)
    return (f'<figure><img alt="{escape(name)}" src="{source}" loading="lazy">'
            f'<figcaption>{escape(caption)}</figcaption></figure>')


def _embedded(image: bytes) -> str:
    return f'data:image/{_TYPES[image[:4]]};base64,{b64encode(image).decode("ascii")}'


def jpeg_of(image_rgb: NDArray[np.uint8], most_px: int | None = None) -> bytes:
    """Return an image (h, w, 3) as JPEG, made smaller if a side is longer than a limit."""
    if most_px is not None and (large := max(image_rgb.shape) / most_px) > 1.0:
        height, width = (max(1, round(side / large)) for side in image_rgb.shape[:2])
        image_rgb = cv2.resize(image_rgb, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.imencode('.jpg', image_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
                        )[1].tobytes()


def side_by_side(parts: Iterable[str]) -> str:
    """Return parts side by side, or below each other on a narrow screen."""
    return f'<div class="row">{"".join(parts)}</div>'


def items(texts: Iterable[str]) -> str:
    """Return a list."""
    return '<ul>' + ''.join(f'<li>{escape(text)}</li>' for text in texts) + '</ul>'


def note(text: str) -> str:
    """Return a remark in small type."""
    return f'<p class="note">{escape(text)}</p>'


def table(head: Sequence[str], rows: Iterable[Sequence[str | tuple[str, str]]]) -> str:
    """Return a table; a cell may have a CSS class, and # in a heading right-aligns its column."""
    kinds = ['number' if title.startswith('#') else '' for title in head]
    lines = [(('th', title.lstrip('#'), kind) for title, kind in zip(head, kinds, strict=True))
             ] if any(head) else []
    lines += [(('td', *((cell, kind) if isinstance(cell, str) else cell))
               for cell, kind in zip(row, kinds, strict=True)) for row in rows]
    return '<div class="scroll"><table>' + ''.join(
        '<tr>' + ''.join(f'<{tag}{f" class={kind}" if kind else ""}>{escape(text)}</{tag}>'
                         for tag, text, kind in line) + '</tr>' for line in lines
    ) + '</table></div>'
