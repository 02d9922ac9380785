"""Frames and rows by name; the oracle is the same question to a plain array."""

from __future__ import annotations

import collections
import warnings

import numpy as np
import pytest

import jaxcal

pandas = pytest.importorskip("pandas")

AXES = ("pitch", "yaw", "roll")
RNG = np.random.default_rng(3)
U = RNG.uniform(-20.0, 20.0, (12, 3)).round(3)
Y = U @ np.diag([0.43, 0.71, 0.87]) + [3.1, -5.8, 2.41]
# The readings are exact: what is tested is how they are read.
pytestmark = pytest.mark.filterwarnings("ignore::jaxcal.CalibrationWarning")

COMMANDS = pandas.DataFrame(U, columns=AXES)
READINGS = pandas.DataFrame(Y, columns=[f"y_{axis}" for axis in AXES])
TARGETS = READINGS.iloc[:3, ::-1]  # roll first
DICT = TARGETS.to_dict("list")
ALL = COMMANDS.assign(available=[0, 1] * 6, index=range(12), time=np.arange(12) / 10)
ALL.insert(0, "Unnamed: 0", range(12))


@pytest.fixture(scope="module")
def calibration():
    return jaxcal.identify(COMMANDS, READINGS, noise_std=0.01)


def of_polars(columns):
    return pytest.importorskip("polars").DataFrame(columns)


def of_pyarrow(columns):
    return pytest.importorskip("pyarrow").table(columns)


def of_xarray(columns):
    xarray = pytest.importorskip("xarray")
    values = np.stack([*columns.values()], axis=-1)
    return xarray.DataArray(values, dims=("row", "axis"), coords={"axis": [*columns]})


MAKERS = {
    "pandas": pandas.DataFrame,
    "dict": dict,
    "records": lambda columns: pandas.DataFrame(columns).to_dict("records"),
    "structured": lambda columns: pandas.DataFrame(columns).to_records(index=False),
    "tuples": lambda columns: [*pandas.DataFrame(columns).itertuples()],
    "series": lambda columns: [row for _, row in pandas.DataFrame(columns).iterrows()],
    "table": lambda columns: jaxcal.read_table(columns),
    "nullable": lambda columns: pandas.DataFrame(columns).convert_dtypes(),
    "polars": of_polars,
    "lazy": lambda columns: of_polars(columns).lazy(),
    "pyarrow": of_pyarrow,
    "xarray": of_xarray,
}


@pytest.mark.parametrize("maker", MAKERS)
def test_targets_are_read_by_name_whatever_holds_them(calibration, maker):
    found = calibration.command_for(MAKERS[maker](DICT))
    np.testing.assert_allclose(found, U[:3], atol=1e-9)


Target = collections.namedtuple("Target", [*DICT])
ROWS = {
    "series": TARGETS.iloc[0],
    "pandas' tuple": next(TARGETS.itertuples()),
    "named tuple": Target(*TARGETS.iloc[0]),
    "dict": TARGETS.iloc[0].to_dict(),
    "record": TARGETS.to_records(index=False)[0],
}


@pytest.mark.parametrize("kind", ROWS)
def test_a_row_is_read_by_name(calibration, kind):
    np.testing.assert_allclose(calibration.command_for(ROWS[kind]), U[0], atol=1e-9)


def test_a_row_of_xarray_is_read_by_name(calibration):
    row = of_xarray(DICT).isel(row=0)
    np.testing.assert_allclose(calibration.command_for(row), U[0], atol=1e-9)


def test_what_has_no_names_is_read_by_its_place(calibration):
    for given in (Y[0], Y[0].tolist(), tuple(Y[0]), pandas.Series(Y[0])):
        np.testing.assert_allclose(calibration.command_for(given), U[0], atol=1e-9)


@pytest.mark.parametrize("maker", ["pandas", "dict", "polars", "pyarrow", "records"])
def test_select_leaves_out_what_the_shell_does(maker):
    mask = np.array([0, 1] * 6)
    expected = jaxcal.select(U, 4, available=mask).indices
    with pytest.warns(UserWarning, match="'index', 'time' are not read"):
        found = jaxcal.select(MAKERS[maker](ALL.to_dict("list")), 4)
    np.testing.assert_array_equal(found.indices, expected)


def test_a_table_of_both_is_identified():
    both = pandas.concat([COMMANDS.add_prefix("u_"), READINGS], axis=1)
    for given in (both, both.to_dict("list"), jaxcal.read_table(both)):
        found = jaxcal.identify(given)
        assert found.input_names == tuple(f"u_{axis}" for axis in AXES)
        np.testing.assert_allclose(found.matrix, np.diag([0.43, 0.71, 0.87]), atol=1e-9)


def test_three_axes_of_a_frame_are_three():
    frame = pandas.DataFrame(U, columns=["x_mm", "y_mm", "z_mm"])
    with pytest.warns(UserWarning, match="'y_mm' is read as input: a coordinate"):
        assert jaxcal.identify(frame, READINGS).input_names == ("x_mm", "y_mm", "z_mm")
    with pytest.warns(UserWarning, match="'y_mm' is read as input: a coordinate"):
        found = jaxcal.identify(frame, frame.copy())
    assert found.output_names == ("x_mm", "y_mm", "z_mm")


def test_readings_leave_out_the_time():
    with pytest.warns(UserWarning, match="ignored: time"):
        found = jaxcal.identify(COMMANDS, READINGS.assign(time=np.arange(12.0)))
    assert found.output_names == tuple(READINGS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"yaw": ["fast", "slow"] * 6}, None),  # a label, said
        ({"u_yaw": ["fast", "slow"] * 6}, "row 0, column 'u_yaw' must .* got 'fast'"),
        (
            {"yaw": [np.nan, *U[1:, 1]]},
            "row 0, column 'yaw' must .*, got nan",
        ),
        ({"yaw": [*map(str, U[:-1, 1]), "x"]}, "row 11, column 'yaw' must .* got 'x'"),
        ({"available": [1] * 11 + [2]}, "row 11, available must be 1 or 0, .* got 2"),
    ],
)
def test_a_fault_names_row_and_column(changes, message):
    frame = COMMANDS.assign(**changes)
    if message is None:
        with pytest.warns(UserWarning, match="'yaw' is read as label"):
            jaxcal.select(frame, 3)
        return
    with pytest.raises(ValueError, match=message):
        jaxcal.select(frame, 4)
    if "available" in changes:
        return
    with pytest.raises(ValueError, match=message.replace("yaw'", "yaw'")):
        jaxcal.identify(frame, READINGS)


FREE = np.arange(12) != 4
MASKS = {
    "dict": lambda c, m: {x: np.ma.masked_array(y, m & (x == "yaw")) for x, y in c},
    "whole numbers": lambda c, m: {
        x: np.ma.masked_array(y.astype(int), m & (x == "yaw")) for x, y in c
    },
    "words": lambda c, m: {
        x: np.ma.masked_array([*map(str, y)], m & (x == "yaw")) for x, y in c
    },
    "structured": lambda c, m: np.ma.array(
        [*zip(*(y for _, y in c), strict=True)],
        dtype=[(x, float) for x, _ in c],
        mask=[tuple(bad and x == "yaw" for x, _ in c) for bad in m],
    ),
}
MASKS["rows"] = lambda c, m: [*MASKS["structured"](c, m)]


@pytest.mark.parametrize("maker", MASKS)
def test_a_masked_number_is_missing(maker):
    columns = [(name, COMMANDS[name].to_numpy()) for name in AXES]
    healthy = MASKS[maker](columns, np.zeros(12, bool))
    masked = MASKS[maker](columns, ~FREE)
    jaxcal.identify(healthy, READINGS)
    for question in (jaxcal.identify, lambda frame, _: jaxcal.select(frame, 4)):
        with pytest.raises(ValueError, match=r"row 4, column 'yaw' must hold a number"):
            question(masked, READINGS)
    wanted = jaxcal.select(healthy, 4, available=FREE).indices
    found = jaxcal.select(masked, 4, available=FREE).indices
    np.testing.assert_array_equal(found, wanted)


def test_a_masked_target_is_missing(calibration):
    row = dict(TARGETS.iloc[0])
    calibration.command_for(row)
    for given in (row, [row, row]):
        row["y_yaw"] = np.ma.masked
        with pytest.raises(ValueError, match="row 0, column 'y_yaw' must hold a num"):
            calibration.command_for(given)


@pytest.mark.parametrize(
    ("available", "message"),
    [
        (["yes", "no"] * 6, "available must hold True or 1 .* got yes"),
        ([True] * 5, r"available must have shape \(12,\), got \(5,\)"),
        ([[1] * 12], r"available must have shape \(12,\), got \(1, 12\)"),
    ],
)
def test_what_is_no_mask_is_refused(available, message):
    with pytest.raises(ValueError, match=message):
        jaxcal.select(COMMANDS, 4, available=available)
    gap = COMMANDS.assign(yaw=np.where(FREE, U[:, 1], np.nan))
    for mask in (FREE, FREE.astype(int), FREE.astype(float), FREE.tolist()):
        assert 4 not in jaxcal.select(gap, 4, available=mask).indices


def test_a_constant_column_is_named():
    with pytest.raises(ValueError, match=r"the same in every row: load$"):
        jaxcal.select(COMMANDS.assign(load=3.0), 5)


def test_rows_that_are_not_available_are_used_and_said(calibration):
    flags = {"available": [0, 1, 1] * 4}
    both = COMMANDS.join(READINGS).rename(columns=lambda x: x if "_" in x else f"u_{x}")
    for question in (
        jaxcal.identify,
        calibration.predict,
        calibration.command_for,
        calibration.check,
    ):
        with pytest.warns(UserWarning, match="rows are used, 4 of them with 0"):
            question(both.assign(**flags))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            question(both.assign(available=True))
        assert not [x for x in said if x.category is UserWarning]


def test_single_precision_stays_what_it_is():
    frame = COMMANDS.astype(np.float32)
    plain = jaxcal.Design(frame.to_numpy()).candidates
    np.testing.assert_array_equal(jaxcal.Design(frame).candidates, plain)


def test_words_among_readings_are_refused():
    with pytest.raises(ValueError, match=r"row 0, column 'y_two' must .* got 'ok'"):
        jaxcal.identify(COMMANDS, READINGS.assign(y_two=["ok", "bad"] * 6))


def test_names_that_are_none_are_refused():
    for frame, message in (
        (COMMANDS.rename(columns={"yaw": 3}), "every column needs a text"),
        (pandas.concat({"a": COMMANDS}, axis=1), "every column needs a text"),
        (COMMANDS[["pitch", "pitch"]], "column 'pitch' comes twice"),
    ):
        with pytest.raises(ValueError, match=message):
            jaxcal.select(frame, 3)
    with pytest.raises(ValueError, match="table must be a path or have names"):
        jaxcal.read_table(U)


def test_available_is_given_once():
    frame = COMMANDS.assign(Available=[0, 1] * 6)
    mask = np.array([False, True] * 6)
    found = jaxcal.select(frame, 4, available=mask)
    np.testing.assert_array_equal(found.indices, jaxcal.select(frame, 4).indices)
    with pytest.raises(ValueError, match="the candidates' column 'available' differ"):
        jaxcal.select(frame, 4, available=~mask)


def test_an_import_loads_no_frames():
    import subprocess
    import sys

    code = (
        "import sys, jaxcal; jaxcal.read_table\n"
        "assert not {'pandas', 'polars', 'pyarrow', 'narwhals'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_index_in_another_order_is_said():
    shuffled = COMMANDS.sample(frac=1.0, random_state=0)
    said = "Rows are paired by position: row 0 is"
    with pytest.warns(UserWarning, match=said):
        jaxcal.identify(shuffled, READINGS, noise_std=0.01)
    at_hand = jaxcal.identify(shuffled, READINGS.loc[shuffled.index], noise_std=0.01)
    np.testing.assert_allclose(
        at_hand.affine[0], np.diag([0.43, 0.71, 0.87]), atol=1e-6
    )


@pytest.mark.parametrize("names", [("u1", "u2", "y1"), ("U_a", "U_b", "Y_a")])
def test_a_reading_in_another_spelling_is_said(names):
    with pytest.warns(UserWarning, match=f"'{names[2]}' is read as input: readings"):
        jaxcal.select(pandas.DataFrame(U, columns=names), 4)


def test_what_is_in_the_index_or_in_later_rows_alone_is_refused():
    frame = pandas.DataFrame({"u_a": [1.0, 2.0, 4.0], "u_b": [3.0, 1.0, 2.0]})
    for keys in ("u_a", ["u_a", "u_b"]):
        with pytest.raises(ValueError, match="is in the index; frame"):
            jaxcal.select(frame.assign(u_c=[9.0, 1.0, 5.0]).set_index(keys))
    rows = [{"u_a": 1.0, "y_1": 2.0}, {"u_a": 3.0, "y_1": 4.0, "u_b": 7.0}]
    with pytest.raises(ValueError, match="row 1 has 'u_b', which row 0 lacks"):
        jaxcal.read_table(rows)


def test_indices_that_only_overlap_are_said():
    commands = pandas.DataFrame({"a": np.arange(6.0) ** 2})
    measured = pandas.DataFrame({"y": 2.0 * np.arange(6.0)}, index=range(1, 7))
    with pytest.warns(UserWarning, match="indices that differ. Rows are paired"):
        jaxcal.identify(commands, measured)


def test_names_of_rows_are_refused():
    rng = np.random.default_rng(0)
    commands = rng.normal(size=(9, 3))
    fit = jaxcal.identify(
        commands,
        commands + 0.01 * rng.normal(size=(9, 3)),
        output_names=["a", "b", "c"],
    )
    targets = pandas.DataFrame(np.eye(3), columns=["c", "a", "b"])
    expected = np.stack([fit.command_for(row) for row in np.eye(3)[:, [1, 2, 0]]])
    np.testing.assert_allclose(fit.command_for(targets), expected)
    with pytest.raises(ValueError, match=r"c, a, b are names of rows; transpose it"):
        fit.command_for(targets.T)


LIMITS = pandas.DataFrame(
    {"high": [50.0, 1.0, 9.0], "low": [0.0, -1.0, -9.0]}, index=["yaw", "pitch", "roll"]
)


@pytest.mark.filterwarnings("ignore:.* clipped:UserWarning")
@pytest.mark.parametrize(
    "limits",
    [
        LIMITS,
        LIMITS.T,
        LIMITS.rename(columns={"low": "min", "high": "max"}),
        LIMITS[["low", "high"]].set_axis([0, 1], axis=1),
        LIMITS.loc[[*AXES]].reset_index(drop=True),
        LIMITS.reset_index(names="axis"),
        {name: (row.low, row.high) for name, row in LIMITS.iterrows()},
        collections.namedtuple("Limits", LIMITS.index)(
            (0.0, 50.0), (-1.0, 1.0), (-9.0, 9.0)
        ),
    ],
    ids=lambda limits: type(limits).__name__,
)
def test_limits_are_read_by_name(calibration, limits):
    target, plain = TARGETS.iloc[0], LIMITS.loc[[*AXES], ["low", "high"]].to_numpy()
    commands = [
        calibration.command_for(target, limits=one, clip=True)
        for one in (limits, plain)
    ]
    np.testing.assert_array_equal(*commands)
    model = jaxcal.models.Linear("1 + pitch + yaw + roll", inputs=AXES)
    designs = [
        jaxcal.optimise(one, 4, model, starts=1, time_limit=1.0).commands
        for one in (limits, plain)
    ]
    np.testing.assert_array_equal(*designs)


def test_limits_of_other_names_are_refused(calibration):
    for other, missing in (
        (LIMITS.rename(index={"yaw": "jaw"}), "'yaw' is missing .columns: jaw"),
        (LIMITS.rename(columns={"low": "from"}), "'low' is missing .columns: high, f"),
        ({"yaw": (0.0, 1.0)}, "'pitch' is missing"),
    ):
        with pytest.raises(ValueError, match=f"limits needs .*{missing}"):
            calibration.command_for(TARGETS, limits=other, clip=True)


@pytest.mark.parametrize("named", [True, False])
def test_commands_beside_candidates_are_read_by_name(named):
    model = jaxcal.models.Linear("1 + pitch + yaw + roll + I(pitch**2)", inputs=AXES)
    where, limits = COMMANDS.iloc[:5], [[-20.0, 20.0]] * 3
    candidates = COMMANDS if named else U
    moved, plain = where[["roll", "pitch", "yaw"]], where.to_numpy()
    answers = []
    for at in (moved, plain):
        design = jaxcal.Design(candidates, model, measured=at)
        motion = jaxcal.Motion((10.0, 1.0, 5.0), (10.0, 1.0, 5.0))
        answers.append(
            [
                design.select(6).value,
                design.select(6, jaxcal.I(at)).value,
                design.select(6, "G", region=at).value,
                design.plan(1.0, noise_std=0.1, region=at).standard_error[0],
                design.fastest(
                    5, motion, start=at.loc[0] if at is moved else at[0]
                ).seconds,
                jaxcal.optimise(
                    limits, 6, model, region=at, criterion="I", starts=1
                ).value,
                design.refine([*range(6)], criterion="I", region=at, starts=1).value,
            ]
        )
    np.testing.assert_array_equal(*answers)
    with pytest.raises(ValueError, match=r"region needs .* 'roll' is missing"):
        jaxcal.select(
            candidates, 6, model=model, region=where[["yaw", "pitch"]], criterion="I"
        )


def test_an_index_of_available_in_another_order_is_said():
    flags = pandas.Series([1, 0] * 6, index=range(12)).iloc[::-1]
    with pytest.warns(UserWarning, match="candidates and available have the same ind"):
        jaxcal.select(COMMANDS, 4, available=flags)
    with pytest.warns(UserWarning, match="commands and weights have the same index"):
        jaxcal.identify(COMMANDS, READINGS, noise_std=0.01, weights=flags)


FIVE = [1.0, 2.0, 4.0, 8.0, 3.0]


@pytest.mark.parametrize(
    ("maker", "cells", "got"),
    [
        (of_polars, [{"p": i} for i in range(5)], r"\{'p': 0\}"),
        (of_polars, [[i] * (i + 1) for i in range(5)], r"\[0\]"),
        (pandas.DataFrame, [{"p": i} for i in range(5)], r"\{'p': 0\}"),
        (dict, [[i] * (i + 1) for i in range(5)], r"\[0\]"),
    ],
)
def test_cells_that_hold_more_than_a_number_are_named(maker, cells, got):
    frame = maker({"u_a": cells, "u_b": FIVE})
    with pytest.raises(ValueError, match=f"row 0, column 'u_a' must .* got .{got}"):
        jaxcal.select(frame)
    fit = jaxcal.identify({"u_a": FIVE, "u_b": FIVE[::-1]}, {"y_c": FIVE})
    with pytest.raises(ValueError, match=f"row 0, column 'u_a' must .* got .{got}"):
        fit.predict(frame)


def test_variables_of_two_axes_are_named_with_the_rule(calibration):
    xarray = pytest.importorskip("xarray")
    grid = {name: (("p", "q"), U[:, i].reshape(3, 4)) for i, name in enumerate(AXES)}
    for frame in (xarray.Dataset(grid), {x: values for x, (_, values) in grid.items()}):
        with pytest.raises(
            ValueError, match=r"'pitch' must hold one number a row, got"
        ):
            jaxcal.select(frame)
        outputs = calibration.predict(frame)
        np.testing.assert_array_equal(outputs, calibration.predict(U.reshape(3, 4, 3)))
    mixed = xarray.Dataset(grid | {"roll": (("p",), U[:3, 2])})
    with pytest.raises(ValueError, match=r"'roll' must have the shape .3, 4. of 'pit"):
        calibration.predict(mixed)


def test_what_is_not_needed_is_said_once(calibration):
    both = pandas.concat([COMMANDS, READINGS], axis=1).assign(note="a", index=range(12))
    more = both.assign(depth=np.arange(12.0) ** 2)
    for question, argument in (
        (calibration.predict, "commands"),
        (calibration.predict_std, "commands"),
        (calibration.command_for, "desired"),
        (lambda row: calibration.command_for(row.iloc[0]), "desired"),
        (calibration.check, "commands"),
        (lambda rows: calibration.verification(rows, 3), "candidates"),
    ):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            question(more)
            question(both)
        texts = [str(warning.message) for warning in said]
        assert texts == [f"{argument}: column 'depth' is ignored (not needed)"]


def test_levels_of_noise_and_of_a_prior_are_read_by_name():
    names = [*READINGS][::-1]
    level = pandas.Series([0.3, 0.2, 0.1], index=names)
    plain = jaxcal.identify(COMMANDS, READINGS, noise_std=[0.1, 0.2, 0.3])
    for noise in ({"noise_std": level}, {"noise": level}):
        fit = jaxcal.identify(COMMANDS, READINGS, **noise)
        np.testing.assert_array_equal(fit.noise_std, plain.noise_std)
    model = jaxcal.models.Affine(3, 3)
    stds = pandas.Series({"by": 2.0, "a12": 0.5})
    given = jaxcal.Prior(stds, mean=stds).resolve(model)
    wanted = jaxcal.Prior(stds.to_dict(), mean=stds.to_dict()).resolve(model)
    np.testing.assert_array_equal(given.precisions, wanted.precisions)
    np.testing.assert_array_equal(given.mean, wanted.mean)


@pytest.mark.parametrize(
    "make",
    [
        lambda named: jaxcal.Noise(named),
        lambda named: jaxcal.Noise(1.0, command_std=named),
        lambda named: jaxcal.Motion(named, 1.0),
        lambda named: jaxcal.Motion(1.0, named),
        lambda named: jaxcal.select(COMMANDS, 4, noise=named),
    ],
)
def test_names_that_nothing_can_be_matched_with_are_refused(make):
    with pytest.raises(ValueError, match=r"read by position.* roll, pitch, yaw:"):
        make(pandas.Series([1.0, 2.0, 3.0], index=["roll", "pitch", "yaw"]))
