# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refine landmarks and poses together.

A prior on their errors keeps the poses near the given ones (PosePrior). Odometry, if available,
joins successive frames (cliploc_ros.offline.mapping.odometry). Box edges give the same residuals
as in cliploc_ros.offline.mapping.fitting.

The normal equations have a block for each landmark, blocks for each pose and its successor, and
a block for each box, which couples a pose and a landmark. The poses, whose part is banded, are
eliminated. The reduced system of the landmarks is solved by conjugate gradients, so that memory
grows only with the number of boxes (Agarwal et al., "Bundle Adjustment in the Large", ECCV 2010).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import bsr_matrix
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial.transform import Rotation

from cliploc_ros.offline.mapping.fitting import accumulate_all, move_all
from cliploc_ros.offline.mapping.landmarks import LANDMARK_SIZE, POSE_SIZE, Landmarks
from cliploc_ros.offline.mapping.odometry import Steps
from cliploc_ros.offline.mapping.options import INSTANT_S, PoseErrors
from cliploc_ros.offline.mapping.views import Views

_SOLVER_ITERATIONS = 200
_SOLVER_TOLERANCE = 1e-3
_LEAST_IMPROVEMENT = 1e-3
_MAX_DAMPING = 1e4


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
