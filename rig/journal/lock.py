"""One lock for each bus: who moves the device now, and how to stop it without them.

The lock is an flock on a file in a folder of this user, so the kernel frees it however
its holder ends. The file says who holds it; what it says without the flock is stale.
Beside it lies what a stop needs, written before the drives are armed: bus, units and
register maps. ``stop`` asks the holder before it loads anything heavy.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pathlib
import re
import signal
import socket
import stat
import time
from typing import TYPE_CHECKING, Any

from jaxcal.jsonlines import flock, until
from rig.faults import Refused

if TYPE_CHECKING:
    from rig.config.config import RigConfig
    from rig.config.settings import BusSettings

# The same for every login, service and TMPDIR of a user, or two sessions of one user
# would not see each other's locks.
FOLDER = pathlib.Path(
    os.environ.get("JAXCAL_RIG_LOCKS", f"/var/tmp/jaxcal-rig-{os.getuid()}")
)
HELD: dict[pathlib.Path, int] = {}  # locks of this process
PATIENCE_S = 0.2  # a `holder` of another process keeps the flock for an instant
ENDING, ENDING_S = "the end of a session", 8.0  # which stops its drives, and looks
UNKNOWN = {"command": "a session", "since": "unknown"}
_ASKERS_S = 2.0  # the same where several `holder` calls follow one another


class BusLock:
    """The right to write to one bus, taken before its port is opened."""

    def __init__(self, settings: BusSettings) -> None:
        self.where = settings.where
        name = re.sub(r"[^\w.-]+", "_", _identity(settings))
        self.path, self.armed_path = FOLDER / f"{name}.lock", FOLDER / f"{name}.armed"
        self._fd: int | None = None
        self._told: dict[str, Any] = {}

    def acquire(self, what: str) -> BusLock:
        """Take the lock for the command ``what``; Refused names who holds it."""
        self._fd = fd = self._open(os.O_RDWR | os.O_CREAT)

        def taken(seconds: float) -> bool:
            return until(seconds, lambda: flock(fd, fcntl.LOCK_EX))

        if not (free := taken(PATIENCE_S)):
            told = _content(fd) or {"command": ""}
            more = {"": _ASKERS_S, ENDING: ENDING_S}.get(told["command"], 0.0)
            free = taken(more)
        if not free:
            told = _content(fd)
            self.release()
            raise Refused(
                f"{self.where} is {held_by(told)}. Wait until it ends, or stop it with "
                "`jaxcal-rig stop`"
            )
        os.ftruncate(fd, 0)
        HELD[self.path] = fd
        return self.adopt(fd, what)

    def adopt(self, fd: int, what: str) -> BusLock:
        """Go on holding what another process held, of which this one has the file."""
        if fd >= 0:
            self._fd, self._told = fd, _content(fd)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            self.tell(pid=os.getpid(), command=what, since=since)
        return self

    def tell(self, **facts: Any) -> None:
        """Add to what other processes are told of the holder, such as ``run``."""
        if self._fd is not None:
            self._told |= facts
            text = json.dumps(self._told | {"bus": self.where}) + "\n"
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, text.encode(), 0)

    def release(self) -> None:
        """Give the lock back, where it was taken."""
        if self._fd is not None:
            if self._told:
                os.ftruncate(self._fd, 0)
                HELD.pop(self.path, None)
            os.close(self._fd)
        self._fd, self._told = None, {}

    def __enter__(self) -> BusLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def holder(self) -> dict[str, Any] | None:
        """Who holds the lock now (pid, command, since, run), None where it is free.

        The flock is tried first, so never the word of a dead holder; empty where it has
        not said who it is. Where the file is gone or of no use the kernel is asked.
        """
        try:
            fd = self._open(os.O_RDONLY)
        except FileNotFoundError:
            return _opener(self.path)
        except Refused:
            if told := _opener(self.path):
                return told
            raise
        try:
            until(PATIENCE_S, lambda: flock(fd, fcntl.LOCK_SH) or bool(_content(fd)))
            if flock(fd, fcntl.LOCK_SH):
                return None
            return _content(fd) or _opener(self.path) or {}
        finally:
            os.close(fd)

    def signal_holder(self, number: int) -> dict[str, Any] | None:
        """Send a signal to the holder, unless it is this process; who that is."""
        told = self.holder()
        if told and told["pid"] != os.getpid():
            with contextlib.suppress(ProcessLookupError):
                os.kill(told["pid"], signal.Signals(number))
        return told

    def leave(self, config: RigConfig) -> None:
        """Write what a stop of these drives needs, before they are armed; Refused."""
        self._write_armed(config.told)

    def stood(self, forget: bool = False, standing: bool = True) -> None:
        """All drives were seen standing, or, not ``standing``, one to go on;
        ``forget``: they are gone as well, as simulated ones are."""
        with contextlib.suppress(Refused, OSError):  # they stand, whatever is written
            if forget:
                self.armed_path.unlink(missing_ok=True)
            elif told := read_armed(self.armed_path):
                self._write_armed(told | {"standing": standing})

    def _write_armed(self, told: dict[str, Any]) -> None:
        new = self.armed_path.with_suffix(f".{os.getpid()}")
        try:
            _folder()
            new.write_text(json.dumps(told), encoding="utf-8")
            new.replace(self.armed_path)
        except OSError as error:
            text = f"cannot write {self.armed_path}, which `stop` needs"
            raise Refused(f"{text}: {error.strerror or error}") from None

    def freed(self, seconds: float) -> bool:
        """Wait so long for the holder to let go; whether it did."""
        return until(seconds, lambda: self.holder() is None)

    def _open(self, flags: int) -> int:
        try:
            _folder(make=bool(flags & os.O_CREAT))
            flags |= os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK  # it may be a pipe
            fd = os.open(self.path, flags, 0o600)
            if not stat.S_ISREG(os.fstat(fd).st_mode):
                os.close(fd)
                raise OSError("no regular file")
            return fd
        except FileNotFoundError:
            raise
        except OSError as error:
            reason = error.strerror or error
            raise Refused(f"cannot lock {self.where}: {self.path}: {reason}") from None


def _folder(make: bool = True) -> None:
    """The folder is there, and this user's."""
    if make:
        with contextlib.suppress(FileExistsError):
            FOLDER.mkdir(mode=0o700)
    owner = FOLDER.lstat().st_uid
    if owner != os.getuid():
        raise Refused(f"{FOLDER} belongs to user {owner}: remove the folder")


def armed_files() -> list[pathlib.Path]:
    """What sessions of this user have left for a stop, the newest first."""
    try:
        _folder(make=False)
        found = {path: path.stat().st_mtime for path in FOLDER.glob("*.armed")}
    except (OSError, Refused):
        return []
    return sorted(found, key=lambda path: -found[path])


def read_armed(path: pathlib.Path) -> dict[str, Any] | None:
    """What was left for a stop; None where there is nothing, or nothing of use."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return None
        told = json.loads(path.read_text(encoding="utf-8"))
        useful = told["bus"] and told["drives"]
        return {"standing": False, **told} if useful else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def held_by(told: dict[str, Any]) -> str:
    """What a holder says of itself, in words."""
    if not told:
        return "in use by an unknown process"
    run = f" in {told['run']}" if told.get("run") else ""
    return (
        f"in use by `{told['command']}`{run} (process {told['pid']}, since "
        f"{told['since']})"
    )


def _identity(settings: BusSettings) -> str:
    """One text for every name of a bus: a serial port's real path, what a host's name
    resolves to."""
    if settings.transport in ("rtu", "serial"):
        return os.path.realpath(settings.device)
    if settings.transport == "can":
        return settings.device
    try:
        entries = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM
        )
        addresses = {str(entry[4][0]).removeprefix("::ffff:") for entry in entries}
        # A name with addresses of both kinds is known by that of version 4.
        address = min(addresses, key=lambda text: (":" in text, text))
    except OSError:
        address = settings.host.lower()  # opening it will fail, and say why
    if address == "::1" or address.startswith("127."):
        address = "localhost"
    return f"{address}:{settings.port}"


def _opener(path: pathlib.Path) -> dict[str, Any] | None:
    """Another process of this user that has a file open, also one that was deleted."""
    names = (str(path), os.path.realpath(path))
    with contextlib.suppress(OSError):  # no Linux
        for pid in filter(str.isdigit, os.listdir("/proc")):
            with contextlib.suppress(OSError):  # it has ended, or is another user's
                for fd in os.listdir(f"/proc/{pid}/fd"):
                    link = os.readlink(f"/proc/{pid}/fd/{fd}")
                    other = int(pid) != os.getpid()
                    if other and link.removesuffix(" (deleted)") in names:
                        return {"pid": int(pid), **UNKNOWN}
    return None


def _content(fd: int) -> dict[str, Any]:
    """What the file says, empty where that is not whole."""
    try:
        told = json.loads(os.pread(fd, 65536, 0))
        valid = isinstance(told["pid"], int) and 1 < told["pid"] < 1 << 31
        return UNKNOWN | told if valid else {}
    except (ValueError, KeyError, TypeError, RecursionError):
        return {}
