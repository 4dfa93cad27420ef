# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP's tokens of a text: byte pairs, merged by a table (Sennrich et al., 2016)."""

import gzip
import html
import re
import unicodedata
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

# The table has these merges after its first line; 256 bytes stand alone or end a word.
_MERGES = 49_152 - 256 - 2
_CONTRACTIONS = re.compile(r"'(?:s|t|re|ve|m|ll|d)")
_END = '</w>'
# Typographic quotation marks, which labels are copied with from texts.
_QUOTES = str.maketrans({'\u2018': "'", '\u2019': "'", '\u201c': '"', '\u201d': '"'})


class ClipTokenizer:
    """Splits texts as the tokenizer of open_clip does for OpenAI's table of merges.

    open_clip also mends texts that were decoded wrongly, wide letters and ligatures (``ftfy``).
    This class does not: such a label has other tokens here.
    """

    def __init__(self, merges_gz: bytes, context_length: int) -> None:
        lines = gzip.decompress(merges_gz).decode().split('\n')[1:_MERGES + 1]
        merges = [tuple(line.split()) for line in lines]
        self._ranks = {merge: rank for rank, merge in enumerate(merges)}
        self._symbols = _byte_symbols()
        letters = list(self._symbols.values())
        names = [*letters, *(letter + _END for letter in letters), *map(''.join, merges)]
        self._numbers = {name: number for number, name in enumerate(names)}
        self._start, self._stop = len(names), len(names) + 1
        self._length = context_length

    def __call__(self, texts: Sequence[str]) -> NDArray[np.int64]:
        """Return the tokens (n, context) of texts; a longer text is cut, the rest is 0."""
        found = np.zeros((len(texts), self._length), dtype=np.int64)
        for row, text in enumerate(texts):
            tokens = [self._start, *self.encode(text)[:self._length - 2], self._stop]
            found[row, :len(tokens)] = tokens
        return found

    def encode(self, text: str) -> list[int]:
        """Return the tokens of a text, without start and end."""
        text = unicodedata.normalize('NFC', text.translate(_QUOTES))
        text = ' '.join(html.unescape(html.unescape(text)).split()).lower()
        return [self._numbers[part] for word in _words(text) for part in self._merged(word)]

    def _merged(self, word: str) -> list[str]:
        parts = [self._symbols[byte] for byte in word.encode()]
        parts[-1] += _END
        while len(parts) > 1:
            pairs = list(pairwise(parts))
            best = min(pairs, key=lambda pair: self._ranks.get(pair, _MERGES))
            if best not in self._ranks:
                break
            merged: list[str] = []
            for part in parts:
                # a part that is merged already ends no other pair
                if merged and (merged[-1], part) == best:
                    merged[-1] += part
                else:
                    merged.append(part)
            parts = merged
        return parts


def _words(text: str) -> list[str]:
    """Split a text into contractions, runs of letters, single digits and runs of others."""
    found, start = [], 0
    while start < len(text):
        kind, end = _kind(text[start]), start + 1
        if contraction := _CONTRACTIONS.match(text, start):
            end = contraction.end()
        elif kind in 'LO':
            while end < len(text) and _kind(text[end]) == kind:
                end += 1
        if kind != ' ':
            found.append(text[start:end])
        start = end
    return found


def _kind(character: str) -> str:
    """Return L for a letter, N for a number, a space, or O for any other character."""
    category = unicodedata.category(character)[0]
    return category if category in 'LN' else ' ' if character.isspace() else 'O'


def _byte_symbols() -> dict[int, str]:
    """Return the visible character that stands for each byte in the table, in its order."""
    visible = [*range(33, 127), *range(161, 173), *range(174, 256)]
    hidden = [byte for byte in range(256) if byte not in visible]
    return ({byte: chr(byte) for byte in visible}
            | {byte: chr(256 + number) for number, byte in enumerate(hidden)})
