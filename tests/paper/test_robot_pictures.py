"""The robot's picture and film: what is drawn, by whom, and what a failure leaves."""

from __future__ import annotations

import ctypes.util
import io
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from jaxcal.paper.twin.robot import RobotConfig
from studies.paper.exhibits import pictures
from studies.paper.exhibits.pictures import draw, film_of, picture_of

SIZE = (240, 180)
CONFIG = RobotConfig(mechanism_order="YXZ", read_out_order="YXZ")


POSTURE_DEG = (18.0, 14.0, -12.0)


def pixels(file: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(file)) as image:
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
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    with pytest.raises(RuntimeError, match=r"no EGL or OSMesa library \(Debian: libeg"):
        picture_of(CONFIG, POSTURE_DEG)


def test_the_picture_shows_the_posture(opengl: None) -> None:
    before = os.environ.get("PYOPENGL_PLATFORM")
    one, two = (pixels(picture_of(CONFIG, u, SIZE)) for u in (POSTURE_DEG, (0, 0, 0)))
    assert os.environ.get("PYOPENGL_PLATFORM") == before
    assert one.shape == two.shape == (180, 240, 3)
    assert (one != 255).any(axis=2).mean() > 0.1  # something is drawn
    assert (one != two).any(axis=2).mean() > 0.02  # and it moves


def test_a_machine_that_cannot_draw_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ImportError("no EGL here")

    monkeypatch.setattr(pictures, "_renderer", fail)
    with pytest.raises(RuntimeError, match="MuJoCo cannot draw here: no EGL here"):
        picture_of(CONFIG, POSTURE_DEG)


def test_the_film_moves_and_ends_where_it_began(opengl: None) -> None:
    said: list[tuple[str, int, int]] = []
    file = film_of(
        CONFIG,
        [[15.0, 0.0, 0.0]],
        size=(120, 90),
        progress=lambda *what: said.append(what),
    )
    assert said[0] == ("draw the film", 0, len(said))
    with Image.open(io.BytesIO(file)) as film:
        frames = []
        for number in range(film.n_frames):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB"), dtype=int))
        assert film.info["loop"] == 0
    assert 5 <= len(frames) <= len(said)  # frames that repeat are merged
    apart = [np.abs(frame - frames[-1]).mean() for frame in frames]
    assert max(apart) > 1.0 and apart[0] < max(apart)


def test_the_closed_form_loads_neither_mujoco_nor_matplotlib() -> None:
    code = (
        "import sys\nfrom jaxcal.paper.twin import RobotConfig, read_out\n"
        "assert not {'mujoco', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_size_that_is_too_large_is_refused() -> None:
    with pytest.raises(ValueError, match=r"size must be within 1280 x 960 pixels, got"):
        picture_of(CONFIG, POSTURE_DEG, (5000, 10))
