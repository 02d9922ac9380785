"""The paper's claims, one by one: its figure, ours, and whether they agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from jaxcal.paper.exhibits.exhibit import Claim, Exhibit, Verdict

__all__ = ["claims"]

Found = Mapping[str, Exhibit]


def claims(exhibits: list[Exhibit], recorded: str) -> list[Claim]:
    """Judge every claim by the numbers of the exhibits.

    Args:
        exhibits: all of them.
        recorded: what Datasets 4 and 5 are, in words.
    """
    found = {exhibit.key: exhibit for exhibit in exhibits}
    return [
        *_information(found, recorded),
        *_parameters(found, recorded),
        *_four_and_fifty(found),
        *_recalibration(found),
        *_training(found),
        *_calibration(found, recorded),
    ]


def _verdict(true: bool, partly: bool = False) -> Verdict:
    if true:
        return "agrees"
    return "agrees in part" if partly else "disagrees"


def _of(exhibit: Exhibit) -> Verdict:
    return exhibit.verdict or "not comparable"


def _information(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_3", "simulation"), ("figure_7", recorded)):
        numbers = found[key].numbers
        times, greedy, exact = (
            numbers[method]["times_random"] for method in ("policy", "greedy", "exact")
        )
        log, raw, relative = (
            numbers[f"policy_over_random_{name}"]
            for name in ("std_log_det_s", "std_det_s", "relative_std_det_s")
        )
        yield Claim(
            f"times_random_{key}",
            f"Mean det S against random, {where}",
            "> 100 times",
            f"{times:,.0f} times; greedy {greedy.value:,.0f}, optimum "
            f"{exact.value:,.0f}: a weak measure",
            _verdict(times.low > 100, times.high > 100),
            key,
        )
        yield Claim(
            f"reduced_variance_{key}",
            f"Less variance of det S than random, {where}",
            "reduced",
            f"s.d. of log det S {log:.3f} times random's; s.d. over mean "
            f"{relative:.3f} times; s.d. of det S itself {raw:,.0f} times",
            _verdict(
                max(log.high, relative.high, raw.high) < 1.0,
                min(log.high, relative.high) < 1.0,
            ),
            key,
        )
    best = found["figure_4"].numbers
    seen = found["figure_3"].numbers["policy"]["ratio_to_exact"]
    ratio = best["comparison"]["policy"]["ratio_to_exact"]
    times = best["comparison"]["policy"]["times_random"]
    yield Claim(
        "generalises",
        "Does as well on the independent simulation (dataset3)",
        "far above random again",
        f"{times:,.0f} times random; det S / det S* {ratio:.4f}, on dataset2 "
        f"{seen:.4f}",
        _verdict(times.low > 100 and ratio.high >= seen.low, times.low > 100),
        "figure_4",
    )
    never = best["random_draws_that_never_reach_policys_first"]
    episode = best["policy_first_episode_within_half_of_best"]
    yield Claim(
        "best_so_far",
        "Best det S comes near the upper range quickly, random slowly",
        "within a few episodes",
        f"within a factor of two from episode {episode} on; {never:.0%} of random "
        "runs of 100 episodes do not reach the policy's first episode",
        _verdict(never > 0.95 and episode <= 50, never > 0.5),
        "figure_4",
    )


def _parameters(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_5", "dataset3"), ("figure_9", recorded)):
        random = found[key].numbers["random/policy"]
        fifty = found[key].numbers["all 50/policy"]
        lower = int((random["low"] > 1.0).sum())
        fewer = int((fifty["high"] < 1.0).sum())
        yield Claim(
            f"parameter_variance_{key}",
            f"Lowest cross-episode variance of the parameters, {where}",
            "lowest, on most of the 12",
            f"below random on {lower} of 12 (by {random['value'].min():,.0f} to "
            f"{random['value'].max():,.0f} times); above all fifty postures on "
            f"{fewer} of 12",
            _verdict(lower > 6 and fewer == 0, lower > 6),
            key,
        )


def _four_and_fifty(found: Found) -> Iterator[Claim]:
    numbers = found["four_or_fifty"].numbers
    for scenario in ("white noise", "drift", "outliers"):
        ratio = numbers[scenario]["ratio_of_means"]
        better = numbers[scenario]["four_better"]
        sides = ratio.high < 1.0, better.low > 0.5
        yield Claim(
            f"four_or_fifty_{scenario.replace(' ', '_')}",
            f"Four postures predict better than fifty: {scenario}",
            "four better",
            f"mean error {ratio:.3g} times that of fifty; four better on "
            f"{better:.1%} of the devices",
            _verdict(all(sides), any(sides)),
            "four_or_fifty",
        )
    ratio = numbers["recorded"]["ratio_of_means"]
    yield Claim(
        "four_or_fifty_recorded",
        "Four of the recorded fifty predict other episodes better than the fifty",
        "four better",
        f"mean error {ratio:.3g} times that of fifty",
        _verdict(ratio.high < 1.0),
        "four_or_fifty",
    )


def _recalibration(found: Found) -> Iterator[Claim]:
    ratios = found["figure_10"].numbers["error_of_second_over_first"]
    for key, reading in (
        ("random_x0_against_x_star", "X_0 from random postures (caption)"),
        ("policy_x0_against_x_star", "X_0 from the policy's postures (text)"),
    ):
        yield Claim(
            key,
            f"Recalibration pays, {reading}",
            "X_* clearly better",
            f"X_* has {ratios[key]:.3f} times the error of X_0 on devices that drift; "
            f"age alone makes {ratios['age_alone_policy']:.3f}",
            _verdict(ratios[key].high < 1.0),
            "figure_10",
        )
    recorded = found["figure_10_recorded"]
    over = recorded.numbers["x_star_over"]
    yield Claim(
        "recalibration_recorded",
        "The same on the recordings of Datasets 5 and 4",
        "X_* clearly better",
        f"X_* has {over['x0_policy']:.3f} (X_0 by the policy) and "
        f"{over['x0_random']:.3f} (X_0 random) times the error of X_0",
        _of(recorded),
        "figure_10_recorded",
    )


def _training(found: Found) -> Iterator[Claim]:
    reward, network = found["reward_range"].numbers, found["table_2"].numbers
    size, share = network["parameters"], network["shared_share"]
    bound = reward["largest_log_det_s_in_unit_cube"] / 10.0
    yield Claim(
        "reward_range",
        "Range of the reward, commands in [0, 1]",
        "3.0 to 4.2",
        f"{reward['policy_reward_smallest']:.3f} to "
        f"{reward['policy_reward_largest']:.3f}; no choice can exceed {bound:.4f}",
        _verdict(bound >= 3.0),
        "reward_range",
    )
    yield Claim(
        "parameters",
        "Size of the network",
        "about 3.5 M",
        f"{size / 1e6:.2f} M",
        _verdict(abs(size / 3.5e6 - 1.0) < 0.03),
        "table_2",
    )
    yield Claim(
        "shared",
        "Shared by actor and critic",
        "about 71 %",
        f"{share:.1%}",
        _verdict(abs(share - 0.71) < 0.015),
        "table_2",
    )
    for key, name, ours in (
        ("figure_2_paper", "the paper's network", _convergence_of_paper),
        ("figure_2", "our compact network", _convergence_of_seeds),
    ):
        yield Claim(
            f"convergence_{key}",
            f"Converges within 200,000 episodes: {name}",
            "200,000 episodes",
            ours(found[key]),
            _of(found[key]),
            key,
        )


def _convergence_of_seeds(exhibit: Exhibit) -> str:
    numbers = exhibit.numbers
    if numbers["seeds"] < 2:
        return "no kept run in studies/"
    if exhibit.verdict == "not comparable":
        return f"{min(numbers['episodes']):,} episodes run, not finished or too few"
    text = (
        f"within 5 % of its final level from episode "
        f"{numbers['plateau_episode']:,.0f}, {numbers['seeds']} seeds"
    )
    if "ratio_to_exact" in numbers:
        text += f"; det S / det S* {numbers['ratio_to_exact']:.4f}"
    return text


def _convergence_of_paper(exhibit: Exhibit) -> str:
    numbers = exhibit.numbers
    if not numbers["present"]:
        return "no kept run in studies/"
    text = f"{numbers['episodes']:,} episodes run"
    if exhibit.verdict == "not comparable":
        return f"{text}, {'too few' if numbers['finished'] else 'not finished'}"
    text += (
        f"; within 5 % of its final level from {numbers['episode']:,.0f}; the last "
        f"tenth brings {numbers['last_tenth']:.1%} of the rise"
    )
    if numbers["dataset2"] is not None:
        text += f"; det S / det S* {numbers['dataset2']['ratio_to_exact']:.4f}"
    return text


def _calibration(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_1", "simulation"), ("figure_6", recorded)):
        numbers = found[key].numbers
        shrink = numbers["interquartile_range_shrinks_by"]
        before = {axis: numbers[f"{axis}_before"] for axis in shrink}
        widest = max(shrink, key=lambda a: before[a]["interquartile_range_deg"])
        furthest = max(shrink, key=lambda a: abs(before[a]["median_deg"]))
        yield Claim(
            f"errors_shrink_{key}",
            f"Calibration centres and narrows the errors of all axes, {where}",
            "medians near 0, narrow",
            "interquartile range smaller by "
            + ", ".join(f"{v:.3g} ({a})" for a, v in shrink.items()),
            _verdict(min(shrink.values()) > 2.0, min(shrink.values()) > 1.0),
            key,
        )
        yield Claim(
            f"yaw_{key}",
            f"Before calibration yaw is the worst axis, {where}",
            "yaw",
            f"largest offset: {furthest}; largest spread: {widest}",
            _verdict(widest == furthest == "yaw", "yaw" in (widest, furthest)),
            key,
        )
    table, rank = found["table_1"], found["rank"]
    yield Claim(
        "table_1",
        "Identification returns the set values of Table 1",
        ".43 .71 .87, 3.1 -5.8 2.41",
        f"{table.numbers['inside']} of 12 within their intervals (95 % for all at "
        "once)",
        _of(table),
        "table_1",
    )
    yield Claim(
        "four_suffice",
        "Four distinct postures identify twelve parameters",
        "4",
        f"rank {rank.numbers['rank_of_4']} with four, {rank.numbers['rank_of_3']} with "
        "three; four in one plane do not, and four leave no residual",
        _of(rank),
        "rank",
    )
    yield Claim(
        "pairs",
        "Recorded pairs of Datasets 4 and 5 (100 x 50 and 1 x 50)",
        "550",
        f"{100 * 50 + 50:,} would be needed; read as a pool of 500, and 50",
        "disagrees",
        "table_3",
    )
