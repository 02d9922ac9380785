"""Files that are either the old one or the whole new one, whatever happens between."""

from __future__ import annotations

import contextlib
import itertools
import os
import pathlib
import secrets
import sys
from collections.abc import Iterator, Mapping
from typing import IO, Any

AnyPath = str | os.PathLike[str]
_WRITTEN = {"out", "servos_out", "picture", "json"}  # arguments that are files
_SHOWN = "/dev/stdout"  # where the shell has redirected it, that file
_RECORDS = {".json", ".jsonl", ".toml", ".csv"}


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """A binary file to fill, in the same folder; once on the disk (fsync) it is renamed
    over ``path``. If the block raises or the process dies, ``path`` is what it was.
    OSError: the folder is missing, not writable or full."""
    target = pathlib.Path(path).resolve()
    if target.exists() and not target.is_file():
        kind = "folder" if target.is_dir() else "device"
        raise IsADirectoryError(f"{path} is a {kind}, not a file")
    partial = target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")
    try:
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no folder {target.parent}") from None
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(target)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    with contextlib.suppress(OSError):  # the rename too, where folders can be synced
        descriptor = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write UTF-8 text atomically; OSError: the old file stays."""
    with atomic_write(path) as file:
        file.write(text.encode("utf-8"))


def write_over(path: str | os.PathLike[str], text: str, force: bool) -> None:
    """Write a text of any bytes (surrogates), over a file that is there by ``force``,
    else FileExistsError."""
    if not force and os.path.exists(path):
        raise FileExistsError(
            f"{os.fspath(path)} exists; pass force=True to replace it"
        )
    with atomic_write(path) as file:
        file.write(text.encode("utf-8", "surrogateescape"))


def require_writable_folder(folder: str | os.PathLike[str]) -> None:
    """An OSError where ``folder``, or its nearest ancestor that exists, is a file or
    takes no files, before work is spent on them."""
    place = pathlib.Path(folder).resolve()
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise NotADirectoryError(f"{place} is not a folder")
    probe = place / f".jaxcal.{secrets.token_hex(4)}.probe"
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise PermissionError(
            f"cannot write in {place}: {error.strerror or error}"
        ) from None


def require_kept(given: Mapping[str, Any]) -> None:
    """Refuse arguments that would write over a file they read, by any path to it."""
    written = {name: given.get(name) for name in _WRITTEN}
    if folder := given.get("report"):
        require_writable_folder(folder)
        pages = ("index.html", "verdict.json", "calibration.json")
        written |= {f"report {page}": os.path.join(folder, page) for page in pages}
    read = {}
    for name in given.keys() - _WRITTEN - {"report"}:
        values = given[name]
        read[name] = values if isinstance(values, list | tuple) else [values]
    for option, path in written.items():
        if not isinstance(path, str | pathlib.Path) or given.get("overwrite"):
            continue
        for name, values in read.items():
            if any(_same_file(path, value) for value in values):
                raise ValueError(
                    f"--{option.replace('_', '-')}: {path} is what is read "
                    f"({name.replace('_', '-')}); write to another file"
                )
    for value in itertools.chain.from_iterable(read.values()):
        shown = value != "-" and os.path.isfile(_SHOWN) and _same_file(_SHOWN, value)
        if shown:
            raise ValueError(
                f"standard output goes to {value}, which is read; write to another file"
            )


def _same_file(path: Any, value: Any) -> bool:
    """Whether what is written is what is read, or a file of the folder that is."""
    try:
        if value == "-":
            return os.path.samestat(os.stat(path), os.fstat(sys.stdin.fileno()))
        if not isinstance(value, str | pathlib.Path):
            return False
        if os.path.isdir(value) and os.path.isfile(path):  # of a folder its records
            if pathlib.PurePath(path).suffix not in _RECORDS:
                return False
            path = os.path.dirname(os.path.abspath(path))
        return os.path.samefile(path, value)
    except (OSError, ValueError):
        return False
