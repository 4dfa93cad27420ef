# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import time
from contextlib import ExitStack

import pytest

from cliploc_ros.ros.lingering import Lingering


@pytest.fixture
def node(make_node):
    return make_node()


@pytest.fixture
def lingering(node):
    return Lingering(node)


def stack_that_tells(ended, name):
    stack = ExitStack()
    stack.callback(ended.append, name)
    return stack


def test_what_nobody_comes_back_for_ends_after_a_second_or_two(node, lingering, spin_until):
    ended, begun = [], time.monotonic()
    lingering.open()
    lingering.keep(stack_that_tells(ended, 'first'))
    spin_until([node], lambda: ended, 'the end')
    assert 0.9 < time.monotonic() - begun < 4.0
    assert ended == ['first']


def test_the_next_one_is_kept_before_the_last_one_ends(lingering):
    events = []
    lingering.open()
    lingering.keep(stack_that_tells(events, 'first'))
    second = stack_that_tells(events, 'second')
    events.append('opened second')
    lingering.keep(second)
    assert events == ['opened second', 'first']


def test_closed_it_keeps_nothing(lingering):
    ended = []
    lingering.keep(stack_that_tells(ended, 'before it was opened'))
    lingering.open()
    lingering.keep(stack_that_tells(ended, 'open'))
    assert ended == ['before it was opened']
    lingering.close()
    assert ended[1:] == ['open']
    lingering.keep(stack_that_tells(ended, 'late'))
    assert ended[2:] == ['late']
    lingering.open()
    lingering.close()
    assert len(ended) == 3, 'nothing ends twice'
