# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An environment without PyTorch, for processes of tests, and imports of it at the first use."""

import importlib
import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]


class Lazy:
    """A module that is imported at its first use, and not by each worker of the tests.

    In a new environment, PyTorch and open_clip take 13 s.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __getattr__(self, attribute: str) -> object:
        if attribute.startswith('_') or attribute == 'pytestmark':  # pytest looks at all objects
            raise AttributeError(attribute)
        return getattr(importlib.import_module(self.name), attribute)


def hide_pytorch(folder: Path) -> dict[str, str]:
    """Return an environment in which PyTorch, open_clip and ultralytics are not installed."""
    for name in ('torch', 'torchvision', 'open_clip', 'ultralytics', 'timm'):
        (folder / f'{name}.py').write_text(
            f"raise ModuleNotFoundError(\"No module named '{name}'\", name='{name}')\n")
    paths = [str(folder), str(PROJECT), os.environ.get('PYTHONPATH', '')]
    return os.environ | {'PYTHONPATH': os.pathsep.join(filter(None, paths))}
