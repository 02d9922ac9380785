"""Tables 2 and 3, the size of the network and the range of the reward."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from benchmarks.paper.exhibits.exhibit import Exhibit, from_rows, judge
from benchmarks.paper.exhibits.intervals import mean_interval
from benchmarks.paper.exhibits.study import Study
from jaxcal.information.regression import log_det_information, regression_matrix
from jaxcal.paper.datasets import EPISODES, NUM_CANDIDATES, RANGES


def exhibits(study: Study) -> list[Exhibit]:
    """Table 2, Table 3, the reward's range and the rank of the regression matrix."""
    return [_table_2(), _table_3(study), _reward(study), _rank(study)]


def _network() -> dict[str, Any]:
    """Size of the ``paper`` preset's network, counted from its weights' shapes."""
    import jax

    from jaxcal.paper.network import HEADS
    from jaxcal.paper.preset import PAPER

    shapes = jax.eval_shape(PAPER.learners[0].init, jax.random.key(0))
    size = {
        name: sum(leaf.size for leaf in jax.tree.leaves(part))
        for name, part in shapes.items()
    }
    total = sum(size.values())
    shared = total - sum(size[name] for name in HEADS)
    numbers = {"parameters": total, "shared": shared, "shared_share": shared / total}
    return numbers | {"by_layer": size}


def _table_2() -> Exhibit:
    from jaxcal.paper.preset import PAPER

    environment, ppo, network = PAPER.tasks[0].environment, PAPER.ppo, _network()
    k, episodes = environment.num_selected, ppo.num_episodes
    exact = [
        ("state, numbers", "210", str(environment.observation_size)),
        ("actions", "50", str(environment.num_candidates)),
        ("decisions per episode", "4", str(k)),
        (
            *("terminal reward", "log det S / 10"),
            f"log det S / {1 / environment.reward_scale:g}",
        ),
        ("hidden width", "768", str(PAPER.network.width)),
        ("episodes", "200,000", f"{episodes:,}"),
        ("decisions", "800,000", f"{episodes * k:,}"),
        ("episodes per update", "16", str(ppo.episodes_per_update)),
        ("epochs per update", "10", str(ppo.num_epochs)),
    ]
    about = [
        ("parameters", "about 3.5 M", f"{network['parameters']:,}"),
        ("shared", "about 71 %", f"{network['shared_share']:.1%}"),
    ]
    rows = [
        *exact[:5],
        *about,
        *exact[5:],
        ("reward's range", "3.0 to 4.2", "see below"),
    ]
    same = sum(paper == ours for _, paper, ours in exact)
    return Exhibit.from_texts(
        "table_2",
        {"same": same, "exact": len(exact)},
        verdict=judge(same == len(exact)),
        rows=[("", "paper", "ours"), *rows],
        data={"table_2": from_rows(("item", "paper", "ours"), rows)},
        numbers=network,
    )


def _table_3(study: Study) -> Exhibit:
    paper = {
        "dataset0": ("simulation", 200, 6),
        "dataset1": ("simulation", 200_000, 3),
        "dataset2": ("simulation", 1_000, 3),
        "dataset3": ("simulation", 100, 6),
        "dataset4": ("rig", 100, 6),
        "dataset5": ("rig", 1, 6),
    }
    head = ("", "kind", "paper: episodes x postures, dim", "ours", "used here")
    rows: list[tuple[str, ...]] = [head]
    numbers = {}
    for name, (kind, episodes, dim) in paper.items():
        size, width, used = NUM_CANDIDATES, 3, "no; training draws its own sets"
        if name != "dataset1":
            data = study.dataset(name)
            size, used = data.num_candidates, f"{data.num_episodes:,}"
            outputs = 0 if data.measured is None else data.num_outputs
            width = data.num_inputs + outputs
        sizes = {"paper": [episodes, 50, dim], "ours": [EPISODES[name], size, width]}
        numbers[name] = sizes
        told = (f"{e:,} x {m}, {d}" for e, m, d in sizes.values())
        rows.append((name, kind, *told, used))
    same = all(entry["paper"] == entry["ours"] for entry in numbers.values())
    return Exhibit.from_texts(
        "table_3",
        {"recordings": study.settings.about_recordings},
        verdict=judge(same, True),
        rows=rows,
        numbers=numbers,
    )


def _reward(study: Study) -> Exhibit:
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    sets = np.array(list(itertools.combinations(range(8), 4)))
    with np.errstate(divide="ignore"):
        bound = float(np.max(log_det_information(corners[sets])))
    reward = study.result("dataset2", "policy").log_det[:, 0] / 10.0
    best = study.evaluation("dataset2").reference
    side = float(np.exp((36.0 - best.mean()) / 18.0))
    words = {"count": len(reward), "bound": bound / 10, "side": side}
    return Exhibit.from_texts(
        "reward_range",
        words | {"constant": 6.0 * np.log(RANGES.span).sum() / 10},
        verdict=judge(bound / 10 >= 3.0),
        numbers={
            "largest_log_det_s_in_unit_cube": bound,
            "policy_reward": mean_interval(reward),
            "policy_reward_smallest": float(reward.min()),
            "policy_reward_largest": float(reward.max()),
            "optimum_reward_largest": float(best.max() / 10),
            "share_in_paper_range": float(((reward >= 3.0) & (reward <= 4.2)).mean()),
            "cube_side_for_3.6_deg": side,
        },
    )


def _rank(study: Study) -> Exhibit:
    sets = study.dataset("dataset3").candidates
    ranks = {
        k: [int(np.linalg.matrix_rank(regression_matrix(c[:k]))) for c in sets]
        for k in (3, 4, 5)
    }
    return Exhibit.from_texts(
        "rank",
        {"count": len(sets)},
        verdict=judge(min(ranks[4]) == 12 and max(ranks[3]) < 12),
        numbers={f"rank_of_{k}": min(values) for k, values in ranks.items()},
    )
