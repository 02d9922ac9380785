"""The paper's claims, one by one: its figure, ours, and whether they agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from jaxcal.paper.exhibits.exhibit import Claim, Exhibit, Verdict

__all__ = ["claims"]

Found = Mapping[str, Exhibit]
claim = Claim.from_texts


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
        *_four_and_fifty(found["four_or_fifty"]),
        *_recalibration(found),
        *_training(found),
        *_calibration(found, recorded),
        claim("pairs", found["table_3"], "disagrees"),
    ]


def _verdict(true: bool, partly: bool = False) -> Verdict:
    if true:
        return "agrees"
    return "agrees in part" if partly else "disagrees"


def _information(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_3", "simulation"), ("figure_7", recorded)):
        numbers = found[key].numbers
        times = numbers["policy"]["times_random"]
        log, raw, relative = (
            numbers[f"policy_over_random_{name}"].high
            for name in ("std_log_det_s", "std_det_s", "relative_std_det_s")
        )
        for name, verdict in (
            ("times_random", _verdict(times.low > 100, times.high > 100)),
            (
                "reduced_variance",
                _verdict(max(log, relative, raw) < 1.0, min(log, relative) < 1.0),
            ),
        ):
            yield claim(name, found[key], verdict, f"{name}_{key}", where=where)
    best = found["figure_4"]
    policy = best.numbers["comparison"]["policy"]
    far = policy["times_random"].low > 100
    seen = found["figure_3"].numbers["policy"]["ratio_to_exact"]
    as_good = policy["ratio_to_exact"].high >= seen.low
    yield claim("generalises", best, _verdict(far and as_good, far), seen=seen)
    never = best.numbers["random_draws_that_never_reach_policys_first"]
    soon = best.numbers["policy_first_episode_within_half_of_best"] <= 50
    yield claim("best_so_far", best, _verdict(never > 0.95 and soon, never > 0.5))


def _parameters(found: Found, recorded: str) -> Iterator[Claim]:
    for key, where in (("figure_5", "dataset3"), ("figure_9", recorded)):
        random = found[key].numbers["random/policy"]
        fifty = found[key].numbers["all 50/policy"]
        lower = int((random["low"] > 1.0).sum())
        fewer = int((fifty["high"] < 1.0).sum())
        yield claim(
            "parameter_variance",
            found[key],
            _verdict(lower > 6 and fewer == 0, lower > 6),
            f"parameter_variance_{key}",
            where=where,
            lower=lower,
            fewer=fewer,
            least=random["value"].min(),
            most=random["value"].max(),
        )


def _four_and_fifty(exhibit: Exhibit) -> Iterator[Claim]:
    for scenario in ("white noise", "drift", "outliers"):
        ratio = exhibit.numbers[scenario]["ratio_of_means"]
        better = exhibit.numbers[scenario]["four_better"]
        sides = ratio.high < 1.0, better.low > 0.5
        yield claim(
            "four_or_fifty",
            exhibit,
            _verdict(all(sides), any(sides)),
            f"four_or_fifty_{scenario.replace(' ', '_')}",
            scenario=scenario,
            ratio=ratio,
            better=better,
        )
    better = exhibit.numbers["recorded"]["ratio_of_means"].high < 1.0
    yield claim("four_or_fifty_recorded", exhibit, _verdict(better))


def _recalibration(found: Found) -> Iterator[Claim]:
    exhibit = found["figure_10"]
    for key, reading in (
        ("random_x0_against_x_star", "X_0 from random postures (caption)"),
        ("policy_x0_against_x_star", "X_0 from the policy's postures (text)"),
    ):
        ratio = exhibit.numbers["error_of_second_over_first"][key]
        verdict = _verdict(ratio.high < 1.0)
        yield claim(
            "recalibration", exhibit, verdict, key, reading=reading, ratio=ratio
        )
    recorded = found["figure_10_recorded"]
    yield claim("recalibration_recorded", recorded, recorded.verdict)


def _training(found: Found) -> Iterator[Claim]:
    reward, network = found["reward_range"], found["table_2"]
    bound = reward.numbers["largest_log_det_s_in_unit_cube"] / 10.0
    yield claim("reward_range", reward, _verdict(bound >= 3.0), bound=bound)
    size, share = (network.numbers[name] for name in ("parameters", "shared_share"))
    near = _verdict(abs(size / 3.5e6 - 1.0) < 0.03)
    yield claim("parameters", network, near, millions=size / 1e6)
    yield claim("shared", network, _verdict(abs(share - 0.71) < 0.015))
    for key, name, how in (
        ("figure_2_paper", "the paper's network", _convergence_of_paper),
        ("figure_2", "our compact network", _convergence_of_seeds),
    ):
        yield claim(
            "convergence",
            found[key],
            found[key].verdict,
            f"convergence_{key}",
            network=name,
            how=how(found[key]),
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
        least = min(shrink.values())
        before = {axis: numbers[f"{axis}_before"] for axis in shrink}
        widest = max(shrink, key=lambda a: before[a]["interquartile_range_deg"])
        furthest = max(shrink, key=lambda a: abs(before[a]["median_deg"]))
        yield claim(
            "errors_shrink",
            found[key],
            _verdict(least > 2.0, least > 1.0),
            f"errors_shrink_{key}",
            where=where,
            by=", ".join(f"{v:.3g} ({a})" for a, v in shrink.items()),
        )
        yield claim(
            "yaw",
            found[key],
            _verdict(widest == furthest == "yaw", "yaw" in (widest, furthest)),
            f"yaw_{key}",
            where=where,
            furthest=furthest,
            widest=widest,
        )
    yield claim("table_1", found["table_1"], found["table_1"].verdict)
    yield claim("four_suffice", found["rank"], found["rank"].verdict)
