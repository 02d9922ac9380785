"""How close each way of choosing postures comes to the proven optimum."""

from jaxcal.evaluation.dataset import Dataset, load_dataset, save_npz
from jaxcal.evaluation.methods import PostureEvaluation, evaluate
from jaxcal.evaluation.report import Evaluation, Summary, text_table

__all__ = [
    "Dataset",
    "Evaluation",
    "PostureEvaluation",
    "Summary",
    "evaluate",
    "load_dataset",
    "save_npz",
    "text_table",
]
