# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images from messages: raw, or compressed by compressed_depth_image_transport.

A compressed depth image is a header of 12 bytes and a PNG of 16 bits. The PNG of 16UC1 holds the
counts, that of 32FC1 quantized inverse depth: depth = a / (value - b), with a and b in the header.
"""

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import ImageError
from cliploc_ros.messages import CompressedImageMessage, ImageMessage, check_size, declared_size

_TYPES = {'16UC1': np.uint16, 'mono16': np.uint16, '32FC1': np.float32}
_HEADER = struct.Struct('<iff')


def depth_counts_from_msg(msg: ImageMessage | CompressedImageMessage) -> NDArray[np.generic]:
    """Return the pixels (h, w) of a depth image, uint16 or float32, as recorded.

    Parameters
    ----------
    msg : sensor_msgs/Image or sensor_msgs/CompressedImage
        Of encoding 16UC1, mono16 or 32FC1. 0 or NaN stands for no depth.

    Raises
    ------
    ImageError
        A field is invalid; the message names it.
    """
    return _decoded(msg) if isinstance(msg, CompressedImageMessage) else _unpacked(msg)


def _unpacked(msg: ImageMessage) -> NDArray[np.generic]:
    dtype = np.dtype(_TYPES[_checked(msg.encoding)])
    dtype = dtype.newbyteorder('>' if getattr(msg, 'is_bigendian', 0) else '<')
    check_size(msg.width, msg.height)
    used = msg.width * dtype.itemsize
    if msg.step < used or len(msg.data) < msg.step * msg.height:
        raise ImageError(f'depth image of {msg.width}x{msg.height} px with step {msg.step} has '
                         f'only {len(msg.data)} bytes')
    rows = np.frombuffer(msg.data, dtype=np.uint8, count=msg.step * msg.height)
    pixels = np.ascontiguousarray(rows.reshape(msg.height, msg.step)[:, :used]).view(dtype)
    return pixels.astype(dtype.newbyteorder('='))


def _decoded(msg: CompressedImageMessage) -> NDArray[np.generic]:
    encoding, _, transport = (part.strip() for part in msg.format.partition(';'))
    if not transport.startswith('compressedDepth') or transport.endswith('rvl'):
        raise ImageError(f"depth format '{msg.format}' is not 'ENCODING; compressedDepth png': "
                         'record the compressedDepth topic, as PNG')
    is_inverse = _TYPES[_checked(encoding)] == np.float32
    data = bytes(msg.data)
    check_size(*declared_size(data[_HEADER.size:], msg.format))
    try:
        values = cv2.imdecode(np.frombuffer(data, np.uint8, offset=_HEADER.size),
                              cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageError(f"depth image ('{msg.format}') does not decode: {error.err}") from error
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        raise ImageError(f"depth image ('{msg.format}', {len(data)} bytes) is no PNG of 16 bits "
                         'with one channel')
    return _from_inverse(values, *_HEADER.unpack_from(data)[1:]) if is_inverse else values


def _from_inverse(values: NDArray[np.generic], a: float, b: float) -> NDArray[np.float32]:
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        depths = np.float32(a) / (values.astype(np.float32) - np.float32(b))
    depths[values == 0] = np.nan
    return depths


def _checked(encoding: str) -> str:
    if encoding not in _TYPES:
        raise ImageError(f"depth encoding '{encoding}' is none of {', '.join(_TYPES)}")
    return encoding
