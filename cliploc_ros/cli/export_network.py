# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``export_network``: write ONNX files of weights that exist for PyTorch only."""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from cliploc_ros.cli.options import add_weights_options
from cliploc_ros.command import option, program, run_main
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.storage import MAKE_ROOM, make_folder, unfinished

EPILOG = """\
Exporting needs PyTorch (script/setup models). A robot runs the files without it: name them in
its parameters model and clip_pretrained.

examples:
  export_network --model yolov8n.pt --out yolov8n.onnx
  export_network --model yolov8s-worldv2.pt --detector-vocabulary office.yaml --out office.onnx
  export_network --clip-model ViT-L-14 --clip-pretrained openai --out vit_l14
"""


def main(args: Sequence[str] | None = None) -> int:
    """Export a network; return the exit code."""
    return run_main(make_parser(), export_network, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = program('export_network', EPILOG, 'Write a detector of ultralytics or a CLIP of '
                     'open_clip as ONNX, and compare the results of both.')
    add_weights_options(parser)
    option(parser, '--half', 'store weights in half precision: half the size; the network still '
           'runs in fp32')
    option(parser, '--out PATH', 'the file of a detector, or the new folder of a CLIP', Path,
           required=True)
    parser.set_defaults(profile='accurate')
    return parser


def export_network(options: argparse.Namespace) -> int:
    """Write the ONNX files of the network that the command line names; return the exit code.

    CliplocError: the message names the option or file to correct.
    """
    is_clip = bool(options.clip_model or options.clip_pretrained)
    if is_clip == bool(options.model):
        raise OptionsError('name either a detector (--model) or a CLIP (--clip-model and '
                           '--clip-pretrained)')
    if is_clip and (options.detector_vocabulary or options.text_model):
        raise OptionsError('--detector-vocabulary and --text-model are for --model')
    if options.out.exists() and (is_clip or options.out.is_dir()):
        raise OptionsError(f'{options.out} exists: name a new {"folder" if is_clip else "file"}')
    if not is_clip and options.out.suffix != '.onnx':
        raise OptionsError(f'--out {options.out}: the file name of a detector must end in .onnx')
    out = options.out.absolute()
    make_folder(out.parent)
    # The imports take seconds.
    from cliploc_ros.cli.sources import clip_options, detector_options
    from cliploc_ros.models.export import export_clip
    from cliploc_ros.models.exports import DETECTOR, run_export
    from cliploc_ros.models.onnx_clip import names_onnx
    from cliploc_ros.models.yolo_weights import export_detector, resolve_published

    with tempfile.TemporaryDirectory(prefix='cliploc_ros_export_') as desk:
        found = Path(desk) / 'network'
        if is_clip:
            clip = clip_options(options)
            if names_onnx(clip):
                raise OptionsError(f'{clip.pretrained} has ONNX files already')
            run_export(f'CLIP {clip.model}', partial(export_clip, clip, half=options.half), found)
        else:
            detector = detector_options(options)
            file = resolve_published(detector.model, '', 'model')
            run_export(str(file), partial(export_detector, file, detector, half=options.half),
                       found)
            found /= DETECTOR
        copy = shutil.copytree if is_clip else shutil.copy
        try:
            with unfinished(out, Path.mkdir) as beside:
                Path(copy(found, beside / out.name)).rename(out)
        except OSError as error:
            raise OptionsError(f'{out}: cannot be written: {error.strerror}; {MAKE_ROOM}'
                               ) from error
    files = [out] if out.is_file() else out.rglob('*')
    print(f'{out}: {sum(file.stat().st_size for file in files) / 1e6:.1f} MB, results equal to '
          'those of PyTorch')
    return 0


if __name__ == '__main__':
    sys.exit(main())
