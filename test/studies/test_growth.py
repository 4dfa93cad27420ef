# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of how confidence grows with images."""

from studies.acceptance.growth import Answer, tables


def test_each_number_of_images_has_its_own_figures():
    grows = [Answer(n, 0.15 * n + 0.2, 0.1, n > 3) for n in range(1, 6)]
    wrong = [Answer(n, 0.1, 5.0, n == 5) for n in range(1, 6)]
    cut_short = [Answer(1, 0.9, 0.1, True)]
    lines = tables([grows, wrong, cut_short]).splitlines()
    assert lines[2].split(' | ')[1:6] == ['1 of 2', '0.225', '0.350', '0.100', '']
    assert lines[6].split(' | ')[1:6] == ['1 of 2', '0.525', '0.950', '0.100', '1.000']
    assert '2, 1 | 1.000' in lines[6]
    of_bins = [line for line in lines if line.startswith('| 0.95')]
    assert of_bins[0].count('1 of 1') == 1
    assert lines[-1].endswith('| 1, 1 |')
