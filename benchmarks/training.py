"""Training speed of `mc` and `dql` against the same network written plainly in PyTorch, and of `ddpg` against d3rlpy's.

python benchmarks/training.py --shards data/regular-10k
"""

import contextlib
import copy
import dataclasses
import random
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from graspq.benchmarks.d3rlpy_rival import update_by_d3rlpy
from graspq.benchmarks.measuring import (
    Ratio,
    Result,
    Row,
    TrainingSpeedSettings,
    command,
    compared,
    greatest_difference,
    take_turns,
)
from graspq.benchmarks.plain_pytorch import PlainTraining, augmented, plain_copy
from graspq.benchmarks.sessions import CPU, ready, steps_on, training_of, update_of
from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.train import augment
from graspq.train.batch import Batch
from graspq.train.device import Precision
from graspq.train.estimator import loss_of, targets_of
from graspq.train.loop import Session
from graspq.train.selection import uniform_actions
from graspq.train.state import advance, seeded

OURS, PLAIN, TILED, D3RLPY = "graspq", "plain PyTorch", "plain PyTorch, 16 tiled copies", "d3rlpy"
Runs = dict[str, tuple[Callable[[], None], int]]  # what runs, and how many transitions it trains on


@dataclass(frozen=True)
class TrainingSettings(TrainingSpeedSettings):
    """Settings of this benchmark."""

    steps: int = setting(4, help="Steps of each in a turn; plain dql with tiled copies: one.", minimum=1)


def plain_batch(batch: Batch) -> dict[str, Tensor]:
    """Return transitions as the rivals take them: no steps dimension, pictures as contiguous NCHW."""
    names = ("image", "step", "action", "reward", "terminal", "mc_return", "next_image", "next_step")
    values = {name: getattr(batch, name) for name in names}
    flat = {name: value.squeeze(1) for name, value in values.items() if value is not None}
    return {n: v.permute(0, 3, 1, 2).contiguous() if n.endswith("image") else v for n, v in flat.items()}


@torch.no_grad()
def check_agreement(current: Session, plain: PlainTraining, batch: Batch) -> None:
    """Refuse a rival whose pictures, Q (in evaluation and in training mode) or target are others, in float32.

    Raises:
        UserError: it computes something else.
    """
    settings, rows, networks = current.settings, len(batch.action), current.state.networks
    shifts = torch.randint(-settings.shift, settings.shift + 1, (rows, 2), generator=seeded("benchmarks/agreement"))
    mirrored, mirror = [True, False] * (rows // 2) + [True] * (rows % 2), networks.specification.action.mirror
    assert mirror is not None
    image = augment.shifted(batch.image, shifts, torch.tensor(mirrored))
    action = augment.mirrored_action(batch.action, torch.tensor(mirrored), mirror).squeeze(1)
    theirs = plain_batch(batch)
    plain_image, plain_action = augmented(theirs["image"], theirs["action"], shifts.tolist(), mirrored, settings.shift)
    same = torch.equal(image.squeeze(1).permute(0, 3, 1, 2).float(), plain_image) and torch.equal(action, plain_action)
    if not same:
        raise UserError("the plain augmentation gives other pictures or actions than ours")
    # Copies: a pass in training mode moves running statistics.
    network, plain_network, step = copy.deepcopy(networks.q), copy.deepcopy(plain.network), batch.step.squeeze(1)
    for mode in (False, True):
        ours = network.value_of(network.train(mode)(image.squeeze(1), step, action))
        asked = network.value_of(plain_network.train(mode)(plain_image, step, action))
        greatest_difference(ours, {f"Q of plain {settings.algo}": asked})
    if plain.dql is not None:
        precise = dataclasses.replace(networks, precision=Precision("float32", CPU))
        networks.q.eval()
        target = targets_of(settings.row, batch, precise, settings.own, seeded("benchmarks/candidates"), 0.0)
        candidates = uniform_actions(seeded("benchmarks/candidates"), rows, plain.dql.candidates, action.shape[1])
        asked = plain.double_q(theirs, theirs["next_image"].float(), candidates, plain.dql.discount)
        greatest_difference(target, {"the target of plain dql": asked})


def rivals_of(current: Session, batches: Sequence[Batch]) -> Runs:
    """Return ours and its rivals for one estimator."""
    size, theirs = len(batches[0].action), [plain_batch(batch) for batch in batches]
    runs: Runs = {OURS: (steps_on(batches, update_of(current)), size * len(batches))}
    if current.settings.algo == "ddpg":
        update = update_by_d3rlpy(theirs)
        return runs if update is None else runs | {D3RLPY: (update, size * len(batches))}
    for name in (PLAIN, TILED) if current.settings.algo == "dql" else (PLAIN,):
        copied = plain_copy(current.state.networks.q, current.state.networks.specification.steps - 1)
        plain = PlainTraining(copied, current.settings, tiled=name == TILED)
        check_agreement(current, plain, batches[0])
        taken = theirs[:1] if name == TILED else theirs  # sixteen copies of every picture take seconds
        runs[name] = steps_on(taken, plain.update), size * len(taken)
    return runs


def pieces_row(current: Session, batches: Sequence[Batch]) -> Row:
    """Return the medians of the pieces of a step, taken apart as `Session.update` does them, in milliseconds."""
    seconds: dict[str, list[float]] = {}

    @contextlib.contextmanager
    def timed(piece: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        seconds.setdefault(piece, []).append(time.perf_counter() - start)

    settings, state, row = current.settings, current.state, current.settings.row
    networks, mirror = state.networks, state.networks.specification.action.mirror
    for batch in batches:
        with timed("augmentation"):
            changed = augment.augmented(batch, settings.shift, mirror, seeded("benchmarks/augment", state.step))
        networks.q.eval()
        with timed("target"):
            numbers = seeded("benchmarks/candidates", state.step)
            target = targets_of(row, changed, networks, settings.own, numbers, 0.0)
        networks.q.train()
        with timed("forward"):
            loss = loss_of(row, changed, target, networks, settings.own)["loss"]
        state.optimizers["q"].zero_grad(set_to_none=True)
        with timed("backward"):
            loss.backward()  # type: ignore[no-untyped-call]
        with timed("optimiser"):
            state.optimizers["q"].step()
        with timed("averages"):
            advance(state, settings.average_decay, getattr(settings.own, "lag_steps", None))
        with timed("step"):
            current.update(batch)
    # The first batch warms up.
    median = {piece: 1e3 * statistics.median(values[1:]) for piece, values in seconds.items()}
    step, network = median.pop("step"), median["forward"] + median["backward"]
    return {
        "estimator": settings.algo,
        "step (ms)": step,
        **{f"{piece} (ms)": value for piece, value in median.items()},
        "share of forward and backward": f"{network / step:.0%}",
        "share of forward, backward and target": f"{(network + median['target']) / step:.0%}",
    }


def measure(settings: TrainingSettings) -> Result:
    """Return transitions a second of training, and where a step's time goes."""
    pool = open_shards(settings.shards)
    random.seed(0)
    torch.manual_seed(0)
    rows: list[Row] = []
    pieces: list[Row] = []
    faster: dict[tuple[str, str], float] = {}
    # One estimator after the other: a turn of ours and one of its rival then lie within seconds of each other.
    for algo in ("mc", "dql", "ddpg"):
        with training_of(algo, pool, settings) as current:
            batches = ready(current, pool, settings.steps)
            runs = rivals_of(current, batches)
            seconds = take_turns({name: run for name, (run, _) in runs.items()}, settings.turns)
            counts = {name: count for name, (_, count) in runs.items()}
            found, times = compared("training", "transitions", seconds, counts, OURS)
            if algo != "ddpg":
                pieces.append(pieces_row(current, batches[:1] + batches * settings.turns))
            precision = current.state.networks.precision.name
        rows += [{**row, "training": f"{algo}, {row['training']}"} for row in found]
        faster |= {(algo, name): 1 / value for name, value in times.items()}
    tiled = "… of `dql`, the plain one with a copy of the picture for every candidate"
    return Result(
        [
            Ratio("training of `mc`, against the same network in plain PyTorch", faster["mc", PLAIN], bar=2, aim=4),
            Ratio("… of `dql`", faster["dql", PLAIN], bar=2, aim=4),
            Ratio(tiled, faster["dql", TILED]),
            Ratio("… of `ddpg`, against d3rlpy's own, smaller network", faster.get(("ddpg", D3RLPY))),
        ],
        {"Training speed on a CPU": rows, "Where a training step's time goes": pieces},
        {"threads": torch.get_num_threads(), "our precision": precision},
    )


main = command(TrainingSettings, measure)


if __name__ == "__main__":
    main()
