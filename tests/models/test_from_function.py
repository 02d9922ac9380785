"""FromFunction: derivatives against those by hand and by JAX, runs, failures, files."""

import concurrent.futures
import importlib
import os
import re
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

import jaxcal
from jaxcal.commands import main as jaxcal_main
from jaxcal.models import FromFunction, from_dict
from jaxcal.models.runs import Runs

NOMINAL = np.array([2.0, 0.5, 0.0])
SCALE, NAMES = [0.5, 0.1, 1.0], ("a", "k", "c")
U = np.linspace(0.0, 8.0, 17)[:, None]


def decay(u, theta):
    a, k, c = theta
    return a * np.exp(-k * u[0]) + c


def decays(u, theta):
    a, k, c = theta
    return a * np.exp(-k * u) + c


def fails_far(u, theta):
    if u[0] > 7.0:
        raise RuntimeError("too far")
    return [decay(u, theta), np.nan if u[0] == 3.0 else 1.0]


def by_hand(u, theta):
    """(N, 1, 3) and (N, 1, 1)."""
    a, k, _ = theta
    e = np.exp(-k * u)
    return np.stack([e, -a * u * e, np.ones_like(e)], -1), (-a * k * e)[..., None]


def model(f=decay, **options):
    return FromFunction(f, NOMINAL, SCALE, NAMES, **options)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_derivatives_are_those_by_hand_in_any_unit(unit):
    exact, by_command = by_hand(U, NOMINAL)
    one = FromFunction(
        lambda u, t: unit * decay(u / unit, t / [unit, 1.0, 1.0]),
        NOMINAL * [unit, 1.0, 1.0],
        np.array(SCALE) * [unit, 1.0, 1.0],
    )
    scale = np.array([1.0, unit, unit])
    np.testing.assert_allclose(one.jacobian(U * unit), exact * scale, atol=1e-7 * unit)
    np.testing.assert_allclose(one.command_jacobian(U * unit), by_command, atol=1e-7)
    assert one.fitting.resolution <= 1e-8


@pytest.mark.parametrize("noise", [1e-10, 1e-6, 1e-3])
def test_steps_are_as_long_as_the_noise_of_f_asks(noise):
    rng = np.random.default_rng(0)
    noisy = model(lambda u, t: decay(u, t) + noise * rng.normal())
    off = np.abs(noisy.jacobian(U) - by_hand(U, NOMINAL)[0]) * SCALE
    # A tenth of the readings' size, and differences of fifth order: noise^(4/5).
    assert off.max() < 30.0 * noise**0.8
    found = noisy.differences(U)
    assert 0.3 * noise < found.noise[0] < 3.0 * noise
    rms = np.sqrt((off**2).mean(axis=(0, 1)))
    size = np.sqrt(((by_hand(U, NOMINAL)[0] * SCALE) ** 2).mean(axis=(0, 1)))
    assert (rms / size < 5.0 * found.errors + 1e-12).all()  # what it says is so
    assert "noise of f" in str(found) and found.steps[1] < found.steps[2]


def test_a_parameter_at_the_edge_gets_differences_to_one_side():
    def friction(u, theta):
        if theta[1] < 0.0:
            raise ValueError("friction below zero")
        return theta[0] * u[0] * np.exp(-theta[1] * u[0])

    one = FromFunction(friction, [1.0, 0.0], [0.1, 0.1])
    found = one.jacobian(U)[:, 0]
    np.testing.assert_allclose(found, np.hstack([U, -(U**2)]), atol=1e-8)
    assert one.differences(U).sides == ("central", "forward")


def test_batch_processes_and_one_by_one_agree(tmp_path):
    one = model().jacobian(U)
    np.testing.assert_array_equal(model(decays, batch=True).jacobian(U), one)
    assert model(decays, batch=True).predict(U[:1]).shape == (1, 1)


def test_a_function_of_all_commands_is_called_once_for_their_derivative():
    sizes = []

    def area(u, theta):
        sizes.append(len(u))
        return theta * u[:, :1] * u[:, 1:]

    one = FromFunction(area, [2.0], inputs=2, batch=True, quiet=True)
    rectangles = np.array([[1.0, 3.0], [2.0, 5.0]])
    one.command_jacobian(rectangles)  # which finds the steps
    sizes.clear()
    slopes = one.command_jacobian(rectangles + 0.5)[:, 0]
    np.testing.assert_allclose(slopes, 2.0 * (rectangles[:, ::-1] + 0.5), rtol=1e-8)
    assert sizes == [16]


ENDS = """
import os


def f(u, theta):
    if u[0] == 3.0:
        os._exit(1)
    return u[0] * theta
"""


@pytest.mark.slow
def test_processes_agree_and_a_run_that_ends_one_is_named(tmp_path, monkeypatch):
    (tmp_path / "ends_its_process.py").write_text(ENDS)
    monkeypatch.syspath_prepend(str(tmp_path))
    f = importlib.import_module("ends_its_process").f
    parallel = FromFunction(f, [2.0], processes=2, quiet=True)
    rows = U[[0, 3, 6, 8]]  # the third is the one
    with pytest.warns(UserWarning, match=r"there: 2 \(its process ended\)"):
        design = jaxcal.Design(rows, parallel)
    assert design.available.tolist() == [True, True, False, True]
    np.testing.assert_array_equal(
        parallel.predict(rows)[[0, 1, 3]], 2 * rows[[0, 1, 3]]
    )
    parallel.close()
    with pytest.raises(
        ValueError, match="f must be a function at the top of an importable"
    ):
        model(lambda u, t: decay(u, t), processes=2)


@pytest.mark.slow
def test_a_run_may_end_its_process_before_all_are_handed_over(tmp_path, monkeypatch):
    (tmp_path / "ends_its_process.py").write_text(ENDS)
    monkeypatch.syspath_prepend(str(tmp_path))
    f = importlib.import_module("ends_its_process").f
    submit = ProcessPoolExecutor.submit

    def waited_for(pool, *args):
        future = submit(pool, *args)
        concurrent.futures.wait([future])
        return future

    monkeypatch.setattr(ProcessPoolExecutor, "submit", waited_for)
    parallel = FromFunction(f, [2.0], processes=2, quiet=True)
    rows = U[[6, 0, 3, 8]]
    with pytest.warns(UserWarning, match=r"there: 0 \(its process ended\)"):
        design = jaxcal.Design(rows, parallel)
    assert design.available.tolist() == [False, True, True, True]
    parallel.close()


@pytest.mark.slow
def test_a_cluster_of_dask_runs_f_and_names_what_ends_a_worker():
    """Its local cluster; of a function that only this process knows."""
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    here = os.getpid()

    def f(u, theta):
        if u[0] == 3.0:
            os._exit(1)
        if u[0] > 7.0:
            raise RuntimeError("too far")
        return [theta[0] * np.exp(-theta[1] * u[0]), float(os.getpid() == here)]

    rows = U[[0, 3, 6, 8, 16]]
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 2}),
        distributed.Client(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as client,
        client.get_executor() as executor,
    ):
        runs = Runs(f, False, executor, True)
        (values,), (reasons,) = runs([(rows, np.array([2.0, 0.5]))])
        runs.close()  # the executor is the caller's
        assert executor.submit(abs, -1).result() == 1
    assert reasons == {2: "its process ended", 4: "RuntimeError: too far"}
    expected = 2.0 * np.exp(-0.5 * rows[[0, 1, 3], 0])
    np.testing.assert_array_equal(values[[0, 1, 3]], np.c_[expected, np.zeros(3)])


def test_an_executor_of_ones_own_keeps_the_order():
    with concurrent.futures.ThreadPoolExecutor(3) as executor:
        one = model(processes=executor, quiet=True)
        np.testing.assert_array_equal(one.predict(U), model().predict(U))
        np.testing.assert_array_equal(one.jacobian(U), model().jacobian(U))
        one.close()
        assert executor.submit(abs, -1).result() == 1
    with pytest.raises(ValueError, match="processes must be a whole number"):
        model(processes="four")


CALLS = []


def counting(factor):
    def f(u, theta):
        CALLS.append(1)
        return factor * decay(u, theta)

    return f


def test_results_are_kept_in_memory():
    one = model(counting(1.0))
    one.jacobian(U[:4])
    made = len(CALLS)
    one.jacobian(U[3::-1])
    assert len(CALLS) == made


def test_candidates_that_fail_are_masked_and_named():
    with pytest.warns(UserWarning) as told:
        design = jaxcal.Design(U, model(fails_far), noise=jaxcal.Noise([0.1, 1.0]))
    words = str(told[0].message)
    assert "3 of 17 candidates are left out" in words
    assert "6 (reading 2 is nan), 15 (RuntimeError: too far), 16" in words
    chosen = design.select(3)
    assert not {6, 15, 16} & {*chosen.indices.tolist()}
    kept = np.delete(U, [6, 15, 16], axis=0)
    exact = jaxcal.select(blocks=by_hand(kept, NOMINAL)[0] / 0.1, k=3, criterion="D")
    assert design.select(3, "D").log_det == pytest.approx(exact.log_det, abs=1e-8)
    with pytest.warns(UserWarning, match="3 of 17"):
        assert jaxcal.identifiability(model(fails_far), U).rank == 3
    with pytest.raises(ValueError, match=r"all 1 commands; for \(8\): RuntimeError"):
        jaxcal.Design(U[-1:], model(fails_far))


def test_what_cannot_be_told_is_named_though_derivatives_are_rough():
    rng = np.random.default_rng(1)

    def torque(u, theta):  # mass and lever only as a product, the last nowhere
        m, r, g, _ = theta
        exact = m * r * 9.81 * np.sin(u[0]) + g * u[0]
        return exact * (1.0 + 1e-8 * rng.normal())

    one = FromFunction(torque, [2.0, 0.3, 0.1, 1.0], names=["mass", "lever", "g", "x"])
    told = jaxcal.identifiability(one, U)
    assert told.rank == 2 and told.identifiable == ("g",)
    assert {d.words for d in told.directions} == {"mass with lever", "x"}
    with pytest.raises(ValueError, match="do not inform mass with lever; x"):
        jaxcal.select(U, 2, model=one)


def test_fit_check_and_prediction_are_those_of_the_exact_model():
    theta = np.array([2.2, 0.45, 0.1])
    rng = np.random.default_rng(2)
    y = decays(U, theta) + 0.01 * rng.normal(size=U.shape)
    exact = model()
    exact.jacobian = lambda u, t=None: by_hand(u, NOMINAL if t is None else t)[0]
    fits = [jaxcal.identify(U, y, model=m, noise_std=0.01) for m in (model(), exact)]
    np.testing.assert_allclose(fits[0].parameters, fits[1].parameters, rtol=1e-6)
    np.testing.assert_allclose(fits[0].covariance, fits[1].covariance, rtol=1e-6)
    assert fits[0].check(U, y).says == "holds"
    command = fits[0].command_for([1.0])
    np.testing.assert_allclose(fits[0].predict(command[None]), 1.0)


@pytest.mark.parametrize("inputs", [None, 1, ("minutes",)])
def test_readings_that_lie_before_are_fitted_first_of_all(inputs):
    y = np.array([[decay(u, (2.4, 0.4, 0.1))] for u in U])
    y += 0.01 * np.random.default_rng(0).normal(size=y.shape)
    fit = jaxcal.identify(U, y, model=model(inputs=inputs))
    assert np.abs(fit.parameters - [2.4, 0.4, 0.1]).max() < 0.05
    with pytest.raises(ValueError, match=r"measured must have shape \(N, 1\)"):
        jaxcal.identify(U, np.hstack([y, y]), model=model(inputs=inputs))


def test_a_trajectory_is_one_measurement():
    t = np.linspace(0.0, 5.0, 400)

    def swing(u, theta):
        return theta[0] * np.cos(np.sqrt(theta[1]) * t) * u[0]

    one = FromFunction(swing, [1.0, 9.0], noise=jaxcal.Noise(0.1))
    assert jaxcal.select([[0.5], [1.0], [2.0]], 1, model=one).indices.tolist() == [2]
    y = one.predict([[1.0]], [1.1, 9.2]) + np.random.default_rng(0).normal(0, 0.1, 400)
    fit = jaxcal.identify([[1.0]], y, model=one, loss="gaussian")
    assert (np.abs(fit.parameters - [1.1, 9.2]) < 4.0 * fit.standard_errors).all()


PROGRAM = "import sys; u, a, k = map(float, sys.argv[1:]); print(a * u, k, sep=', ')"


def test_a_program_is_a_model():
    line = [sys.executable, "-c", PROGRAM, "{u}", "{a}", "{k}"]
    one = FromFunction(line, [2.0, 3.0], names=["a", "k"], inputs=["u"], processes=2)
    np.testing.assert_array_equal(one.predict([[1.5], [2.0]]), [[3.0, 3.0], [4.0, 3.0]])
    with pytest.raises(
        ValueError, match=r"must contain \{k\}, the place of the value of k"
    ):
        FromFunction(line[:-1], [2.0, 3.0], names=["a", "k"], inputs=["u"])
    failing = FromFunction(
        [sys.executable, "-c", "raise SystemExit('no {u} {t1}')"], [1.0], inputs=["u"]
    )
    with pytest.raises(ValueError, match=r"for \(1\): exit code 1: no 1.0 1.0"):
        failing.predict([[1.0]])


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="because c is nominally 0"):
        FromFunction(decay, NOMINAL, names=NAMES)
    with pytest.raises(ValueError, match="scale must be positive"):
        FromFunction(decay, NOMINAL, [1.0, 0.0, 1.0])
    with pytest.raises(ValueError, match=r"f must return \(q,\) for one command, got"):
        model(lambda u, t: np.zeros((2, 2))).predict(U)
    with pytest.raises(ValueError, match=r"must return \(1,\) for every .* got \(2,\)"):
        model(lambda u, t: [1.0] * (1 + (u[0] > 4.0))).predict(U)
    with pytest.raises(ValueError, match=r"must return \(17, q\) for 17 commands"):
        model(lambda u, t: np.zeros(3), batch=True).predict(U)
    with pytest.raises(ValueError, match="f must return numbers, got str"):
        model(lambda u, t: "one").predict(U)
    with pytest.raises(ValueError, match="contains a function, which cannot"):
        from_dict(model().to_dict())
    with pytest.raises(ValueError, match="f must be a program that can be run"):
        FromFunction("no-such-program {u}", [1.0], inputs=["u"])


FILE = """
import math
from jaxcal.models import FromFunction

def f(u, theta):
    if u[0] > 7.0:
        return RESULT
    return theta[0] * math.exp(-theta[1] * u[0])

model = FromFunction(f, [2.0, 0.5], names=["a", "k"], inputs=["time"])
"""


def test_a_file_of_python_is_a_model_on_the_command_line(tmp_path, capsys):
    table = tmp_path / "times.csv"
    table.write_text("time\n" + "\n".join(str(u) for u in U[:, 0]) + "\n")

    def run(name, result):
        (tmp_path / f"{name}.py").write_text(FILE.replace("RESULT", result))
        file = str(tmp_path / f"{name}.py")
        code = jaxcal_main(["select", str(table), "-k", "2", "--model", file])
        return code, capsys.readouterr()

    code, told = run("decay_that_is_nan", "math.nan")
    assert code == 0 and "2 of 17 candidates are left out" in told.err
    code, told = run("decay_of_another_shape", "[1.0, 2.0]")
    assert code == 2 and "f must return (1,) for every command, got (2,)" in told.err
    file = str(tmp_path / "decay_that_is_nan.py")
    words = [str(table), "-k", "2", "--model", file, "--criterion", "D"]
    assert jaxcal_main(["select", *words, "--between", "--csv"]) == 0
    name, *times = capsys.readouterr().out.split()
    assert name == "time"  # 0 and 1 / rate, by hand
    np.testing.assert_allclose(sorted(map(float, times)), [0.0, 2.0], atol=1e-2)
    (tmp_path / "nothing.py").write_text("x = 1\n")
    code = jaxcal_main(["select", str(table), "--model", str(tmp_path / "nothing.py")])
    assert code == 2 and "it must set `model`" in capsys.readouterr().err
    (tmp_path / "signal.py").write_text("model = None")
    code = jaxcal_main(["select", str(table), "--model", str(tmp_path / "signal.py")])
    assert code == 2 and "another module is named signal" in capsys.readouterr().err
    (tmp_path / "misspelt.py").write_text("import math\nmodel = math.nothing")
    code = jaxcal_main(["select", str(table), "--model", str(tmp_path / "misspelt.py")])
    assert code == 2 and "no attribute 'nothing'" in capsys.readouterr().err


def test_it_is_measured_one_by_one():
    adaptive = pytest.importorskip("jaxcal.adaptive")
    one = model(decays, batch=True, noise=jaxcal.Noise(0.05))
    prior = jaxcal.Prior([0.2, 0.05, 0.1])
    task = adaptive.ParticleTask.of(one, prior, None, U, measurements=3)
    assert task.model.dim == 3


def test_a_jump_is_told():
    jumps = FromFunction(lambda u, t: (t[0] > 1.0 and u[0] == 2.0) + t[0] * u[0], [1.0])
    with pytest.warns(UserWarning, match=r"f is not smooth in t1 at the command \(2\)"):
        jumps.jacobian(U)


def test_near_an_edge_the_other_side_is_taken():
    def friction(u, theta):
        if theta[0] < 0.0:
            raise ValueError("friction below zero")
        return np.exp(-theta[0] * u[0])

    one = FromFunction(friction, [0.5], [0.1])
    one.jacobian(U)  # whose steps are to both sides
    found = one.jacobian(U, [1e-9])[:, 0, 0]
    np.testing.assert_allclose(found, -U[:, 0], atol=1e-7)


def test_each_command_is_differenced_to_the_side_that_f_takes_there():
    def reached(u, theta):
        if abs(u[0] - theta[0]) > 1.0:
            raise ValueError("out of reach")
        return (u[0] - theta[0]) ** 2

    ends = np.array([[-1.0], [0.0], [1.0]])
    found = FromFunction(reached, [0.0], [0.1]).jacobian(ends)[:, 0, 0]
    np.testing.assert_allclose(found, [2.0, 0.0, -2.0], atol=1e-6)


def test_a_fit_that_ends_where_f_fails_says_so():
    def walled(u, theta):
        if theta[0] < 0.5:
            raise ValueError("below .5")
        return theta[0] * u[0]

    one = FromFunction(walled, [1.0], [0.1])
    with pytest.raises(ValueError, match="fails near the parameters"):
        jaxcal.identify(U, 0.1 * U, model=one, noise_std=0.01)


def printed(digits: int, size: float):
    """f that prints so many digits, and its exact derivative (N, 2, 3)."""

    def f(u, t):
        a, b, c = t
        exact = a * np.exp(-b * u[0]) + c * u[1], a * u[1] ** 2 + np.sin(b * u[0])
        return [float(f"{size * y:.{digits}g}") for y in exact]

    def slopes(u, t):
        a, b, _ = t
        x, z, none = u[:, 0], u[:, 1], np.zeros(len(u))
        first = np.stack([np.exp(-b * x), -a * x * np.exp(-b * x), z], axis=-1)
        second = np.stack([z**2, x * np.cos(b * x), none], axis=-1)
        return size * np.stack([first, second], axis=1)

    return f, slopes


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("digits", [4, 6, 8])
def test_a_program_that_prints_few_digits(digits, size, rng):
    f, slopes = printed(digits, size)
    nominal, true = np.array([1.3, 0.7, 0.9]), np.array([1.36, 0.65, 0.99])
    commands = rng.uniform(0.2, 2.0, (40, 2))
    model = FromFunction(f, nominal, quiet=True)
    found, exact = model.jacobian(commands), slopes(commands, nominal)
    off = np.sqrt(((found - exact) ** 2).mean(axis=(0, 1)) / (exact**2).mean((0, 1)))
    chosen = model.differences(commands)
    assert (off <= chosen.errors).all() and (off < 10.0 ** (2.5 - digits)).all()
    # Readings of 1 to 10 sizes, of which the last digit is rounded.
    unit = size * 10.0 ** (1 - digits)
    assert (0.2 * unit < chosen.noise).all() and (chosen.noise < unit).all()
    clean = np.array([f(u, true) for u in commands])
    measured = clean + 0.003 * size * rng.normal(size=clean.shape)
    fit = jaxcal.identify(commands, measured, model=model)
    assert fit.verdict.good, fit.verdict
    assert (np.abs(fit.parameters - true) < 4.0 * fit.standard_errors).all()
    selection = jaxcal.select(commands, 6, model=model, criterion="D")
    assert selection.proven == (digits > 4)
    if digits == 4:
        assert re.search(r"derivatives are differences, off by \d", selection.reason)


@pytest.mark.parametrize("loss", ["student", "gaussian"])
def test_a_function_that_underflows_has_no_effect(loss):
    """A peak so far from every reading that none of them feels it."""

    def peak(u, theta):
        height, width, centre = theta
        return (height * np.exp(-0.5 * ((u[:, 0] - centre) / width) ** 2))[:, None]

    x = np.linspace(400.0, 500.0, 35)[:, None]
    y = peak(x, [0.4, 4.1, 451.5]) + 0.002 * np.random.default_rng(2).normal(
        size=(35, 1)
    )
    model = FromFunction(peak, [1.0, 5.0, 900.0], batch=True, quiet=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert not jaxcal.identify(x, y, model=model, loss=loss).verdict.good


def test_a_start_is_no_nominal_machine():
    """A prior that says nothing but where to begin: no sign is told by it."""

    def wave(u, theta):
        return (theta[0] * np.sin(theta[1] * u[:, 0]))[:, None]

    rng = np.random.default_rng(0)
    u = rng.uniform(-1.5, 1.5, (30, 1))
    y = wave(u, [-1.2, 1.1]) + 0.01 * rng.normal(size=(30, 1))
    model = FromFunction(wave, [5.0, 5.0], batch=True, quiet=True)
    start = jaxcal.Prior(np.inf, mean=[1.0, 1.0])
    assert jaxcal.identify(u, y, model=model, prior=start).verdict.good
