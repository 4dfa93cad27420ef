# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An environment without PyTorch, for processes of tests."""

import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]


def hide_pytorch(folder: Path) -> dict[str, str]:
    """Return an environment in which PyTorch, open_clip and ultralytics are not installed."""
    for name in ('torch', 'torchvision', 'open_clip', 'ultralytics', 'timm'):
        (folder / f'{name}.py').write_text(
            f"raise ModuleNotFoundError(\"No module named '{name}'\", name='{name}')\n")
    paths = [str(folder), str(PROJECT), os.environ.get('PYTHONPATH', '')]
    return os.environ | {'PYTHONPATH': os.pathsep.join(filter(None, paths))}
