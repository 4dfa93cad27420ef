# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Do covariances hold the errors: ``python -m studies.covariance --help``."""

import sys

from studies.commands import run_one_of

if __name__ == '__main__':
    sys.exit(run_one_of('studies.covariance', {
        'consistency': 'the share of poses within their covariance, for each mode',
        'continuous': 'a filter that fuses successive poses'}))
