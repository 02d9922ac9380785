"""The paper's claims, one by one: its figure, ours, and whether they agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from benchmarks.paper.exhibits.exhibit import Claim, Exhibit, judge

Found = Mapping[str, Exhibit]
claim = Claim.from_texts


def claims(exhibits: list[Exhibit], recorded: str) -> list[Claim]:
    """Judge every claim by the exhibits; ``recorded`` is what Datasets 4 and 5 are."""
    found = {exhibit.key: exhibit for exhibit in exhibits}
    return [
        *_information(found, recorded),
        *_parameters(found, recorded),
        *_four_and_fifty(found["four_or_fifty"]),
        *_recalibration(found),
        *_training(found),
        *_calibration(found, recorded),
        claim("pairs", found["table_3"], "disagrees"),
    ]


def _information(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_3", "simulation"), ("figure_7", recorded)):
        exhibit, numbers = found[key], found[key].numbers
        times = numbers["policy"]["times_random"]
        verdict = judge(times.low > 100, times.high > 100)
        name = "times_random"
        yield claim(name, exhibit, verdict, f"{name}_{key}", where=where)
        log, raw, relative = (
            numbers[f"policy_over_random_{name}"].high
            for name in ("std_log_det_s", "std_det_s", "relative_std_det_s")
        )
        verdict = judge(max(log, relative, raw) < 1.0, min(log, relative) < 1.0)
        name = "reduced_variance"
        yield claim(name, exhibit, verdict, f"{name}_{key}", where=where)
    best = found["figure_4"]
    policy = best.numbers["comparison"]["policy"]
    far = policy["times_random"].low > 100
    seen = found["figure_3"].numbers["policy"]["ratio_to_exact"]
    as_good = policy["ratio_to_exact"].high >= seen.low
    yield claim("generalises", best, judge(far and as_good, far), seen=seen)
    never = best.numbers["random_draws_that_never_reach_policys_first"]
    soon = best.numbers["policy_first_episode_within_half_of_best"] <= 50
    yield claim("best_so_far", best, judge(never > 0.95 and soon, never > 0.5))


def _parameters(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_5", "dataset3"), ("figure_9", recorded)):
        random = found[key].numbers["random/policy"]
        lower = int((random["low"] > 1.0).sum())
        fewer = int((found[key].numbers["all 50/policy"]["high"] < 1.0).sum())
        least, most = random["value"].min(), random["value"].max()
        words = {"lower": lower, "fewer": fewer, "least": least, "most": most}
        name, verdict = "parameter_variance", judge(lower > 6 and not fewer, lower > 6)
        yield claim(name, found[key], verdict, f"{name}_{key}", where=where, **words)


def _four_and_fifty(exhibit: Exhibit) -> Iterator[Claim]:
    name = "four_or_fifty"
    for scenario in ("white noise", "drift", "outliers"):
        numbers = exhibit.numbers[scenario]
        ratio, better = numbers["ratio_of_means"], numbers["four_better"]
        sides = ratio.high < 1.0, better.low > 0.5
        words = {"scenario": scenario, "ratio": ratio, "better": better}
        key = f"{name}_{scenario.replace(' ', '_')}"
        yield claim(name, exhibit, judge(all(sides), any(sides)), key, **words)
    ratio = exhibit.numbers["recorded"]["ratio_of_means"]
    yield claim("four_or_fifty_recorded", exhibit, judge(ratio.high < 1.0))


def _recalibration(found: Found) -> Iterator[Claim]:
    exhibit = found["figure_10"]
    for key, reading in (
        ("random_x0_against_x_star", "X_0 from random postures (caption)"),
        ("policy_x0_against_x_star", "X_0 from PPO's postures (text)"),
    ):
        ratio = exhibit.numbers["error_of_second_over_first"][key]
        words = {"reading": reading, "ratio": ratio}
        yield claim("recalibration", exhibit, judge(ratio.high < 1.0), key, **words)
    recorded = found["figure_10_recorded"]
    yield claim("recalibration_recorded", recorded, recorded.verdict)


def _training(found: Found) -> Iterator[Claim]:
    reward, network = found["reward_range"], found["table_2"]
    bound = reward.numbers["largest_log_det_s_in_unit_cube"] / 10.0
    yield claim("reward_range", reward, judge(bound >= 3.0), bound=bound)
    size, share = (network.numbers[name] for name in ("parameters", "shared_share"))
    near = judge(abs(size / 3.5e6 - 1.0) < 0.03)
    yield claim("parameters", network, near, millions=size / 1e6)
    yield claim("shared", network, judge(abs(share - 0.71) < 0.015))
    paper, seeds = found["figure_2_paper"], found["figure_2"]
    for exhibit, name, how in (
        (paper, "the paper's network", _convergence_of_paper(paper)),
        (seeds, "our compact network", _convergence_of_seeds(seeds)),
    ):
        key = f"convergence_{exhibit.key}"
        words = {"network": name, "how": how}
        yield claim("convergence", exhibit, exhibit.verdict, key, **words)


def _convergence_of_seeds(exhibit: Exhibit) -> str:
    numbers = exhibit.numbers
    if numbers["seeds"] < 2:
        return "no kept run in benchmarks/paper/kept"
    if exhibit.verdict == "not comparable":
        return f"{min(numbers['episodes']):,} episodes run, not finished or too few"
    return (
        f"within 5 % of its final level from episode "
        f"{numbers['plateau_episode']:,.0f}, {numbers['seeds']} seeds"
        f"; det S / det S* {numbers['ratio_to_exact']:.4f}"
    )


def _convergence_of_paper(exhibit: Exhibit) -> str:
    numbers = exhibit.numbers
    if not numbers["present"]:
        return "no kept run in benchmarks/paper/kept"
    text = f"{numbers['episodes']:,} episodes run"
    if exhibit.verdict == "not comparable":
        return f"{text}, {'too few' if numbers['finished'] else 'not finished'}"
    return (
        f"{text}; within 5 % of its final level from {numbers['episode']:,.0f}; the "
        f"last tenth brings {numbers['last_tenth']:.1%} of the rise; det S / det S* "
        f"{numbers['dataset2']['ratio_to_exact']:.4f}"
    )


def _calibration(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_1", "simulation"), ("figure_6", recorded)):
        exhibit, numbers = found[key], found[key].numbers
        shrink = numbers["interquartile_range_shrinks_by"]
        least = min(shrink.values())
        by = ", ".join(f"{value:.3g} ({axis})" for axis, value in shrink.items())
        words = {"where": where, "by": by}
        verdict = judge(least > 2.0, least > 1.0)
        yield claim("errors_shrink", exhibit, verdict, f"errors_shrink_{key}", **words)
        before = {axis: numbers[f"{axis}_before"] for axis in shrink}
        widest = max(shrink, key=lambda a: before[a]["interquartile_range_deg"])
        furthest = max(shrink, key=lambda a: abs(before[a]["median_deg"]))
        verdict = judge(widest == furthest == "yaw", "yaw" in (widest, furthest))
        words = {"where": where, "furthest": furthest, "widest": widest}
        yield claim("yaw", exhibit, verdict, f"yaw_{key}", **words)
    for name, key in (("table_1", "table_1"), ("four_suffice", "rank")):
        yield claim(name, found[key], found[key].verdict)
