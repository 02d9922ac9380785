"""A job of several processes, which run the same command: how one joins and leaves.

It learns of the others from ``--coordinator``, ``--num-processes`` and
``--process-id``, or from what JAX finds under SLURM, Open MPI, Kubernetes and on Cloud
TPU. When a process dies, JAX ends the others after ``HEARTBEAT_SECONDS``; checkpoints
stay.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, ClassVar

from jaxcal.arguments import Parser, values_of

EXIT_LOST = 3  # another process of the job is gone
HEARTBEAT_SECONDS = 20  # silence after which a process counts as lost
_CONNECT_SECONDS = 300  # for all processes to come together
_LEAVE_SECONDS = 3600  # for process 0 to write its files when the others are done


@dataclasses.dataclass
class Job:
    TITLE: ClassVar = "several processes"
    ABOUT: ClassVar = "found automatically under SLURM, Open MPI and on Cloud TPU"
    RARE: ClassVar = True

    coordinator: Annotated[
        str | None, "address of process 0, the same in every process", "HOST:PORT"
    ] = None
    num_processes: int | None = None
    process_id: Annotated[int | None, "0 to N - 1", "I"] = None


def expected(job: Job, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether this process is one of several, or may be."""
    address, number, process_id = job.coordinator, job.num_processes, job.process_id
    if number == 1:
        return False
    if address is number is process_id is None:
        return _cluster(environ)
    if address is None or number is None or process_id is None:
        raise ValueError(
            "--coordinator, --num-processes and --process-id must come together"
        )
    if number < 1:
        raise ValueError(f"--num-processes must be at least 1, got {number}")
    if not 0 <= process_id < number:
        raise ValueError(f"--process-id must be in [0, {number}), got {process_id}")
    if not re.fullmatch(r".+:\d+", address):
        raise ValueError(f"--coordinator must be HOST:PORT, got {address!r}")
    return True


def _cluster(environ: Mapping[str, str]) -> bool:
    """Whether a launcher that JAX knows started several of these processes."""
    if environ.get("SLURM_NTASKS", "1") != "1":
        # A batch script has SLURM_NTASKS too, but runs outside any job step.
        return "SLURM_STEP_NODELIST" in environ
    if environ.get("OMPI_COMM_WORLD_SIZE", "1") != "1":
        return True
    if "," in environ.get("TPU_WORKER_HOSTNAMES", ""):
        return True
    several = ("JAX_COORDINATOR_ADDRESS", "MEGASCALE_COORDINATOR_ADDRESS")
    if any(name in environ for name in (*several, "JOB_COMPLETION_INDEX")):
        return True
    # The slice of a Cloud TPU machine is in its metadata, which only JAX reads.
    return any(map(os.path.exists, ("/dev/accel0", "/dev/vfio/0")))


def run_job(
    program: str, argv: list[str] | None, work: Callable[[], int], advice: str
) -> int:
    """Run a command that may be one process of a job; its exit code. ``program`` begins
    every message, ``advice`` says how to go on when a process was lost."""
    flags = Parser(add_help=False, exit_on_error=False).of(Job)
    try:
        job = values_of(flags.parse_known_args(argv)[0])["options"]
        if not expected(job):
            return work()
    except (ValueError, argparse.ArgumentError) as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 2

    import jax

    try:
        _connect(job)
        code = work()
        if code == 0 and jax.distributed.is_initialized():
            sys.stdout.flush()
            jax.distributed.shutdown()  # without it the process counts as lost
            return code
    except ValueError as error:
        print(f"{program}: {error}", file=sys.stderr)
        code = 2
    except RuntimeError as error:  # what a collective raises
        line = (str(error).splitlines() or ["no reason given"])[0][:200]
        print(f"{program}: job aborted ({line}); {advice}", file=sys.stderr)
        code = EXIT_LOST
    if jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)  # JAX's exit handler would wait for the lost process
    return code


@contextlib.contextmanager
def collective() -> Iterator[None]:
    """Raise RuntimeError where a collective fails because another process is gone.

    JAX's transport raises ValueError, which commands report as a wrong argument.
    """
    import jax

    try:
        yield
    except ValueError as error:
        if jax.process_count() == 1:
            raise
        raise RuntimeError(str(error)) from error


def _connect(job: Job) -> None:
    """Join the job; must be called before JAX is initialised."""
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            job.coordinator,
            job.num_processes,
            job.process_id,
            initialization_timeout=_CONNECT_SECONDS,
            heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
            shutdown_timeout_seconds=_LEAVE_SECONDS,
        )
    except ValueError:
        if job.num_processes is None:
            return  # none of JAX's detections found a job: this process is alone
        raise
    except RuntimeError as error:
        raise RuntimeError(
            f"not every process connected to {job.coordinator or 'the coordinator'} in "
            f"{_CONNECT_SECONDS} s: {str(error).splitlines()[0][:120]}"
        ) from None
