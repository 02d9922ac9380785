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

Array = NDArray[np.float64]

_DRAWS = 10  # random choices that a plan is compared with


@dataclasses.dataclass
class ViewOptions:
    """A board, and how a camera sees it."""

    TITLE: ClassVar[str] = "of --sensor board"
    RARE: ClassVar[bool] = True

    camera: Annotated[
        list[float] | None,
        "of --sensor board: width,height,fx,fy,cx,cy in pixels, or degrees of view "
        "horizontal,vertical: the board is in the picture",
        several(float, "numbers"),
    ] = None
    board: Annotated[
        list[float] | None,
        "width,height of the board from the corner that its pose is of",
        several(float, "numbers"),
    ] = None
    away: Annotated[
        list[float] | None,
        "least,greatest distance of the camera from the board",
        several(float, "numbers"),
    ] = None
    tilt: Annotated[
        float | None, "degrees that the board may be turned from the camera, default 45"
    ] = None
    side: Annotated[
        str | None,
        "where the board's z axis points from its printed side",
        ["+z", "-z"],
    ] = None

    def with_board(self, arm: SerialChain) -> SerialChain:
        """The arm whose board is of this width and height, if they are given."""
        if self.board is None:
            return arm
        if not isinstance(arm.sensor, Board) or len(self.board) != 2:
            raise ValueError("--board WIDTH,HEIGHT is of --sensor board")
        width, height = self.board
        return arm.measured_with(
            dataclasses.replace(arm.sensor, extent=(width, height))
        )


@dataclasses.dataclass
class RoomOptions:
    """What the arm stays away from."""

    TITLE: ClassVar[str] = "what the arm stays away from"
    RARE: ClassVar[bool] = True

    floor: Annotated[float | None, "height that no joint is below"] = None
    approach: Annotated[
        list[float] | None,
        "direction in which the tool comes, and the degrees about it: 0,0,-1,60",
        several(float, "numbers"),
    ] = None
    clear: Annotated[
        list[list[float]] | None,
        "a plane (normal, offset) or box (least x,y,z, greatest) that links stay away "
        "from, as spheres along lines between the joints; once for each",
        several(float, "numbers"),
    ] = None


def postures(
    model: Annotated[str, "the arm's .urdf"],
    *,
    k: Annotated[int, "postures to measure in all", "K"],
    view: ViewOptions,
    room: RoomOptions,
    of_arm: ArmOptions,
    near: Annotated[
        list[list[float]] | None,
        "where a socket (x,y,z), a plane (normal, offset) or an anchor (x,y,z,zero) "
        "is, roughly; for other sensors x,y,z,radius around the tip; once for each",
        several(float, "numbers"),
    ] = None,
    measured: Annotated[
        str | None,
        "table of postures that were measured already, with columns named as the "
        "joints and as the sensor's",
        "FILE",
    ] = None,
    count: Annotated[int, "postures to choose from"] = 300,
    one_side: Annotated[
        float | None,
        "columns `from JOINT`: where to come from, so many degrees below, so that play "
        "is on one side",
    ] = None,
    seed: Annotated[int, "of the random draws of these postures"] = 0,
    picture: Annotated[
        pathlib.Path | None, "draw the arm at each posture chosen: .png, .pdf, .svg"
    ] = None,
    output: Output,
) -> None:
    """Choose the postures to measure, in an order of little travel.

    Postures are made within the joint limits, where the sensor reads, and chosen for
    the predictions of the calibrated arm. With --measured the rest of the K is chosen
    beside what was reached, which shows where sockets, planes and boards are, too.
    Collisions are looked at as far as --floor, --approach and --clear say.
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
        arm.require_commands(done)
        arm = arm.located(done)
    more = k - (0 if done is None else len(done))
    if more < 1:
        reason = f"-k must be more than the {k - more} that were reached"
        raise ValueError(f"{reason}, got {k}")
    arm = view.with_board(arm)
    offered = arm.postures(
        count,
        seed=seed,
        near=None if placed else near,
        camera=view.camera,
        distance=view.away,
        tilt=view.tilt,
        side=view.side,
        floor=room.floor,
        approach=room.approach,
        clear=room.clear or (),
    )
    design = Design(offered, model=arm, measured=done)
    chosen = design.select(more, method="exchange").indices
    logging.getLogger("jaxcal").info(_worth(design, chosen, seed))
    plan = offered[chosen]
    plan = plan[arm.in_turn(plan)]
    if picture:
        _draw(arm, plan, picture)
    header, rows = _rows_of(arm, plan, one_side, of_arm.radians)
    if not output.written(header, rows):
        cells = [[f"{i + 1}", *(f"{x:.4g}" for x in r)] for i, r in enumerate(rows)]
        print("\n".join(aligned([["", *header], *cells])))


def _draw(arm: SerialChain, plan: Array, path: pathlib.Path) -> None:
    """A picture of the arm at each posture of the plan."""
    from matplotlib.figure import Figure

    from jaxcal.reports import plots

    figure = Figure(figsize=(8, 2.2 * -(-len(plan) // 4)), layout="constrained")
    plots.postures(figure, arm, plan).savefig(path)


def _rows_of(
    arm: SerialChain, plan: Array, one_side: float | None, radians: bool
) -> tuple[tuple[str, ...], list[list[float]]]:
    """The names of the columns of a plan (N, n), and its rows.

    ``one_side``: degrees below each posture where its joints come from, which are then
    columns too.
    """
    header = (*arm.joint_names, *arm.sensor.inputs)
    turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
    if one_side is not None:
        start, width = arm.from_one_side(plan, one_side), plan.shape[1]
        header = (*header, *(f"from {name}" for name in arm.joint_names))
        turning += [width + i for i in turning]
        plan = np.hstack([plan, start])
    if radians:
        plan[:, turning] = np.radians(plan[:, turning])
    return header, plan.tolist()


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
