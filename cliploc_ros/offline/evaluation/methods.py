# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Define the methods to compare: the paper's ten, our defaults, and named sets of options."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError, did_you_mean

#: The rows of the paper's Table 1. Class matching has no similarities, which PROSAC needs.
PAPER_METHODS = ('class_bf', 'class_ransac', 'clip_bf', 'clip_ransac', 'clip_prosac',
                 'clip_b-prosac', 'hybrid_bf', 'hybrid_ransac', 'hybrid_prosac',
                 'hybrid_b-prosac')
#: The default options of the relocalizer node.
AUTO = 'auto'
ALL = 'all'
_FIELDS = {field.name: field for field in fields(RelocalizerOptions)}


@dataclass(frozen=True)
class Method:
    """A named set of options, with keyframes or without."""

    name: str
    options: RelocalizerOptions
    keyframes: bool = False

    @property
    def draws_nothing(self) -> bool:
        """Return whether it draws no random samples. Then all its trials are equal."""
        return self.options.algorithm in ('auto', 'bf')

    @property
    def accumulates(self) -> bool:
        """Return whether a localizer gets all queries of a trial, unlike the paper's methods."""
        return self.options.algorithm == 'auto'


def parse_methods(words: Iterable[str], paper: RelocalizerOptions, landmarks: int,
                  with_clip: bool = True) -> tuple[Method, ...]:
    """Return the methods that the words name.

    OptionsError: a name, or an option in a file, is unknown or invalid; the message names it.

    Parameters
    ----------
    words : iterable of str
        Names of the paper's methods, 'auto', 'all' of these, or YAML files: a mapping of names
        to options. 'base' names the method with the default values, 'keyframes' switches
        keyframes on or off. The paper's methods never use keyframes.
    paper : RelocalizerOptions
        Options of the paper's methods other than matching and algorithm. auto takes its seed,
        height range, deviations of vertical and tilt, crops and matching from them.
    landmarks : int
        Number of landmarks of the map; it limits k. If it is 0, all methods must use keyframes.
    """
    methods: dict[str, Method] = {}
    for word in words:
        if word == ALL:
            found = [_named(name, paper, landmarks) for name in (*PAPER_METHODS, AUTO)]
            found = [one for one in found if with_clip or not one.options.needs_similarities]
        elif word.endswith(('.yaml', '.yml')):
            content = read_parameter_file(word)
            if not content:
                raise OptionsError(f'{word}: is not a mapping of names to options')
            found = [_made(f'{word}: {name}', name, options, paper, landmarks)
                     for name, options in content.items()]
        else:
            found = [_named(word, paper, landmarks)]
        for method in found:
            if methods.get(method.name, method) != method:
                raise OptionsError(f"two different methods are called '{method.name}'")
            methods[method.name] = method
    if not methods:
        raise OptionsError(f'no method is named: give one or more of {", ".join(PAPER_METHODS)}, '
                           f'{ALL}, {AUTO}, or a YAML file')
    for name, method in methods.items():
        if not landmarks and not method.keyframes:
            raise OptionsError(f"'{name}' uses landmarks only, and the map has none: give "
                               f'--methods {AUTO}')
    return tuple(methods.values())


def _named(name: str, paper: RelocalizerOptions, landmarks: int) -> Method:
    if name == AUTO:
        options = RelocalizerOptions(
            matching=paper.matching, random_seed=paper.random_seed,
            height_range_m=paper.height_range_m,
            vertical_deviation_deg=paper.vertical_deviation_deg,
            tilt_deviation_deg=paper.tilt_deviation_deg, crops=paper.crops)
    elif name in PAPER_METHODS:
        matching, algorithm = name.split('_')
        options = replace(paper, matching=matching, algorithm=algorithm, refine=False,
                          tilt_deviation_deg=0.0)
    else:
        raise OptionsError(f"'{name}' is none of {', '.join(PAPER_METHODS)}, {ALL}, {AUTO}, "
                           f'nor a YAML file{did_you_mean(name, [*PAPER_METHODS, ALL, AUTO])}')
    return Method(name, replace(options, k=min(options.k, landmarks or options.k)), name == AUTO)


def _made(where: str, name: str, values: Any, paper: RelocalizerOptions, landmarks: int) -> Method:
    if not isinstance(values, Mapping):
        raise OptionsError(f'{where}: is not a mapping of options')
    if '@' in name or '/' in name:
        raise OptionsError(f"{where}: a name must hold neither '@' nor '/'")
    base = _named(str(values.get('base', AUTO)), paper, landmarks)
    keyframes = _converted(f'{where}: keyframes', values.get('keyframes', base.keyframes), True)
    changes = {option: value for option, value in values.items()
               if option not in ('base', 'keyframes')}
    for option, value in changes.items():
        if option not in _FIELDS:
            raise OptionsError(f"{where}: '{option}' is none of base, {', '.join(_FIELDS)}, "
                               f'keyframes{did_you_mean(option, _FIELDS)}')
        changes[option] = _converted(f'{where}: {option}', value, _FIELDS[option].default)
    try:
        return Method(name, replace(base.options, **changes), keyframes)
    except OptionsError as error:
        raise OptionsError(f'{where}: {error}') from error


def _converted(where: str, value: Any, default: Any) -> Any:
    """Return an option's value from YAML; OptionsError: its type is not that of the default."""
    if isinstance(default, tuple):
        if not isinstance(value, list) or len(value) != len(default):
            raise OptionsError(f'{where}: {value!r} is not a list of {len(default)}')
        return tuple(_converted(where, *pair) for pair in zip(value, default, strict=True))
    kind = type(default)
    fits = isinstance(value, int | float if kind is float else kind)
    if not fits or (isinstance(value, bool) and kind is not bool):
        raise OptionsError(f'{where}: {value!r} is no {kind.__name__}')
    return value
