"""Runs of a caller's function: in this process or several, kept on disk, with failures.

A job is some commands with one set of parameters. A run that raises, or whose numbers
are not finite, is a failure with a reason; another shape than that of the others is an
error. Runs that were made before are read from a file where the caller names one.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import hashlib
import multiprocessing
import os
import pathlib
import pickle
import shlex
import shutil
import sqlite3
import subprocess
import time
import types
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import in_words
from jaxcal.progress import Progress

Array = NDArray[np.float64]
Job = tuple[Array, Array]  # commands (N, n) and parameters (p,)
Answer = Array | str  # readings (q,), or why there are none

_EVERY = 2.0  # seconds between writings of runs to the disk
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

    def content(self) -> bytes:
        """Bytes that differ where results may: the words, and the files they name."""
        parts = [*self.words]
        for word in self.words:
            path = pathlib.Path(shutil.which(word) or word)
            if path.is_file():
                parts.append(hashlib.sha256(path.read_bytes()).hexdigest())
        return "\0".join(parts).encode()


class Runs:
    """Runs of a caller's function, several at a time; made ones are read from a file.

    Args:
        f: one command and the parameters, or with ``batch`` many commands.
        batch: f takes commands (N, n) and returns (N, q).
        processes: that run at a time, or the caller's own executor.
        cache: file of runs, made where it does not exist; None: nothing is kept.
        quiet: no progress on standard error.
    """

    def __init__(
        self,
        f: Callable[..., Any],
        batch: bool,
        processes: int | concurrent.futures.Executor,
        cache: str | os.PathLike[str] | None,
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
        self._kept = None if cache is None else _Cache(cache, _content(f))
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
        if self.batch and self.processes == 1 and self._kept is None:
            whole = [self._whole(*job) for job in jobs]
            if all(values is not None for values in whole):
                return [values for values in whole if values is not None], [{}] * len(
                    jobs
                )
        answers: list[list[Answer | None]] = [[None] * len(rows) for rows, _ in jobs]
        if self._kept is not None:
            answers = [self._kept.read(*job) for job in jobs]
        pieces = self._pieces(jobs, answers)
        total, done = sum(len(rows) for _, rows in pieces), 0
        self._progress("runs of f", 0, total)
        try:
            for (j, rows), of_piece in self._answered(jobs, pieces):
                for i, answer in zip(rows, of_piece, strict=True):
                    answers[j][i] = self._checked(answer, jobs[j][0][i])
                if self._kept is not None:
                    self._kept.write(jobs[j], rows, answers[j])
                done += len(rows)
                self._progress("runs of f", done, total)
        finally:
            self._progress.clear()
            if self._kept is not None:
                self._kept.flush()
        q = self.num_outputs
        if q is None:  # known from files alone, or not at all
            sizes = {len(x) for a in answers for x in a if isinstance(x, np.ndarray)}
            self.num_outputs = q = sizes.pop() if sizes else None
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

    def _pieces(
        self, jobs: Sequence[Job], answers: list[list[Answer | None]]
    ) -> list[tuple[int, list[int]]]:
        """Job and rows of each piece of work."""
        open_rows = [
            (j, [i for i, answer in enumerate(of_job) if answer is None])
            for j, of_job in enumerate(answers)
        ]
        total = sum(len(rows) for _, rows in open_rows)
        size = max(1, -(-total // self._num_tasks))
        if self.processes == 1:
            size = max(total, 1) if self.batch else 1
        return [
            (j, rows[first : first + size])
            for j, rows in open_rows
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


class _Cache:
    """Runs in a file of SQLite; those of another f are other runs."""

    def __init__(self, path: str | os.PathLike[str], content: bytes) -> None:
        self._path, self._content = os.fspath(path), content
        self._waiting: list[tuple[bytes, bytes]] = []
        self._written = time.monotonic()
        try:
            with self._opened() as file:
                file.execute(
                    "CREATE TABLE IF NOT EXISTS runs (key BLOB PRIMARY KEY, value BLOB)"
                )
        except sqlite3.Error as error:
            raise ValueError(f"cache {path} is not a file of runs: {error}") from None

    @contextlib.contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        """Committed when the block succeeds."""
        connection = sqlite3.connect(self._path, timeout=60.0)
        with contextlib.closing(connection), connection:
            yield connection

    def _keys(self, commands: Array, parameters: Array) -> list[bytes]:
        first = hashlib.sha256(self._content)
        first.update(parameters.tobytes())
        keys = []
        for command in commands:
            whole = first.copy()
            whole.update(command.tobytes())
            keys.append(whole.digest())
        return keys

    def read(self, commands: Array, parameters: Array) -> list[Answer | None]:
        found: list[Answer | None] = []
        with self._opened() as file:
            for key in self._keys(commands, parameters):
                row = file.execute("SELECT value FROM runs WHERE key = ?", (key,))
                value = row.fetchone()
                found.append(None if value is None else np.frombuffer(value[0]).copy())
        return found

    def write(self, job: Job, rows: list[int], answers: list[Answer | None]) -> None:
        """Keep the answers of ``rows``; not failures, which may not be so again."""
        commands, parameters = job
        keys = self._keys(commands[rows], parameters)
        self._waiting += [
            (key, answer.tobytes())
            for key, answer in zip(keys, (answers[i] for i in rows), strict=True)
            if isinstance(answer, np.ndarray)
        ]
        if time.monotonic() > self._written + _EVERY:
            self.flush()

    def flush(self) -> None:
        """Put what waits on the disk."""
        if self._waiting:
            with self._opened() as file:
                file.executemany(
                    "INSERT OR REPLACE INTO runs VALUES (?, ?)", self._waiting
                )
        self._waiting, self._written = [], time.monotonic()


def _content(f: Any) -> bytes:
    """What tells one f from another: its code and what it holds.

    Functions that it calls, and files that it reads, are not looked at.
    """
    if isinstance(f, CommandLine):
        return f.content()
    if isinstance(f, types.FunctionType):
        held = [f.__defaults__, *(cell.cell_contents for cell in f.__closure__ or ())]
        code = repr(_code(f.__code__)).encode()
        return code + b"".join(_content(one) for one in held)
    try:
        return pickle.dumps(f)
    except Exception as error:
        raise ValueError(
            f"leave out cache: f holds data that cannot be compared: {error}"
        ) from None


def _code(code: types.CodeType) -> tuple[Any, ...]:
    constants = [
        _code(x) if isinstance(x, types.CodeType) else x for x in code.co_consts
    ]
    return code.co_code, code.co_names, constants
