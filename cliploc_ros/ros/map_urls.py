# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a map is: a path, or a URL that begins with file:// or package://."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory

from cliploc_ros.errors import MapError

_FILE, _PACKAGE = 'file://', 'package://'


def path_of(name: str) -> str:
    """Return the path of a map.

    Parameters
    ----------
    name : str
        A path; ``file:///PATH``; or ``package://PACKAGE/PATH``, a path in the package's share
        folder, as in URDF files.

    Raises
    ------
    MapError
        The package is not installed, or the URL names no file in it.
    """
    if not name.startswith(_PACKAGE):
        return name.removeprefix(_FILE)
    package, _, path = name.removeprefix(_PACKAGE).partition('/')
    if not package or not path:
        raise MapError(f'{name}: no package://PACKAGE/PATH, such as package://my_maps/office.yaml')
    try:
        return str(Path(get_package_share_directory(package)) / path)
    except (LookupError, ValueError) as error:
        raise MapError(f"{name}: there is no package '{package}' here: install it, or source "
                       'the workspace that has it') from error
