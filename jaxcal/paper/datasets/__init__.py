"""The paper's Datasets 0 to 5 (Table 3): drawn, simulated and recorded.

``python -m jaxcal.paper.datasets --out DIR`` writes them all, each with a data card;
``python -m jaxcal.paper.datasets.record`` records 4 and 5 against the rig's simulator.
"""

from jaxcal.paper.constants import (
    AXES,
    BIAS_DEG,
    BLOCK,
    DRAWN,
    EPISODES,
    NAMES,
    NOISE_STD_DEG,
    NUM_CANDIDATES,
    RANGES,
    RECORDED,
    SCALE,
)
from jaxcal.paper.datasets.datasets import chunks, dataset0_robot, drawn, make_dataset
from jaxcal.paper.datasets.recordings import SHIPPED, read_pool, recorded_dataset

__all__ = [
    "AXES",
    "BIAS_DEG",
    "BLOCK",
    "DRAWN",
    "EPISODES",
    "NAMES",
    "NOISE_STD_DEG",
    "NUM_CANDIDATES",
    "RANGES",
    "RECORDED",
    "SCALE",
    "SHIPPED",
    "chunks",
    "dataset0_robot",
    "drawn",
    "make_dataset",
    "read_pool",
    "recorded_dataset",
]
