# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``doctor``: check everything that a request needs, and say what to do."""

import argparse
import sys
from collections.abc import Sequence

from cliploc_ros.command import needs_ros, option, positive, printable, run_main, running_ros

EPILOG = """\
It reads the parameters and topics of the running relocalizer, listens to the same topics, and
localizes once. It changes nothing, and sends no pose to a localizer. If the nodes are not running,
give their parameter files and the same remappings.

exit codes: 0 no check failed, 1 a check failed

examples:
  doctor
  doctor --relocalizer /robot1/relocalizer
  doctor --params-file robot.yaml --ros-args -r image:=/camera/image_raw
"""


def main(args: Sequence[str] | None = None) -> int:
    """Check a robot; return the exit code."""
    return run_main(make_parser(), run, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='doctor', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        usage='doctor [options] [--ros-args ...]',
        description='Check parameters, map, camera, calibration, clock, tf, odometry, detector, '
        'localizer and the time of a request. Each failure comes with its remedy.')
    option(parser, '--relocalizer NAME', 'its name, absolute or in the namespace of this node '
           '(%(default)s)', default='relocalizer')
    option(parser, '--params-file FILE', 'check with these parameters; repeat it as on the '
           'command line of the node (default: ask the running relocalizer)', default=[],
           action='append')
    option(parser, '--timeout S', 'wait S seconds for an input (%(default)g)', positive, 10.0)
    return parser


def run(options: argparse.Namespace) -> int:
    """Check and print; return the exit code. CliplocError: a parameter file cannot be read."""
    with needs_ros('doctor'):
        from cliploc_ros.ros.doctor import Report, State, doctor

    report = Report(lambda finding: print(
        f'{finding.what:<12} {finding.state:<12} {printable(finding.text)}', flush=True))
    with running_ros(options.ros_args):
        doctor(options.params_file, options.relocalizer, options.timeout, report)
    failed = [finding.what for finding in report.findings if finding.state is State.FAIL]
    print(f'{len(failed)} of {len(report.findings)} failed: {", ".join(failed)}' if failed else
          f'nothing failed in {len(report.findings)} checks' + (
              ', but no pose was accepted here' if any(
                  finding.state is State.REFUSED for finding in report.findings) else ''))
    return int(bool(failed))


if __name__ == '__main__':
    sys.exit(main())
