"""The paper's Datasets 0 to 5 (Table 3): drawn, simulated and recorded.

``python -m jaxcal.paper.datasets --out DIR`` writes them all, each with a data card.
"""

from jaxcal.paper.constants import BIAS_DEG, SCALE
from jaxcal.paper.datasets.datasets import chunks, dataset0_robot, make_dataset

__all__ = ["BIAS_DEG", "SCALE", "chunks", "dataset0_robot", "make_dataset"]
