"""The paper's datasets, as ``jaxcal.evaluation`` takes them."""

from __future__ import annotations

from jaxcal.evaluation.catalogue import Catalogue
from jaxcal.paper.constants import BLOCK, DRAWN, EPISODES
from jaxcal.paper.datasets.datasets import drawn, make_dataset

__all__ = ["CATALOGUE"]

CATALOGUE = Catalogue(
    sizes=EPISODES, make=make_dataset, endless=DRAWN, draw=drawn, block=BLOCK
)
