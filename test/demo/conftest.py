# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Import PyTorch before anything renders.

PyTorch's Triton and Mesa's software renderer each load an LLVM, and the opposite order crashes the
process. The programs render and train in separate processes.
"""

import importlib.util

if importlib.util.find_spec('torchvision'):
    import torchvision  # noqa: F401
