# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is known of classes: phrases, which a file can add to, and sizes of their objects.

The phrases of COCO and Objects365 and the sizes are shipped.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import OptionsError

#: Reserved symbols: the first kind, and a colour that differs from that of {colour}.
NAME, SECOND = 'name', 'second'
#: Greatest number of phrases of a class. ViT-L-14 encodes about 30 phrases per second on a CPU.
MOST_PHRASES = 2000
# CLIP reads at most 77 tokens.
_MOST_CHARACTERS = 200
_MOST_STEPS = 20
_SYMBOL = re.compile(r'\{(\w+)\}')
_A_BEFORE_VOWEL = re.compile(r'\b(a)(?= (?:[aeio]|u(?!ni|se)))', re.IGNORECASE)

Rules = Mapping[str, Sequence[str]]
_FOLDER = Path(__file__).parent
_GENERAL = 'general'


class Phrases(NamedTuple):
    """P phrases: texts and embeddings (P, d), unit rows."""

    texts: tuple[str, ...]
    embeddings: NDArray[np.float32]


def expand_phrases(rules: Rules) -> tuple[str, ...]:
    """Return all distinct phrases of a grammar, in the order of its templates.

    Parameters
    ----------
    rules : mapping of str to sequence of str
        ``phrases`` are the templates. A word in braces is a symbol, which is replaced by each of
        its alternatives; a symbol that occurs twice in a phrase has the same value. Alternatives
        may contain symbols. ``{name}`` is the first ``kind``; ``{second}`` is each ``colour``
        except that of ``{colour}``.

    Raises
    ------
    OptionsError
        A symbol has no rule, rules refer to each other, or phrases are too many or too long.
    """
    phrases = [_A_BEFORE_VOWEL.sub(r'\1n', phrase) for template in rules['phrases']
               for phrase in islice(_expand(template, rules, {}, 0), MOST_PHRASES + 1)]
    if len(phrases) > MOST_PHRASES:
        raise OptionsError(f'more than {MOST_PHRASES} phrases; use fewer words or templates')
    return tuple(dict.fromkeys(phrases))


def _expand(text: str, rules: Rules, chosen: dict[str, str], steps: int) -> Iterator[str]:
    """Yield a text with its symbols replaced, from left to right."""
    if len(text) > _MOST_CHARACTERS:
        raise OptionsError(f"'{text[:40]}...' has more than {_MOST_CHARACTERS} characters")
    if steps > _MOST_STEPS:
        raise OptionsError(f"'{text}' cannot be expanded: rules refer to each other")
    symbol = _SYMBOL.search(text)
    if symbol is None:
        yield text
        return
    name = symbol[1]
    words = [chosen[name]] if name in chosen else _alternatives(name, rules, chosen)
    for word in words:
        yield from _expand(text[:symbol.start()] + word + text[symbol.end():], rules,
                           chosen | {name: word}, steps + 1)


def _alternatives(name: str, rules: Rules, chosen: dict[str, str]) -> Sequence[str]:
    if name == NAME:
        return rules['kind'][:1]
    if name == SECOND:
        words = [word for word in rules['colour'] if word != chosen.get('colour')]
        if not words:
            raise OptionsError('{second} needs two colours')
        return words
    if name not in rules or name == 'phrases':
        raise OptionsError(f'{{{name}}} has no words; add the rule {name}')
    return rules[name]


def load_vocabulary(path: str | os.PathLike[str]) -> dict[str, tuple[str, ...]]:
    """Load further phrases by class from a file.

    Parameters
    ----------
    path : str or path
        A YAML file that maps class names to a list of phrases, or to rules as in coco.yaml.

    Raises
    ------
    CliplocError
        The file is invalid; the message names file, class and rule.
    """
    entries = read_parameter_file(path)
    if not entries:
        raise OptionsError(f'{path}: has no classes')
    return {name: _phrases_of(name, entry, f"{path}: class '{name}'")
            for name, entry in entries.items()}


def shipped_classes() -> tuple[str, ...]:
    """Return the class names in the shipped vocabulary, in lower case."""
    return tuple(chain.from_iterable(map(_shipped, (
        'coco.yaml', 'objects365.yaml', 'aliases.yaml'))))


def common_name(name: str) -> str:
    """Return the name of a detector's class in the vocabulary and in the table of sizes."""
    plain = ' '.join(name.lower().split())
    return str(_shipped('aliases.yaml').get(plain, plain))


def shipped_phrases(name: str) -> tuple[str, ...]:
    """Return the shipped phrases of a class; those of the general grammar if it has none."""
    common = common_name(name)
    entry = _shipped('coco.yaml').get(common, _shipped('objects365.yaml').get(common, {}))
    return _phrases_of(common if entry else name, entry, f"class '{name}'")


class Size(NamedTuple):
    """The longest extent of objects of a class [m], and the factor within which it lies."""

    extent_m: float
    factor: float

    @property
    def most_m(self) -> float:
        """Return the extent that almost no object exceeds [m]."""
        return self.extent_m * self.factor


def size_of_class(name: str) -> Size | None:
    """Return the size of objects of a class, ignoring the case of its name; None if unknown."""
    values = _shipped('sizes.yaml').get(common_name(name))
    return values and Size(*values)


@cache
def _shipped(file: str) -> dict[str, Any]:
    return read_parameter_file(_FOLDER / file)


def _phrases_of(name: str, entry: Any, where: str) -> tuple[str, ...]:
    """Return the phrases of a class from a list of templates or a mapping of rules."""
    if isinstance(entry, list):
        entry = {'phrases': entry}
    if not isinstance(entry, Mapping):
        raise OptionsError(f'{where}: expected a list of phrases or a mapping of rules, '
                           f'not {entry!r:.60}')
    rules = {rule: _words(words, f'{where}: {rule}') for rule, words in entry.items()
             if rule != 'grammar'}
    # a detector's class may be named tv_monitor; braces would be read as symbols
    plain = ' '.join(re.sub(r'[_{}]', ' ', name).split()) or 'object'
    grammars, chosen = _shipped('grammars.yaml'), entry.get('grammar', _GENERAL)
    if not isinstance(chosen, str) or chosen not in grammars:
        raise OptionsError(f'{where}: grammar: {chosen!r:.60} is not one of {", ".join(grammars)}')
    try:  # missing rules are those of the general grammar
        return expand_phrases({'kind': [plain], **grammars[_GENERAL], **grammars[chosen], **rules})
    except OptionsError as error:
        raise OptionsError(f'{where}: {error}') from error


def _words(words: Any, where: str) -> list[str]:
    if where.endswith((f': {NAME}', f': {SECOND}')):
        raise OptionsError(f'{where}: is a reserved name; choose another one')
    if not isinstance(words, list) or not words:
        raise OptionsError(f'{where}: expected a list of texts, not {words!r:.60}')
    for word in words:
        if not isinstance(word, str) or not word.strip():
            raise OptionsError(f'{where}: {word!r:.60} is not text (quote numbers and yes/no)')
    return words
