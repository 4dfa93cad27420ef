# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the package raises for input that its user can mend."""


# Of a longer message the middle is left out: what is wrong is named first, and what to do last.
_HEAD, _TAIL = 700, 250


class CliplocError(Exception):
    """Bad input. The message names the thing to mend; no traceback is needed to act on it.

    It may quote what a stranger wrote, and goes to logs, answers and diagnostics: as text it is
    one line, and short.
    """

    def __str__(self) -> str:
        """Return the message as one line of bounded length."""
        text = super().__str__()
        if len(text) > _HEAD + _TAIL:
            text = f'{text[:_HEAD]} ... {text[-_TAIL:]}'
        return ''.join(char if char.isprintable() else ' ' for char in text)


class MapError(CliplocError):
    """A landmark map that cannot be used: file, landmark and field are named."""


class OptionsError(CliplocError):
    """An option or parameter outside its allowed values."""


class CameraError(CliplocError):
    """Camera intrinsics or distortion that no camera can have."""


class ImageError(CliplocError):
    """An image that cannot be decoded."""


class ModelError(CliplocError):
    """Weights or an architecture that cannot be loaded."""


class DatasetError(CliplocError):
    """A recording that cannot be read or written."""


class MappingError(CliplocError):
    """Posed detections of which no map can be made."""


class InternalError(CliplocError):
    """A defect of this package, not of its input. The traceback is in the log."""


class StoppedError(CliplocError):
    """The process is ending; what was asked for will not come."""
