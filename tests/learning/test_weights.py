"""The plain weights file: whole, or refused by name."""

from __future__ import annotations

import numpy as np
import pytest

import jaxcal
from jaxcal.adaptive.policy import training
from jaxcal.learning.runtime import weights
from jaxcal.learning.runtime.weights import CheckpointError, Weights
from jaxcal.learning.training import checkpoint

HELD = Weights(
    {"kind": "compact", "width": 2},
    {"embed.kernel": np.arange(6, dtype=np.float32).reshape(3, 2)},
    {"preset": "general"},
)


def test_what_is_read_is_what_was_written(tmp_path):
    path = tmp_path / "policy.npz"
    weights.write(path, HELD)
    found = weights.read(path)
    assert (found.network, found.meta) == (HELD.network, HELD.meta)
    np.testing.assert_array_equal(
        found.arrays["embed.kernel"], HELD.arrays["embed.kernel"]
    )
    assert found.fingerprint == HELD.fingerprint


def test_no_damage_is_read_as_weights(tmp_path, rng):
    path = tmp_path / "policy.npz"
    weights.write(path, HELD)
    whole = path.read_bytes()
    damaged = [b"", b"x", whole[:100], whole[:-1], bytes(len(whole))]
    for where in rng.integers(len(whole), size=200):
        bit = bytes([whole[where] ^ (1 << rng.integers(8))])
        damaged.append(whole[:where] + bit + whole[where + 1 :])
    refused = 0
    for data in damaged:
        path.write_bytes(data)
        try:
            found = weights.read(path)
        except CheckpointError as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
        else:  # a bit that says nothing, such as a date in the archive
            assert found.fingerprint == HELD.fingerprint
    assert refused > 150


def test_another_format_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "policy.npz"
    monkeypatch.setattr(weights, "_VERSION", 1)
    weights.write(path, HELD)
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match="format jaxcal-policy-weights 2, got"):
        weights.read(path)


@pytest.mark.parametrize("load", [checkpoint.load, training.load])
def test_what_ships_is_one_file_that_jax_reads_too(load):
    held = weights.read(weights.shipped("knee" if load is training.load else "default"))
    policy = load()
    assert policy.weights.fingerprint == held.fingerprint
    assert policy.meta == held.meta


def test_weights_that_do_not_fit_their_network_are_refused(tmp_path):
    held = weights.read(weights.locate(None))
    held.arrays["embed.kernel"] = held.arrays["embed.kernel"][1:]
    path = tmp_path / "policy.npz"
    weights.write(path, held)
    with pytest.raises(CheckpointError, match="do not fit the network"):
        checkpoint.load(path)


def test_a_policy_that_an_earlier_version_trained_by_another_criterion_is_refused(
    tmp_path,
):
    """Fields of before: D is read as ever, A refused with its version by every way."""
    shipped = weights.read(weights.shipped())
    path, rows = tmp_path / "policy.npz", np.random.default_rng(0).random((12, 3))
    envs = [task["environment"] for task in shipped.meta["tasks"]]
    for criterion in "DA":
        for held in (shipped.network, shipped.meta["network"], *envs):
            held["criterion"] = criterion
        weights.write(path, shipped)
        if criterion == "D":
            assert len(jaxcal.select(rows, 4, "policy", checkpoint=path).indices) == 4
            assert checkpoint.load(path).network.config.kind == "compact"
    version = shipped.meta["versions"]["jaxcal"]
    words = rf"trained for criterion A by jaxcal {version}; .*docs/learning\.md"
    with pytest.raises(CheckpointError, match=words):
        jaxcal.select(rows, 4, "policy", checkpoint=path)
    with pytest.raises(CheckpointError, match=words):
        checkpoint.load(path)


def test_the_policy_chooses_by_d_alone():
    rows = np.random.default_rng(0).random((12, 3))
    with pytest.raises(ValueError, match=r'"policy" is trained .*got criterion A'):
        jaxcal.select(rows, 4, "policy", criterion="A")
