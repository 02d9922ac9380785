"""Runs of a caller's function: in this process or several, with failures.

A job is some commands with one set of parameters. A run that raises, or whose numbers
are not finite, is a failure with a reason; another shape than that of the others is an
error.
"""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import pickle
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any

import numpy as np

from jaxcal.checks import Array, in_words
from jaxcal.progress import Progress

Job = tuple[Array, Array]  # commands (N, n) and parameters (p,)
Answer = Array | str  # readings (q,), or why there are none

_TASKS_EACH = 4  # pieces of work for each process, so that none waits long
_TASKS = 256  # of an executor, whose size is not known


class _RunError(Exception):
    """A run of a program."""


class CommandLine:
    """A program that prints the readings of one command.

    Args:
        words: the program and its arguments, in which ``{name}`` stands for the value
            of a command or parameter of that name; one text is split as a shell does.
        names: of commands and parameters, in this order.
        timeout: seconds after which a run has failed.
    """

    def __init__(
        self, words: str | Sequence[str], names: Sequence[str], timeout: float | None
    ) -> None:
        self.words = tuple(shlex.split(words) if isinstance(words, str) else words)
        self.names, self.timeout = tuple(names), timeout
        if not self.words or not all(isinstance(word, str) for word in self.words):
            raise ValueError(f"f must be a program with its arguments, got {words!r}")
        if shutil.which(self.words[0]) is None:
            raise ValueError(f"f must be a program that can be run, got {words!r}")
        unused = [x for x in self.names if not any(f"{{{x}}}" in w for w in self.words)]
        if unused:
            raise ValueError(
                f"the arguments of f must contain {{{unused[0]}}}, the place of the "
                f"value of {unused[0]}, got {' '.join(self.words)!r}"
            )

    def __call__(self, command: Array, parameters: Array) -> Array:
        line = list(self.words)
        for name, value in zip(self.names, [*command, *parameters], strict=True):
            line = [word.replace(f"{{{name}}}", repr(float(value))) for word in line]
        done = subprocess.run(
            line, capture_output=True, text=True, timeout=self.timeout, check=False
        )
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [""])[-1]
            raise _RunError(f"exit code {done.returncode}: {last}"[:200])
        try:
            return np.array([float(x) for x in done.stdout.replace(",", " ").split()])
        except ValueError as error:
            raise _RunError(f"standard output: {error}") from None


class Runs:
    """Runs of a caller's function, several at a time.

    Args:
        f: one command and the parameters, or with ``batch`` many commands.
        batch: f takes commands (N, n) and returns (N, q).
        processes: that run at a time, or the caller's own executor.
        quiet: no progress on standard error.
    """

    def __init__(
        self,
        f: Callable[..., Any],
        batch: bool,
        processes: int | concurrent.futures.Executor,
        quiet: bool,
    ) -> None:
        self.f, self.batch = f, batch
        self._pool: concurrent.futures.Executor | None = None
        self._owned = isinstance(processes, int)  # else the caller closes it
        if isinstance(processes, int):
            self.processes, self._num_tasks = processes, _TASKS_EACH * processes
        else:
            self.processes, self._num_tasks, self._pool = 0, _TASKS, processes
        self.num_outputs: int | None = None  # of the first run
        self._progress = Progress(quiet=quiet)
        if self.processes > 1 and not isinstance(f, CommandLine):
            try:
                pickle.dumps(f)
            except Exception as error:
                raise ValueError(
                    "with processes above 1, f must be a function at the top of an "
                    f"importable module: {error}"
                ) from None

    def __call__(self, jobs: Sequence[Job]) -> tuple[list[Array], list[dict[int, str]]]:
        """Readings (N, q) of each job, NaN where a run failed, and why by row."""
        if self.batch and self.processes == 1:
            whole = [self._whole(*job) for job in jobs]
            if all(values is not None for values in whole):
                return [values for values in whole if values is not None], [{}] * len(
                    jobs
                )
        answers: list[list[Answer | None]] = [[None] * len(rows) for rows, _ in jobs]
        pieces = self._pieces(jobs)
        total, done = sum(len(rows) for _, rows in pieces), 0
        self._progress("runs of f", 0, total)
        try:
            for (j, rows), of_piece in self._answered(jobs, pieces):
                for i, answer in zip(rows, of_piece, strict=True):
                    answers[j][i] = self._checked(answer, jobs[j][0][i])
                done += len(rows)
                self._progress("runs of f", done, total)
        finally:
            self._progress.clear()
        q = self.num_outputs
        if q is None:
            reasons = [x for a in answers for x in a if isinstance(x, str)]
            raise ValueError(
                f"f fails for all {len(reasons)} commands; for "
                f"{in_words(jobs[0][0][0])}: {reasons[0]}"
            )
        return self._arrays(answers, q)

    def _whole(self, commands: Array, parameters: Array) -> Array | None:
        """(N, q) of a batch whose readings are as before, or the first; None: it is
        taken apart."""
        try:
            with np.errstate(all="ignore"):
                values = np.asarray(self.f(commands.copy(), parameters.copy()))
        except Exception:
            return None
        q = values.shape[-1] if values.ndim == 2 else 0
        if values.shape != (len(commands), self.num_outputs or q) or not q:
            return None
        values = values.astype(np.float64)
        if not np.isfinite(values).all():
            return None
        self.num_outputs = q
        return values

    def close(self) -> None:
        """End the processes, but for those of the caller's executor."""
        if self._pool is not None and self._owned:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def _arrays(
        self, answers: list[list[Answer | None]], q: int
    ) -> tuple[list[Array], list[dict[int, str]]]:
        values, reasons = [], []
        for of_job in answers:
            table = np.full((len(of_job), q), np.nan)
            why = {}
            for i, answer in enumerate(of_job):
                if isinstance(answer, np.ndarray):
                    table[i] = answer
                else:
                    why[i] = str(answer)
            values.append(table)
            reasons.append(why)
        return values, reasons

    def _pieces(self, jobs: Sequence[Job]) -> list[tuple[int, list[int]]]:
        """Job and rows of each piece of work."""
        total = sum(len(rows) for rows, _ in jobs)
        size = max(1, -(-total // self._num_tasks))
        if self.processes == 1:
            size = max(total, 1) if self.batch else 1
        return [
            (j, [*range(first, min(first + size, len(rows)))])
            for j, (rows, _) in enumerate(jobs)
            for first in range(0, len(rows), size)
        ]

    def _answered(
        self, jobs: Sequence[Job], pieces: list[tuple[int, list[int]]]
    ) -> Iterator[tuple[tuple[int, list[int]], list[Answer]]]:
        if self.processes == 1:
            for j, rows in pieces:
                commands, parameters = jobs[j]
                yield (j, rows), _answer(self.f, self.batch, commands[rows], parameters)
            return
        try:
            broken: list[tuple[int, list[int]]] = []
            futures: dict[Any, tuple[int, list[int]]] = {}
            answers: list[Answer]
            for j, rows in pieces:
                try:
                    future = self._submit(jobs[j][0][rows], jobs[j][1])
                except BrokenExecutor:  # an earlier run killed a worker process
                    broken.append((j, rows))
                else:
                    futures[future] = (j, rows)
            for future in concurrent.futures.as_completed(futures):
                try:
                    answers = future.result()
                except Exception as error:
                    if not _process_ended(error):
                        raise
                    broken.append(futures[future])
                else:
                    yield futures[future], answers
            # A run that ends its process takes those beside it along: one by one. What
            # is held of the first try a cluster would give as the answer again.
            futures, future = {}, None
            for j, rows in broken:
                answers = []
                for i in rows:
                    self.close()
                    try:
                        answers += self._submit(jobs[j][0][[i]], jobs[j][1]).result()
                    except Exception as error:
                        if not _process_ended(error):
                            raise
                        answers.append("its process ended")
                self.close()
                yield (j, rows), answers
        except BaseException:
            self.close()
            raise

    def _submit(self, commands: Array, parameters: Array) -> Any:
        if self._pool is None and isinstance(self.f, CommandLine):
            self._pool = concurrent.futures.ThreadPoolExecutor(self.processes)
        elif self._pool is None:
            self._pool = concurrent.futures.ProcessPoolExecutor(
                self.processes, multiprocessing.get_context("spawn")
            )
            try:
                self._pool.submit(callable, self.f).result()
            except BrokenExecutor:
                raise ValueError(
                    "with processes above 1, a new process must import f: define it at "
                    "the top of a module, and put the code that runs under `if "
                    "__name__ == '__main__':`"
                ) from None
        return self._pool.submit(_answer, self.f, self.batch, commands, parameters)

    def _checked(self, answer: Answer, command: Array) -> Answer:
        """The answer, of the shape of the first; what is not finite is a failure."""
        if isinstance(answer, str):
            return answer
        if self.num_outputs is None:
            self.num_outputs = len(answer)
        if len(answer) != self.num_outputs:
            raise ValueError(
                f"f must return ({self.num_outputs},) for every command, got "
                f"({len(answer)},) for {in_words(command)}"
            )
        finite = np.isfinite(answer)
        if finite.all():
            return answer
        bad = int(finite.argmin())
        return f"reading {bad + 1} is {answer[bad]}"


def _process_ended(error: Exception) -> bool:
    """Whether a run ended its process; ``KilledWorker`` is what dask calls it."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"


def _answer(
    f: Callable[..., Any], batch: bool, commands: Array, parameters: Array
) -> list[Answer]:
    """The readings of each command, or why it has none."""
    if batch and len(commands) > 1:
        try:
            with np.errstate(all="ignore"):
                result = f(commands.copy(), parameters.copy())
        except Exception:  # of which command, each by itself will say
            result = None
        if result is not None:
            return [*_readings(result, len(commands))]
    answers: list[Answer] = []
    for command in commands:
        argument = command[None] if batch else command
        try:
            with np.errstate(all="ignore"):
                result = f(argument.copy(), parameters.copy())
        except Exception as error:
            name = "" if isinstance(error, _RunError) else f"{type(error).__name__}: "
            answers.append(f"{name}{error}".splitlines()[0])
            continue
        answers.append(_readings(result, 1 if batch else 0)[0])
    return answers


def _readings(result: Any, rows: int) -> Array:
    """(N, q) of what f returned for ``rows`` commands, 0: for one without an axis."""
    try:
        array = np.asarray(result, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"f must return numbers, got {type(result).__name__}"
        ) from None
    if not rows and array.ndim <= 1 and array.size:
        return array.reshape(1, -1)
    if rows and array.ndim == 1 and len(array) == rows:
        return array[:, None]
    if not rows or array.ndim != 2 or len(array) != rows or not array.shape[1]:
        rule = f"({rows}, q) for {rows} commands" if rows else "(q,) for one command"
        raise ValueError(f"f must return {rule}, got {array.shape}")
    return array
