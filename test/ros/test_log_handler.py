# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import logging

import pytest

from cliploc_ros.ros.node.lifecycle import RosLogHandler


@pytest.fixture
def logger(make_node):
    """A Python logger whose records go to a real node's logger."""
    handler = RosLogHandler(make_node('spokesman'))
    logger = logging.getLogger('cliploc_ros_test')
    logger.propagate = False
    logger.setLevel(logging.DEBUG)
    logger.addHandler(handler)
    yield logger
    logger.removeHandler(handler)


@pytest.mark.parametrize(('level', 'word'), [
    (logging.INFO, 'INFO'), (logging.WARNING, 'WARN'), (logging.CRITICAL, 'ERROR')])
def test_records_come_out_of_the_node_at_their_level(logger, capfd, level, word):
    logger.log(level, 'loaded %d of %s', 3, 'cup')
    written = capfd.readouterr()
    line, = (written.out + written.err).splitlines()
    assert f'[{word}]' in line and '[spokesman]' in line and line.endswith('loaded 3 of cup')
