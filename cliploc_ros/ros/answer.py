# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Answers to requests and to frames in continuous mode, and their recording as cases."""

import math
import threading
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import Header

from cliploc_ros.core.acceptance.verdict import RefusalKind, needed_confidence
from cliploc_ros.core.answer_line import answer_line, detail_of, figures_of_pose
from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.core.query import CASE, Case, Query, case_arrays
from cliploc_ros.errors import CliplocError, DatasetError, OptionsError
from cliploc_ros.files.storage import make_folder
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.frame_localizer import Localized
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import RobotState
from cliploc_ros.ros.parameters import RelocalizerParameters

# Number of past frames that acceptance uses, see cliploc_ros.core.acceptance.looks.
_MAX_FRAMES = 20
_MAX_BYTES = 256 * 2**20
_MIB = 2**20


class Verdict(StrEnum):
    """The outcome of a request."""

    #: A pose is accepted and, for a request, delivered.
    ACCEPTED = 'accepted'
    #: No pose is certain enough.
    REFUSED = 'refused'
    #: A pose is accepted but was not delivered: the robot moves, or no localizer takes the pose.
    WITHHELD = 'withheld'
    #: No decision was possible: there is no frame, a message is bad, or the node is not active.
    FAILED = 'failed'


@dataclass(frozen=True)
class Answer:
    """A verdict, its reason and, if accepted, the pose."""

    verdict: Verdict
    detail: str  #: The pose in words, or why there is none, in one line
    pose: PoseWithCovarianceStamped | None = None  #: None unless accepted
    #: When the image arrived (monotonic clock) [s]; -inf without an image
    received_at: float = -math.inf
    query: Query | None = None  #: Reproduces the answer; None without an image
    #: Whether the frame was refused before all crops were compared, so that a retry may succeed
    is_cut: bool = False
    stages_ms: Mapping[str, float] = field(default_factory=dict)  #: Duration of each stage [ms]
    time_s: float | None = None  #: From the request, or from the image, to the answer [s]
    #: Hash of the searched map, see frame_localizer.load_map; empty without a map
    map_hash: str = ''
    kind: RefusalKind | None = None  #: Kind of a refusal; None for other verdicts
    header: Header | None = None  #: Stamp of the image, frame of the map; None without an image
    #: The deciding figures, as doc/interface.md describes them
    figures: Mapping[str, object] = field(default_factory=dict)
    pose_figures: Mapping[str, object] = field(default_factory=dict)  #: Empty unless accepted
    number: int = 0  #: Answers to requests count from 1; 0: not the answer to a request

    def withheld(self, why: str) -> 'Answer':
        """Return this accepted answer without its pose, which is not delivered."""
        return replace(self, verdict=Verdict.WITHHELD, pose=None, pose_figures={},
                       detail=f'{why} ({answer_line(self.verdict, self.detail)})')

    @property
    def message(self) -> str:
        """Return the answer in one line."""
        return self.detail if self.verdict is Verdict.FAILED else answer_line(
            self.verdict, self.detail, self.kind, self.time_s)


def answer_to(frame: Frame, localized: Localized, state: RobotState,
              parameters: RelocalizerParameters, map_hash: str, stages_ms: Mapping[str, float]
              ) -> Answer:
    """Return the answer that a frame gives, before its pose is published.

    `state` is the robot's state at the stamp of the frame, `map_hash` that of the searched map.
    """
    found = localized.found
    header = Header(stamp=frame.image.header.stamp, frame_id=localized.landmark_map.frame_id)
    evidence, points, depth = found.evidence, found.recognized, found.depth
    stamp, seen = header.stamp, localized.seen.observation
    compared = int((seen.similarity_rows >= 0).sum())
    is_cut = not found.accepted and seen.similarities is not None \
        and compared < len(seen.detections)
    figures: dict[str, object] = {
        'stamp [s]': f'{stamp.sec}.{stamp.nanosec:09d}', 'frame': header.frame_id,
        'source': found.source if found.solved else '', 'confidence': found.confidence,
        'confidence needed': parameters.min_confidence if evidence is None else
        needed_confidence(evidence, parameters.options()),
        'score': found.score, 'landmarks': 0 if evidence is None else evidence.inliers,
        'frames': len(found.frame_matches), 'hypotheses': found.tried,
        'searched percent': 100.0 * found.coverage, 'crops': '' if seen.similarities is None else
        f'{compared} of {len(seen.detections)}',
        'keyframe points': 0 if points is None else points.inliers,
        'keyframe search': found.keyframe_search,
        'keyframe recording': '' if points is None else points.recorded,
        'depth': '' if depth is None else f'depth of {depth.objects} objects' if depth.is_passed
        else 'depth contradicts the boxes',
        'scan': state.no_scan if evidence is None or evidence.scan is None else str(evidence.scan),
        'cameras': len(localized.query.frames), 'left out': ', '.join(localized.left_out),
        'prior': 0.0 if evidence is None else evidence.prior,
        **{f'{stage} [ms]': f'{ms:.1f}' for stage, ms in stages_ms.items()}}
    left_out = f'; no image of {figures["left out"]}' if localized.left_out else ''
    answer = Answer(Verdict.REFUSED, found.reason + left_out, None, frame.received_at,
                    localized.query, is_cut, stages_ms, sum(stages_ms.values()) / 1e3, map_hash,
                    found.refusal_kind, header, figures)
    if not found.accepted:
        return answer
    assert found.covariance is not None and found.map_from_camera is not None
    map_from_base = found.map_from_camera @ state.camera_from_base
    covariance = move_covariance(
        found.covariance, map_from_base[:3, 3] - found.map_from_camera[:3, 3])
    of_pose = figures_of_pose(map_from_base, covariance, 0 if parameters.base_frame else 2)
    return replace(answer, verdict=Verdict.ACCEPTED, pose_figures=of_pose,
                   pose=pose_with_covariance_msg(header, map_from_base, covariance),
                   detail=detail_of(found, header.frame_id, of_pose) + left_out)


def answer_msg(answer: Answer, node: str) -> DiagnosticArray:
    """Return an answer as a diagnostic message with the keys that doc/interface.md describes.

    `node` is the name of the relocalizer with its namespace.
    """
    level = {Verdict.ACCEPTED: DiagnosticStatus.OK, Verdict.FAILED: DiagnosticStatus.ERROR}
    name = node.lstrip('/')
    values = {'answer': answer.number, 'verdict': answer.verdict, 'kind': answer.kind or '',
              **answer.figures, **answer.pose_figures, 'map hash': answer.map_hash}
    return DiagnosticArray(header=answer.header or Header(), status=[DiagnosticStatus(
        level=level.get(answer.verdict, DiagnosticStatus.WARN), name=f'{name}: answer',
        message=answer.message, hardware_id=name,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])])


class RequestCounters:
    """Counts requests by verdict and kind of refusal. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = Counter[str]()

    def add(self, answer: Answer) -> None:
        """Count a request."""
        with self._lock:
            self._counts.update(['requests', f'requests {answer.verdict}',
                                 *([f'refused: {answer.kind}'] if answer.kind else [])])

    def values(self) -> dict[str, object]:
        """Return the counts since the start of the node."""
        with self._lock:
            return {name: self._counts[name] for name in (
                'requests', *(f'requests {verdict}' for verdict in Verdict),
                *(f'refused: {kind}' for kind in RefusalKind))}


class CaseRecorder:
    """Keeps the latest answers to frames of requests, unless `keeps` is false."""

    def __init__(self, keeps: bool) -> None:
        self._keeps = keeps
        self._lock = threading.Lock()
        self._seen: deque[Answer] = deque(maxlen=_MAX_FRAMES)
        self._last = Answer(Verdict.FAILED, 'no request yet')

    def add(self, answer: Answer) -> None:
        """Keep the result of a frame."""
        if not self._keeps:
            return
        with self._lock:
            self._seen.append(answer)
            while len(self._seen) > 1 and sum(
                    image.nbytes for kept in self._seen if kept.query
                    for image in kept.query.images) > _MAX_BYTES:
                self._seen.popleft()

    def end(self, answer: Answer) -> None:
        """Keep the answer to a request."""
        with self._lock:
            self._last = answer

    def forget(self) -> None:
        """Forget all frames."""
        with self._lock:
            self._seen.clear()

    def store(self, parameters: RelocalizerParameters) -> str:
        """Store the last request in record_folder; return a description of it in one line.

        Raises
        ------
        CliplocError
            The last request had no frame, or the folder is not given, full, or not writable.
        """
        if not parameters.record_folder:
            raise OptionsError('record_folder is not set: start the node with a folder that has '
                               'space for record_limit_mb')
        with self._lock:
            seen, last = list(self._seen), self._last
        while seen and seen[-1].received_at != last.received_at:
            seen.pop()
        if not seen:
            raise DatasetError(f'nothing to record: the last request had no frame: {last.message}')
        # odometry links the queries to the newest one; the oldest first
        queries: list[Query] = []
        for answer in reversed(seen):
            assert answer.query is not None
            if queries and (answer.query.run is None or answer.query.run != queries[0].run):
                break
            queries.insert(0, answer.query)
        found = seen[-1]
        try:
            folder = Path(parameters.record_folder).expanduser()
            make_folder(folder)
        except (CliplocError, RuntimeError) as error:
            raise DatasetError(f'record_folder: {error}') from error
        arrays = case_arrays(Case(tuple(queries), {
            'verdict': last.verdict, 'message': last.message, 'found': found.verdict,
            'reason': found.detail, 'map_hash': found.map_hash,
            'parameters': asdict(parameters), 'options': asdict(parameters.options())}))
        size, limit_mb, used = sum(array.nbytes for array in arrays.values()), \
            parameters.record_limit_mb, 0
        for parent, _, names in folder.walk():
            for name in names:
                with suppress(FileNotFoundError):  # moved away meanwhile
                    used += (parent / name).stat().st_size
        if used + size > limit_mb * _MIB:
            raise DatasetError(f'{folder} holds {used // _MIB} of record_limit_mb {limit_mb} and '
                               f'needs {max(1, size // _MIB)} more: move recordings, or raise it')
        now = datetime.now(UTC).strftime('%Y%m%dT%H%M%S.%f')[:-3]
        path = folder / f'case_{now}_{last.verdict}.npz'
        CASE.write(path, arrays, compress=True)
        return f'{path}: {len(queries)} frames; {last.message}'
