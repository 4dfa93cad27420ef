# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``import_map``: convert a table of ellipsoids to a map file."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cliploc_ros import command
from cliploc_ros.command import option
from cliploc_ros.errors import DatasetError, OptionsError

if TYPE_CHECKING:
    from cliploc_ros.offline.datasets.given_map import GivenMap

_LEFT_OUT_SHOWN = 10
# [m] [deg]. Chosen so that 0.95 of the poses lie in their 95 % ellipsoid on the map of TUM fr3, if
# the landmarks are displaced by 5 cm on each axis, independently or together, or enlarged by 1.25.
_ERRORS = (0.05, 1.0)
EPILOG = """\
columns: class_id x y z a b c, and optional ones; see doc/mapping.md

examples:
  import_map office.csv --out office.yaml
  import_map slam.csv --scale 2.31 --transform 0 0 1.2 -0.5 0.5 -0.5 0.5 \\
             --refit office.npz --out office.yaml
"""


def main(args: Sequence[str] | None = None) -> int:
    """Import a map; return the exit code."""
    return command.run_main(make_parser(), import_map, args)


def make_parser(formats: Sequence[str] = ('csv',)) -> argparse.ArgumentParser:
    """Return the parser of the command line, with the formats of the input."""
    parser = command.program('import_map', EPILOG, 'Import a map from a table. An existing map is '
                             'replaced only when the new one is complete. Needs no sourced ROS.')
    option(parser, 'input IN', 'the file to import')
    option(parser, '--from', 'its format (%(default)s)', dest='format', choices=formats,
           default=formats[0])
    option(parser, '--out YAML', 'the map to write', required=True)
    option(parser, '--report JSON', 'also write what was left out, and why')
    place = parser.add_argument_group('coordinate frame and errors of the map')
    option(place, '--frame-id', 'coordinate frame of the map (%(default)s)', default='map')
    option(place, '--scale METRES', 'length of a unit of the file in metres (%(default)s)',
           command.positive, 1.0)
    option(place, '--transform V', "x y z [m] qx qy qz qw of the file's coordinate frame in the "
           "map's", command.finite, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), nargs=7)
    option(place, '--errors METRES DEGREES', 'errors of the landmarks on each axis, both '
           'independent and shared, if the file has no position_sigma (0.05 1)', command.positive,
           _ERRORS)
    refit = parser.add_argument_group('fit to a recording')
    option(refit, '--refit NPZ', 'fit each landmark to the boxes of these observations')
    option(refit, '--keep-unsupported', 'keep landmarks that cannot be fitted, as they are in the '
           'file')
    return parser


def import_map(options: argparse.Namespace,
               read: 'Callable[[Path], GivenMap] | None' = None) -> int:
    """Import the map that the command line names; return the exit code. Default: read a table."""
    # Imported late, so that --help is fast.
    from cliploc_ros.core.keyframes.layer import layer_path, removed_layer
    from cliploc_ros.core.map.map_file import write_map
    from cliploc_ros.files.storage import write_text
    from cliploc_ros.offline.datasets.given_map import place, read_table, refit
    from cliploc_ros.offline.datasets.map_recording import recording_path
    from cliploc_ros.offline.datasets.poses import mount_from_numbers

    begin = time.monotonic()
    for name, path in (('out', options.out), ('report', options.report)):
        if path is not None:
            command.check_output(path)
            if any(other is not None and path.exists() and other.exists() and path.samefile(other)
                   for other in (options.input, options.refit)):
                raise OptionsError(f'--{name} {path} is an input; name another file')
    if not options.frame_id.strip():
        raise OptionsError('--frame-id: must not be empty')
    try:
        map_from_given = mount_from_numbers(options.transform)
    except DatasetError as error:
        raise OptionsError(f'--transform: {error}') from error
    given = (read or read_table)(options.input)
    try:
        landmark_map, left_out = place(
            given, f'import_map {options.format} {options.input.name}', options.frame_id,
            options.scale, map_from_given, tuple(options.errors))
    except DatasetError as error:
        raise DatasetError(f'{options.input}: {error}') from error
    notes = [f'{len(landmark_map)} landmarks, not fitted to a recording',
             'note: maps of other systems localize better after --refit OBSERVATIONS']
    if options.refit is not None:
        landmark_map, unfitted, notes = refit(landmark_map, options.refit,
                                              options.keep_unsupported)
        left_out += unfitted
    notes += [f'note: {note}' for note in given.notes]
    of_map_before = recording_path(options.out), layer_path(options.out)
    had_layer = of_map_before[1].exists()
    write_map(options.out, landmark_map,
              [f'imported by import_map from {options.input.name} ({options.format})', notes[0]],
              besides=dict.fromkeys(of_map_before))
    if had_layer:
        print(removed_layer(options.out))
    if options.report is not None:
        write_text(options.report, json.dumps({
            'landmarks': len(landmark_map), 'lines': notes,
            'left_out': [skipped._asdict() for skipped in left_out]}, indent=1))
    lines = [*notes, f'left out: {len(left_out)}', *(
        f'  {skipped.landmark_id}: {skipped.reason}' for skipped in left_out[:_LEFT_OUT_SHOWN])]
    if len(left_out) > _LEFT_OUT_SHOWN:
        lines.append(f'  and {len(left_out) - _LEFT_OUT_SHOWN} more: see --report')
    print('\n'.join(map(command.printable, lines)))
    print(f'wrote {options.out} with {len(landmark_map)} landmarks in '
          f'{time.monotonic() - begin:.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
