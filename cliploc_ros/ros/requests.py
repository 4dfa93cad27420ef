# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A wake-up request: look at fresh frames until a pose is accepted or the time is up."""

import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.errors import CliplocError, TimeUpError
from cliploc_ros.ros.answer import Answer, Verdict
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame, FrameSource, NoFrameError
from cliploc_ros.ros.inputs.robot_state import RobotStateSource
from cliploc_ros.ros.inputs.time_jumps import TimeJumpError
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.outputs.handoff import HandOff, HandOffError, NoLocalizerError

# Every frame that odometry does not link is another chance of a false accept.
_MAX_UNLINKED = 3
# An earlier request ends at its own deadline, shortly before those that wait for it.
_GRACE_S = 0.2


_SMALLER = 'choose a faster profile or a smaller'
# Of each stage its name in a message, and what makes it faster.
_STAGES = {'image': 'waiting for an image with detections', 'detection': 'the detector',
           'waiting': 'waiting for earlier work or for /tf', 'decoding': 'reading the image',
           'CLIP': 'CLIP', 'search': 'the search', 'keyframes': 'matching keyframes'}
_REMEDIES = {'image': 'raise the rate of the camera or of the detector',
             'detection': f'{_SMALLER} detector',
             'waiting': 'retry', 'decoding': 'use smaller images', 'CLIP': f'{_SMALLER} CLIP',
             'search': 'lower iterations or time_budget_ms',
             'keyframes': "set keyframes_file to ''"}


class _Look(NamedTuple):
    """The answer from one frame, and whether the next one can change it."""

    answer: Answer
    may_go_on: bool


class Requests:
    """Answers requests one at a time.

    A request that had to wait shares the previous answer if the image of that answer arrived
    after the request: clients that ask together cost one search and reset the localizer once.
    Otherwise it looks at fresh frames itself.

    Parameters
    ----------
    node : ManagedNode
    frames : FrameSource
    robot : RobotStateSource
    localize : callable
        Takes a frame, its StageTimes and the deadline (monotonic clock) [s]; returns its Answer.
        Called in the worker's thread.
    handoff : HandOff
    """

    def __init__(self, node: ManagedNode, frames: FrameSource, robot: RobotStateSource,
                 localize: Callable[[Frame, StageTimes, float], Answer], handoff: HandOff) -> None:
        self._node = node
        self._frames = frames
        self._robot = robot
        self._localize = localize
        self._handoff = handoff
        self._turn = threading.Lock()
        self._previous = Answer(Verdict.FAILED, 'no request yet')

    def answer(self) -> Answer:
        """Return the answer to a request that arrives now, within timeout_s."""
        arrived_at = time.monotonic()
        deadline = arrived_at + self._node.settings['timeout_s']
        if not self._turn.acquire(timeout=deadline - arrived_at + _GRACE_S):
            return Answer(Verdict.FAILED, 'earlier requests took all of timeout_s: retry')
        try:
            if self._previous.received_at <= arrived_at:
                self._previous = self._guarded(arrived_at, deadline)
            return self._previous
        finally:
            self._turn.release()

    def _guarded(self, arrived_at: float, deadline: float) -> Answer:
        """Return an answer whatever happens, and log it in one line."""
        try:
            # A map or weights that were missing may be there now.
            self._node.bring_up(deadline)
            answer = self._look_until(deadline, arrived_at)
        except CliplocError as error:
            answer = Answer(Verdict.FAILED, str(error))
        except Exception as error:
            self._node.report(traceback.format_exc())
            answer = Answer(Verdict.FAILED,
                            f'internal error: {error} (the traceback is in the log)')
        self._node.get_logger().info(answer.message)
        return answer

    def _look_until(self, deadline: float, arrived_at: float) -> Answer:
        """Look at one frame after another while another frame can change the answer."""
        try:
            look, looks = self._look_past_problems(arrived_at, deadline), 1
        except TimeUpError as error:
            return Answer(Verdict.REFUSED, str(error), kind=RefusalKind.TIME_UP)
        stages_ms, unlinked = Counter(look.answer.stages_ms), int(not look.answer.is_linked)
        is_up = look.answer.is_cut
        while look.may_go_on and unlinked < _MAX_UNLINKED:
            try:
                look = self._look_past_problems(time.monotonic(), deadline)
            except (NoFrameError, TimeUpError, TimeJumpError, NoTransformError):
                is_up = True
                break
            looks += 1
            stages_ms.update(look.answer.stages_ms)
            unlinked += not look.answer.is_linked
            is_up = look.answer.is_cut
        answer = look.answer
        # more images of a place without objects are no remedy
        if is_up and answer.verdict is Verdict.REFUSED and (
                answer.is_cut or answer.kind is not RefusalKind.TOO_FEW_OBJECTS):
            answer = replace(answer, detail=f'{answer.detail}; {_time_is_up(stages_ms)}')
        if looks == 1:
            return answer
        return replace(answer, detail=f'{answer.detail} [{looks} frames in '
                                      f'{time.monotonic() - arrived_at:.1f} s]')

    def _look(self, after: float, deadline: float) -> _Look:
        """Localize with the next frame and hand an accepted pose to the localizer."""
        frame = self._frames.next_frame(after, deadline)
        times = StageTimes('image', after)
        times.begin('detection', frame.received_at)
        times.begin('waiting', frame.detected_at)
        try:
            answer = self._node.worker.run(lambda: self._localize(frame, times, deadline),
                                           deadline)
        except TimeUpError as error:
            raise TimeUpError(_time_is_up(times.ms)) from error
        may_go_on = answer.pose is None
        if answer.pose is not None:
            try:
                self._handoff.hand_over(answer.pose, self._node.settings.snapshot(), deadline,
                                        answer.received_at)
            except HandOffError as error:
                answer = replace(answer, verdict=Verdict.WITHHELD, pose=None,
                                 detail=f'{error} ({answer.message})')
                may_go_on = not isinstance(error, NoLocalizerError)
        return _Look(answer, may_go_on
                     and self._robot.is_linked_soon(frame.image.header.stamp, deadline))

    def _look_past_problems(self, after: float, deadline: float) -> _Look:
        """Look at the next frame; at newer ones after a jump in time or without its transform."""
        problem: CliplocError | None = None
        while True:
            try:
                return self._look(after, deadline)
            except NoFrameError as error:
                raise problem or error from error
            except (TimeJumpError, NoTransformError) as error:
                problem, after = error, time.monotonic()
                if after > deadline - _GRACE_S:
                    raise


def _time_is_up(stages_ms: Mapping[str, float]) -> str:
    """Return which stage used up the time of a request, and what to do about it."""
    stage = max(stages_ms, key=lambda name: stages_ms[name])
    total_s = sum(stages_ms.values()) / 1e3
    return (f'time is up: {_STAGES[stage]} took {stages_ms[stage] / 1e3:.1f} of {total_s:.1f} s; '
            f'{_REMEDIES[stage]}, or raise timeout_s')
