# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert the demo's networks for machines without PyTorch: ``python -m demo.world.convert DIR``.

The folder has yolo.pt, clip.json and clip.safetensors. The networks are written beside them, into
openvino/, in the half precision of these files.
"""

import argparse
import shutil
from pathlib import Path

from cliploc_ros.models.clip_towers import (
    convert_image_tower,
    convert_text_tower,
    text_identity,
)
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.openvino_networks import network_folder, store_network
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_detector import convert_yolo, identity_of


def convert(folder: Path) -> None:
    """Write the converted networks of a demo's folder, in place of older ones."""
    shutil.rmtree(folder / 'openvino', ignore_errors=True)
    yolo = DetectorOptions(str(folder / 'yolo.pt'))
    weights = resolve_clip_weights(ClipOptions(str(folder / 'clip.json'),
                                               str(folder / 'clip.safetensors')))
    for name, identity, conversion in (
            ('YOLO', identity_of(Path(yolo.model), yolo), convert_yolo(Path(yolo.model), yolo)),
            (weights.model, weights.identity, convert_image_tower(weights)),
            (weights.model, text_identity(weights), convert_text_tower(weights))):
        store_network(network_folder(folder, name, identity), identity, conversion, in_half=True)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog='convert', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', type=Path, metavar='DIR')
    convert(parser.parse_args().folder.absolute())


if __name__ == '__main__':
    main()
