"""Runs of a caller's function: in this process or several, with failures.

A run that raises, or whose numbers are not finite, is a failure with a reason; another
shape than that of the others is an error.
"""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import pickle
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any

import numpy as np

from jaxcal.checks import Array, in_words
from jaxcal.progress import Progress

Job = tuple[Array, Array]  # commands (N, n) and parameters (p,)
# Readings (S, q) of the commands that have some, and why the others have none, by row.
Answer = tuple[Array, dict[int, str]]

_TASKS_EACH = 4  # pieces of work for each process, so that none waits long
_SOON = 0.05  # seconds: more rows are run at once, before progress is told
_TASKS = 256  # of an executor, whose size is not known


class _RunError(Exception):
    """A run of a program."""


class CommandLine:
    """A program that prints the readings of one command: its ``words``, in which
    ``{name}`` stands for a value, of ``names`` of commands, then parameters; one text
    is split as a shell does."""

    def __init__(self, words: str | Sequence[str], names: Sequence[str]) -> None:
        self.words = tuple(shlex.split(words) if isinstance(words, str) else words)
        self.names = tuple(names)
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
        done = subprocess.run(line, capture_output=True, text=True)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [""])[-1]
            raise _RunError(f"exit code {done.returncode}: {last}"[:200])
        try:
            return np.array([float(x) for x in done.stdout.replace(",", " ").split()])
        except ValueError as error:
            raise _RunError(f"standard output: {error}") from None


class Runs:
    """Runs of a caller's function, several at a time; arguments of ``FromFunction``."""

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
        parts: list[tuple[int, slice, Array | None]] = []
        reasons: list[dict[int, str]] = [{} for _ in jobs]
        total, done = sum(len(rows) for rows, _ in jobs), 0
        self._progress("runs of f", 0, total)
        try:
            for (j, rows), answer in self._answered(jobs, self._pieces(jobs)):
                parts.append((j, rows, self._checked(answer, jobs[j][0][rows])))
                reasons[j] |= {rows.start + i: why for i, why in answer[1].items()}
                done += rows.stop - rows.start
                self._progress("runs of f", done, total)
        finally:
            self._progress.clear()
        if self.num_outputs is None:
            count, first = sum(map(len, reasons)), in_words(jobs[0][0][0])
            raise ValueError(
                f"f fails for all {count} commands; for {first}: {reasons[0][0]}"
            )
        tables = [np.full((len(rows), self.num_outputs), np.nan) for rows, _ in jobs]
        for j, rows, readings in parts:
            if readings is not None:
                tables[j][rows] = readings
        return tables, reasons

    def _checked(self, answer: Answer, commands: Array) -> Array | None:
        """(N, q), NaN where there is a reason, as of what is not finite; None of
        failures alone."""
        values, why = answer
        if not len(values):
            return None
        if self.num_outputs is None:
            self.num_outputs = values.shape[1]
        if why:
            table = np.full((len(commands), values.shape[1]), np.nan)
            table[[i for i in range(len(commands)) if i not in why]] = values
            values = table
        if values.shape[1] != self.num_outputs:
            row = next(i for i in range(len(commands)) if i not in why)
            raise ValueError(_of_shape(self.num_outputs, values[row], commands[row]))
        bad = ~np.isfinite(values)
        if not bad.any():
            return values
        for i, k in np.argwhere(bad).tolist():  # the first of each row
            why.setdefault(i, f"reading {k + 1} is {values[i, k]}")
        return np.where(bad.any(axis=1, keepdims=True), np.nan, values)

    def close(self) -> None:
        """End the processes, but for those of the caller's executor."""
        if self._pool is not None and self._owned:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def _pieces(self, jobs: Sequence[Job]) -> list[tuple[int, slice]]:
        """Job and rows of each piece of work."""
        total = sum(len(rows) for rows, _ in jobs)
        size = max(1, -(-total // self._num_tasks))
        if self.processes == 1:
            size = max(total, 1)
        return [
            (j, slice(first, min(first + size, len(rows))))
            for j, (rows, _) in enumerate(jobs)
            for first in range(0, len(rows), size)
        ]

    def _answered(
        self, jobs: Sequence[Job], pieces: list[tuple[int, slice]]
    ) -> Iterator[tuple[tuple[int, slice], Answer]]:
        if self.processes == 1:
            size = 1
            for j, rows in pieces:
                (commands, parameters), first = jobs[j], 0
                while first < rows.stop:
                    part = slice(first, rows.stop if self.batch else first + size)
                    begun = time.perf_counter()
                    result = _answer(self.f, self.batch, commands[part], parameters)
                    if time.perf_counter() - begun < _SOON:
                        size *= 2
                    first += len(commands[part])
                    yield (j, slice(part.start, first)), result
            return
        try:
            broken: list[tuple[int, slice]] = []
            futures: dict[Any, tuple[int, slice]] = {}
            for j, rows in pieces:
                try:
                    future = self._submit(jobs[j][0][rows], jobs[j][1])
                except BrokenExecutor:  # an earlier run killed a worker process
                    broken.append((j, rows))
                else:
                    futures[future] = (j, rows)
            for future in concurrent.futures.as_completed(futures):
                if (answer := _result(future)) is None:
                    broken.append(futures[future])
                else:
                    yield futures[future], answer
            # A run that ends its process takes those beside it along: one by one, told
            # from the first try, whose answer a cluster would give again.
            alone = [(j, i) for j, rows in broken for i in range(rows.start, rows.stop)]
            for j, i in alone:
                self.close()
                try:
                    answer = _result(self._submit(jobs[j][0][[i]], jobs[j][1], True))
                except concurrent.futures.BrokenExecutor:  # a caller's own
                    answer = None
                self.close()
                ended = np.zeros((0, 0)), {0: "its process ended"}
                yield (j, slice(i, i + 1)), answer or ended
        except BaseException:
            self.close()
            raise

    def _submit(self, commands: Array, parameters: Array, again: bool = False) -> Any:
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
        asked = self.f, self.batch, commands, parameters
        return self._pool.submit(_answer, *asked, again)


def _result(future: Any) -> Answer | None:
    """The answer; None of a run that ended its process, dask's ``KilledWorker``."""
    try:
        answer: Answer = future.result()
    except Exception as error:
        if isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker":
            return None
        raise
    return answer


_PLAIN = {list, tuple, np.ndarray}  # of numbers, as they are taken together


def _answer(
    f: Callable[..., Any],
    batch: bool,
    commands: Array,
    parameters: Array,
    again: bool = False,  # a cluster knows what was asked by the arguments
) -> Answer:
    """The readings of each command that has them, and why the others have none."""
    if batch and len(commands) > 1:
        try:
            with np.errstate(all="ignore"):
                result = f(commands.copy(), parameters.copy())
        except Exception:  # of which command, each by itself will say
            result = None
        if result is not None:
            return _readings(result, len(commands)), {}
    results: list[Any] = []
    why: dict[int, str] = {}
    given = (commands[:, None] if batch else commands).copy()  # f may write into it
    with np.errstate(all="ignore"):
        for i, command in enumerate(given):
            try:
                results.append(f(command, parameters.copy()))
            except Exception as error:
                kind = "" if isinstance(error, _RunError) else type(error).__name__
                why[i] = f"{kind}: {error}".removeprefix(": ").splitlines()[0]
    if {*map(type, results)} <= _PLAIN:
        try:  # at once
            values = np.array(results, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.zeros(0)
        if values.ndim == 2 and values.size and not batch:
            return values, why
    rows = [_readings(result, 1 if batch else 0)[0] for result in results]
    asked = (i for i in range(len(commands)) if i not in why)
    for row, i in zip(rows, asked, strict=True):
        if len(row) != len(rows[0]):
            raise ValueError(_of_shape(len(rows[0]), row, commands[i]))
    return np.array(rows), why


def _of_shape(num_outputs: int, readings: Array, command: Array) -> str:
    return (
        f"f must return ({num_outputs},) for every command, got "
        f"({len(readings)},) for {in_words(command)}"
    )


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
