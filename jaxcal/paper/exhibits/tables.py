"""Tables 2 and 3, the size of the network and the range of the reward."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from jaxcal.information.regression import log_det_information, regression_matrix
from jaxcal.paper.datasets import EPISODES, NUM_CANDIDATES, RANGES
from jaxcal.paper.exhibits.exhibit import Exhibit, Verdict
from jaxcal.paper.exhibits.intervals import mean_interval
from jaxcal.paper.exhibits.material import Material

__all__ = ["exhibits"]


def exhibits(material: Material) -> list[Exhibit]:
    """Table 2, Table 3, the reward's range and the rank of the regression matrix."""
    return [_table_2(), _table_3(material), _reward(material), _rank(material)]


def _network() -> dict[str, Any]:
    """Size of the ``paper`` preset's network, counted from its weights' shapes."""
    import jax

    from jaxcal.learning.policies import networks
    from jaxcal.learning.training import ppo, presets

    config = presets.PRESETS["paper"]
    network = networks.build(config.network)
    shapes = jax.eval_shape(lambda: ppo.init(config.ppo, config.tasks[0], network))
    size = {
        name: sum(leaf.size for leaf in jax.tree.leaves(part))
        for name, part in shapes.params.items()
    }
    heads = sum(size[name] for name in networks.PAPER_HEADS)
    total = sum(size.values())
    return {
        "parameters": total,
        "shared": total - heads,
        "shared_share": (total - heads) / total,
        "by_layer": size,
    }


def _table_2() -> Exhibit:
    from jaxcal.learning.training import presets

    config = presets.PRESETS["paper"]
    environment, ppo = config.tasks[0].environment, config.ppo
    network, scale = _network(), environment.reward_scale
    m, k = environment.num_candidates, environment.num_selected
    episodes = ppo.num_episodes
    rows: list[tuple[str, str, str]] = [
        ("state, numbers", "210", str(environment.observation_size)),
        ("actions", "50", str(m)),
        ("decisions an episode", "4", str(k)),
        ("terminal reward", "log det S / 10", f"log det S / {1 / scale:g}"),
        ("hidden width", "768", str(config.network.width)),
        ("parameters", "about 3.5 M", f"{network['parameters']:,}"),
        ("shared", "about 71 %", f"{network['shared_share']:.1%}"),
        ("episodes", "200,000", f"{episodes:,}"),
        ("decisions", "800,000", f"{episodes * k:,}"),
        ("episodes an update", "16", str(ppo.episodes_per_update)),
        ("epochs an update", "10", str(ppo.num_epochs)),
        ("reward's range", "3.0 to 4.2", "see below"),
    ]
    exact = [row for row in rows if "about" not in row[1] and "see" not in row[2]]
    same = sum(row[1] == row[2] for row in exact)
    return Exhibit(
        key="table_2",
        title="Table 2: configuration of the training",
        caption=(
            "Ours: the paper preset (python train.py --preset paper), counted from the "
            "code that trains. The paper gives neither learning rate nor clip range "
            "nor entropy bonus; ours are in jaxcal/learning/presets.py and in every "
            "checkpoint."
        ),
        paper="See the table.",
        ours=(
            f"{same} of {len(exact)} settings that the paper states exactly are the "
            f"same; {network['parameters']:,} parameters, "
            f"{network['shared_share']:.1%} of them shared by actor and critic."
        ),
        verdict="agrees" if same == len(exact) else "disagrees",
        rows=[("", "paper", "ours"), *rows],
        data={
            "table_2": {
                "item": [row[0] for row in rows],
                "paper": [row[1] for row in rows],
                "ours": [row[2] for row in rows],
            }
        },
        numbers=network,
    )


def _table_3(material: Material) -> Exhibit:
    paper = {
        "dataset0": ("simulation", 200, 6),
        "dataset1": ("simulation", 200_000, 3),
        "dataset2": ("simulation", 1_000, 3),
        "dataset3": ("simulation", 100, 6),
        "dataset4": ("rig", 100, 6),
        "dataset5": ("rig", 1, 6),
    }
    rows = [("", "kind", "paper: episodes x postures, dim", "ours", "used here")]
    numbers = {}
    for name, (kind, episodes, dim) in paper.items():
        if name == "dataset1":
            ours, used = (EPISODES[name], NUM_CANDIDATES, 3), "no; training draws anew"
        else:
            data = material.dataset(name)
            width = data.num_inputs
            width += data.num_outputs if data.measured is not None else 0
            count = EPISODES.get(name, data.num_episodes)
            ours, used = (count, data.num_candidates, width), f"{data.num_episodes:,}"
        numbers[name] = {"paper": [episodes, 50, dim], "ours": list(ours)}
        rows.append(
            (
                name,
                kind,
                f"{episodes:,} x 50, {dim}",
                f"{ours[0]:,} x {ours[1]}, {ours[2]}",
                used,
            )
        )
    same = all(entry["paper"] == entry["ours"] for entry in numbers.values())
    verdict: Verdict = "agrees" if same else "agrees in part"
    return Exhibit(
        key="table_3",
        title="Table 3: datasets",
        caption=material.settings.about_recordings,
        paper="See the table; 550 recorded pairs in all.",
        ours=(
            "The same sizes. 550 pairs cannot be 100 x 50 + 50 = 5,050: Dataset 4 is "
            "taken as 100 draws of 50 from one pool of 500, Dataset 5 as 50 more."
        ),
        verdict=verdict,
        rows=rows,
        numbers=numbers,
    )


def _reward(material: Material) -> Exhibit:
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    sets = np.array(list(itertools.combinations(range(8), 4)))
    with np.errstate(divide="ignore"):
        values = np.asarray(log_det_information(corners[sets]))
    bound = float(values.max())
    policy = material.result("dataset2", "policy").log_det[:, 0]
    best = material.evaluation("dataset2").reference
    mean = mean_interval(policy / 10.0)
    side = float(np.exp((36.0 - best.mean()) / 18.0))
    return Exhibit(
        key="reward_range",
        title="The range of the reward",
        caption=(
            f"dataset2, {len(policy):,} episodes, commands in [0, 1], natural log. The "
            "bound is over all sets of four corners of the cube; docs/reproduction.md "
            "proves that no other four points do better."
        ),
        paper="Commands in [0, 1], reward log det S / 10 between 3.0 and 4.2.",
        ours=(
            f"No four points of the unit cube have log det S above 6 ln 2 = "
            f"{bound:.4f}, so the reward cannot exceed {bound / 10:.4f}. The policy's "
            f"is {mean:.4f} on average, {policy.min() / 10:.3f} to "
            f"{policy.max() / 10:.3f}; the optimum's is at most {best.max() / 10:.3f}. "
            f"Commands in degrees only add a constant ({RANGES.log_det_scale / 10:.2f} "
            f"for ±20°); 3.0 to 4.2 would fit a cube with sides of about {side:.0f}°, "
            "or log det S itself near its bound."
        ),
        verdict="disagrees" if bound / 10 < 3.0 else "agrees",
        numbers={
            "largest_log_det_s_in_unit_cube": bound,
            "policy_reward": mean,
            "policy_reward_smallest": float(policy.min() / 10),
            "policy_reward_largest": float(policy.max() / 10),
            "optimum_reward_largest": float(best.max() / 10),
            "share_in_paper_range": float(
                ((policy / 10 >= 3.0) & (policy / 10 <= 4.2)).mean()
            ),
            "cube_side_for_3.6_deg": side,
        },
    )


def _rank(material: Material) -> Exhibit:
    data = material.dataset("dataset3")
    ranks = {
        k: [
            int(np.linalg.matrix_rank(regression_matrix(c[:k])))
            for c in data.candidates
        ]
        for k in (3, 4, 5)
    }
    least = {k: min(values) for k, values in ranks.items()}
    return Exhibit(
        key="rank",
        title="Four postures identify twelve parameters",
        caption=(
            f"Rank of the regression matrix of the first 3, 4 and 5 postures of each "
            f"of the {data.num_episodes} episodes of dataset3 (Equation 2)."
        ),
        paper="Four distinct postures suffice for the twelve parameters.",
        ours=(
            f"Rank {least[3]} with three postures, {least[4]} with four in every "
            "episode. Distinct is not enough: the four must not lie in one plane. With "
            "exactly four nothing is left over: no residual, no estimate of the noise, "
            "no test for outliers."
        ),
        verdict="agrees" if least[4] == 12 and max(ranks[3]) < 12 else "disagrees",
        numbers={f"rank_of_{k}": value for k, value in least.items()},
    )
