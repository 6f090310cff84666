"""A frame of our renderer against one of PyBullet's TinyRenderer: the same scene, camera, light and size.

python benchmarks/frame.py --sheet frames.png
"""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from graspq.benchmarks.harness import Ratio, Result, Row, TurnsSettings, command, median_ratio, take_turns
from graspq.common.options import setting
from graspq.objects.defaults import default_object_set
from graspq.sim import cell
from graspq.sim.bullet import bullet
from graspq.sim.camera import Camera
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import task_named

TASK = task_named("regular")
OURS, RIVAL = "graspq", "TinyRenderer"
SIZES = (64, 256)
HIDDEN_LINKS = (-1, 0, 1)  # never in view; TinyRenderer is not made to draw them
Draw = Callable[[GraspSimulation, int], np.ndarray]


@dataclass(frozen=True)
class FrameSettings(TurnsSettings):
    """Settings of this benchmark."""

    turns: int = setting(11, help="Episodes of which every frame is drawn.", minimum=1)
    sheet: Path | None = setting(None, help="PNG to write: ours beside TinyRenderer's, at both sizes.")


def ours(simulation: GraspSimulation, size: int) -> np.ndarray:
    """Return our picture, uint8 [size, size, 3]."""
    return simulation.render(size)


def rivals(simulation: GraspSimulation, size: int) -> np.ndarray:
    """Return TinyRenderer's picture, uint8 [size, size, 3], moved so that it is mirror-symmetric too."""
    camera, client = Camera(), simulation.world.client
    view = bullet.computeViewMatrix(camera.eye, camera.target, (0, 0, 1))
    degrees = 2 * np.degrees(np.arctan(camera.half_view))
    projection = list(bullet.computeProjectionMatrixFOV(degrees, 1.0, camera.nearest, 3.0))
    projection[8] += 1.0 / size  # it samples a pixel at its corner
    pixels = bullet.getCameraImage(
        size,
        size,
        view,
        projection,
        lightDirection=camera.light,
        lightColor=(1.0, 1.0, 1.0),
        lightDistance=2.0,
        lightAmbientCoeff=camera.ambient,
        lightDiffuseCoeff=camera.diffuse,
        lightSpecularCoeff=0.0,
        shadow=1,
        renderer=bullet.ER_TINY_RENDERER,
        flags=bullet.ER_NO_SEGMENTATION_MASK,
        physicsClientId=client,
    )[2]
    return np.ascontiguousarray(np.asarray(pixels, dtype=np.uint8).reshape(size, size, 4)[:, :, :3])


def at_its_best(simulation: GraspSimulation) -> None:
    """Take from TinyRenderer what costs it time and is not seen: links, and the table under the bin."""
    client, (half, middle, color) = simulation.world.client, cell.table_box(TASK.settings)
    for link in HIDDEN_LINKS:
        bullet.changeVisualShape(simulation.arm.number, link, rgbaColor=(0, 0, 0, 0), physicsClientId=client)
    bullet.removeBody(0, physicsClientId=client)  # the table comes first
    hole = TASK.settings.bin_half_width
    x = TASK.settings.bin_center_x - middle[0]
    boxes = [(a, b, -half[1], half[1]) for a, b in ((-half[0], x - hole), (x + hole, half[0]))]
    boxes += [(x - hole, x + hole, a, b) for a, b in ((-half[1], -hole), (hole, half[1]))]
    shapes = bullet.createVisualShapeArray(
        shapeTypes=[bullet.GEOM_BOX] * 4,
        halfExtents=[((b - a) / 2, (d - c) / 2, half[2]) for a, b, c, d in boxes],
        visualFramePositions=[((a + b) / 2, (c + d) / 2, 0) for a, b, c, d in boxes],
        rgbaColors=[color] * 4,
        physicsClientId=client,
    )
    bullet.createMultiBody(0, -1, shapes, middle, useMaximalCoordinates=True, physicsClientId=client)


def moments(simulation: GraspSimulation, seed: int) -> Iterator[None]:
    """Play an episode of random actions; give every moment in which a policy would look."""
    rng = np.random.default_rng(seed)
    simulation.load(TASK.draw(simulation.objects, "train", rng))
    at_its_best(simulation)
    simulation.reset(rng)
    while not simulation.terminated:
        yield
        simulation.step(rng.uniform(-1, 1, 4) * (1, 1, 0.5, 1))


def seconds_of(simulation: GraspSimulation, draw: Draw, size: int) -> Callable[[int], float]:
    """Return a rival that gives the median CPU seconds of a frame of an episode, each after a step of it."""

    def seconds(turn: int) -> float:
        spent = []
        for _ in moments(simulation, turn + 1):
            start = time.thread_time()
            draw(simulation, size)
            spent.append(time.thread_time() - start)
        return statistics.median(spent)

    return seconds


def write_sheet(simulation: GraspSimulation, path: Path, scenes: int = 4) -> None:
    """Write pictures of the same moments: ours and TinyRenderer's at 64 pixels, then at 256, all shown as large."""

    def shown(draw: Draw, size: int) -> np.ndarray:
        return np.kron(draw(simulation, size), np.ones((256 // size, 256 // size, 1), np.uint8))

    rows = []
    for seed in range(1, scenes + 1):
        seen = [
            np.hstack([shown(draw, size) for size in SIZES for draw in (ours, rivals)])
            for _ in moments(simulation, seed)
        ]
        rows.append(seen[len(seen) // 2])
    Image.fromarray(np.vstack(rows)).save(path)


def measure(settings: FrameSettings) -> Result:
    """Return milliseconds of a frame of both, at both sizes."""
    rows: list[Row] = []
    ratios: list[float] = []
    with GraspSimulation(TASK, default_object_set("regular")) as simulation:
        for size in SIZES:
            arms = {OURS: seconds_of(simulation, ours, size), RIVAL: seconds_of(simulation, rivals, size)}
            found = take_turns(arms, settings.turns)
            ratios.append(median_ratio(found[RIVAL], found[OURS]))
            times = {f"{name}, ms": 1e3 * statistics.median(taken) for name, taken in found.items()}
            rows.append({"pixels": f"{size} x {size}", **times, "ratio": ratios[-1]})
        if settings.sheet is not None:
            write_sheet(simulation, settings.sheet)
    return Result([Ratio("a frame, against TinyRenderer", ratios[0], bar=6, aim=10)], {"A frame": rows})


main = command(FrameSettings, measure)


if __name__ == "__main__":
    main()
