# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A grammar of phrases: templates and the words that fill them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice

from cliploc_ros.errors import OptionsError

#: Symbols with a meaning of their own: the first kind, and a colour other than the first one.
NAME, SECOND = 'name', 'second'
#: The most phrases of one class. ViT-L-14 reads about 30 phrases per second of a processor.
MOST_PHRASES = 2000
# CLIP reads 77 tokens.
_MOST_CHARACTERS = 200
_MOST_STEPS = 20
_SYMBOL = re.compile(r'\{(\w+)\}')
_A_BEFORE_VOWEL = re.compile(r'\b(a)(?= (?:[aeio]|u(?!ni|se)))', re.IGNORECASE)

Rules = Mapping[str, Sequence[str]]


def expand_phrases(rules: Rules) -> tuple[str, ...]:
    """Return all phrases of a grammar, each once, in the order of its templates.

    Parameters
    ----------
    rules : mapping of str to sequence of str
        ``phrases`` are the templates. A word in braces is a symbol: each of its alternatives
        fills its place, the same one wherever it occurs in a phrase. Alternatives may hold
        symbols, too. ``{name}`` is the first ``kind``; ``{second}`` is each ``colour`` but the
        one that fills ``{colour}``.

    Raises
    ------
    OptionsError
        A symbol has no rule, rules do not end, or the phrases are too many or too long.
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
        raise OptionsError(f"'{text}' does not end: rules refer to each other")
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
