"""The flags of ``evaluate``, and what ``--help`` says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxcal.arguments import Parser, at_least, flag, seconds, several
from jaxcal.evaluation.methods import DEFAULT_METHODS

__all__ = ["parser"]

_DESCRIPTION = """\
Let every method choose K postures in every episode of a dataset, and compare the
determinant of the information matrix S with that of the best choice there is (S*).

columns:
  mean, median det S  larger is better; in the unit of the dataset's commands
  det S/det S*        mean over the episodes; 1 is optimal
  hit rate            share of episodes in which the optimum itself was found
  D-eff.              mean of (det S/det S*)^(1/p), p parameters (12 for 3 x 3)
  x random            mean det S over that of random selection, the paper's measure
  time each           seconds a selection, averaged over the batch, compilation left out
"""

_EPILOG = """\
methods:
  policy              the trained network, likeliest posture at every step
  policy:samples      the best of --num sampled passes
  policy:first        each of the --num likeliest first postures, completed; the best
  policy:exchange     policy, then Fedorov exchange from what it chose
  policy:all          all four
  random              --draws selections an episode, all counted
  greedy              the posture that adds most, K times
  exchange            Fedorov exchange with random restarts
  exact               the proven optimum
  auto                what select does by default: the cheapest way to a proven
                      D-efficiency of 0.999; not among the methods run by default

datasets:
  dataset0 to 5       the paper's, made from --seed (200, 200,000, 1,000, 100, 100 and
                      1 episodes); 4 and 5 from --recordings, or those that ship
  FILE.npz            candidates (episodes, M, n); optional measured, available
  FILE.csv            episode,candidate,u_x,u_y,u_z[,y_x,y_y,y_z]

examples:
  {program}
      the shipped policy and every baseline on 1,000 unseen sets of 50 postures
  {program} --checkpoint runs/a runs/b --methods policy,exact --json out.json
      two trainings side by side, the numbers for a script
  {program} --dataset dataset3 mine.npz --report report
      figures and report/index.html; dataset3 holds outputs, so parameters too
  {program} --methods random,greedy,exact --k 8 --episodes 100
      eight of fifty postures; loads no JAX
  {program} --task knee
      deciders of sequential measurement; {program} --task knee --help
  {program} --stream runs/ten_million --episodes 10000000
      any number of episodes in constant memory; the same command resumes where it
      stopped; started again beside it, on any machine, it shares the work
"""


_MANY: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}
_FLAGS = (
    flag("--checkpoint", "trained policies; the shipped one", "DIR", **_MANY),
    flag("--dataset", "datasets; dataset2", "NAME|FILE", **_MANY),
    flag("--recordings", "of dataset4.csv and dataset5.csv, by the rig", "DIR", Path),
    flag("--methods", "comma separated; all but auto", "LIST", several(str, "names"),
         default=DEFAULT_METHODS),
    flag("--k", "postures to choose; 4", "K", at_least(1), default=4),
    flag("--episodes", "at most the first N of each", "N", at_least(1)),
    flag("--seed", "of datasets and draws; 0", "S", at_least(0), default=0),
    flag("--num", "tries of policy:samples and :first", "N", at_least(1), default=16),
    flag("--draws", "random selections an episode; 100", "N", at_least(1), default=100),
    flag("--time-limit", "of the exact solver, a dataset; what it cannot prove is "
         "bounded", "SECONDS", seconds),
    flag("--json", "write every number", type=Path),
    flag("--indices", "and the postures chosen, in the JSON", on=True),
    flag("--report", "write figures and index.html", "DIR", Path),
    flag("--run", "training runs to draw curves of; those of --checkpoint are found",
         "DIR", Path, **_MANY),
    flag("--stream", "evaluate in parts kept in DIR: any number of --episodes, "
         "resumable", "DIR", Path),
    flag("--quiet", "no progress", on=True),
)  # fmt: skip


def parser(program: str, typed: str) -> Parser:
    """The parser: ``program`` begins a message, ``typed`` an example of the help."""
    about, more = _DESCRIPTION, _EPILOG.format(program=typed)
    return Parser(prog=program, description=about, epilog=more).with_flags(_FLAGS)
