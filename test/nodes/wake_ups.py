# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests on the frames of a recording, and their answers against the true poses."""

import numpy as np
from tester import transform_of

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.ros.conversions import stamp_ns


def wake_up_on_frames(tester, frames):
    """Request until so many different frames of a looping recording are answered; by stamp.

    Which frame an answer is about stands in the stamp of the hypotheses published with it.
    """
    answers = {}
    tester.hypotheses.clear()
    while len(answers) < frames:
        heard = len(tester.hypotheses)
        answer = tester.answer(tester.ask())
        assert answer.message.startswith(('accepted', 'refused')), answer.message
        tester.wait(lambda n=heard: len(tester.hypotheses) > n, 'the hypotheses')
        hypotheses = tester.hypotheses[-1]
        answers[stamp_ns(hypotheses.header.stamp)] = (answer, hypotheses)
    return answers


def judge(answers, sequence):
    """Print and return the errors [m] on frames with ground truth, and how many wrong accepts."""
    errors, wrong = [], 0
    for stamp, (answer, hypotheses) in sorted(answers.items()):
        truth = sequence.pose_at(stamp)
        if truth is None:
            continue
        error = pose_error(transform_of(hypotheses.poses[0]), truth)[0] if hypotheses.poses \
            else np.inf
        errors.append(error)
        wrong += answer.success and error > 1.0
        print(f'{stamp / 1e9:.3f}: {error:6.2f} m, {answer.message[:60]}')
    errors_m = np.array(errors)
    rates = ' / '.join(f'{np.mean(errors_m < limit):.2f}' for limit in (0.25, 0.5, 1.0))
    print(f'{len(errors)} frames with ground truth: success at .25 / .5 / 1 m {rates}, '
          f'{wrong} accepted and wrong')
    return errors_m, wrong
