"""The person at the device: asked before anything moves or is written."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable

from rig.faults import Refused


class Operator:
    """Questions with a default; ``yes`` takes every default and confirms everything."""

    def __init__(
        self,
        yes: bool = False,
        say: Callable[[str], None] = print,
        read: Callable[[str], str] = input,
        option: str = "--yes",  # that confirms
    ) -> None:
        self.yes = yes
        self.say = say
        self._read = read
        self._option = option

    def ask(self, question: str, default: str = "") -> str:
        """An answer, or the default where none is given.

        Raises:
            Refused: there is no terminal to ask on and no --yes, or no default.
        """
        if self.yes:
            if not default:
                raise Refused(f"{question}: no default; pass it as an option")
            self.say(f"{question} [{default}]")
            return default
        return self._answer(f"{question} [{default}]: ") or default

    def _answer(self, prompt: str) -> str:
        if self._read is input and not sys.stdin.isatty():
            raise Refused(f"{prompt}no terminal: pass {self._option} to confirm")
        try:
            return self._read(prompt).strip()
        except EOFError:
            raise Refused(f"{prompt}no answer") from None

    def number(self, question: str, default: float, most: float = 1e9) -> float:
        """A number; asked again where the answer is none, or larger either way."""
        while True:
            answer = self.ask(question, f"{default:g}")
            with contextlib.suppress(ValueError):
                if abs(number := float(answer)) <= most:
                    return number
            self.say(f"  must be a number in [{-most:g}, {most:g}], got {answer!r}")

    def choose(self, question: str, known: list[str], default: str) -> str:
        """One of ``known``; asked again where the answer is none of them."""
        while (answer := self.ask(question, default)) not in known:
            self.say(f"  must be one of {', '.join(known)}, got {answer!r}")
        return answer

    def confirm(self, what: str, word: str) -> None:
        """Refused where the operator does not type the word: Enter moves nothing."""
        self.say(what)
        if self.yes:
            self.say(f"confirmed by --yes: {word}")
        elif self._answer(f"Type {word} to continue: ") != word:
            raise Refused(f"not confirmed ({word!r} was not typed); nothing was done")
