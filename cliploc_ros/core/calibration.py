# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers that decide whether a pose is accepted, or a running pose doubted.

They are read from calibration.yaml.
"""

from pathlib import Path

import yaml

FILE = Path(__file__).with_name('calibration.yaml')


class Named[T](dict[str, T]):
    """Values by name; calibration.yaml states the meaning of each section and number."""

    def __getattr__(self, name: str) -> T:
        """Return the value of a name."""
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f'calibration.yaml has no {name} here') from None

    def _replace(self, **values: T) -> 'Named[T]':
        """Return these values with some of them replaced."""
        return Named(self | values)


#: The sections by name, with their numbers by name
Calibration = Named[Named[float]]
#: The installed numbers.
CALIBRATION: Calibration = Named({
    name: Named({term: entry['value'] for term, entry in section['terms'].items()})
    for name, section in yaml.load(
        FILE.read_text(), getattr(yaml, 'CSafeLoader', yaml.SafeLoader)).items()})
