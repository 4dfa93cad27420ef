# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refine landmarks and poses together, and estimate the errors of the given poses from the boxes.

A prior on their errors keeps the poses near the given ones (PosePrior). Odometry, if available,
joins successive frames (cliploc_ros.offline.mapping.odometry). Box edges give the same residuals
as in cliploc_ros.offline.mapping.fitting.

The normal equations have a block for each landmark, blocks for each pose and its successor, and
a block for each box, which couples a pose and a landmark. The poses, whose part is banded, are
eliminated. The reduced system of the landmarks is solved by conjugate gradients, so that memory
grows only with the number of boxes (Agarwal et al., "Bundle Adjustment in the Large", ECCV 2010).

Errors of a pose move all boxes of a frame together; errors of the detector move each box
independently. The estimate maximizes the marginal likelihood of the boxes over the standard
deviations of the poses, the time constant of their errors, and the scale s of the edges'
deviations (empirical Bayes; Laplace's approximation, MacKay, "Bayesian Interpolation", 1992).
With H the normal equations of the boxes at the best landmarks and poses, b their gradient, and Q
the information of the process of pose errors e (PosePrior),

    -log p = r' W r / 2 s^2 + N log s + e' Q e / 2 - b' (H / s^2 + Q)^-1 b / 2
             + log det (H / s^2 + Q) / 2 - log det Q / 2.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.optimize import minimize
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial.transform import Rotation

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.offline.mapping.fitting import accumulate_all, linearize_boxes, move_all
from cliploc_ros.offline.mapping.landmarks import LANDMARK_SIZE, POSE_SIZE, Landmarks, group_boxes
from cliploc_ros.offline.mapping.odometry import Steps
from cliploc_ros.offline.mapping.options import INSTANT_S, PoseErrors
from cliploc_ros.offline.mapping.views import Views

_SOLVER_ITERATIONS = 200
_SOLVER_TOLERANCE = 1e-3
_LEAST_IMPROVEMENT = 1e-3
_MAX_DAMPING = 1e4
# Greatest numbers of frames and landmarks in the estimate: more take time but add little
# precision.
_MAX_FRAMES, _MAX_LANDMARKS = 200, 25
# Of a long recording, only the middle is used: frames far apart have no landmark in common.
_MAX_SPAN = 3000
_MIN_FRAMES, _MIN_LANDMARKS, _MIN_BOXES = 20, 3, 3
# Smaller errors than these are not refined. Chosen: motion capture and clock of TUM fr3 are
# estimated to be
# off by 6 mm and 0.2 degrees.
_HARMLESS = PoseErrors(0.01, 0.3)
# A wide start lets poses follow their boxes; a narrow one would make distant boxes outliers.
_START = PoseErrors(0.1, 2.0, 0.3)
_ROUNDS, _REFINEMENTS, _EVALUATIONS = 3, 6, 40
# Bounds of sigma [m] [deg], time constant [s] and scale of the edges' deviations.
_LOWEST = np.log([0.001, 0.02, 0.05, 0.3])
_HIGHEST = np.log([1.0, 20.0, 100.0, 5.0])
# Poses within this time have similar errors [s]: the default of PoseErrors.correlation_s.
_POSE_ERROR_S = 3.0
# Boxes that are matched wrongly before the poses are refined bend the map: the error of a part
# is this multiple of the mean error of its poses. Chosen on maps of TUM fr3 from poses off by 5
# and 10 cm over 3 s (five seeds).
_BENDING = 1.6


class PosePrior(NamedTuple):
    """The information of the errors of the poses: its diagonal and next diagonal (F, 6)."""

    diagonal: NDArray[np.float64]
    beside: NDArray[np.float64]

    @staticmethod
    def of(stamps_s: NDArray[np.float64], errors: PoseErrors) -> 'PosePrior':
        """Return the prior of frames with the given stamps."""
        kept = np.zeros(len(stamps_s))
        kept[:-1] = errors.kept(np.maximum(np.diff(stamps_s), INSTANT_S))
        # information of the innovation between a frame and the next one
        gain = 1.0 / (1.0 - kept[:-1] ** 2)
        diagonal = np.ones(len(stamps_s))
        diagonal[1:] = gain
        diagonal[:-1] += gain * kept[:-1] ** 2
        beside = np.zeros(len(stamps_s))
        beside[:-1] = -gain * kept[:-1]
        weights = 1.0 / errors.sigmas ** 2
        return PosePrior(diagonal[:, None] * weights, beside[:, None] * weights)

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of the information."""
        # Q = L D L': each pivot is the diagonal minus the contribution of the frame before
        pivots = self.diagonal.copy()
        for frame in range(1, len(pivots)):
            pivots[frame] -= self.beside[frame - 1] ** 2 / pivots[frame - 1]
        return float(np.log(pivots).sum())

    def gradient(self, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the information times errors (F, 6)."""
        product = self.diagonal * errors
        product[:-1] += self.beside[:-1] * errors[1:]
        product[1:] += self.beside[:-1] * errors[:-1]
        return product


def pose_bands(of_poses: NDArray[np.float64], prior: PosePrior,
               of_steps: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the poses' part of the equations with the prior, as lower bands.

    Each pose has a block (6, 6). With odometry, there is a block below it, with the rows of the
    next pose and the columns of this one. The bands are (7, 6 F), or (12, 6 F) with odometry.
    """
    count = POSE_SIZE + 1 if of_steps is None else 2 * POSE_SIZE
    bands = np.zeros((count, len(of_poses), POSE_SIZE))
    for below in range(POSE_SIZE):
        for column in range(POSE_SIZE - below):
            bands[below, :, column] = of_poses[:, column + below, column]
    bands[0] += prior.diagonal
    bands[POSE_SIZE] = prior.beside
    if of_steps is not None:
        for row, column in np.ndindex(POSE_SIZE, POSE_SIZE):
            bands[POSE_SIZE + row - column, :, column] += of_steps[:, row, column]
    return bands.reshape(count, -1)


class Equations(NamedTuple):
    """Normal equations of F poses, L landmarks, m boxes and, with odometry, successive poses."""

    of_landmarks: NDArray[np.float64]    # (L, 9, 9)
    of_poses: NDArray[np.float64]        # (F, 6, 6)
    of_boxes: NDArray[np.float64]        # (m, 6, 9)
    landmark_gradient: NDArray[np.float64]  # (L, 9)
    pose_gradient: NDArray[np.float64]   # (F, 6)
    of_steps: NDArray[np.float64] | None = None  # (F, 6, 6)


class Anchors(NamedTuple):
    """Known positions of L landmarks: centres (L, 3) and their deviations (L,) [m]."""

    centers: NDArray[np.float64]
    sigmas: NDArray[np.float64]


def refine_jointly(given: Views, views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                   errors: PoseErrors, iterations: int = 20, anchors: Anchors | None = None,
                   steps: Steps | None = None) -> tuple[Views, Landmarks]:
    """Refine poses and landmarks together; return the refined views and landmarks.

    The prior pulls the poses towards the given ones, anchors pull the landmarks towards their
    known positions, and steps are the odometry between successive frames. The poses start from
    those of views. At most the given number of Levenberg-Marquardt steps is taken.
    """
    problem = Problem(views, shown, PosePrior.of(views.stamps_s, errors), anchors, steps)
    state = State(views, landmarks, pose_errors(given, views))
    cost, equations = problem.linearize(state)
    damping = 1e-4
    for _ in range(iterations):
        trial = state.moved(*problem.solve(equations, damping))
        trial_cost, trial_equations = problem.linearize(trial)
        if trial_cost < cost:
            improvement = cost - trial_cost
            state, cost, equations = trial, trial_cost, trial_equations
            damping *= 0.2
            if improvement < _LEAST_IMPROVEMENT * cost:
                break
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > _MAX_DAMPING:
                break
    return state.views, state.landmarks


def pose_errors(given: Views, present: Views) -> NDArray[np.float64]:
    """Return the errors of the given poses (F, 6): x, y, z [m], rotation vector [rad].

    They are the errors of the rig's first camera. The rotation also displaces the centre of any
    other camera, by its lever.
    """
    offsets = present.centers - given.centers
    turns = np.einsum('fji,fjk->fik', present.rotations, given.rotations)
    rotvecs = Rotation.from_matrix(turns).as_rotvec()
    return np.concatenate([offsets - np.cross(rotvecs, given.levers), rotvecs], axis=1)


def pose_changes(given: Views, present: Views) -> tuple[float, float]:
    """Return the root mean square change of the poses: [m], [deg]."""
    squares = np.square(pose_errors(given, present))
    return (float(np.sqrt(squares[:, :3].sum(axis=1).mean())),
            float(np.degrees(np.sqrt(squares[:, 3:].sum(axis=1).mean()))))


class State(NamedTuple):
    """Views with their present poses, landmarks, and the errors (F, 6) of the given poses."""

    views: Views
    landmarks: Landmarks
    errors: NDArray[np.float64]

    def moved(self, landmark_steps: NDArray[np.float64], pose_steps: NDArray[np.float64]
              ) -> 'State':
        """Return the state after steps (L, 9) and (F, 6)."""
        centers = np.empty_like(self.landmarks.centers)
        bases = np.empty_like(self.landmarks.bases)
        move_all(self.landmarks.centers, self.landmarks.bases, landmark_steps, centers, bases)
        turned = Rotation.from_rotvec(pose_steps[:, 3:]).as_matrix().transpose(0, 2, 1)
        origins = self.views.centers
        rotations = np.ascontiguousarray(self.views.rotations @ turned)
        shifts = pose_steps[:, :3] + np.cross(pose_steps[:, 3:], self.views.levers)
        translations = -np.einsum('fij,fj->fi', rotations, origins + shifts)
        return State(self.views._replace(rotations=rotations, translations=translations),
                      self.landmarks._replace(centers=centers, bases=bases),
                      self.errors + pose_steps)


class Problem(NamedTuple):
    """The data that stay constant over the iterations."""

    views: Views
    shown: NDArray[np.int64]  #: (n,): the landmark that each box shows, -1 for none (m show one)
    prior: PosePrior
    anchors: Anchors | None = None
    steps: Steps | None = None

    def linearize(self, state: State) -> tuple[float, Equations]:
        """Return the cost of a state and its normal equations."""
        count, frames = len(state.landmarks.centers), len(state.errors)
        rows = np.nonzero(self.shown >= 0)[0]
        arrays = (np.zeros((count, LANDMARK_SIZE, LANDMARK_SIZE)),
                  np.zeros((frames, POSE_SIZE, POSE_SIZE)),
                  np.zeros((len(rows), POSE_SIZE, LANDMARK_SIZE)),
                  np.zeros((count, LANDMARK_SIZE)), np.zeros((frames, POSE_SIZE)))
        cost = accumulate_all(state.views, rows, self.shown[rows], state.landmarks.centers,
                           state.landmarks.bases, *arrays)
        equations = Equations(*arrays)
        if self.anchors is not None:
            weights = 1.0 / np.square(self.anchors.sigmas)[:, None]
            offsets = state.landmarks.centers - self.anchors.centers
            equations.landmark_gradient[:, :3] += weights * offsets
            equations.of_landmarks[:, np.arange(3), np.arange(3)] += weights
            cost += 0.5 * float((weights * np.square(offsets)).sum())
        pull = self.prior.gradient(state.errors)
        equations.pose_gradient[:] += pull
        cost += 0.5 * float((pull * state.errors).sum())
        if self.steps is None:
            return cost, equations
        own_cost, of_poses, of_steps, gradient = self.steps.linearize(state.views)
        return cost + own_cost, equations._replace(
            of_poses=equations.of_poses + of_poses, of_steps=of_steps,
            pose_gradient=equations.pose_gradient + gradient)

    def solve(self, equations: Equations, damping: float
              ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the steps of the landmarks (L, 9) and of the poses (F, 6)."""
        count, frames = len(equations.of_landmarks), len(equations.of_poses)
        bands = pose_bands(equations.of_poses, self.prior, equations.of_steps)
        bands[0] *= 1.0 + damping
        factor = cholesky_banded(bands, lower=True)
        of_landmarks = equations.of_landmarks.copy()
        diagonal = np.arange(LANDMARK_SIZE)
        of_landmarks[:, diagonal, diagonal] *= 1.0 + damping
        of_landmarks[:, diagonal, diagonal] += 1e-9
        coupling = self.coupling(equations.of_boxes, frames, count)
        inverses = np.linalg.inv(of_landmarks)

        def reduced(vector: NDArray[np.float64]) -> NDArray[np.float64]:
            own = np.einsum('lij,lj->li', of_landmarks, vector.reshape(count, -1)).ravel()
            return np.asarray(own - coupling.T @ cho_solve_banded((factor, True),
                                                                  coupling @ vector))

        def precondition(vector: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.einsum('lij,lj->li', inverses, vector.reshape(count, -1)).ravel()

        size = count * LANDMARK_SIZE
        of_gradient = cho_solve_banded((factor, True), equations.pose_gradient.ravel())
        right = coupling.T @ of_gradient - equations.landmark_gradient.ravel()
        steps, _ = cg(LinearOperator((size, size), matvec=reduced, dtype=np.float64), right,
                      rtol=_SOLVER_TOLERANCE, maxiter=_SOLVER_ITERATIONS,
                      M=LinearOperator((size, size), matvec=precondition, dtype=np.float64))
        poses = cho_solve_banded((factor, True),
                                 -equations.pose_gradient.ravel() - coupling @ steps)
        return steps.reshape(count, -1), poses.reshape(frames, -1)

    def coupling(self, of_boxes: NDArray[np.float64], frames: int, count: int) -> bsr_matrix:
        """Return the part (6 F, 9 L) of the equations that couples poses and landmarks."""
        rows = np.nonzero(self.shown >= 0)[0]
        order = np.lexsort((self.shown[rows], self.views.frames[rows]))
        starts = np.searchsorted(self.views.frames[rows], np.arange(frames + 1))
        return bsr_matrix((of_boxes[order], self.shown[rows][order], starts),
                          shape=(frames * POSE_SIZE, count * LANDMARK_SIZE))


def significant_pose_errors(given: Views, landmarks: Landmarks, shown: NDArray[np.int64]
                            ) -> PoseErrors | None:
    """Estimate the errors of the given poses; None if they are negligible or unknown."""
    errors = estimate_pose_errors(given, landmarks, shown, given)
    if errors is None or (errors.sigma_m < _HARMLESS.sigma_m
                          and errors.sigma_deg < _HARMLESS.sigma_deg):
        return None
    return errors


def estimated_note(errors: PoseErrors) -> str:
    """Return a note for the user about the estimated errors of the poses."""
    return (f'the poses are off by {100 * errors.sigma_m:.1f} cm, {errors.sigma_deg:.1f} degrees '
            f'over {errors.correlation_s:.1f} s, estimated from the boxes; they are refined')


def estimate_pose_errors(given: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                         start: Views) -> PoseErrors | None:
    """Estimate the errors of the given poses; None with too few boxes.

    The landmarks were fitted to the poses of start.
    """
    frames, rows = _sample(given)
    counts = np.bincount(shown[rows][shown[rows] >= 0], minlength=len(landmarks.centers))
    chosen = np.argsort(-counts, kind='stable')[:_MAX_LANDMARKS]
    chosen = chosen[counts[chosen] >= _MIN_BOXES]
    if len(frames) < _MIN_FRAMES or len(chosen) < _MIN_LANDMARKS:
        return None
    numbers = np.full(len(counts) + 1, -1)  # the last entry is for boxes without a landmark
    numbers[chosen] = np.arange(len(chosen))
    shown, landmarks = numbers[shown[rows]], landmarks.select(chosen)
    views, refined = _pick(given, frames, rows), _pick(start, frames, rows)
    errors, logs = _START, np.log([_START.sigma_m, _START.sigma_deg, _START.correlation_s, 1.0])
    for _ in range(_ROUNDS):
        refined, landmarks = refine_jointly(views, refined, landmarks, shown, errors, _REFINEMENTS)
        found = minimize(_cost_function(views, refined, landmarks, shown), logs,
                         method='Nelder-Mead', bounds=list(zip(_LOWEST, _HIGHEST, strict=True)),
                         options={'maxfev': _EVALUATIONS, 'xatol': 0.05, 'fatol': 0.1,
                                  'initial_simplex': logs + 0.7 * np.eye(5, 4, -1)})
        logs = found.x
        errors = PoseErrors(*map(float, np.exp(logs[:3])))
    return errors


def _sample(views: Views) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return one frame of each of an even sample of viewpoints, and the rows of their boxes."""
    order = np.argsort(views.viewpoints, kind='stable')
    _, firsts, counts = np.unique(views.viewpoints[order], return_index=True, return_counts=True)
    middles = np.sort(order[firsts + counts // 2])
    left_out = max(0, len(middles) - _MAX_SPAN)
    places = np.linspace(left_out // 2, len(middles) - 1 - (left_out - left_out // 2),
                         _MAX_FRAMES).astype(np.int64)
    frames = middles[np.unique(places)]
    return frames, np.nonzero(np.isin(views.frames, frames))[0]


def _pick(views: Views, frames: NDArray[np.int64], rows: NDArray[np.int64]) -> Views:
    """Return views of the given frames and rows of boxes, each frame with full weight."""
    offsets = np.searchsorted(rows, views.offsets)
    return views.select(frames, rows)._replace(
        viewpoints=np.arange(len(frames)), weights=np.ones(len(frames)),
        offsets=np.append(offsets[frames], len(rows)),
        frames=np.searchsorted(frames, views.frames[rows]))


def _cost_function(given: Views, refined: Views, landmarks: Landmarks, shown: NDArray[np.int64]
                   ) -> Callable[[NDArray[np.float64]], float]:
    """Return -log p as a function of the logarithms of sigma [m] [deg], time [s] and scale.

    The boxes are linearized at refined poses and landmarks.
    """
    frames, size = len(given.rotations), len(landmarks.centers)
    no_prior = PosePrior(np.zeros((frames, POSE_SIZE)), np.zeros((frames, POSE_SIZE)))
    problem = Problem(refined, shown, no_prior)
    errors = pose_errors(given, refined)
    _, equations = problem.linearize(State(refined, landmarks, errors))
    joint = problem.coupling(equations.of_boxes, frames, size).toarray()
    linear = linearize_boxes(refined, shown, landmarks)
    shares = refined.weights[refined.frames[linear.rows], None] * linear.weights
    squares, weights = float((shares * linear.residuals ** 2).sum()), float(shares.sum())

    def cost(logs: NDArray[np.float64]) -> float:
        sigma_m, sigma_deg, correlation_s, scale = np.exp(logs)
        prior = PosePrior.of(given.stamps_s, PoseErrors(sigma_m, sigma_deg, correlation_s))
        gain, every = scale ** -2, np.arange(size)
        bands = pose_bands(gain * equations.of_poses, prior)
        of_landmarks = np.zeros((size, 9, size, 9))
        of_landmarks[every, :, every] = gain * equations.of_landmarks + 1e-6 * np.eye(9)
        pull, coupling = prior.gradient(errors), gain * joint
        by_pose = (gain * equations.pose_gradient + pull).ravel()
        try:
            factor = cholesky_banded(bands, lower=True)
            held = cho_solve_banded((factor, True), np.column_stack([coupling, by_pose]))
            schur = of_landmarks.reshape(9 * size, -1) - coupling.T @ held[:, :-1]
            right = gain * equations.landmark_gradient.ravel() - coupling.T @ held[:, -1]
            root = cho_factor(schur, lower=True)
        except LinAlgError:
            return np.inf
        gained = by_pose @ held[:, -1] + right @ cho_solve(root, right)
        return float(0.5 * gain * squares + weights * logs[3] + 0.5 * (pull * errors).sum()
                     - 0.5 * gained + np.log(factor[0]).sum() + np.log(np.diag(root[0])).sum()
                     - 0.5 * prior.log_determinant())

    return cost


def left_by_poses(views: Views, changes: NDArray[np.float64], shown: NDArray[np.int64],
                  count: int) -> NDArray[np.float64]:
    """Return the displacement of each landmark by errors of the poses, on each axis (count,) [m].

    The mean error over the frames of a landmark remains. Errors are independent between the spans
    of time in which it was seen. Changes (F, 6) are the squares of the changes by refinement; 0
    where the
    poses were not refined.
    """
    squares = np.zeros(count)
    for row, boxes in enumerate(group_boxes(shown, count)):
        frames = np.unique(views.frames[boxes])
        spans = len(np.unique(views.stamps_s[frames] // _POSE_ERROR_S))
        if spans:
            squares[row] = changes[frames, :3].mean() / spans
    return np.sqrt(squares)


def shared_by_neighbours(views: Views, shown: NDArray[np.int64], count: int, errors: PoseErrors
                         ) -> NDArray[np.float64]:
    """Return the error of the part of the map around each landmark (count, 2) [m] [deg].

    The part consists of the landmarks that some frame shows together with this one, and of the
    frames that saw any of them. It is displaced on each axis, and rotated about the cameras that
    saw it. For a stationary process of deviation sigma and correlation exp(-|t - s| / tau), the
    mean error over n frames has the variance

        sigma^2 / n_eff,   1 / n_eff = (sum over i and j of exp(-|t_i - t_j| / tau)) / n^2.
    """
    rows = np.nonzero(shown >= 0)[0]
    seen = csr_matrix((np.ones(len(rows), dtype=np.int32), (views.frames[rows], shown[rows])),
                      shape=(len(views.rotations), count))
    # (F, L): the frame saw a landmark that some frame shows together with this one
    near = (seen @ ((seen.T @ seen) > 0).astype(np.int32)).tocsc()
    near.sort_indices()
    shares = np.array([_share_left(
        views.stamps_s[frames], views.weights[frames], errors.correlation_s)
        for frames in np.split(near.indices, near.indptr[1:-1])])
    return np.asarray(_BENDING * np.sqrt(shares)[:, None] * [errors.sigma_m, errors.sigma_deg])


@compiled
def _share_left(stamps_s, weights, correlation_s):
    """Return the variance of the weighted mean error, as a share of the variance of one error.

    The stamps ascend.
    """
    before, total, squares = 0.0, 0.0, 0.0
    for place in range(len(stamps_s)):
        if place > 0:
            step = stamps_s[place] - stamps_s[place - 1]
            kept = 1.0 if step <= INSTANT_S else 0.0
            if correlation_s > 0.0:
                kept = np.exp(-step / correlation_s)
            before = kept * (before + weights[place - 1])
        squares += weights[place] * (weights[place] + 2.0 * before)
        total += weights[place]
    return squares / (total * total) if total > 0.0 else 1.0
