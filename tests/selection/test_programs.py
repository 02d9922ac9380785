"""Programs kept whole: the same answers, with JAX alone, whatever a file holds."""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.learning.policies import decoding
from jaxcal.learning.runtime import checkpoint_folder, programs
from jaxcal.learning.runtime.checkpoint_folder import CheckpointError, default_folder
from jaxcal.selection import policy
from jaxcal.selection.policy import select_batch

SHAPE = (jax.ShapeDtypeStruct((3,), np.float32),)
WEIGHTS = {"scale": np.float32(2.0), "shift": {"by": np.arange(3, dtype=np.float32)}}


def affine(weights, x):
    return weights["scale"] * x + weights["shift"]["by"]


@pytest.fixture
def fresh():
    """As if nothing had been chosen in this process yet."""
    policy._source.cache_clear()
    yield
    policy._source.cache_clear()


def made(name):
    return programs.make(name, affine, WEIGHTS, SHAPE, {"kind": "affine"})


def test_a_kept_program_is_the_function_with_its_weights(kept):
    x = np.array([1.0, -2.0, 0.5], np.float32)
    for program in (made("a"), programs.load("a")):
        np.testing.assert_array_equal(program(x), [2.0, -3.0, 3.0])
        assert program.facts == {"kind": "affine"}
    assert [path.name for path in kept.iterdir()] == ["a.program"]
    assert kept.stat().st_mode & 0o077 == 0  # it holds code: nobody else writes here


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[:100],
        lambda data: data[:-1],
        lambda data: data[:5000] + bytes([data[5000] ^ 1]) + data[5001:],
        lambda data: bytes(len(data)),
    ],
    ids=["empty", "begun", "cut", "one bit", "zeros"],
)
def test_a_damaged_program_is_no_program(kept, damage):
    made("a")
    path = kept / "a.program"
    path.write_bytes(damage(path.read_bytes()))
    assert programs.load("a") is None


def test_a_program_of_somebody_else_is_not_run(kept, monkeypatch):
    made("a")
    assert programs.load("a") is not None
    (kept / "a.program").chmod(0o620)  # another could have written it
    assert programs.load("a") is None
    (kept / "a.program").chmod(0o600)
    assert programs.load("a") is not None
    monkeypatch.setattr(os, "getuid", lambda: os.geteuid() + 1)
    assert programs.load("a") is None


def test_a_loose_umask_does_not_open_a_program_to_others(kept):
    before = os.umask(0)
    try:
        made("a")
    finally:
        os.umask(before)
    assert (kept / "a.program").stat().st_mode & 0o077 == 0
    assert programs.load("a") is not None


def test_the_programs_used_longest_ago_go_first(kept, monkeypatch):
    monkeypatch.setattr(programs, "_MOST", 2)
    for age, name in ((300, "a"), (200, "b")):
        made(name)
        os.utime(kept / f"{name}.program", (0, 1e9 - age))
    assert programs.load("a") is not None  # used now
    made("c")
    assert sorted(path.stem for path in kept.iterdir()) == ["a", "c"]


def test_a_program_can_be_made_again_where_jax_still_has_its_code(kept):
    for _ in range(2):
        made("a")
        shutil.rmtree(kept)
    made("a")
    assert not list(kept.parent.glob("*-cache"))  # kept once is enough
    x = np.array([1.0, -2.0, 0.5], np.float32)
    np.testing.assert_array_equal(programs.load("a")(x), [2.0, -3.0, 3.0])


def test_a_program_that_does_not_read_back_the_same_is_not_kept(kept, monkeypatch):
    read = programs._read

    def wrong(body):
        program = read(body)
        program._weights = jax.tree.map(lambda leaf: leaf + 1, program._weights)
        return program

    monkeypatch.setattr(programs, "_read", wrong)
    assert made("a")(np.zeros(3, np.float32)).tolist() == [0.0, 1.0, 2.0]
    assert not kept.exists()


def test_without_a_place_to_keep_them_programs_still_run(kept):
    kept.write_text("a file where the folder should be")
    assert made("a")(np.zeros(3, np.float32)).tolist() == [0.0, 1.0, 2.0]
    assert programs.load("a") is None
    kept.unlink()
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        made("a")
        assert not kept.exists()
    finally:
        jax.config.update("jax_enable_compilation_cache", True)


def test_a_name_stands_for_everything_the_program_depends_on(monkeypatch):
    name = programs.name_of("weights", 4)
    assert name == programs.name_of("weights", 4)
    others = {programs.name_of("weights", 5), programs.name_of("other", 4)}
    with monkeypatch.context() as patch:
        patch.setattr(programs, "_sources", lambda: "another network")
        others.add(programs.name_of("weights", 4))
    with monkeypatch.context() as patch:
        patch.setattr(programs, "_processor", lambda: "another processor")
        others.add(programs.name_of("weights", 4))
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        others.add(programs.name_of("weights", 4))
    with jax.enable_x64(True):
        inside = programs.name_of("weights", 4)
    assert len(others | {name}) == 6
    assert inside != name


@pytest.mark.parametrize("how", ["greedy", "samples", "first"])
def test_what_is_chosen_is_what_the_network_chooses(kept, fresh, rng, how):
    sets = rng.normal(size=(5, 20, 3))
    free = rng.random((5, 20)) < 0.8
    first = select_batch(sets, 4, available=free, decoding=how, num=3, seed=7)
    policy._source.cache_clear()
    again = select_batch(sets, 4, available=free, decoding=how, num=3, seed=7)
    assert len(list(kept.iterdir())) == 1
    np.testing.assert_array_equal(again, first)
    shipped = policy.load_policy()
    inputs = policy.to_order_one(sets, free, white=True)
    plain = decoding.choose(
        shipped.network,
        shipped.params,
        jnp.asarray(np.where(free[..., None], inputs, 0.0), jnp.float32),
        jnp.asarray(free),
        jnp.zeros((5, 0), jnp.int32),
        jax.random.key(7),
        k=4,
        decoding=how,
        num=3,
    )
    np.testing.assert_array_equal(first, plain)


def test_a_second_process_needs_jax_alone(kept):
    code = (
        "import json, sys, numpy as np, jaxcal\n"
        "points = np.random.default_rng(0).random((30, 3))\n"
        "chosen = jaxcal.select(points, 4, 'policy').indices.tolist()\n"
        "heavy = {'flax', 'orbax', 'optax', 'scipy', 'numba'} & set(sys.modules)\n"
        "print(json.dumps([chosen, sorted(heavy)]))"
    )
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(kept.parent)}

    def run():
        found = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return json.loads(found.stdout)

    first, second = run(), run()
    assert first[0] == second[0]
    assert "flax" in first[1]
    assert second[1] == []


def copy_of_the_shipped(folder: pathlib.Path) -> pathlib.Path:
    shutil.copytree(default_folder(), folder)
    return folder


def test_the_digest_is_of_the_newest_policy_alone(tmp_path):
    folder = copy_of_the_shipped(tmp_path / "policy")
    shipped = checkpoint_folder.digest()
    assert checkpoint_folder.digest(folder) == shipped
    step = checkpoint_folder.newest_step(folder)
    (step / "state").mkdir()
    (step / "state" / "moments").write_text("of a training run")
    assert checkpoint_folder.digest(folder) == shipped
    newer = folder / str(int(step.name) + 1)
    shutil.copytree(step, newer)
    assert checkpoint_folder.digest(folder) == shipped
    largest = max((newer / "policy").rglob("*"), key=lambda p: p.stat().st_size)
    data = largest.read_bytes()
    largest.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert checkpoint_folder.digest(folder) != shipped


def test_weights_that_change_under_a_process_are_not_mixed(kept, fresh, rng, tmp_path):
    folder = copy_of_the_shipped(tmp_path / "policy")
    sets = rng.random((1, 12, 3))
    select_batch(sets, 4, checkpoint=folder)
    policy._source.cache_clear()
    select_batch(sets, 4, checkpoint=folder)  # from the kept program
    step = checkpoint_folder.newest_step(folder)
    newer = folder / str(int(step.name) + 1)
    shutil.copytree(step, newer)
    (newer / "policy" / "note").write_text("another policy")
    with pytest.raises(CheckpointError, match="has changed since this process"):
        select_batch(sets, 6, checkpoint=folder)
    policy._source.cache_clear()
    select_batch(sets, 6, checkpoint=folder)
