# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The phrases of each detector class: shipped ones for COCO, and those of a user's file."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cliploc_ros.core.maps.parameter_file import read_parameter_file
from cliploc_ros.errors import OptionsError
from cliploc_ros.vocabulary.grammar import NAME, SECOND, expand_phrases

_FOLDER = Path(__file__).parent
_GENERAL = 'general'


@dataclass(frozen=True)
class Vocabulary:
    """Phrases by class.

    Parameters
    ----------
    added : mapping of str to tuple of str
        Phrases of a user besides the shipped ones.
    """

    added: Mapping[str, tuple[str, ...]]

    def phrases(self, class_name: str) -> tuple[str, ...]:
        """Return the phrases of a class, each once; the user's come first.

        A class that is not in the vocabulary is described by the general grammar.
        """
        return tuple(dict.fromkeys(self.added.get(class_name, ()) + shipped_phrases(class_name)))


def load_vocabulary(path: str | os.PathLike[str] | None = None) -> Vocabulary:
    """Return the shipped vocabulary, with the phrases of a file besides.

    Parameters
    ----------
    path : str or path, optional
        A YAML file: class names to a list of phrases, or to rules as in coco.yaml.

    Raises
    ------
    CliplocError
        The file is invalid; the message names file, class and rule.
    """
    if path is None:
        return Vocabulary({})
    entries = read_parameter_file(path)
    if not entries:
        raise OptionsError(f'{path}: holds no classes')
    return Vocabulary({name: _phrases_of(name, entry, f"{path}: class '{name}'")
                       for name, entry in entries.items()})


def shipped_classes() -> tuple[str, ...]:
    """Return the classes that the shipped vocabulary knows by name."""
    return tuple(_shipped('coco.yaml'))


def shipped_phrases(name: str) -> tuple[str, ...]:
    """Return the phrases of a class without those of a user."""
    return _phrases_of(name, _shipped('coco.yaml').get(name, {}), f"class '{name}'")


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
    # a detector may name a class tv_monitor; braces would be symbols
    plain = ' '.join(re.sub(r'[_{}]', ' ', name).split()) or 'object'
    grammar = _grammar(entry.get('grammar', _GENERAL), where)
    try:
        return expand_phrases({'kind': [plain]} | grammar | rules)
    except OptionsError as error:
        raise OptionsError(f'{where}: {error}') from error


def _grammar(name: Any, where: str) -> dict[str, list[str]]:
    """Return the rules of a grammar and, where it has none, those of the general one."""
    grammars = _shipped('grammars.yaml')
    if not isinstance(name, str) or name not in grammars:
        raise OptionsError(f'{where}: grammar: {name!r:.60} is none of {", ".join(grammars)}')
    return {**grammars[_GENERAL], **grammars[name]}


def _words(words: Any, where: str) -> list[str]:
    if where.endswith((f': {NAME}', f': {SECOND}')):
        raise OptionsError(f'{where}: has a meaning of its own; choose another name')
    if not isinstance(words, list) or not words:
        raise OptionsError(f'{where}: expected a list of text, not {words!r:.60}')
    for word in words:
        if not isinstance(word, str) or not word.strip():
            raise OptionsError(f'{where}: {word!r:.60} is no text (quote numbers and yes/no)')
    return words
