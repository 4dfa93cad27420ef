# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The looks of objects, and the labels that describe them."""

from dataclasses import dataclass

import numpy as np

#: Object classes, in the order of the detector's class indices.
CLASSES = ('mug', 'bottle', 'book', 'box', 'bowl', 'can', 'clock', 'plant')

#: Colours by name, RGB.
COLORS = {
    'red': (196, 30, 36),
    'orange': (238, 122, 24),
    'yellow': (240, 205, 40),
    'green': (42, 140, 56),
    'blue': (34, 76, 190),
    'purple': (112, 48, 150),
    'pink': (240, 140, 176),
    'brown': (112, 70, 40),
    'black': (28, 28, 30),
    'white': (236, 236, 232),
}
#: Patterns in a second colour, and how a label names them.
PATTERNS = {
    'plain': '',
    'dots': 'with {color} dots',
    'stripes': 'with {color} stripes',
    'bands': 'with {color} bands',
    'checks': 'with {color} checks',
    'label': 'with a {color} label',
}
#: Words printed on objects, by class.
WORDS = {
    'mug': ('TEA', 'JOE', 'HOT'),
    'bottle': ('OIL', 'WINE', 'MILK'),
    'book': ('MAPS', 'ART', 'LAW', 'BIRDS'),
    'box': ('TOOLS', 'TOYS', 'SALT'),
    'can': ('COLA', 'BEANS', 'SOUP'),
}
SIZES = {'small': 0.8, 'medium': 1.0, 'large': 1.2}


@dataclass(frozen=True)
class Appearance:
    """What distinguishes an object."""

    class_id: str  #: One of `CLASSES`
    color: str  #: Name of the main colour
    pattern: str = 'plain'  #: A key of `PATTERNS`
    second_color: str = 'white'  #: Colour of the pattern
    word: str = ''  #: The printed word, '' for none
    size: str = 'medium'  #: A key of `SIZES`

    @property
    def label(self) -> str:
        """The label, as a person would write it for a map."""
        size = {'large': 'tall' if self.class_id == 'bottle' else 'large'}.get(
            self.size, self.size)
        adjectives = ([] if size == 'medium' else [size])
        words = [*adjectives, self.color, self.class_id]
        if self.class_id == 'plant':
            words = [*adjectives, 'plant in', _article(self.color), self.color, 'pot']
        words.insert(0, _article(words[0]))
        if self.pattern != 'plain':
            words.append(PATTERNS[self.pattern].format(color=self.second_color))
        if self.word:
            words.append(f'that says {self.word}')
        return ' '.join(words)


def _article(word: str) -> str:
    return 'an' if word[0] in 'aeiou' else 'a'


def draw_appearance(class_id: str, rng: np.random.Generator) -> Appearance:
    """Draw the look of an object of a class at random."""
    color, second = rng.choice(list(COLORS), 2, replace=False)
    pattern = str(rng.choice(list(PATTERNS), p=(0.2, 0.16, 0.16, 0.16, 0.16, 0.16)))
    word = ''
    if class_id in WORDS and rng.random() < 0.25:
        pattern, word = 'label', str(rng.choice(WORDS[class_id]))
    size = str(rng.choice(list(SIZES), p=(0.15, 0.7, 0.15)))
    return Appearance(class_id, str(color), pattern, str(second), word, size)


def draw_lookalike(original: Appearance, rng: np.random.Generator) -> Appearance:
    """Draw a nearly identical look, which differs only in the second colour."""
    others = [c for c in COLORS if c not in (original.color, original.second_color)]
    pattern = 'dots' if original.pattern == 'plain' else original.pattern
    return Appearance(original.class_id, original.color, pattern, str(rng.choice(others)),
                      original.word, original.size)
