"""Methods whose module loads when they are first called."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any


class late:
    """A method that a module further up defines: ``report = late("module:function")``.

    Asked for, of the class or of an object, it is that function, or a class as it is;
    with ``of`` the function of the object's attribute of this name.
    """

    def __init__(self, path: str, of: str = "") -> None:
        self.path, self.of = path, of

    @functools.cached_property
    def function(self) -> Callable[..., Any]:
        """The function, its module loaded."""
        module, _, name = self.path.partition(":")
        function: Callable[..., Any] = getattr(importlib.import_module(module), name)
        return function

    def __get__(self, instance: Any, owner: type | None = None) -> Callable[..., Any]:
        if isinstance(self.function, type):
            return self.function
        if self.of and instance is not None:
            instance = getattr(instance, self.of)
        method: Callable[..., Any] = self.function.__get__(instance, owner)
        return method
