# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layer's file: it comes back as it was, and bad files are named."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scene import make_map

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import KeyframeLayer, learn_words, nearest_words
from cliploc_ros.core.keyframes.layer_file import layer_path, load_layer_of_map, save_layer
from cliploc_ros.core.keyframes.features import DIMENSIONS, unit_rows
from cliploc_ros.errors import MapError
