# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Neural networks behind two small protocols: an object detector, an image-text encoder.

Importing this package imports neither torch nor open_clip nor ultralytics; making an encoder or a
detector does.
"""

from cliploc_ros.models.clip_encoder import ClipEncoder, LoadedEncoder, load_encoder
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.images import visible_boxes
from cliploc_ros.models.protocols import ImageTextEncoder, ObjectDetector
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.yolo_weights import YoloOptions

__all__ = [
    'ClipEncoder', 'ClipOptions', 'ImageTextEncoder', 'LoadedEncoder', 'ObjectDetector',
    'YoloDetector', 'YoloOptions', 'load_encoder', 'visible_boxes']
