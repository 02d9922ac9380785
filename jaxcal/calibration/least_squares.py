"""The fit of any model: Levenberg-Marquardt for the most probable parameters.

Rows of residuals, whitened: readings, prior (a row for each parameter) and uncertain
commands, unknowns of their own measurement that an orthogonal projection eliminates.
A linear model is searched along orthogonal directions, so one step is enough whatever
its units. A loss is iteratively reweighted least squares. A level of noise that was not
given is estimated from the residuals and the degrees of freedom that they have.

Sources: Marquardt, 1963, with the damping of Nielsen, 1999; Lange, Little and Taylor,
1989 (losses); Foerstner, 1979, and MacKay, 1992 (levels of noise and prior).
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.losses import Loss, constants
from jaxcal.checks import Array, in_words
from jaxcal.information.blocks import gram, triangle
from jaxcal.information.singular import significant
from jaxcal.models.model import Model
from jaxcal.models.predictions import derivative, predict, without_effect

_LIMIT = 300  # iterations
_PATIENCE = 20  # iterations whose gain together decides whether the search creeps
_MANY = 64  # readings of a measurement from which matrices of them are not made
_CHOLESKY = 1e-6  # least pivot, of the largest, at which it is as exact as reflections
_ONCE = 1e-3  # likewise, at which a single one is exact to 1e-8 or so
_CLEAR = 1e8  # most by which directions differ that are determined without a doubt
_LITTLE = 1e-6  # of a gain: a step of .001 standard deviations changes no derivative
_LARGER = 0.05  # of its logarithm: no machine is larger than described by more
_TOUCHED = 4.0  # times the usual noise: most that is read of what is touched
_AHEAD = 0.1  # of a step, where its curvature is looked for
_BENT = 0.75  # curvature of a step, of its length, at most
_LEAST_DAMPING = 1e-14  # keeps directions that nothing determines where they are
# What a search takes over from another one of the same measurements.
_SHARED = (
    *("parameters", "commands", "residuals", "white", "weights", "level", "facts"),
    *("fact_rows", "by_theta", "by_command", "sizes"),
)


@dataclasses.dataclass(frozen=True)
class FitProblem:
    """N measurements of q outputs, P parameters of which F are free."""

    model: Model
    commands: Array  # (N, n)
    measured: Array  # (N, q)
    white: Array  # (N, q, q) whitening of the readings, at level 1; (N, q) a diagonal
    reading_std: Array  # (N, q) of a reading of weight 1, at level 1
    mean: Array  # (P,) of the prior
    precision: Array  # (P,) of the prior, 0 where nothing is known
    free: NDArray[np.bool_]  # (P,) False: held at the mean
    command_std: Array  # (N, n) 0 exact, inf unknown in every measurement
    noise_known: bool  # the level is 1; else it is estimated
    levels: NDArray[np.intp]  # (q,) from 0: outputs of the same number share one
    loss: Loss | None  # None: least squares
    first_log_size: Array | None  # (N,) of the model, at the prior's mean

    def growth(self, theta: Array) -> Array | None:
        """(N, 1) by which contacts' readings are larger than at the prior's mean, up to
        ``_LARGER``, or a tool would grow without end; None: by nothing."""
        log = self.model.log_size(self.commands, theta)
        if log is None or self.first_log_size is None:
            return None
        larger = np.minimum(log - self.first_log_size, _LARGER)
        return np.exp(self._zeros * larger[:, None])

    def growth_slopes(self, theta: Array) -> Array:
        """(N, F) derivative of the logarithm of ``growth``."""
        slopes = self.model.log_size_jacobian(self.commands, theta)
        log = self.model.log_size(self.commands, theta)
        if log is not None and self.first_log_size is not None:
            slopes = slopes * (log - self.first_log_size < _LARGER)[:, None]
        return self._zeros * (slopes if self.free.all() else slopes[:, self.free])

    @functools.cached_property
    def _zeros(self) -> Array:
        """(N, 1) 1 where no more was measured than contacts miss by, else 0."""
        noise = self.model.default_noise()
        most = 0.0 if noise is None else _TOUCHED * np.asarray(noise.std)
        near = np.all(np.abs(self.measured) <= most, axis=1, keepdims=True)
        return np.asarray(near, dtype=np.float64)


def solve(
    problem: FitProblem, start: FitSolution | None = None, *, rough: bool = False
) -> FitSolution:
    """The most probable parameters, from the prior's mean or from ``start``, a solution
    of a problem that differs by prior, whitening, levels or loss alone.

    ``rough`` is to .1 standard deviations, the weights of the loss to .03.

    Raises:
        ValueError: the model fails at the start, a derivative is not finite, or the
            search does not converge.
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
        creeps = len(evidence) > _PATIENCE and search.damping < 1e-3
        creeps = creeps and not search.whole
        if creeps:
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


def _weighted(matrices: Array, rows: Array) -> Array:
    """(N, q, F) rows times matrices (N, q, q), or their diagonals (N, q)."""
    return matrices[..., None] * rows if matrices.ndim == 2 else matrices @ rows


def apart(rows: Array) -> list[NDArray[np.intp]]:
    """Columns of rows (R, F) in groups that no row joins, as of independent outputs,
    so that a rounding of one is none of another."""
    filled = (rows != 0.0).astype(np.float64)
    joined = filled.T @ filled > 0.0
    np.fill_diagonal(joined, True)
    if joined.all():
        return [np.arange(rows.shape[1])]
    while (more := joined.astype(np.float64) @ joined > 0.0).sum() > joined.sum():
        joined = more
    first = joined.argmax(axis=1)  # column of the group of each
    return [np.flatnonzero(first == column) for column in dict.fromkeys(first)]


def singular(rows: Array) -> list[tuple[NDArray[np.intp], Array, Array]]:
    """For each group of ``apart`` columns (c,) of F or more rows (R, F): these,
    singular values, right vectors (c, c)."""
    groups = apart(rows)
    sizes = {len(columns) for columns in groups}
    if len(sizes) == 1 and len(rows) <= 128:  # all at once
        of_groups = rows.T[np.array(groups)].transpose(0, 2, 1)
        _, size, right = np.linalg.svd(of_groups, full_matrices=False)
        return list(zip(groups, size, right, strict=True))
    factors = [np.linalg.svd(triangle(rows[:, columns])) for columns in groups]
    return [(groups[i], size, right) for i, (_, size, right) in enumerate(factors)]


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
    widest: Array | None = None  # (F,) largest columns of the system yet, at level 1
    last_move: float = np.inf  # squared, of the step before in noise
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
        # (R, r) roots of the hat matrix, hardly damped, where a step had them.
        self.solved: Array | None = None
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
        self.basis: Array | None = None  # (F, r) directions of a linear model
        self.freedom = np.zeros(q)
        self._share(problem.levels)
        # The last step of the logarithms of the levels, and how much of one is taken.
        self.climbed, self.trust = np.zeros(q), 1.0
        self.all_free = bool(problem.free.all())
        self.informed = bool(np.logical_and(problem.free, problem.precision).any())
        linear = problem.model.linear and not self.num_uncertain
        # From zero a linear model without a prior is as exact as its step.
        from_zero = linear and start is None and not self.informed
        if start is None:
            self.parameters, self.commands = problem.mean, problem.commands
            if from_zero:
                self.parameters = np.where(problem.free, 0.0, problem.mean)
            if from_zero and self.all_free:
                self._take(problem.measured)
            else:
                self._predict()
            self.weights = np.ones(len(problem.measured))
            self.level = self._first_level()
            self.facts, self.fact_rows = problem.model.facts(self.parameters)
            self._linearise()
        else:
            for name in _SHARED:
                if name in vars(start):
                    setattr(self, name, getattr(start, name))
            if start.problem.white is not problem.white:
                self._take(start.residuals)
                self.level = self._first_level()
                self._linearise()
        if linear:
            self.basis, self.damping = self._directions(), _LEAST_DAMPING
            if from_zero and self.basis.shape[1] < len(self.basis):
                self._keep_undetermined()

    @functools.cached_property
    def sizes(self) -> Array:
        """(P,) of the parameters."""
        return self.problem.model.parameter_sizes()

    def _share(self, levels: NDArray[np.intp]) -> None:
        """Let outputs of the same number in ``levels`` (q,) share one level. The least
        level of contacts, whose readings are zero, is in usual noise."""
        self.shared, self.same = levels, 1.0 * (levels[:, None] == levels)
        self.floor = np.zeros(len(levels))
        if not self.problem.noise_known:
            readings = _weighted(self.problem.white, self.problem.measured[..., None])
            largest = np.abs(readings).max(axis=(0, 2))
            if not largest.all():
                largest[largest == 0.0] = largest.max() or 1e7
            self.floor = (self.same * (1e-13 * largest)).max(axis=1)

    def _first_level(self) -> Array:
        """(q,) root mean square of the residuals, of the outputs that share a level."""
        if self.problem.noise_known:
            return np.ones(len(self.shared))
        square, same = self.white**2, self.same
        mean = same @ square.sum(axis=0) / (len(square) * same.sum(axis=1))
        return np.maximum(np.sqrt(mean), self.floor)

    def _changed(self, step: Array) -> Array:
        """(P,) the parameters with a step (F,) of the free ones."""
        if self.all_free:
            return self.parameters + step
        theta = self.parameters.copy()
        theta[self.problem.free] += step
        return theta

    def _take(self, residuals: Array) -> None:
        self.residuals = residuals
        self.white = self.whitened(residuals[..., None])[..., 0]

    def whitened(self, rows: Array, theta: Array | None = None) -> Array:
        """(N, q, F) rows in noise of level 1, those of zeros by the machine's size."""
        white = _weighted(self.problem.white, rows)
        theta = self.parameters if theta is None else theta
        if self._grown is None or self._grown[0] is not theta:
            self._grown = theta, self.problem.growth(theta)
        growth = self._grown[1]
        return white if growth is None else white / growth[..., None]

    def _predict(self) -> None:
        """Residuals at the present parameters and commands."""
        self._take(self._off(self.commands, self.parameters))

    def _off(self, commands: Array, theta: Array, finite: bool = True) -> Array:
        """(N, q) measured less predicted."""
        model = self.problem.model
        predicted = predict(model, commands, theta, finite=finite)
        return model.wrapped(self.problem.measured - predicted, commands)

    def _linearise(self) -> None:
        """Derivatives at the present parameters, whitened at level 1."""
        problem, self.stale = self.problem, False
        if self.basis is not None:  # derivatives stay what they are
            return
        rows = derivative(problem.model, self.commands, self.parameters)
        if not problem.model.linear:  # those of a linear model are exact
            if (idle := without_effect(rows, self.sizes)).any():
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

    def _directions(self) -> Array:
        """(F, r) changes of the parameters, those that nothing determines left out.
        Orthogonal in what they change, the readings in noise and the prior."""
        rows, _, scale = self.system = self._system(0.0)
        inverse, across = _cholesky(rows, 0.0)
        # The least singular value is above one over the length of the inverse.
        if inverse is not None and np.vdot(inverse, inverse) * len(scale) < _CLEAR**2:
            self.solved = across
            return inverse / scale[:, None]
        if len(rows) < len(scale):
            rows = np.concatenate([rows, np.zeros((len(scale), len(scale)))])
        directions = []
        for columns, size, right in singular(rows):
            determined = np.flatnonzero(significant(size))
            block = np.zeros((rows.shape[1], len(determined)))
            turned = right[determined] / size[determined, None] / scale[columns]
            block[columns] = turned.T
            directions.append(block)
        return np.hstack(directions)

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
            rows, right, scale = self._system(0.0)
            inverse, self.solved = _factor(rows, self.damping)
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

    def _keep_undetermined(self) -> None:
        """Move to the prior's mean in directions that nothing determines."""
        problem, basis = self.problem, np.asarray(self.basis)
        mean, size = problem.mean[problem.free], np.linalg.norm(basis, axis=1)
        size = np.where(size > 0.0, size, 1.0)
        shown = np.linalg.lstsq(basis / size[:, None], mean / size, rcond=None)[0]
        self.parameters = self.parameters.copy()
        self.parameters[problem.free] = mean - basis @ shown
        self._predict()

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
        k = self.num_uncertain
        if not k:
            return rows, right
        by_command = self.by_command / self.level[:, None]
        command_rows = self.command_root[..., None] * np.eye(k)
        by_command = np.concatenate([by_command, command_rows], axis=1)
        length = np.sqrt((by_command**2).sum(axis=1))[:, :, None] * np.eye(k)
        by_command = np.concatenate([by_command, np.sqrt(damping) * length], axis=1)
        moved = (self.problem.commands - self.commands)[:, self.uncertain]
        right = np.concatenate([right, moved * self.command_root, 0.0 * moved], axis=1)
        turn, triangle = np.linalg.qr(by_command, mode="complete")
        turn = np.matrix_transpose(turn)
        rows = turn[..., : rows.shape[1]] @ rows
        right = (turn @ right[..., None])[..., 0]
        self._back = triangle[:, :k], rows[:, :k], right[:, :k]
        return rows[:, k:], right[:, k:]

    def _moved(self, step: Array) -> Array:
        """(N, n) the commands after the parameters move by ``step`` (F,)."""
        commands = self.commands
        if self.num_uncertain:
            triangle, rows, right = self._back
            change = np.linalg.solve(triangle, (right - rows @ step)[..., None])[..., 0]
            commands = commands.copy()
            commands[:, self.uncertain] += change
        return commands

    def _system(self, damping: float) -> tuple[Array, Array, Array]:
        """Weighted rows (R, F), residuals (R,), scale (F,): readings, prior, facts. By
        directions, (R, r) and (r,), where the model is linear."""
        rows, right = self._reduce(damping)
        weight = np.sqrt(self.weights)[:, None]
        rows = (weight[..., None] * rows).reshape(-1, rows.shape[-1])
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
        return rows / scale, right, scale

    def step(self) -> bool:
        """Move the parameters to a lower cost; True where they need not move."""
        problem = self.problem
        cost = self.cost
        while True:
            rows, right, scale = self._system(self.damping)
            if self.whole:
                rows, scale = self._widened(rows, scale)
            # Of a model that is not linear the next step makes up for rounding.
            inverse, across = _factor(rows, self.damping, self.basis is None)
            self.solved = across if self.damping < 1e-9 else None
            step = inverse @ (across.T @ right)
            rest = rows @ step - right
            gain = float(right @ right - rest @ rest)
            last = gain <= self.least + 1e-13 * cost
            if last and not self._still_falls(rows @ step):
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
            facts, fact_rows = problem.model.facts(theta)
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
            if gain <= self._blur():
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

    def _blur(self) -> float:
        """By how much the noise of the model itself may change the cost."""
        noise = self.problem.model.rounding
        if noise is None or self.problem.white.ndim > 2:
            return 0.0
        off = self.problem.white * noise / self.level
        share = np.sqrt(self.weights)[:, None]
        beside = np.linalg.norm(share**2 * off * self.white / self.level)
        return float(4.0 * beside + 2.0 * np.linalg.norm(share * off) ** 2)

    def _widened(self, rows: Array, scale: Array) -> tuple[Array, Array]:
        """Rows and scale (F,) by the largest scale so far (Moré, 1978), so that no
        parameter that loses its effect takes ever longer steps."""
        size = float(np.exp(np.log(self.level).mean()))
        self.widest = np.fmax(
            scale * size, np.nan if self.widest is None else self.widest
        )
        wide = self.widest / size
        return rows * (scale / wide), wide

    def _still_falls(self, moved: Array) -> bool:
        """Whether steps whose gain is rounding, by (R,) in noise, become shorter."""
        before, self.last_move = self.last_move, float(moved @ moved)
        return self.whole and 1e-16 < self.last_move < 0.5 * before

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
        return all(
            np.abs(new - old).max() < slack * limit
            for new, old, limit in zip(after, before, self.change, strict=True)
        )

    def _level(self) -> Array:
        """(q,) sums of squares over the degrees of freedom that they have."""
        self.freedom = freedom = self._freedom(self._leverage(self.solved))
        if freedom.sum() < 1.0:
            return self.level
        square = self.weights @ self.white**2
        shared = self.same @ freedom
        if (shared < 0.5).any():
            # What is met exactly has no level of its own, from then on.
            self._share(0 * self.shared)
            shared = self.same @ freedom
        square = self.same @ square
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
            root = _factor(self._system(0.0)[0], _LEAST_DAMPING)[1]
        count, width = len(self.weights), root.shape[1]
        readings = self.residuals.shape[1] + self.num_uncertain
        return root[: count * readings].reshape(count, readings, width)

    def _freedom(self, readings: Array) -> Array:
        """(q,) residual degrees of freedom of each output."""
        count, q = self.residuals.shape
        used = np.vecdot(readings, readings).sum(axis=0)
        if self.num_uncertain:
            return np.full(q, (count * self.num_readings - used.sum()) / q)
        freedom = count - used
        if (met := self.residuals == 0.0).any():
            # A reading that nothing moves and that is met is none, as where the sensors
            # of one arm have different numbers of readings.
            freedom -= (met & (self.by_theta == 0.0).all(axis=-1)).sum(axis=0)
        whole = np.rint(freedom)
        return np.where(np.abs(freedom - whole) < 1e-9, whole, freedom)

    @functools.cached_property
    def rows(self) -> Array:
        """(N, R, F) whitened derivatives at the end, the commands eliminated."""
        return self._reduce(0.0)[0]

    def finish(self, solved: Array | None = None) -> FitSolution:
        """Itself, with what is said of the measurements where it ended; ``solved`` are
        the roots of the hat matrix there, if they are known."""
        if self.stale:
            self._linearise()
        readings, uncertain = self._leverage(solved), self.num_uncertain
        right = self._reduce(0.0)[1] if uncertain else self.white / self.level
        if solved is None or self.problem.noise_known:
            self.freedom = self._freedom(readings)
        self.distance = (right**2).sum(axis=1)
        if uncertain:
            self.distance = self._distance(self.white, self.commands)
        deleted = _deleted(readings, right)
        self.deleted = np.maximum((right * deleted).sum(axis=1), 0.0)
        return self


def _deleted(readings: Array, right: Array) -> Array:
    """(N, R) residuals of each measurement from the fit without it, by roots of the hat
    matrix (N, R, F) and residuals ``right`` (N, R)."""
    count, columns = readings.shape[1:]
    back = readings.transpose(0, 2, 1)
    if count <= max(_MANY, columns):
        gap = (1.0 + 1e-9) * np.eye(count) - readings @ back
        return np.asarray(np.linalg.solve(gap, right[..., None])[..., 0])
    one = 1.0 + 1e-9  # by the F columns, of a trajectory of many readings
    inner = one * np.eye(columns) - back @ readings
    along = np.linalg.solve(inner, back @ right[..., None])
    return np.asarray((right + (readings @ along)[..., 0]) / one)


def _factor(rows: Array, damping: float, once: bool = False) -> tuple[Array, Array]:
    """The inverse of R (F, F), and Q (R, F), of the damped rows (R, F); ``once``: 1e-8
    or so is enough."""
    inverse, across = _cholesky(rows, damping, once)
    if inverse is not None:
        return inverse, across
    damp = np.sqrt(damping) * np.eye(rows.shape[1])
    whole, triangle = np.linalg.qr(np.concatenate([rows, damp]))
    return np.linalg.inv(triangle), whole[: len(rows)]


def _cholesky(
    rows: Array, damping: float, once: bool = False
) -> tuple[Array | None, Array]:
    """The inverse of R, and Q of the damped rows (R, F); None where it is not exact.
    Cholesky twice (Yamamoto et al., 2015) is as exact as Householder's reflections
    where it succeeds, and does not wait for BLAS's threads in every column."""
    from scipy.linalg.lapack import dpotrf, dtrtri

    turned, inverse = rows, None
    for _ in range(2):
        square = gram(turned)
        if damping and inverse is None:
            square += damping * np.eye(len(square))
        elif damping and inverse is not None:
            square += damping * (inverse.T @ inverse)
        root, failed = dpotrf(square)
        size = root.diagonal().tolist()
        if failed or (size and min(size) < _CHOLESKY * max(size)):
            return None, rows
        step = dtrtri(root)[0]
        inverse = step if inverse is None else inverse @ step
        turned = rows @ inverse
        if once and min(size) > _ONCE * max(size):
            break
    return inverse, turned
