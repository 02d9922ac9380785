"""A job of several processes: who takes part, and what happens when one is lost.

Every process runs the same command. It learns of the others from ``--coordinator``,
``--num-processes`` and ``--process-id``, or from what JAX finds under SLURM, Open MPI,
Kubernetes and on Cloud TPU. JAX aborts a process whose partner died, with a page of
traces; so the work is done in a child, and the parent, which holds no JAX, says in one
line what happened. Nothing here imports JAX before the fork.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import pathlib
import re
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NoReturn

__all__ = [
    "EXIT_LOST",
    "HEARTBEAT_SECONDS",
    "LostProcessError",
    "add_arguments",
    "expected",
    "local_device_ids",
    "losing_a_process",
    "run_job",
    "supervise",
]

EXIT_LOST = 3  # another process of the job is gone
HEARTBEAT_SECONDS = 20  # silence after which a process counts as lost
_CONNECT_SECONDS = 300  # for all processes to come together
_LEAVE_SECONDS = 3600  # for the first to write, when the others are done
_SAYS = "jaxcal: "  # begins a line of the log that is meant for the parent


class LostProcessError(RuntimeError):
    """A collective failed because another process of the job is gone."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The three flags that name a job."""
    group = parser.add_argument_group(
        "several processes", "found by itself under SLURM, Open MPI and on Cloud TPU"
    )
    group.add_argument(
        "--coordinator", metavar="HOST:PORT", help="of process 0; the same everywhere"
    )
    group.add_argument("--num-processes", type=int, metavar="N")
    group.add_argument("--process-id", type=int, metavar="I", help="0 to N - 1")


def expected(job: argparse.Namespace, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether this process is one of several, or may be.

    Raises:
        ValueError: naming the flag, the rule and the value.
    """
    address, number, own = job.coordinator, job.num_processes, job.process_id
    if number is not None and number < 1:
        raise ValueError(f"--num-processes must be at least 1, got {number}")
    if own is not None and (number is None or not 0 <= own < number):
        limit = "--num-processes" if number is None else number
        raise ValueError(f"--process-id must be in [0, {limit}), got {own}")
    if address is not None:
        if not re.fullmatch(r".+:\d+", address):
            raise ValueError(f"--coordinator must be HOST:PORT, got {address!r}")
        if number is None or own is None:
            raise ValueError("--coordinator needs --num-processes and --process-id")
    if number is None or number == 1:
        return number is None and _cluster(environ)
    if own is None or (address is None and not _cluster(environ)):
        raise ValueError("--num-processes needs --coordinator and --process-id")
    return True


def _cluster(environ: Mapping[str, str]) -> bool:
    """Whether a launcher that JAX knows started several of these processes."""
    if environ.get("SLURM_NTASKS", "1") != "1":
        # A batch script has this, too, but is no task of its own job step.
        return "SLURM_STEP_NODELIST" in environ
    if environ.get("OMPI_COMM_WORLD_SIZE", "1") != "1":
        return True
    if "," in environ.get("TPU_WORKER_HOSTNAMES", ""):
        return True
    several = ("JAX_COORDINATOR_ADDRESS", "MEGASCALE_COORDINATOR_ADDRESS")
    if any(name in environ for name in (*several, "JOB_COMPLETION_INDEX")):
        return True
    # A Cloud TPU machine keeps its slice in its metadata, which only JAX reads.
    return any(map(os.path.exists, ("/dev/accel0", "/dev/vfio/0")))


def local_device_ids(environ: Mapping[str, str] = os.environ) -> list[int] | None:
    """Which of the GPUs that a SLURM task sees are its own; None leaves it to JAX.

    JAX gives the i-th task of a machine the i-th GPU. That is wrong where SLURM already
    shows each task only its own (``--gpus-per-task``), and where one task has a whole
    machine.
    """
    visible = environ.get("CUDA_VISIBLE_DEVICES", "")
    if not visible or "SLURM_PROCID" not in environ:
        return None
    number = len(visible.split(","))
    tasks = environ.get("SLURM_STEP_TASKS_PER_NODE", "")
    own = number == 1 or re.fullmatch(r"1(\(x\d+\))?", tasks)
    return (
        list(range(number)) if own and "JAX_LOCAL_DEVICE_IDS" not in environ else None
    )


def run_job(
    program: str, argv: list[str] | None, work: Callable[[], int], advice: str
) -> int:
    """Run a command that may be one process of a job; its exit code.

    Args:
        program: begins every message.
        argv: its arguments; those of the process when None.
        work: the command itself.
        advice: how to go on when a process was lost.
    """
    flags = argparse.ArgumentParser(
        add_help=False, allow_abbrev=False, exit_on_error=False
    )
    add_arguments(flags)
    try:
        job, _ = flags.parse_known_args(argv)
        if not expected(job):
            return work()
        os.environ.pop("TF_CPP_MIN_LOG_LEVEL", None)  # what JAX logs is read below
    except (ValueError, argparse.ArgumentError) as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 2

    def joined() -> int:
        import jax

        try:
            _connect(job)
            code = work()
            if code == 0 and jax.distributed.is_initialized():
                sys.stdout.flush()
                jax.distributed.shutdown()  # whoever does not wait counts as lost
            return code
        except LostProcessError as error:
            _note(f"{_SAYS}{error}")
            return EXIT_LOST
        except ValueError as error:
            print(f"{program}: {error}", file=sys.stderr)
            return 2

    return supervise(program, joined, advice)


def _note(text: str) -> None:
    """Write where the runtime writes: into the log that the parent reads."""
    os.write(2, f"{text}\n".encode())


def _connect(job: argparse.Namespace) -> None:
    """Join the job, before anything else of JAX is used.

    Raises:
        ValueError: the job is not described completely.
        LostProcessError: not every process came in time.
    """
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            job.coordinator,
            job.num_processes,
            job.process_id,
            local_device_ids=local_device_ids(),
            initialization_timeout=_CONNECT_SECONDS,
            heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
            shutdown_timeout_seconds=_LEAVE_SECONDS,
        )
    except ValueError:
        if job.num_processes is None:
            return  # none of JAX's detections found a job: this process is alone
        raise
    except RuntimeError as error:
        raise LostProcessError(
            f"not every process came to {job.coordinator or 'the coordinator'} in "
            f"{_CONNECT_SECONDS} s ({str(error).splitlines()[0][:120]})"
        ) from None
    _note(f"{_SAYS}process {jax.process_index()} of {jax.process_count()}")


@contextlib.contextmanager
def losing_a_process() -> Iterator[None]:
    """Turn what a collective raises into ``LostProcessError``, in a job of several.

    JAX names the lost process when its heartbeat has been missing long enough, and ends
    this one: that is waited for, so that the message can say which it was.
    """
    import jax

    try:
        yield
    except (RuntimeError, ValueError) as error:
        if jax.process_count() == 1:
            raise
        _note(traceback.format_exc())
        time.sleep(2 * HEARTBEAT_SECONDS)
        raise LostProcessError("another process of the job was lost") from error


def supervise(program: str, run: Callable[[], int], advice: str) -> int:
    """Run in a child, and say in one line if the job lost a process.

    Args:
        program: begins the line.
        run: the work; its exit code is passed on.
        advice: ends the line: how to go on.

    Returns:
        The child's exit code; ``EXIT_LOST`` where another process was lost, and 128 + n
        where signal n ended this one.
    """
    if not hasattr(os, "fork"):
        return run()
    sys.stdout.flush()
    sys.stderr.flush()
    descriptor, name = tempfile.mkstemp(prefix="jaxcal-runtime-", suffix=".log")
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        _work(run, parent, descriptor)
    os.close(descriptor)

    def pass_on(number: int, frame: Any) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, pass_on)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    log = pathlib.Path(name)
    text = log.read_text(errors="replace")
    if code >= 0 and code != EXIT_LOST:
        log.unlink()
        return code
    who, what, lost = "this process", "", _lost(text)
    for said in re.findall(f"^{_SAYS}(.*)$", text, re.MULTILINE):
        if re.fullmatch(r"process \d+ of \d+", said):
            who = said
        else:
            what = f"stops: {said}"
    if code == EXIT_LOST or (code == -signal.SIGABRT and lost):
        what = what or f"stops: {lost or 'another process of the job'} was lost"
        code = EXIT_LOST
    else:
        what = f"was ended by signal {-code} ({signal.Signals(-code).name})"
        code = 128 - code
    print(f"{program}: {who} {what}; {advice} (log: {log})", file=sys.stderr)
    return code


def _work(run: Callable[[], int], parent: int, log: int) -> NoReturn:
    """The child: Python's output as before, that of the runtime below into the log."""
    os.setpgid(0, 0)  # a Ctrl-C of the terminal comes once, through the parent
    for stream in ("stdout", "stderr"):
        old = getattr(sys, stream)
        kept = os.dup(old.fileno())
        os.dup2(log, old.fileno())
        new = open(kept, "w", encoding=old.encoding, buffering=1, errors=old.errors)
        setattr(sys, stream, new)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(EXIT_LOST)

    threading.Thread(target=watch, daemon=True).start()
    code: Any = 1
    try:
        code = run()
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else 1
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # without the farewell barrier, which would wait for the lost


def _lost(log: str) -> str | None:
    """Which processes JAX's coordination service says are gone."""
    found = re.search(r"stopped sending heartbeats\):\n((?:.*\n)*?)The tasks", log)
    if found:
        names = sorted(set(re.findall(r"\d+", found.group(1))), key=int)
        return ", ".join(f"process {name}" for name in names)
    if "Failed to send RPC to coordination service" in log or "Socket closed" in log:
        return "process 0, the coordinator,"
    return None
