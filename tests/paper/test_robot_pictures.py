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

from jaxcal.paper.twin.robot import RobotConfig
from studies.paper import robot_pictures
from studies.paper.robot_pictures import animate, draw, main, render

SIZE = (240, 180)
CONFIG = RobotConfig(mechanism_order="YXZ", read_out_order="YXZ")


def pixels(path: pathlib.Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), dtype=int)


@pytest.fixture
def opengl() -> None:
    try:
        with draw(CONFIG, SIZE):
            pass
    except RuntimeError as error:
        pytest.skip(f"MuJoCo cannot draw without OpenGL: {error}")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems bring OpenGL along")
def test_a_machine_without_the_library_is_told_which(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    with pytest.raises(RuntimeError, match=r"no EGL or OSMesa library \(Debian: libeg"):
        render(CONFIG, tmp_path / "a.png")


def test_the_picture_shows_the_posture(tmp_path: pathlib.Path, opengl: None) -> None:
    before = os.environ.get("PYOPENGL_PLATFORM")
    render(CONFIG, tmp_path / "a.png", size=SIZE)
    render(CONFIG, tmp_path / "b.png", (0, 0, 0), size=SIZE)
    assert os.environ.get("PYOPENGL_PLATFORM") == before
    one, two = pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png")
    assert one.shape == two.shape == (180, 240, 3)
    assert (one != 255).any(axis=2).mean() > 0.1  # something is drawn
    assert (one != two).any(axis=2).mean() > 0.02  # and it moves


def test_a_machine_that_cannot_draw_says_so(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ImportError("no EGL here")

    monkeypatch.setattr(robot_pictures, "_renderer", fail)
    with pytest.raises(RuntimeError, match="MuJoCo cannot draw here: no EGL here"):
        render(CONFIG, tmp_path / "c.png")
    assert not (tmp_path / "c.png").exists()


def test_the_film_moves_and_ends_where_it_began(
    tmp_path: pathlib.Path, opengl: None
) -> None:
    told: list[tuple[str, int, int]] = []
    animate(
        CONFIG,
        tmp_path / "a.gif",
        [[15.0, 0.0, 0.0]],
        size=(120, 90),
        progress=lambda *what: told.append(what),
    )
    assert told[0] == ("draw the film", 0, len(told))
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
        "assert not {'mujoco', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
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
    assert main([str(tmp_path / "file")]) == 2
    assert "robot_pictures: " in capsys.readouterr().err
