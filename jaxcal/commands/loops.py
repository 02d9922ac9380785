"""``jaxcal loop``: a closed loop that another program drives."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from jaxcal.extras import needs


def loop(
    task: Annotated[str, "a task's name, or a Python file that defines ENTRY"],
    *,
    journal: Annotated[
        Path | None, "journal of the session; an existing journal is resumed"
    ] = None,
    with_: Annotated[tuple[str, ...], "options of the task", "OPTION=VALUE"] = (),
    seconds: Annotated[float | None, "time budget; default the task's", (0.0,)] = None,
    uses: Annotated[
        int | None, "budget of the task's counted resource; default the task's", (1,)
    ] = None,
    seed: Annotated[int, "seed of the random draws", "S", (0,)] = 0,
) -> None:
    """Suggest measurements and take outcomes as JSON lines, for other programs.

    example:
      $ jaxcal loop peak.py --journal session.jsonl
      {"do": "suggest"}
      {"number": 0, "design": 15, "coordinates": [3.05], "gain": 0.055, ...}
      {"do": "observed", "outcome": 0.42}
      {"number": 1}
      {"do": "state"}

    Each outcome is written to the journal before the answer. A session that was killed
    resumes when started again.
    """
    with needs("policy", "loop"):
        from jaxcal.adaptive.loop import Loop
        from jaxcal.adaptive.protocol import answers
        from jaxcal.adaptive.tasks import registry
    entry = registry.load(task)
    made = entry.make(**registry.options_from(entry, with_))
    with Loop(made, journal=journal, seconds=seconds, uses=uses, seed=seed) as session:
        for answer in answers(session, iter(sys.stdin.readline, "")):
            sys.stdout.write(answer)
            sys.stdout.flush()
