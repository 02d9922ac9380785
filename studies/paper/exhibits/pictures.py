"""The simulated robot: a picture, and a film of it on its way through postures.

``mujoco.Renderer`` draws where there is EGL or OSMesa, which need no screen. Files are
written by pillow, so no encoder is needed.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import importlib
import io
import itertools
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.paper.constants import AXES
from jaxcal.paper.datasets import dataset0_robot
from jaxcal.paper.twin.robot import RobotConfig, joint_angles, read_out
from jaxcal.paper.twin.robot_model import load_model, pose, simulate, trajectory
from jaxcal.paper.twin.robot_parts import AXIS_COLOURS
from studies.paper.exhibits.exhibit import Exhibit
from studies.paper.exhibits.material import Material, commands_deg

__all__ = ["draw", "exhibits", "film_of", "picture_of"]

Array = NDArray[np.float64]
Report = Callable[[str, int, int], None]
Image = NDArray[np.uint8]
"""(height, width, 3)"""

_EACH_AXIS_DEG = (  # to either side
    (18.0, 0.0, 0.0),
    (-18.0, 0.0, 0.0),
    (0.0, 18.0, 0.0),
    (0.0, -14.0, 0.0),
    (0.0, 0.0, 18.0),
    (0.0, 0.0, -18.0),
)
_FRAMES_PER_S = 10.0
_MOVE_S, _REST_S = 0.7, 0.3  # of the film, per posture
_PALETTE, _PALETTE_FRAMES = 96, 8  # colours of a GIF, frames they are taken from


def exhibits(material: Material) -> list[Exhibit]:
    """The robot of Table 1 that dataset0 is measured on."""
    robot = dataset0_robot()
    chosen = material.result("dataset3", "policy").indices[0, 0]
    four = postures = commands_deg(material.dataset("dataset3"))[0, chosen]
    way = "the policy's four"
    if not material.settings.quick:
        way = f"each axis alone, then {way}"
        postures = np.concatenate([_EACH_AXIS_DEG, four])
    said, notice, files = "Drawn by MuJoCo, without a screen.", "", {}
    try:
        film = film_of(robot, postures, progress=material.progress)
        files = {"robot.png": picture_of(robot, four[0]), "robot.gif": film}
    except RuntimeError as error:
        said = notice = f"{error}; the report has no picture of the robot."
    apart = np.abs(simulate(robot, postures) - np.asarray(read_out(robot, postures)))
    return [
        Exhibit.from_texts(
            "robot",
            {"way": way, "drawn_by": said},
            numbers={"largest_difference_deg": float(apart.max())},
            pictures=files,
            notice=notice,
        )
    ]


def picture_of(
    config: RobotConfig, command_deg: ArrayLike, size: tuple[int, int] = (960, 720)
) -> bytes:
    """A PNG of the robot at one command.

    Args:
        config: the robot.
        command_deg: (3,) pitch, yaw, roll in degrees.
        size: width and height in pixels, at most 1280 x 960.

    Raises:
        RuntimeError: MuJoCo cannot draw here.
    """
    command = np.asarray(command_deg, dtype=np.float64).reshape(1, 3)
    with draw(config, size) as picture:
        image = picture(np.asarray(joint_angles(config, command))[0])
    read = np.asarray(read_out(config, command))
    file = io.BytesIO()
    _captioned(image, command[0], read[0]).save(file, "PNG", optimize=True)
    return file.getvalue()


def film_of(
    config: RobotConfig,
    commands_deg: ArrayLike,
    size: tuple[int, int] = (480, 360),
    progress: Report = lambda *_: None,
) -> bytes:
    """A GIF, which repeats, of the robot moving through postures, simulated by MuJoCo.

    Args:
        config: the robot.
        commands_deg: (N, 3) pitch, yaw, roll in degrees, one second each.
        size: as in ``picture_of``, and so is what is raised.
        progress: called with how many frames of how many are drawn.
    """
    way = _smooth(np.asarray(commands_deg, dtype=np.float64).reshape(-1, 3))
    links = trajectory(
        config, way, hold_s=1.0 / _FRAMES_PER_S, frames_per_s=_FRAMES_PER_S
    )[1:]
    read = np.asarray(read_out(config, way))
    with draw(config, size) as picture:
        frames: list[Any] = []
        for angles, *shown in zip(links, way, read, strict=True):
            progress("draw the film", len(frames), len(way))
            frames.append(_captioned(picture(angles), *shown))
    first, *rest = _in_one_palette(frames)
    file = io.BytesIO()
    look: dict[str, Any] = {"duration": round(1000.0 / _FRAMES_PER_S), "loop": 0}
    first.save(file, "GIF", save_all=True, append_images=rest, optimize=False, **look)
    return file.getvalue()


@contextlib.contextmanager
def draw(
    config: RobotConfig, size: tuple[int, int]
) -> Iterator[Callable[[ArrayLike], Image]]:
    """A function from joint angles (3,) in degrees to an image.

    Raises:
        RuntimeError: MuJoCo cannot draw here.
    """
    import mujoco

    width, height = size
    if not (1 <= width <= 1280 and 1 <= height <= 960):
        raise ValueError(f"size must be within 1280 x 960 pixels, got {size}")
    model = load_model(config)
    data = mujoco.MjData(model)
    try:
        canvas = _renderer(model, width, height)
    except Exception as error:  # drivers fail in many ways
        why = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise RuntimeError(f"MuJoCo cannot draw here: {why}") from None

    def picture(joints_deg: ArrayLike) -> Image:
        pose(model, data, joints_deg)
        canvas.update_scene(data, "view")
        return np.asarray(canvas.render())

    with contextlib.closing(canvas):
        yield picture


def _renderer(model: Any, width: int, height: int) -> Any:
    """A ``mujoco.Renderer`` that needs no screen.

    MuJoCo chooses its OpenGL library when it is imported, by MUJOCO_GL; on Linux
    without that variable it would open a window. There EGL or OSMesa is used for this
    renderer alone, and the environment is left as it was.
    """
    import mujoco

    if os.environ.get("MUJOCO_GL") or not sys.platform.startswith("linux"):
        return mujoco.Renderer(model, height, width)
    library = next(filter(ctypes.util.find_library, ("EGL", "OSMesa")), None)
    if library is None:
        raise RuntimeError(
            "there is no EGL or OSMesa library (Debian: libegl1 and libgl1-mesa-dri)"
        )
    chosen = sys.modules[mujoco.Renderer.__module__].gl_context  # where it looks
    before, platform = chosen.GLContext, os.environ.get("PYOPENGL_PLATFORM")
    try:
        backend = importlib.import_module(f"mujoco.{library.lower()}")
        chosen.GLContext = backend.GLContext
        return mujoco.Renderer(model, height, width)
    finally:
        chosen.GLContext = before
        if platform is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)


# -- captions and colours --------------------------------------------------------------


def _captioned(image: Image, command_deg: Array, read: Array) -> Any:
    """A pillow image that says what was commanded and what the phone reads."""
    from PIL import Image as Pillow
    from PIL import ImageDraw, ImageFont

    picture = Pillow.fromarray(np.ascontiguousarray(image))
    pen = ImageDraw.Draw(picture)
    size = max(11, picture.height // 30)
    font = ImageFont.load_default(size)
    rows = [("axis", "command", "phone", (60, 60, 60))]
    for name, rgb, *angles in zip(
        AXES, AXIS_COLOURS.values(), command_deg, read, strict=True
    ):
        red, green, blue = (round(255 * value) for value in rgb)
        asked, reached = (f"{angle:+.1f}°" for angle in angles)
        rows.append((name, asked, reached, (red, green, blue)))
    for line, (*texts, colour) in enumerate(rows):
        y = size * (0.6 + 1.35 * line)
        for text, column, anchor in zip(
            texts, (0.7, 8.0, 12.5), ("la", "ra", "ra"), strict=True
        ):
            pen.text((column * size, y), text, colour, font, anchor)
    return picture


def _in_one_palette(frames: list[Any]) -> list[Any]:
    """The same colours in every frame, so that what stands still does not flicker."""
    from PIL import Image as Pillow

    shown = frames[:: max(1, len(frames) // _PALETTE_FRAMES)][:_PALETTE_FRAMES]
    width, height = frames[0].size
    sheet = Pillow.new("RGB", (width, height * len(shown)))
    for number, frame in enumerate(shown):
        sheet.paste(frame, (0, number * height))
    palette = sheet.quantize(_PALETTE, Pillow.Quantize.MAXCOVERAGE)
    return [frame.quantize(palette=palette, dither=0) for frame in frames]


def _smooth(postures_deg: Array) -> Array:
    """(frames, 3) commands on the way, from zero and back, at rest at each posture."""
    stops = np.concatenate([np.zeros((1, 3)), postures_deg, np.zeros((1, 3))])
    t = np.linspace(0.0, 1.0, round(_MOVE_S * _FRAMES_PER_S) + 1)[1:]
    bend = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
    bend = np.append(bend, np.ones(round(_REST_S * _FRAMES_PER_S)))
    pairs = itertools.pairwise(stops)
    return np.concatenate([start + np.outer(bend, end - start) for start, end in pairs])
