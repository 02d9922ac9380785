"""Linear models: formulas, functions, polynomials."""

from __future__ import annotations

import builtins
import itertools

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from jaxcal.extras import MissingExtraError
from jaxcal.models import Affine, Linear, Model, Polynomial, SerialChain, from_dict

from .arms import differences

FORMULA = "1 + x + y + x:y + I(x**2) + sin(2*pi*x/30)"


def test_a_formula_is_its_terms_in_their_order(rng):
    x, y = commands = rng.uniform(-3.0, 3.0, (2, 7))
    model = Linear(FORMULA)
    assert model.inputs == ("x", "y")
    assert model.names == (
        *("1", "x", "y", "x:y", "I(x ** 2)", "sin(2 * pi * x / 30)"),
    )
    expected = [np.ones(7), x, y, x * y, x**2, np.sin(2 * np.pi * x / 30)]
    np.testing.assert_allclose(model.jacobian(commands.T)[:, 0], np.transpose(expected))


@pytest.mark.parametrize(
    ("formula", "names"),
    [
        ("x*y", ("1", "x", "y", "x:y")),
        ("0 + x", ("x",)),
        ("(x + y + z)**2 - 1", ("x", "x:y", "x:z", "y", "y:z", "z")),
        ("u1 + np.exp(u3)", ("1", "u1", "np.exp(u3)")),
    ],
)
def test_formulas_of_the_usual_kind(formula, names):
    assert Linear(formula).names == names


def test_outputs_have_parameters_of_their_own(rng):
    model = Linear("1 + x", 2)
    assert model.names == ("y1:1", "y1:x", "y2:1", "y2:x")
    outputs = model.predict([[2.0], [3.0]], [1.0, 10.0, 5.0, -1.0])
    np.testing.assert_array_equal(outputs, [[21.0, 3.0], [31.0, 2.0]])


def test_a_first_degree_polynomial_is_the_affine_model(rng):
    commands = rng.normal(size=(6, 3))
    affine, linear = Affine(3, 2), Polynomial(1, 3, 2)
    order = [linear.names.index(f"y{i}:{t}") for i in (1, 2) for t in "xyz"]
    order += [linear.names.index(f"y{i}:1") for i in (1, 2)]
    np.testing.assert_allclose(
        affine.jacobian(commands), linear.jacobian(commands)[:, :, order]
    )


def test_a_polynomial_holds_every_monomial():
    assert Polynomial(2, 2).names == ("1", "x", "y", "x^2", "x y", "y^2")
    model = Polynomial(3, 4)
    assert len(model.names) == 35 and model.names[1:3] == ("u1", "u2")
    at = np.array([2.0, 3.0, 5.0, 7.0])
    powers = [p for p in itertools.product(range(4), repeat=4) if sum(p) <= 3]
    expected = sorted(np.prod(at ** np.array(p)) for p in powers)
    assert sorted(model.jacobian(at[None])[0, 0]) == expected


MODELS = [
    Linear(FORMULA, 2),
    Linear("0 + exp(x) + abs(x - 1):tanh(y) + sqrt(y + 4) + I(x**3):arctan(z)"),
    Linear(lambda u: np.stack([u[:, 0], u[:, 1] ** 2], axis=1), 2, inputs=2),
    Polynomial(3, 2, 2),
    Affine(3, 2),
]


@hypothesis.given(st.sampled_from(MODELS), st.integers(0, 2**32 - 1))
def test_derivatives_are_those_of_central_differences(model, seed):
    rng = np.random.default_rng(seed)
    assert isinstance(model, Model)
    commands = rng.uniform(-3.0, 0.9, (3, model.num_inputs))
    parameters = rng.normal(size=model.num_parameters)
    np.testing.assert_allclose(
        model.jacobian(commands, parameters),
        differences(lambda at: model.predict(commands, at), parameters),
        atol=1e-7,
    )
    for i, command in enumerate(commands):
        numeric = differences(
            lambda at: model.predict(at[None], parameters)[0], command
        )
        np.testing.assert_allclose(
            model.command_jacobian(commands, parameters)[i], numeric, atol=1e-6
        )


def test_a_data_frame_is_read_by_its_columns():
    class Frame(dict):
        columns = ("load", "time", "angle")

    frame = Frame(load=[2.0], time=[7.0], angle=[30.0])
    model = Linear("angle + load", inputs=["angle", "load"])
    np.testing.assert_array_equal(model.predict(frame, [1.0, 1.0, 10.0]), [[51.0]])
    Frame.columns = ("angle",)
    with pytest.raises(ValueError, match="'load' is missing"):
        model.predict(frame)


@pytest.mark.parametrize(
    ("features", "options", "message"),
    [
        ("x + foo(x)", {}, r"features may hold .* got 'foo\(x\)'"),
        (
            "x +* y",
            {},
            r"must be the right-hand side of a formula, got 'x \+\* y': Operator",
        ),
        ("y ~ x", {}, "must be the right-hand side"),
        (
            "x + x^2",
            {},
            r"reads x\^2 as x; for a power write I\(x\*\*2\)",
        ),
        ("x + y + y ** 3", {}, r"for a power write I\(y\*\*3\)"),
        ("x + x:x", {}, "reads x:x as x"),
        ("x + sin(2 * x)**2", {}, r"write I\(sin\(2 \* x\)\*\*2\)"),
        ("angle + load", {}, "inputs must be given .* uses angle, load"),
        ("angle", {"inputs": ["load"]}, "must use the inputs load, got 'angle'"),
        ("x", {"terms": ["a"]}, "terms must be left out"),
        ("x", {"num_outputs": 0}, "num_outputs must be at least 1"),
        (3, {}, "features must be a formula or a function, got 3"),
        (np.sin, {}, "inputs must be given with a function"),
        (lambda u: u[:, 0], {"inputs": 2}, r"must return \(1, r\) for commands"),
        (
            lambda u: u,
            {"inputs": 2, "terms": ["a"]},
            "terms must hold 2 different names",
        ),
    ],
)
def test_features_that_do_not_fit_are_refused(features, options, message):
    with pytest.raises(ValueError, match=message):
        Linear(features, **options)


@pytest.mark.parametrize(
    "formula",
    [
        "x + I(open('stolen', 'w'))",
        "I(().__class__.__bases__)",
        "I(x.tofile('stolen'))",
        "I(np.load('stolen'))",
        "I(np.__loader__)",
        "{[c for c in (1,)]}",
        "I((lambda: 1)())",
        "I(x[0])",
        "I('a' * 9)",
        "I(sin(x, out=x))",
    ],
)
def test_a_formula_is_not_run_as_python(formula, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="features"):
        Linear(formula, inputs=["x"])
    assert not list(tmp_path.iterdir())


def test_a_feature_that_is_not_finite_is_named():
    with pytest.raises(ValueError, match=r"'log\(x\)' is nan at candidate 1 \(x = -2"):
        Linear("log(x)").predict([[1.0], [-2.0]])


def test_a_function_that_changes_its_shape_is_refused():
    model = Linear(lambda u: np.ones((len(u), 1 + (len(u) > 1))), inputs=1)
    with pytest.raises(ValueError, match=r"must return \(2, 1\)"):
        model.jacobian([[1.0], [2.0]])


@pytest.mark.parametrize("model", [Linear("x*y", 2), Polynomial(2, 3), Affine(2, 1)])
def test_a_model_comes_back_from_json(model):
    again = from_dict(model.to_dict())
    assert again.to_dict() == model.to_dict() and again.names == model.names


def test_a_model_that_a_file_cannot_hold_is_refused():
    model = Linear(lambda u: u, inputs=1)
    with pytest.raises(ValueError, match=r"contains a function.*model=\.\.\."):
        from_dict(model.to_dict())
    with pytest.raises(ValueError, match="kind of the model must be one of affine"):
        from_dict({"kind": "cubic"})
    with pytest.raises(ValueError, match=r"kind polynomial .* missing .* 'degree'"):
        from_dict({"kind": "polynomial"})
    chain = SerialChain.from_dh([(1.0, 90, 0, 0), (2.0, 0, 0, 0)]).to_dict()
    with pytest.raises(ValueError, match=r"kind serial_chain .* unexpected .* 'tabel'"):
        from_dict({**chain, "tabel": []})
    with pytest.raises(ValueError, match="kind serial_chain must hold values as"):
        from_dict({**chain, "joints": 5})
    with pytest.raises(ValueError, match="a model must be a JSON object"):
        from_dict([1])  # type: ignore[arg-type]  # the point


def test_without_formulaic_the_command_is_named(monkeypatch):
    load = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.partition(".")[0] == "formulaic":
            raise ModuleNotFoundError(name=name)
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    assert Polynomial(2, 1).names == ("1", "x", "x^2")
    with pytest.raises(MissingExtraError, match=r"pip install .*\[models\]'"):
        Linear("x")
