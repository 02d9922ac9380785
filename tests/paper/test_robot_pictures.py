"""The robot's picture and film: what is drawn, by whom, and what a failure leaves."""

from __future__ import annotations

import ctypes.util
import os
import pathlib
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jaxcal.paper.twin import robot_pictures
from jaxcal.paper.twin.robot import RobotConfig
from jaxcal.paper.twin.robot_pictures import animate, draw, main, render

SIZE = (240, 180)
CONFIG = RobotConfig(mechanism_order="YXZ", read_out_order="YXZ")


def pixels(path: pathlib.Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), dtype=int)


@pytest.fixture
def no_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ImportError("no EGL here")

    monkeypatch.setattr(robot_pictures, "_renderer", fail)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems bring OpenGL along")
def test_a_machine_without_the_library_is_told_which(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    with pytest.raises(RuntimeError, match=r"no EGL or OSMesa library \(Debian: libeg"):
        render(CONFIG, tmp_path / "a.png", backend="mujoco")


def test_without_opengl_matplotlib_draws(
    tmp_path: pathlib.Path, no_opengl: None
) -> None:
    assert render(CONFIG, tmp_path / "a.png", size=SIZE) == "matplotlib"
    assert render(CONFIG, tmp_path / "b.png", (0, 0, 0), size=SIZE) == "matplotlib"
    one, two = pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png")
    assert one.shape == two.shape == (180, 240, 3)
    assert (one != 255).any(axis=2).mean() > 0.1  # something is drawn
    assert (one != two).any(axis=2).mean() > 0.02  # and it moves
    with pytest.raises(RuntimeError, match="MuJoCo cannot draw here: no EGL here"):
        render(CONFIG, tmp_path / "c.png", backend="mujoco")
    assert not (tmp_path / "c.png").exists()


def test_both_draw_the_same_robot() -> None:
    """Silhouettes: OpenGL's, and our projection of the same scene by numpy."""
    angles = np.array([12.0, 9.0, -15.0])
    before = os.environ.get("PYOPENGL_PLATFORM")
    try:
        with draw(CONFIG, SIZE, "mujoco") as (name, picture):
            theirs = picture(angles).astype(int)
    except RuntimeError as error:
        pytest.skip(f"MuJoCo cannot draw without OpenGL: {error}")
    assert name == "mujoco" and os.environ.get("PYOPENGL_PLATFORM") == before
    with draw(CONFIG, SIZE, "matplotlib") as (name, picture):
        ours = picture(angles).astype(int)
        other = picture(-angles).astype(int)
    assert name == "matplotlib"

    def overlap(one: np.ndarray, two: np.ndarray) -> float:
        # The floor is pale; robot and shadows are not. Shadows are MuJoCo's alone.
        a, b = (image.max(axis=2) - image.min(axis=2) > 60 for image in (one, two))
        return float((a & b).sum() / (a | b).sum())

    assert overlap(theirs, ours) > 0.6
    assert overlap(theirs, ours) > overlap(theirs, other) + 0.2


def test_the_film_moves_and_ends_where_it_began(
    tmp_path: pathlib.Path, no_opengl: None
) -> None:
    told: list[tuple[str, int, int]] = []
    name = animate(
        CONFIG,
        tmp_path / "a.gif",
        [[15.0, 0.0, 0.0]],
        size=(120, 90),
        progress=lambda *what: told.append(what),
    )
    assert name == "matplotlib" and told[0] == ("draw the film", 0, len(told))
    with Image.open(tmp_path / "a.gif") as film:
        frames = []
        for number in range(film.n_frames):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB"), dtype=int))
        assert film.info["loop"] == 0
    assert 5 <= len(frames) <= len(told)  # frames that repeat are merged
    apart = [np.abs(frame - frames[-1]).mean() for frame in frames]
    assert max(apart) > 1.0 and apart[0] < max(apart)


def test_the_closed_form_loads_neither_mujoco_nor_matplotlib() -> None:
    code = (
        "import sys\nfrom jaxcal.paper.twin import RobotConfig, read_out\n"
        "from jaxcal.paper import twin\n"
        "assert not {'mujoco', 'matplotlib'} & set(sys.modules)\n"
        "assert twin.render.__module__ == 'jaxcal.paper.twin.robot_pictures'\n"
        "assert not hasattr(twin.robot, 'render')"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"backend": "povray"}, "backend must be one of auto, mujoco, matplotlib, got"),
        ({"size": (5000, 10)}, r"size must be within 1280 x 960 pixels, got \(5000"),
    ],
)
def test_bad_requests_are_refused(
    tmp_path: pathlib.Path, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        render(CONFIG, tmp_path / "a.png", **fields)


def test_a_folder_that_is_a_file_is_refused(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main([str(tmp_path / "file"), "--backend", "matplotlib"]) == 2
    assert "robot_pictures: error:" in capsys.readouterr().err
