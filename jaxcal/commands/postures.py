"""``jaxcal postures``."""

from __future__ import annotations

import dataclasses
import logging
import pathlib
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import several
from jaxcal.arms import SerialChain
from jaxcal.arms.sensors import SENSORS, Board, Landmarks
from jaxcal.checks import aligned, one_of
from jaxcal.commands.arms import ArmOptions
from jaxcal.commands.tables import Output
from jaxcal.extras import needs
from jaxcal.selection import Design
from jaxcal.tables import COMMANDS, read_table

_DRAWS = 10  # random choices that a plan is compared with


@dataclasses.dataclass
class PostureOptions:
    """How a camera sees a board, and what the arm avoids."""

    TITLE: ClassVar[str] = "which postures: views of --sensor board, obstacles"
    RARE: ClassVar[bool] = True

    camera: Annotated[
        list[float] | None,
        "--sensor board: width,height,fx,fy,cx,cy in pixels, or field of view "
        "horizontal,vertical in degrees; views keep the board in the picture",
        several(float, "numbers"),
    ] = None
    board: Annotated[
        list[float] | None,
        "width,height of the board, from the corner at its origin",
        several(float, "numbers"),
    ] = None
    away: Annotated[
        list[float] | None,
        "least,greatest distance from the camera to the board",
        several(float, "numbers"),
    ] = None
    tilt: Annotated[
        float | None, "largest angle between board and camera in degrees, default 45"
    ] = None

    floor: Annotated[float | None, "lowest allowed height of a joint"] = None

    def with_board(self, arm: SerialChain) -> SerialChain:
        """The arm whose board is of this width and height, if they are given."""
        if self.board is None:
            return arm
        if not isinstance(arm.sensor, Board) or len(self.board) != 2:
            raise ValueError("--board WIDTH,HEIGHT needs --sensor board")
        width, height = self.board
        return arm.measured_with(
            dataclasses.replace(arm.sensor, extent=(width, height))
        )


def postures(
    model: Annotated[str, "the arm's .urdf"],
    *,
    k: Annotated[int, "number of postures, measured ones included", "K"],
    of_postures: PostureOptions,
    of_arm: ArmOptions,
    near: Annotated[
        list[list[float]] | None,
        "rough place of a socket (x,y,z), plane (normal, offset) or anchor "
        "(x,y,z,zero); for other sensors x,y,z,radius around the tip; may be repeated",
        several(float, "numbers"),
    ] = None,
    measured: Annotated[
        str | None,
        "table of postures already measured; columns have the names of the joints and "
        "of the sensor's readings",
        "FILE",
    ] = None,
    count: Annotated[int, "number of postures to choose from"] = 300,
    seed: Annotated[int, "seed of the random draws"] = 0,
    picture: Annotated[
        pathlib.Path | None, "draw the arm at each chosen posture: .png, .pdf, .svg"
    ] = None,
    output: Output,
) -> None:
    """Choose the postures to measure, in an order of little travel.

    The postures lie within the joint limits, where the sensor reads, and are chosen for
    accurate predictions of the calibrated arm. With --measured the remaining postures
    complement those already measured, which also locate sockets, planes and boards.
    Collisions are checked only by --floor.
    """
    if picture:
        with needs("plots", "--picture"):
            from matplotlib.backend_bases import FigureCanvasBase as Canvas
        ending = picture.suffix.lower().removeprefix(".")  # told before the search
        one_of("ending of --picture", ending, tuple(Canvas.filetypes))
    reached = None if measured is None else read_table(measured)
    placed = issubclass(SENSORS[of_arm.kind], Landmarks)
    arm = of_arm.read(model, reached, near if placed else None)
    header, done = (*arm.joint_names, *arm.sensor.inputs), None
    if reached is not None:
        done = of_arm.commands(
            arm, reached, reached.named(header, COMMANDS, others=arm.sensor.outputs)
        )
        arm.fitting.require_commands(done)
        arm = arm.located(done)
    more = k - (0 if done is None else len(done))
    if more < 1:
        reason = f"-k must be above {k - more}, the number of postures already measured"
        raise ValueError(f"{reason}, got {k}")
    arm = of_postures.with_board(arm)
    offered = arm.postures(
        count,
        seed=seed,
        near=None if placed else near,
        camera=of_postures.camera,
        distance=of_postures.away,
        tilt=of_postures.tilt,
        floor=of_postures.floor,
    )
    design = Design(offered, model=arm, measured=done)
    chosen = design.select(more, method="exchange").indices
    logging.getLogger("jaxcal").info(_worth(design, chosen, seed))
    plan = offered[chosen]
    plan = plan[arm.in_turn(plan)]
    if picture:
        from matplotlib.figure import Figure

        from jaxcal.reports import plots

        figure = Figure((8, 2.2 * -(-len(plan) // 4)), layout="constrained")
        plots.postures(figure, arm, plan).savefig(picture)
    if of_arm.radians:
        turning = np.flatnonzero(np.array(arm.command_units) == "deg")
        plan[:, turning] = np.radians(plan[:, turning])
    rows = plan.tolist()
    if not output.written(header, rows):
        cells = [[f"{i + 1}", *(f"{x:.4g}" for x in r)] for i, r in enumerate(rows)]
        print("\n".join(aligned([["", *header], *cells])))


def _worth(design: Design, chosen: NDArray[np.int_], seed: int) -> str:
    """How many random postures have the same expected error, as a sentence."""
    rng, offered, k = np.random.default_rng(seed), len(design.available), len(chosen)

    problem = design.problem(k)

    def error(indices: NDArray[np.int_]) -> float:
        blocks = problem.blocks[indices]
        gram = problem.prior + np.einsum("kqa,kqb->ab", blocks, blocks)
        return float(np.sqrt(-problem.criterion.value(gram)))

    def by_random(count: int) -> float:
        sets = [rng.permutation(offered)[:count] for _ in range(_DRAWS)]
        return float(np.median([error(rows) for rows in sets]))

    expected, random = error(chosen), by_random(k)
    same = k
    while same < offered and by_random(same) > expected:
        same = min(same + max(1, k // 4), offered)
    return (
        f"Expected error: {1.0 - expected / random:.0%} below {k} random postures, as "
        f"good as about {same} of them. Less if the arm has errors that the model "
        "cannot describe."
    )
