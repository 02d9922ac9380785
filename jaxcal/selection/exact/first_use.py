"""One line in the log where a first use on a machine compiles for many seconds."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import Any

__all__ = ["announced"]

_LOG = logging.getLogger(__name__)


@contextlib.contextmanager
def announced(line: str) -> Iterator[None]:
    """Log ``line`` once (INFO) if numba compiles within; not where it loads its cache.

    The library prints nothing: the console commands show the log on standard error.
    """
    from numba.core import event

    class First(event.Listener):
        told = False

        def on_start(self, event: Any) -> None:
            if not self.told:
                _LOG.info(line)
            self.told = True

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", First()):
        yield
