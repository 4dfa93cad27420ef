# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors that the user can fix."""

import difflib
from collections import Counter
from collections.abc import Iterable

# Longer messages are cut in the middle: the fault is at the beginning, the remedy at the end.
_HEAD, _TAIL = 700, 250
# Share of letters that a misspelt class has in common with the right one, as bokk and book. The
# value is not measured.
_ALIKE = 0.75
# Comparing more pairs of classes takes seconds.
_MOST_PAIRS = 100_000


class CliplocError(Exception):
    """Bad input. The message names the thing to fix, so no traceback is needed.

    The message may quote untrusted text, and is copied to logs, answers and diagnostics.
    Therefore it is cut to one line of bounded length.
    """

    def __str__(self) -> str:
        """Return the message as one line of bounded length."""
        text = super().__str__()
        if len(text) > _HEAD + _TAIL:
            text = f'{text[:_HEAD]} ... {text[-_TAIL:]}'
        return ''.join(char if char.isprintable() else ' ' for char in text)


def did_you_mean(name: str, known: Iterable[str], most: int = 1, alike: float = 0.6) -> str:
    """Return a hint with the known names that are most similar to a name; empty without any.

    `alike` is the least similarity, 0 to 1, as in difflib.
    """
    by_lower_case = {candidate.lower(): candidate for candidate in known}
    near = difflib.get_close_matches(name.lower(), by_lower_case, most, alike)
    names = ' or '.join(f"'{by_lower_case[key]}'" for key in near)
    return f' (did you mean {names}?)' if near else ''


def counted(number: int, what: str) -> str:
    """Return a number of things in words, as '1 box' or '2 boxes'."""
    plural = 'es' if what.endswith('x') else 's'
    return f'{number} {what}{plural if number != 1 else ""}'


def first_line(error: Exception) -> str:
    """Return the first line of an error in ASCII, without emojis and colours."""
    lines = str(error).encode('ascii', 'ignore').decode().strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__


def misspelt_classes(class_ids: Iterable[str], known: Iterable[str], all_known: bool = False
                     ) -> dict[str, str]:
    """Return the classes of a map that look misspelt, each with a hint of the right spelling.

    Such a class is unknown, but similar to a known one. With too many classes to compare, the
    result is empty.

    Parameters
    ----------
    class_ids : iterable of str
        Classes of the landmarks.
    known : iterable of str
        Correct classes, from a detector or a vocabulary.
    all_known : bool
        Whether `known` is complete. If not, a class of several landmarks is also correct.
    """
    counts = Counter(class_ids)
    right = {*known, *(name for name, count in counts.items() if count > 1 and not all_known)}
    unknown = [name for name in counts if name not in right]
    if len(unknown) * len(right) > _MOST_PAIRS:
        return {}
    return {name: hint for name in unknown if (hint := did_you_mean(name, right, alike=_ALIKE))}


class MapError(CliplocError):
    """An invalid landmark map; the message names file, landmark and field."""


class OptionsError(CliplocError):
    """An option or parameter outside its allowed values."""


class CameraError(CliplocError):
    """Invalid camera intrinsics or distortion."""


class ImageError(CliplocError):
    """An image that cannot be decoded."""


class ModelError(CliplocError):
    """Weights or an architecture that cannot be loaded."""


class DatasetError(CliplocError):
    """A recording that cannot be read or written."""


class MappingError(CliplocError):
    """Posed detections from which no map can be made."""


class InternalError(CliplocError):
    """A defect of this package, not of its input. The traceback is in the log."""


class StoppedError(CliplocError):
    """The node or its process is ending."""


class TimeUpError(CliplocError):
    """A request's time is up before the work is done; the message names the work."""


class HandOffError(CliplocError):
    """The pose was not delivered to the localizer; the message says why."""


class NoLocalizerError(HandOffError):
    """No localizer takes poses, or Nav2's grid was not changed. Another frame would not help."""
