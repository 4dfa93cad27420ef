# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of tests, handed to the workers of pytest-xdist, some of which die."""

from xdist.scheduler import LoadFileScheduling


class CrashProofScheduling(LoadFileScheduling):
    """Goes on after the death of a worker, where that of pytest-xdist 3.8 waits for ever.

    That one hands also the finished files of a dead worker to the next, which gets nothing to run
    and never asks again. Here only tests are handed on that have not run, and the one that was
    running runs once more if it is marked flaky.
    """

    def remove_node(self, node):
        """Take back what a worker has not run; return the test at which it died, or None."""
        left = {file: tests for file, tests in self.assigned_work.pop(node).items()
                if not all(tests.values())}
        if not left:
            return None
        self.workqueue.update(left)
        tests = next(iter(left.values()))
        crashed = next(test for test, done in tests.items() if not done)
        tests[crashed] = True
        return crashed

    def mark_test_pending(self, item):
        """Let the test at which a worker died run again; pytest-rerunfailures calls this."""
        self.workqueue[self._split_scope(item)][item] = False

    def _reschedule(self, node):
        """Give a worker more to do; with less than two tests it would wait for ever."""
        if node not in self.registered_collections:  # it still imports the tests
            return
        super()._reschedule(node)
        while (self.workqueue and not node.shutting_down
               and self._pending_of(self.assigned_work[node]) < 2):
            self._assign_work_unit(node)
