"""The fit of any model: Levenberg-Marquardt for the most probable parameters.

Rows of residuals, whitened: readings, prior and uncertain commands, unknowns of their
own measurement that are eliminated. A linear model is searched along orthogonal
directions, so one step is enough whatever its units. A loss is reweighted; a level of
noise follows from the residuals and their degrees of freedom.

Sources: Marquardt, 1963, with the damping of Nielsen, 1999; Foerstner, 1979, and
MacKay, 1992 (levels of noise and prior).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.fit_problem import (
    FitProblem,
    constants,
    degrees_of_freedom,
    deleted_residuals,
    directions,
    eliminated,
    factor,
    unseen_part,
    weighted,
)
from jaxcal.checks import Array, in_words
from jaxcal.models.predictions import derivative, predict, without_effect

_LIMIT = 300  # iterations
_PATIENCE = 20  # iterations whose gain together decides whether the search creeps
_LITTLE = 1e-6  # of a gain: a step of .001 standard deviations changes no derivative
_AHEAD = 0.1  # of a step, where its curvature is looked for
_BENT = 0.75  # curvature of a step, of its length, at most
_LEAST_DAMPING = 1e-14  # keeps directions that nothing determines where they are
# What a search takes over from another one of the same measurements.
_SHARED = (
    *("parameters", "commands", "residuals", "white", "weights", "level", "facts"),
    *("fact_rows", "by_theta", "by_command", "sizes"),
)


def solve(
    problem: FitProblem, start: FitSolution | None = None, *, rough: bool = False
) -> FitSolution:
    """The most probable parameters, from the prior's mean or from ``start``, a solution
    of a problem that differs by prior, whitening, levels or loss alone; ``rough`` is to
    .1 standard deviations, the weights of the loss to .03. A ValueError where the model
    fails at the start, a derivative is not finite, or the search does not converge.
    """
    if problem.loss is not None and start is None:
        start = solve(dataclasses.replace(problem, loss=None), rough=True)
        start.weights = problem.loss.weight(start.deleted, start.num_readings)
    search = FitSolution(problem, start, rough)
    if search.direct():
        return search.finish(search.solved)
    evidence: list[float] = []
    for _ in range(_LIMIT):
        evidence.append(search.evidence)
        done = search.step()
        # Along a curved valley that the measurements hardly close, the search creeps.
        # A gain of 0.1 moves it by a third of a standard deviation, so more is asked.
        creeps = len(evidence) > _PATIENCE and not search.whole
        if creeps := creeps and search.damping < 1e-3:
            gain = evidence[-_PATIENCE] - search.evidence
            asked = max(1e-3, 0.1 * (len(evidence) // 60))
            creeps = gain < max(asked, 1e-3 * search.cost)
        slack = 100.0 if creeps else 1.0
        if search.settle(slack) and (done or creeps):
            return search.finish()
    raise ValueError(
        f"identify did not converge in {_LIMIT} iterations: start nearer with "
        "Prior(mean=...), narrow the prior, or fix parameters that the measurements "
        "do not determine"
    )


class FitSolution:
    """A search, its two moves step (parameters) and settle (levels), and its end."""

    parameters: Array  # (P,)
    commands: Array  # (N, n) as estimated; as given where they are exact
    residuals: Array  # (N, q) measured less predicted at these commands
    white: Array  # (N, q) residuals, whitened at level 1
    by_theta: Array  # (N, q, F) derivatives, whitened at level 1
    by_command: Array  # (N, q, k) likewise, by the commands that are uncertain
    level: Array  # (q,) of the noise
    weights: Array  # (N,) of the loss, 1 for least squares
    distance: Array  # (N,) squared, of each measurement from the fit, in noise
    deleted: Array  # (N,) squared, from the fit without that measurement, in noise
    num_readings: int  # of a measurement, less its unknown commands
    freedom: Array  # (q,) residual degrees of freedom of each output
    widest: Any = np.nan  # (F,) largest columns of the system yet, at level 1
    last_move: float = np.inf  # squared, of the step before in noise
    basis: Array | None = None  # (F, r) directions of a linear model
    solved: Array | None = None  # (R, r) roots of the hat matrix, if at hand
    stale: bool = False  # the parameters have moved a little since the derivatives
    root: Array | None = None  # (F, F) of the covariance, where it is at hand
    _grown: tuple[Array, Array | None] | None = None  # of the last parameters

    def __init__(
        self, problem: FitProblem, start: FitSolution | None, rough: bool
    ) -> None:
        self.problem = problem
        # 1e-6 standard deviations; 1e-5 where convergence is linear.
        self.least = 1e-2 if rough else 1e-10 if problem.loss else 1e-12
        self.change = (3e-2, 3e-2) if rough else (1e-5, 1e-4)  # of weights and levels
        q = problem.measured.shape[1]
        self.uncertain = np.asarray((problem.command_std > 0.0).any(axis=0))
        self.num_uncertain = k = int(self.uncertain.sum())
        spread = problem.command_std[:, self.uncertain]
        self.moves = spread > 0.0  # (N, k) False: exact in this measurement
        # (N, k) 0: unknown, in every measurement.
        self.command_root = 1.0 / np.where(self.moves, spread, 1.0)
        self.num_readings = q - k + np.count_nonzero(self.command_root[0])
        # From where another search ended, the derivatives are right far enough.
        self.damping, self.grow = 1e-3 if start is None else 1e-10, 2.0
        # Least squares are searched to the last digit, along curves.
        exact = not (problem.loss or self.num_uncertain)
        self.whole = exact and not (rough or problem.model.linear)
        self.freedom = np.zeros(q)
        self._share(problem.levels)
        # The last step of the logarithms of the levels, and how much of one is taken.
        self.climbed, self.trust = np.zeros(q), 1.0
        self.all_free = bool(problem.free.all())
        self.informed = bool(np.logical_and(problem.free, problem.precision).any())
        linear = problem.model.linear and not self.num_uncertain
        # As exact as its step is a linear model from zero, without a prior.
        from_zero = linear and start is None and not self.informed
        if start is None:
            zero = problem.free & from_zero
            self.parameters = np.where(zero, 0.0, problem.mean)
            self.commands = problem.commands
            if from_zero and self.all_free:
                self._take(problem.measured)  # none of which wraps
            else:
                self._predict()
            self.weights = np.ones(len(problem.measured))
            self.level = self._first_level()
            self.facts, self.fact_rows = problem.model.fitting.facts(self.parameters)
            self._linearise()
        else:
            vars(self).update({x: vars(start)[x] for x in _SHARED if x in vars(start)})
            if start.problem.white is not problem.white:
                self._take(self.residuals)
                self.level = self._first_level()
                self._linearise()
        if linear:
            self.system = rows, _, scale = self.weighted_system(0.0)
            self.basis, self.solved = directions(rows, scale)
            self.damping = _LEAST_DAMPING
            if from_zero and self.basis.shape[1] < len(self.basis):
                mean = problem.mean[problem.free]  # kept where nothing determines it
                self.parameters = self.parameters.copy()
                self.parameters[problem.free] = unseen_part(mean, self.basis)
                self._predict()

    def _share(self, levels: NDArray[np.intp]) -> None:
        """Let outputs of the same number in ``levels`` (q,) share one level."""
        self.shared, self.same = levels, 1.0 * (levels[:, None] == levels)
        self.floor = (self.same * self.problem.least_levels).max(axis=1)

    def _first_level(self) -> Array:
        """(q,) root mean square of the residuals, of the outputs that share a level."""
        if self.problem.noise_known:
            return np.ones(len(self.shared))
        square, same = self.white**2, self.same
        mean = same @ square.sum(axis=0) / (len(square) * same.sum(axis=1))
        return np.maximum(np.sqrt(mean), self.floor)

    def _changed(self, step: Array) -> Array:
        """(P,) the parameters with a step (F,) of the free ones."""
        theta = self.parameters.copy()
        theta[self.problem.free] += step
        return theta

    def whitened(self, rows: Array, theta: Array | None = None) -> Array:
        """(N, q, F) rows in noise of level 1, those of zeros by the machine's size."""
        white = weighted(self.problem.white, rows)
        theta = self.parameters if theta is None else theta
        if self._grown is None or self._grown[0] is not theta:
            self._grown = theta, self.problem.growth(theta)
        growth = self._grown[1]
        return white if growth is None else white / growth[..., None]

    def _predict(self) -> None:
        """Residuals at the present parameters and commands."""
        self._take(self._off(self.commands, self.parameters))

    def _take(self, residuals: Array) -> None:
        self.residuals = residuals
        self.white = self.whitened(residuals[..., None])[..., 0]

    def _off(self, commands: Array, theta: Array, finite: bool = True) -> Array:
        """(N, q) measured less predicted."""
        model = self.problem.model
        predicted = predict(model, commands, theta, finite=finite)
        return model.fitting.wrapped(self.problem.measured - predicted, commands)

    @functools.cached_property
    def sizes(self) -> Array:
        """(P,) of the parameters, of which a linear model needs none."""
        return self.problem.model.parameter_sizes()

    def _linearise(self) -> None:
        """Derivatives at the present parameters, whitened at level 1."""
        problem, self.stale = self.problem, False
        if self.basis is not None:  # derivatives stay what they are
            return
        rows = derivative(problem.model, self.commands, self.parameters)
        exact = problem.model.linear
        if not exact and (idle := without_effect(rows, self.sizes)).any():
            rows = np.where(idle, 0.0, rows)
        if not self.all_free:
            rows = rows.compress(problem.free, axis=-1)
        self.by_theta = self.whitened(rows)
        if self._grown is not None and self._grown[1] is not None:
            slopes = problem.growth_slopes(self.parameters)
            self.by_theta += self.white[..., None] * slopes[:, None]
        if self.num_uncertain:
            inputs = tuple(f"command {i + 1}" for i in range(len(self.uncertain)))
            rows = derivative(problem.model, self.commands, self.parameters, inputs)
            rows = rows[..., self.uncertain] * self.moves[:, None]
            self.by_command = self.whitened(rows)

    def direct(self) -> bool:
        """Take the one step that is the answer; True where that is so. Of least squares
        of a linear model without a prior, where the levels of noise, if there are
        several, each have parameters of their own."""
        problem = self.problem
        if self.basis is None or problem.loss or len(self.facts) or self.informed:
            return False
        output = None  # (F,) one that each parameter moves
        if not problem.noise_known:
            moved = (self.by_theta != 0.0).any(axis=0)  # (q, F)
            output = moved.argmax(axis=0)
            if (moved > self.same[:, output]).any():
                return False
        level, shared, basis = self.level, self.shared, self.basis
        rows, right, scale = self.system
        if self.solved is None:
            rows, right, scale = self.weighted_system(0.0)
            inverse, self.solved = factor(rows, self.damping)
            basis = basis / scale @ inverse
        cost, target = float(right @ right), self.solved.T @ right
        self.parameters = self._changed(basis @ target)
        self._predict()
        distance = self._distance(self.white, self.commands)
        gain = float(target @ target)
        as_said = abs(cost - gain - distance.sum()) <= 1e-9 * cost
        if not problem.noise_known:
            self.level = self._level()
        # Where noise is as small as rounding of what was measured, another step helps.
        exact = 1e-28 * cost * (level / self.level).max() ** 2 <= self.least
        if not (as_said and exact and self.shared is shared):
            return False
        if basis.shape[1] == len(basis):
            self.root = basis
            if output is not None:
                self.root = (self.level / level)[output, None] * basis
        return True

    def _distance(self, white: Array, commands: Array) -> Array:
        """(N,) squared distance of each measurement from the fit, in noise."""
        square = np.asarray(((white / self.level) ** 2).sum(axis=1))
        if self.num_uncertain:
            moved = (commands - self.problem.commands)[:, self.uncertain]
            square += ((moved * self.command_root) ** 2).sum(axis=1)
        return square

    @property
    def cost(self) -> float:
        """Sum of squares of readings, commands and prior, weighted."""
        return self._cost(self.white, self.parameters, self.commands, self.facts)

    @property
    def evidence(self) -> float:
        """-2 log likelihood: the cost, and what a higher level of noise costs."""
        return self.cost + 2.0 * float(self.freedom @ np.log(self.level))

    def _cost(self, white: Array, theta: Array, commands: Array, facts: Array) -> float:
        off = (theta - self.problem.mean) ** 2 @ self.problem.precision + facts @ facts
        return float(self.weights @ self._distance(white, commands) + off)

    def _reduce(self, damping: float) -> tuple[Array, Array]:
        """Rows (N, R, F) and residuals (N, R), the commands eliminated."""
        rows = self.by_theta / self.level[:, None]
        right = self.white / self.level
        if not self.num_uncertain:
            return rows, right
        by_command = self.by_command / self.level[:, None]
        moved = (self.problem.commands - self.commands)[:, self.uncertain]
        moved *= self.command_root
        rows, right, self._back = eliminated(
            rows, right, by_command, self.command_root, moved, damping
        )
        return rows, right

    def _moved(self, step: Array) -> Array:
        """(N, n) the commands after the parameters move by ``step`` (F,)."""
        commands = self.commands
        if self.num_uncertain:
            triangle, rows, right = self._back
            change = np.linalg.solve(triangle, (right - rows @ step)[..., None])[..., 0]
            commands = commands.copy()
            commands[:, self.uncertain] += change
        return commands

    def weighted_system(self, damping: float) -> tuple[Array, Array, Array]:
        """Weighted rows (R, F), residuals (R,), scale (F,): readings, prior, facts. By
        directions, (R, r) and (r,), where the model is linear."""
        rows, right = self._reduce(damping)
        weight = np.sqrt(self.weights)[:, None]
        rows *= weight[..., None]
        rows = rows.reshape(-1, rows.shape[-1])
        right = (weight * right).ravel()
        if len(self.facts) or self.informed:
            free = self.problem.free
            root = np.sqrt(self.problem.precision[free])
            off = root * (self.problem.mean - self.parameters)[free]
            rows = np.concatenate([rows, np.diag(root), self.fact_rows[:, free]])
            right = np.concatenate([right, off, self.facts])
        if self.basis is not None:
            rows = rows @ self.basis
        scale = np.sqrt((rows**2).sum(axis=0))
        scale = np.where(scale > 0.0, scale, 1.0)
        rows /= scale
        return rows, right, scale

    def step(self) -> bool:
        """Move the parameters to a lower cost; True where they need not move."""
        problem = self.problem
        cost = self.cost
        while True:
            rows, right, scale = self.weighted_system(self.damping)
            if self.whole:
                # By the largest scale so far (Moré, 1978), so that no parameter that
                # loses its effect takes ever longer steps.
                size = float(np.exp(np.log(self.level).mean()))
                self.widest = np.fmax(scale * size, self.widest)
                wide = self.widest / size
                rows, scale = rows * (scale / wide), wide
            # Of a model that is not linear the next step makes up for rounding.
            inverse, across = factor(rows, self.damping, self.basis is None)
            self.solved = across if self.damping < 1e-9 else None
            step = inverse @ (across.T @ right)
            moved = rows @ step
            rest = moved - right
            gain = float(right @ right - rest @ rest)
            last = gain <= self.least + 1e-13 * cost
            if last:  # a gain that is rounding, unless steps become shorter
                before, self.last_move = self.last_move, float(moved @ moved)
                if not (self.whole and 1e-16 < self.last_move < 0.5 * before):
                    return True
            bent = 0.0
            if self.whole and self.damping > 1e-12:
                curve = inverse @ (across.T @ self._curve(step / scale, len(right)))
                bent = 2.0 * float(np.linalg.norm(curve) / np.linalg.norm(step))
                step = step + curve
            step = step / scale if self.basis is None else self.basis @ (step / scale)
            theta = self._changed(step)
            commands = self._moved(step)
            residuals = self._off(commands, theta, finite=False)
            white = self.whitened(residuals[..., None], theta)[..., 0]
            facts, fact_rows = problem.model.fitting.facts(theta)
            with np.errstate(over="ignore"):  # a step that is too long is not taken
                after = self._cost(white, theta, commands, facts)
            if last:
                ratio = 1.0
                if not after <= cost * (1.0 + 1e-12) + 1e-12:
                    return True
            else:
                ratio = (cost - after) / gain if np.isfinite(after) else -1.0
            if bent > _BENT:
                ratio = -1.0
            if ratio > 1e-4:
                self.parameters, self.commands = theta, commands
                self.residuals, self.white = residuals, white
                self.facts, self.fact_rows = facts, fact_rows
                shrunk = self.damping * max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
                self.damping, self.grow = max(shrunk, _LEAST_DAMPING), 2.0
                self.stale = True
                # The weights of a loss move the parameters by little, many times.
                if problem.loss is None or gain > _LITTLE:
                    self._linearise()
                return False
            if gain <= problem.blur(self.white, self.level, self.weights):
                return True
            if self.damping > 1e9:  # rounding is all that is left, or
                slope = np.abs(rows.T @ right).max() / np.linalg.norm(right)
                if slope <= 1e-3:
                    return True
                raise ValueError(
                    "model.jacobian is not the derivative of model.predict: no step "
                    "along it improves the fit"
                    if np.isfinite(after)
                    else "model.predict fails near the parameters "
                    f"{in_words(self.parameters)}, which the fit reaches: narrow the "
                    "prior, or start nearer with Prior(mean=...)"
                )
            self.damping *= self.grow
            self.grow *= 2.0

    def _curve(self, step: Array, size: int) -> Array:
        """(size,) half the residuals' second derivative along a step (F,). Geodesic
        acceleration (Transtrum and Sethna, 2012): in a curved canyon the step that
        follows the curve is far longer."""
        along = np.zeros(size)
        theta = self._changed(_AHEAD * step)
        off = self._off(self.commands, theta, finite=False)
        white = self.whitened(off[..., None], theta)[..., 0]
        bent = (self.white - white) / _AHEAD - self.by_theta @ step
        bent = -bent / (_AHEAD * self.level) * np.sqrt(self.weights)[:, None]
        if np.isfinite(bent).all():
            along[: bent.size] = bent.ravel()
        return along

    def settle(self, slack: float) -> bool:
        """Weights and levels that follow from the residuals; True where they change by
        at most ``slack`` times ``self.change``."""
        problem = self.problem
        before = self.weights, np.log(self.level)
        distance = self._distance(self.white, self.commands)
        if problem.loss is not None:
            self.weights = problem.loss.weight(distance, self.num_readings)
        if not problem.noise_known:
            self._climb(distance)
        after = self.weights, np.log(self.level)
        moves = zip(after, before, self.change, strict=True)
        return all(np.abs(new - old).max() < slack * most for new, old, most in moves)

    def _level(self) -> Array:
        """(q,) sums of squares over the degrees of freedom that they have."""
        self.freedom = freedom = self._freedom(self._leverage(self.solved))
        if freedom.sum() < 1.0:
            return self.level
        shared = self.same @ freedom
        if (shared < 0.5).any():
            # What is met exactly has no level of its own, from then on.
            self._share(0 * self.shared)
            shared = self.same @ freedom
        square = self.same @ (self.weights @ self.white**2)
        if self.problem.loss is not None:
            square = square / constants(self.problem.loss, self.num_readings)[0]
        return np.maximum(np.sqrt(square / shared), self.floor)

    def _climb(self, distance: Array) -> None:
        """Move the levels towards those of the residuals."""
        change, faster = np.log(self._level() / self.level), 1.0
        if (loss := self.problem.loss) is not None:
            # The weights follow the level: Newton's step takes both at once.
            slope = loss.slope(distance, self.num_readings)
            pulled = float(distance @ (self.weights + distance * slope))
            faster = float(self.weights @ distance) / max(pulled, 1e-300)
        near = np.abs(change).max() < 0.3
        step = change * (faster if near else 1.0)
        # Levels that go back and forth may never settle: then half a step is taken.
        back = step @ self.climbed < 0.0
        self.trust = 0.5 * self.trust if back else min(1.5 * self.trust, 1.0)
        self.climbed = self.trust * step
        self.level = self.level * np.exp(self.climbed)

    def _leverage(self, root: Array | None = None) -> Array:
        """(N, R, F) roots of the hat matrix, of the readings, at any level."""
        if root is None:
            root = factor(self.weighted_system(0.0)[0], _LEAST_DAMPING)[1]
        count, width = len(self.weights), root.shape[1]
        readings = self.residuals.shape[1] + self.num_uncertain
        return root[: count * readings].reshape(count, readings, width)

    def _freedom(self, readings: Array) -> Array:
        """(q,) residual degrees of freedom of each output."""
        if not self.num_uncertain:
            return degrees_of_freedom(readings, self.residuals, self.by_theta)
        count, q = self.residuals.shape
        used = np.vecdot(readings, readings).sum(axis=0).sum()
        return np.full(q, (count * self.num_readings - used) / q)

    @functools.cached_property
    def rows(self) -> Array:
        """(N, R, F) whitened derivatives at the end, the commands eliminated."""
        return self._reduce(0.0)[0]

    def finish(self, solved: Array | None = None) -> FitSolution:
        """Itself, with what is said of the measurements where it ended; ``solved`` are
        the roots of the hat matrix there, if they are known."""
        if self.stale:
            self._linearise()
        readings = self._leverage(solved)
        uncertain = self.num_uncertain
        right = self._reduce(0.0)[1] if uncertain else self.white / self.level
        if solved is None or self.problem.noise_known:
            self.freedom = self._freedom(readings)
        self.distance = (right**2).sum(axis=1)
        if uncertain:
            self.distance = self._distance(self.white, self.commands)
        deleted = deleted_residuals(readings, right)
        self.deleted = np.maximum((right * deleted).sum(axis=1), 0.0)
        return self
