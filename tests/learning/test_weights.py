"""The plain weights file: whole, or refused by name."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from jaxcal.learning.runtime import weights
from jaxcal.learning.runtime.weights import CheckpointError, Weights, default_folder
from jaxcal.learning.training import checkpoint

HELD = Weights(
    {"kind": "compact", "width": 2},
    {"embed.kernel": np.arange(6, dtype=np.float32).reshape(3, 2)},
    {"preset": "general"},
)


def test_what_is_read_is_what_was_written(tmp_path):
    path = tmp_path / weights.NAME
    weights.write(path, HELD)
    found = weights.read(path)
    assert (found.network, found.meta) == (HELD.network, HELD.meta)
    np.testing.assert_array_equal(
        found.arrays["embed.kernel"], HELD.arrays["embed.kernel"]
    )
    assert found.fingerprint == HELD.fingerprint


def test_no_damage_is_read_as_weights(tmp_path, rng):
    path = tmp_path / weights.NAME
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
    path = tmp_path / weights.NAME
    monkeypatch.setattr(weights, "_VERSION", 2)
    weights.write(path, HELD)
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match="format jaxcal-policy-weights 1, got"):
        weights.read(path)


def test_the_shipped_file_holds_the_shipped_checkpoint():
    found = weights.read(weights.locate(None))
    policy = checkpoint.load()
    assert found.fingerprint == policy.weights.fingerprint
    assert checkpoint.fingerprint() == found.fingerprint
    assert found.meta == policy.meta


def test_saving_and_the_command_write_the_file(tmp_path, capsys):
    checkpoint.export(default_folder(), tmp_path / "copy")
    path = weights.locate(tmp_path / "copy")
    whole = weights.read(path)
    assert whole.fingerprint == checkpoint.fingerprint()
    path.unlink()
    assert checkpoint.main([str(tmp_path / "copy")]) == 0
    assert weights.read(path).fingerprint == whole.fingerprint
    assert str(path) in capsys.readouterr().out
    shutil.rmtree(path.parent / "policy")
    assert checkpoint.main([str(tmp_path / "copy")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
