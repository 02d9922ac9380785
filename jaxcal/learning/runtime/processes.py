"""A job of several processes, which run the same command: how one joins and leaves.

It learns of the others from its flags, or from what JAX finds under SLURM, Open MPI,
Kubernetes and on Cloud TPU. When one dies, JAX ends the others; checkpoints stay.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import pathlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, ClassVar

from jaxcal.arguments import Parser, refused, values_of

EXIT_LOST = 3  # another process of the job is gone
HEARTBEAT_SECONDS = 20  # silence after which a process counts as lost
_CONNECT_SECONDS = 300  # for all processes to come together
_LAUNCHERS = (  # what others that JAX knows set in each process that they start
    *("JAX_COORDINATOR_ADDRESS", "MEGASCALE_COORDINATOR_ADDRESS"),
    "JOB_COMPLETION_INDEX",
)


@dataclasses.dataclass
class Job:
    TITLE: ClassVar = "several processes"
    ABOUT: ClassVar = "found automatically under SLURM, Open MPI and on Cloud TPU"
    RARE: ClassVar = True

    coordinator: Annotated[
        str | None, "address of process 0, the same in every process", "HOST:PORT"
    ] = None
    num_processes: Annotated[int | None, (1,)] = None
    process_id: Annotated[int | None, "0 to N - 1", "I", (0,)] = None


def expected(job: Job, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether this process is one of several, or may be."""
    address, number, process_id = job.coordinator, job.num_processes, job.process_id
    if number == 1:
        return False
    if address is number is process_id is None:
        # A batch script has SLURM_NTASKS too, but runs outside any job step.
        in_step = "SLURM_STEP_NODELIST" in environ
        return (
            (in_step and environ.get("SLURM_NTASKS", "1") != "1")
            or environ.get("OMPI_COMM_WORLD_SIZE", "1") != "1"
            or "," in environ.get("TPU_WORKER_HOSTNAMES", "")
            # The slice of a Cloud TPU machine is in its metadata, which only JAX reads.
            or any(map(os.path.exists, ("/dev/accel0", "/dev/vfio/0")))
            or any(name in environ for name in _LAUNCHERS)
        )
    if address is None or number is None or process_id is None:
        raise ValueError(
            "--coordinator, --num-processes and --process-id must come together"
        )
    if process_id >= number:
        raise ValueError(f"--process-id must be in [0, {number}), got {process_id}")
    if not re.fullmatch(r".+:\d+", address):
        raise ValueError(f"--coordinator must be HOST:PORT, got {address!r}")
    return True


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
        return refused(program, error)

    import jax

    try:
        _connect(job)
        code = work()
        if code == 0 and jax.distributed.is_initialized():
            sys.stdout.flush()
            jax.distributed.shutdown()  # without it the process counts as lost
    except ValueError as error:
        code = refused(program, error)
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
    """Raise RuntimeError where a collective fails because another process is gone; JAX
    raises ValueError, which commands report as a wrong argument."""
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
            shutdown_timeout_seconds=3600,  # process 0 writes, the others are done
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


def keep_compiled_programs() -> None:
    """Have JAX cache compiled code on disk, so that a second command starts sooner: in
    the folder that the user has set, else in ``jaxcal/jax`` under ``XDG_CACHE_HOME`` or
    ``~/.cache``. Only commands turn it on; does not load JAX."""
    # jaxlib 0.10.1 logs an error for each program that it takes from the cache if the
    # processor has hints that XLA does not list as features; the results are correct.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read when JAX is loaded
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    settings = {
        "jax_compilation_cache_dir": str(pathlib.Path(home) / "jaxcal" / "jax"),
        # Small programs too: a start has a hundred of them.
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": 0,
    }
    for name, value in settings.items():
        os.environ.setdefault(name.upper(), str(value))  # read when JAX is loaded
        jax = sys.modules.get("jax")
        if jax and not (name.endswith("dir") and getattr(jax.config, name)):
            jax.config.update(name, value)
