"""Questions to a :class:`jaxcal.Design` in one call, as the tests ask them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal import As, Design, Ds
from jaxcal.designs.travel import FastSelection, ParetoFront
from jaxcal.information import criteria as information
from jaxcal.information.regression import regressors
from jaxcal.selection.plan import Plan
from jaxcal.selection.problem import Problem
from jaxcal.selection.result import Selection

_RULES = (
    *("model", "prior", "noise", "measured", "available", "required"),
    *("max_replicates", "names", "commands"),
)


def of(name: str, parameters: Any = (0, 1)) -> Any:
    """The criterion of a name, with parameters of interest where it needs some."""
    return {"Ds": Ds, "As": As}[name](parameters) if name in ("Ds", "As") else name


def criteria(
    commands: np.ndarray, region: np.ndarray | None = None, num_outputs: Any = None
) -> information.Criteria:
    """Of commands (N, n) of the affine model, over a region (R, n), by default them."""
    z = regressors(commands)[:, None]
    where = z if region is None else regressors(region)[:, None]
    m = z.shape[2] - 1 if num_outputs is None else num_outputs
    return information.criteria(z, np.zeros((0, z.shape[2])), where, m)


def _asked(candidates: Any, given: dict[str, Any]) -> tuple[Design, dict[str, Any]]:
    """The design of ``candidates`` or ``blocks``, and what is left of ``given``."""
    rules = {name: given.pop(name) for name in _RULES if name in given}
    blocks = given.pop("blocks", None)
    if blocks is None:
        return Design(candidates, **rules), given
    return Design.from_blocks(blocks, commands=candidates, **rules), given


def make_problem(candidates: Any, k: int | None = None, **given: Any) -> Problem:
    design, asked = _asked(candidates, given)
    return design.problem(k, **asked)


def make_block_problem(blocks: Any, k: int | None = None, **given: Any) -> Problem:
    return make_problem(None, k, blocks=blocks, **given)


def score(candidates: Any, indices: Any, **given: Any) -> Selection:
    design, asked = _asked(candidates, given)
    return design.score(indices, **asked)


def plan(candidates: Any = None, **given: Any) -> Plan:
    design, asked = _asked(candidates, given)
    return design.plan(**asked)


def select_fastest(
    candidates: Any, k: int | None = None, **given: Any
) -> FastSelection:
    design, asked = _asked(candidates, given)
    return design.fastest(k, **asked)


def pareto_front(candidates: Any, k: int | None = None, **given: Any) -> ParetoFront:
    design, asked = _asked(candidates, given)
    return design.pareto(k, **asked)
