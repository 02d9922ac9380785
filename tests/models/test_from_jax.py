"""Models from JAX functions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.models import FromJax, Model, SerialChain, from_dict, identifiability
from jaxcal.models.predictions import derivative, predict

from .arms import UR5_TABLE, differences, ur5_data


def two_link(u, theta):
    first, both = jnp.radians(u[0] + theta[2]), jnp.radians(u[0] + u[1] + theta[3])
    return jnp.stack(
        [
            theta[0] * jnp.cos(first) + theta[1] * jnp.cos(both),
            theta[0] * jnp.sin(first) + theta[1] * jnp.sin(both),
        ]
    )


@pytest.fixture(scope="module")
def arm():
    return FromJax(two_link, [300.0, 200.0, 1.0, -2.0], ["l1", "l2", "o1", "o2"], 2)


COMMANDS = np.random.default_rng(0).uniform(-90.0, 90.0, (5, 2))


def test_derivatives_are_those_of_central_differences(arm):
    assert isinstance(arm, Model)
    at = arm.nominal + 0.5
    numeric = differences(lambda theta: arm.predict(COMMANDS, theta), at)
    np.testing.assert_allclose(arm.jacobian(COMMANDS, at), numeric, atol=1e-6)
    slopes = arm.command_jacobian(COMMANDS, at)
    for i, command in enumerate(COMMANDS):
        numeric = differences(lambda u: arm.predict([u, *COMMANDS[1:]], at)[0], command)
        np.testing.assert_allclose(slopes[i], numeric, atol=1e-6)


def test_results_are_float64_and_the_configuration_stays(arm):
    before = jax.config.jax_enable_x64
    outputs = arm.predict(COMMANDS)
    assert outputs.dtype == np.float64
    first, both = np.radians([[1.0, 0.0], [-2.0, 0.0]]) @ [[1.0], [0.0]]
    first = first + np.radians(COMMANDS[:, 0])
    both = both + np.radians(COMMANDS.sum(axis=1))
    x = 300.0 * np.cos(first) + 200.0 * np.cos(both)
    np.testing.assert_allclose(outputs[:, 0], x, rtol=1e-14)
    assert jax.config.jax_enable_x64 is before


def test_a_scalar_is_one_output():
    model = FromJax(lambda u, t: t[0] * u[0] ** t[1], [1.0, 2.0])
    assert model.names == ("t1", "t2")
    np.testing.assert_array_equal(model.predict([[3.0]]), [[9.0]])
    assert (model.num_inputs, model.num_outputs) == (1, 1)
    with pytest.raises(ValueError, match=r"commands must have shape \(N, 1\)"):
        model.predict([[3.0, 4.0]])


@pytest.mark.parametrize(
    "f", [lambda u, t: t[0] * jnp.sum(u[1:]), jax.jit(lambda u, t: u[2] * t[0])]
)
def test_the_number_of_inputs_is_that_of_the_first_commands(f):
    model = FromJax(f, [1.0])
    with pytest.raises(ValueError, match="give num_inputs"):
        model.num_inputs  # noqa: B018 (reading it is the test)
    model.predict([[1.0, 2.0, 3.0, 4.0]])
    assert model.num_inputs == 4


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda u, t: t[2] * u[0], "f must read entries of theta: index 2 is out of"),
        (
            lambda u, t: t[0] * u[0] + u[2],
            "f must read entries of u: index 2 is out of",
        ),
        (jax.jit(lambda u, t: u[0] * t[-3]), "f must read entries of theta: index -3"),
    ],
)
def test_an_index_beyond_the_end_is_refused(f, message):
    with pytest.raises(ValueError, match=message):
        FromJax(f, [1.0, 2.0], num_inputs=2)
    ends = FromJax(lambda u, t: t[-1] * u[0] + t[0] * u[-1], [1.0, 2.0], num_inputs=2)
    np.testing.assert_array_equal(ends.predict([[10.0, 100.0]]), [[120.0]])


def test_it_compiles_once_for_a_number_of_commands():
    calls = []

    def f(u, theta):
        calls.append(1)
        return theta * u

    model = FromJax(f, [1.0], num_inputs=1)
    model.predict([[1.0]])
    traced = len(calls)
    model.predict([[2.0]], [3.0])
    assert len(calls) == traced


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda u, t: np.sin(u), "JAX cannot follow f .* TracerArrayConversionError"),
        (lambda u, t: u if u[0] > 0 else t, "JAX cannot follow f .* TracerBool"),
        (lambda u, t: jnp.ones((3, 3)) @ u, r"a command \(2,\) .* TypeError"),
        (lambda u, t: jnp.outer(u, t), r"f must return an array \(q,\) .* \(2, 1\)"),
        (lambda u, t: (u[0], u[1]), "got tuple"),
        (lambda u, t: u[:0], r"got \(0,\)"),
        (3, "f must be a function"),
    ],
)
def test_functions_that_are_no_model_are_refused(f, message):
    with pytest.raises(ValueError, match=message):
        FromJax(f, [1.0], num_inputs=2)


@pytest.mark.parametrize(
    ("nominal", "names", "message"),
    [
        ([[1.0]], None, r"nominal must have shape \(p,\)"),
        ([np.nan], None, "nominal must be finite"),
        ([1.0, 2.0], ["a"], "names must hold 2 different names"),
        ([1.0, 2.0], ["a", "a"], "names must hold 2 different names"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(nominal, names, message):
    with pytest.raises(ValueError, match=message):
        FromJax(lambda u, t: u, nominal, names)


def test_what_is_not_finite_is_named():
    model = FromJax(lambda u, t: t[0] + u * jnp.sqrt(t[1]), [1.0, 0.0], ["gain", "w"])
    with pytest.raises(
        ValueError, match=r"finite, got .* by .*w for the command \(1\)"
    ):
        identifiability(model, [[1.0], [2.0]])
    with pytest.raises(ValueError, match=r"predict must be finite, got \(nan\)"):
        predict(model, np.ones((1, 1)), np.array([1.0, -1.0]))
    root = FromJax(lambda u, t: t * jnp.sqrt(u), [1.0])
    with pytest.raises(ValueError, match=r"by load for the command \(0\)"):
        derivative(root, np.zeros((1, 1)), np.ones(1), ("load",))


def test_a_function_cannot_come_back_from_a_file(arm):
    data = arm.to_dict()
    assert data["names"] == ["l1", "l2", "o1", "o2"] and data["kind"] == "jax"
    with pytest.raises(ValueError, match=r"contains a function.*model=\.\.\."):
        from_dict(data)


@pytest.mark.slow
def test_an_arm_of_ones_own_shows_what_the_chain_shows():
    """The first joints of a UR5 in JAX, radians and all: the same is seen of them."""
    chain = SerialChain.from_dh(UR5_TABLE[:3], tool=(0, 0, 31))

    def turn(axis, angle):
        c, s = jnp.cos(angle), jnp.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        eye = jnp.eye(3).at[i, i].set(c).at[j, j].set(c)
        return eye.at[i, j].set(-s).at[j, i].set(s)

    def f(u, theta):
        rows, base, tool = theta[:15].reshape(3, 5), theta[15:21], theta[21:]
        point = tool
        for (a, alpha, d, offset, beta), angle in zip(rows[::-1], u[::-1], strict=True):
            point = turn(0, alpha) @ turn(1, beta) @ point + jnp.array([1.0, 0, 0]) * a
            point = turn(2, jnp.radians(angle) + offset) @ point
            point = point + jnp.array([0.0, 0, 1]) * d
        for axis in (2, 1, 0):
            point = turn(axis, base[3 + axis]) @ point
        return base[:3] + point

    angles = np.array(chain.units) == "deg"
    nominal = np.where(angles, np.radians(chain.nominal), chain.nominal)
    model = FromJax(f, nominal, chain.names, 3)
    commands = ur5_data()[0][:60, :3]
    np.testing.assert_allclose(
        model.predict(commands), chain.predict(commands), atol=1e-9
    )
    own, built_in = (identifiability(each, commands) for each in (model, chain))
    assert own.rank == built_in.rank < 24
    words = [{each.words for each in report.directions} for report in (own, built_in)]
    assert words[0] == words[1]
