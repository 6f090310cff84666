"""Training speed of `mc` and `dql` against the same network written plainly in PyTorch, and of `ddpg` against d3rlpy's.

    python benchmarks/training.py --shards data/regular-10k

Ours and its rival take turns in one process, on batches of the same data that lie ready in memory. Ours is
`Session.update` with default options: augmentation, target, forward, backward, optimiser, averaged weights. The plain
rival (`plain_pytorch.py`) does all of that too, in float32; at each start its pictures must equal ours, and its Q and
target to 1e-4. It profits from the allocator settings of our session, which it would not have by itself. Its `dql`
computes the picture's part of Q once for all 16 candidates, as ours does; a second one, which runs the whole network on
16 copies of each picture, stands beside it.

d3rlpy's DDPG (`d3rlpy_rival.py`, which says what it needs) learns from the same pictures with its own default network
and settings, without augmentation: another and smaller job than ours. Where it is not installed that row is left out.
"""

import contextlib
import copy
import dataclasses
import random
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import torch
from d3rlpy_rival import by_d3rlpy
from plain_pytorch import PlainTraining, augmented, plain_copy
from sessions import default_settings, ready, steps_on
from timing import median_ratio, report, take_turns
from torch import Tensor

from graspq.common.options import Command
from graspq.datasets.dataset import open_shards
from graspq.train.augment import Augmentation
from graspq.train.batch import Batch
from graspq.train.distributed import WHOLE
from graspq.train.loop import Session, session
from graspq.train.selection import uniform_actions
from graspq.train.state import advance, seeded
from graspq.train.updates import loss_of, target_of

ALGOS = ("mc", "dql", "ddpg")
TOLERANCE = 1e-4
RIVALS = ("plain PyTorch", "d3rlpy")
TILED = "plain PyTorch, 16 tiled copies"
PIECES = ("augmentation", "target", "forward", "backward", "optimiser", "averages")
NETWORK = ("forward", "backward")


def plain_batch(batch: Batch) -> dict[str, Tensor]:
    """Return transitions as the plain training takes them: no steps dimension, pictures as contiguous NCHW."""
    names = ("image", "step", "action", "reward", "terminal", "mc_return", "next_image", "next_step")
    values = {name: getattr(batch, name) for name in names}
    flat = {name: value.squeeze(1) for name, value in values.items() if value is not None}
    return {n: v.permute(0, 3, 1, 2).contiguous() if n.endswith("image") else v for n, v in flat.items()}


def plain_training(current: Session, tiled: bool = False) -> PlainTraining:
    """Return plain training that starts with a run's weights; see `PlainTraining` for `tiled`."""
    network = plain_copy(current.state.learned["q"], current.specification.steps - 1)
    return PlainTraining(network, current.settings, current.discount, current.estimator.needs_next, tiled)


def greatest_difference(current: Session, plain: PlainTraining, batch: Batch) -> float:
    """Return the greatest difference of Q, in evaluation and in training mode, and of the target, all in float32.

    Raises:
        ClickException: the rival's pictures or actions are others.
    """
    settings, rows = current.settings, len(batch.action)
    # The draws of our augmentation, in its order.
    generator = torch.Generator().manual_seed(1)
    shifts = torch.randint(-settings.shift, settings.shift + 1, (rows, 2), generator=generator).tolist()
    mirrored = (torch.rand(rows, generator=generator) < 0.5).tolist()
    ours = Augmentation(settings.shift, settings.mirror, 0.0)(batch, torch.Generator().manual_seed(1))
    theirs = plain_batch(batch)
    image, action = augmented(theirs["image"], theirs["action"], shifts, mirrored, settings.shift)
    if not torch.equal(image, plain_batch(ours)["image"].float()) or not torch.equal(action, ours.action.squeeze(1)):
        raise click.ClickException("the plain augmentation gives other pictures or actions than ours")
    # Copies: a pass in training mode moves running statistics.
    network, plain_network = copy.deepcopy(current.state.learned["q"]), copy.deepcopy(plain.network)
    differences = []
    for mode in (False, True):
        output = network.train(mode)(ours.image.squeeze(1), batch.step.squeeze(1), action)
        plain_output = plain_network.train(mode)(image, batch.step.squeeze(1), action)
        differences.append(network.value_of(output) - network.value_of(plain_output))
    if plain.bootstrapped:
        context = current._context(current.state.learned, torch.Generator().manual_seed(2))
        context = dataclasses.replace(context, autocast=contextlib.nullcontext)
        current.state.learned["q"].eval()
        candidates = uniform_actions(torch.Generator().manual_seed(2), rows, settings.candidates)
        target = current.estimator.target(batch, context).squeeze(1)
        differences.append(target - plain.double_q(theirs, theirs["next_image"].float(), candidates))
    return max(float(difference.abs().max()) for difference in differences)


@torch.no_grad()
def check_agreement(current: Session, plain: PlainTraining, batch: Batch) -> None:
    """Refuse a rival that computes something else; see `greatest_difference`.

    Raises:
        ClickException: it does.
    """
    difference = greatest_difference(current, plain, batch)
    if not difference <= TOLERANCE:
        algo = current.settings.algo
        raise click.ClickException(f"plain {algo}: Q differs by {difference:.2g}, expected at most {TOLERANCE}")


@dataclasses.dataclass
class Pieces:
    """Seconds of the pieces of steps, of one estimator, and of whole steps of `Session.update`."""

    seconds: dict[str, list[float]] = dataclasses.field(default_factory=dict)

    @contextlib.contextmanager
    def timed(self, piece: str) -> Iterator[None]:
        """Count the time inside."""
        start = time.perf_counter()
        yield
        self.seconds.setdefault(piece, []).append(time.perf_counter() - start)

    def row(self, name: str) -> dict[str, Any]:
        """Return the medians in milliseconds, and what share of a whole step the network takes."""
        median = {piece: 1e3 * statistics.median(self.seconds[piece]) for piece in ("step", *PIECES)}
        network = sum(median[piece] for piece in NETWORK)
        return {
            "estimator": name,
            **{f"{piece}, ms": value for piece, value in median.items()},
            "share of forward and backward": network / median["step"],
            "share of forward, backward and target": (network + median["target"]) / median["step"],
        }


def measure_pieces(current: Session, batches: list[Batch], turns: int) -> Pieces:
    """Return the times of the pieces of a step, taken apart as `Session.update` and `updates.regression` do them."""
    pieces, state, settings = Pieces(), current.state, current.settings
    augmentation = Augmentation(settings.shift, settings.mirror, settings.jitter, settings.action_noise)
    q, optimizer = state.learned["q"], state.optimizers["q"]
    for batch in batches[:1] + batches * turns:
        with pieces.timed("augmentation"):
            changed = augmentation(batch, seeded("benchmarks/augment", state.step), WHOLE)
        context = current._context(state.learned, seeded("benchmarks/candidates", state.step))
        q.eval()
        with pieces.timed("target"):
            target = target_of(changed, current.estimator, context)
        q.train()
        with pieces.timed("forward"):
            loss = loss_of(changed, target, current.estimator, context)
        optimizer.zero_grad(set_to_none=True)
        with pieces.timed("backward"):
            loss.backward()
        with pieces.timed("optimiser"):
            optimizer.step()
        with pieces.timed("averages"):
            advance(state, settings)
        with pieces.timed("step"):
            current.update(batch)
    # The first batch warms up.
    return Pieces({name: values[1:] for name, values in pieces.seconds.items()})


def rivals_of(current: Session, batches: list[Batch]) -> dict[str, tuple[Callable[[], None], int]]:
    """Return ours and its rival for one estimator: what runs, and how many transitions it trains on."""
    algo, size = current.settings.algo, len(batches[0].action)
    found = {f"{algo}, graspq": (steps_on(batches, current.update), size * len(batches))}
    if algo == "ddpg":
        run = by_d3rlpy([plain_batch(batch) for batch in batches], current.settings)
        return found | ({} if run is None else {"ddpg, d3rlpy": (run, size * len(batches))})
    plain = plain_training(current)
    check_agreement(current, plain, batches[0])
    theirs = [plain_batch(batch) for batch in batches]
    found[f"{algo}, plain PyTorch"] = steps_on(theirs, plain.update), size * len(theirs)
    if plain.bootstrapped:
        tiled = plain_training(current, tiled=True)
        check_agreement(current, tiled, batches[0])
        # Sixteen copies of every picture take seconds.
        found[f"{algo}, {TILED}"] = steps_on(theirs[:1], tiled.update), size
    return found


def speed_rows(runs: dict[str, tuple[Callable[[], None], int]], turns: int) -> list[dict[str, Any]]:
    """Return a row for each, with its speed and how many times as fast as its own rival it is."""
    seconds = take_turns({name: run for name, (run, _) in runs.items()}, turns)
    pace = {name: [value / runs[name][1] for value in values] for name, values in seconds.items()}
    rows = []
    for name, values in pace.items():
        algo, _, who = name.partition(", ")
        others = {kind: pace.get(f"{algo}, {kind}") for kind in (*RIVALS, TILED)} if who == "graspq" else {}
        ratios = {kind: median_ratio(other, values) for kind, other in others.items() if other is not None}
        rows.append(
            {
                "training": name,
                "transitions a second": 1 / statistics.median(values),
                "times its rival": next((ratios[kind] for kind in RIVALS if kind in ratios), None),
                "times tiled copies": ratios.get(TILED),
            }
        )
    return rows


@click.command(cls=Command)
@click.option("--shards", multiple=True, required=True, help="Dataset folders, shard files or globs.")
@click.option(
    "--algo",
    "algos",
    multiple=True,
    type=click.Choice(ALGOS),
    default=ALGOS,
    show_default=True,
    help="What to measure; may be given several times.",
)
@click.option("--turns", type=click.IntRange(1), default=5, show_default=True, help="Turns that are measured.")
@click.option(
    "--steps", type=click.IntRange(1), default=4, show_default=True, help="Steps of each in a turn; plain dql: one."
)
@click.option("--threads", type=click.IntRange(1), default=None, help="CPU threads; torch's own choice if not given.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
def main(
    shards: tuple[str, ...], algos: tuple[str, ...], turns: int, steps: int, threads: int | None, out: Path | None
) -> None:
    """Measure transitions a second of training, and where a step's time goes."""
    pool = open_shards(shards)
    kept, held_back = pool.split(0.05, 0)
    rows, pieces, precision = [], [], {}
    random.seed(0)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        # One estimator after the other: a turn of ours and one of its rival then lie within seconds of each other.
        for name in dict.fromkeys(algos):
            settings = default_settings(name, shards, Path(folder) / name, threads)
            with session(settings, pool, kept, held_back) as current:
                batches = ready(current, kept, steps)
                rows += speed_rows(rivals_of(current, batches), turns)
                if name != "ddpg":
                    pieces.append(measure_pieces(current, batches, turns).row(name))
                precision[name] = current.precision.name
    facts = {"steps a turn": steps, "turns": turns, "threads": torch.get_num_threads(), "our precision": precision}
    if pieces:
        facts["where a step of ours goes, medians"] = pieces
    report("Training speed on a CPU", rows, facts, out)


if __name__ == "__main__":
    main()
