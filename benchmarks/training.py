"""Training speed of `mc` and `dql` against the same network written plainly in PyTorch, and of `ddpg` against d3rlpy's.

python benchmarks/training.py --shards data/regular-10k
"""

import copy
import dataclasses
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from graspq.benchmarks.d3rlpy_rival import update_by_d3rlpy
from graspq.benchmarks.harness import (
    DataSettings,
    Ratio,
    Result,
    Row,
    check_equal,
    command,
    compared,
    median_ratio,
    take_turns,
    timed,
)
from graspq.benchmarks.plain_pytorch import PlainTraining, augmented, plain_copy
from graspq.benchmarks.sessions import CPU, ready, steps_on, training_of
from graspq.benchmarks.stopwatch import Stopwatch
from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.train import estimator, loop, views
from graspq.train.batch import Batch
from graspq.train.device import Precision
from graspq.train.estimator import targets_of
from graspq.train.selection import uniform_actions
from graspq.train.session import Session
from graspq.train.state import seeded

OURS, PLAIN, TILED, D3RLPY = "graspq", "plain PyTorch", "plain PyTorch, 16 tiled copies", "d3rlpy"


@dataclass(frozen=True)
class TrainingSettings(DataSettings):
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
    """Refuse a rival whose pictures, Q (in evaluation and in training mode) or target are others (`UserError`)."""
    settings, rows, networks = current.settings, len(batch.action), current.state.networks
    shifts = torch.randint(-settings.shift, settings.shift + 1, (rows, 2), generator=seeded("benchmarks/agreement"))
    mirrored, mirror = [True, False] * (rows // 2) + [True] * (rows % 2), networks.specification.action.mirror
    assert mirror is not None
    image = views.shifted(batch.image, shifts, torch.tensor(mirrored))
    action = views.mirrored_action(batch.action, torch.tensor(mirrored), mirror).squeeze(1)
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
        check_equal(ours, {f"Q of plain {settings.algo}": asked})
    if plain.dql is not None:
        precise = dataclasses.replace(networks, precision=Precision("float32", CPU))
        networks.q.eval()
        target = targets_of(settings.estimator, batch, precise, settings.own, seeded("benchmarks/candidates"), 0.0)
        # Ours draws for the s' that there are.
        goes_on = ~theirs["terminal"]
        drawn = uniform_actions(
            seeded("benchmarks/candidates"), int(goes_on.sum()), plain.dql.candidates, action.shape[1]
        )
        candidates = drawn.new_zeros(rows, *drawn.shape[1:])
        candidates[goes_on] = drawn
        asked = plain.double_q(theirs, theirs["next_image"].float(), candidates, plain.dql.discount)
        check_equal(target, {"the target of plain dql": asked})


def rivals_of(current: Session, batches: Sequence[Batch]) -> dict[str, Callable[[int], float]]:
    """Return what trains ours and its rivals for one estimator; of each the seconds of a transition."""
    algo, size, theirs = current.settings.algo, len(batches[0].action), [plain_batch(batch) for batch in batches]
    arms = {OURS: timed(steps_on(batches, partial(loop.update, current)), size * len(batches))}
    if algo == "ddpg":
        rival = update_by_d3rlpy(theirs)
        return arms if rival is None else arms | {D3RLPY: timed(rival, size * len(batches))}
    for name in (PLAIN, TILED) if algo == "dql" else (PLAIN,):
        copied = plain_copy(current.state.networks.q, current.state.networks.specification.steps - 1)
        plain = PlainTraining(copied, current.settings, tiled=name == TILED)
        check_agreement(current, plain, batches[0])
        taken = theirs[:1] if name == TILED else theirs  # sixteen copies of every picture take seconds
        arms[name] = timed(steps_on(taken, plain.update), size * len(taken))
    return arms


def pieces_row(current: Session, batches: Sequence[Batch]) -> Row:
    """Return the mean milliseconds of the pieces of a step, over batches that are trained on once before."""
    train = steps_on(batches, partial(loop.update, current))
    train()
    with Stopwatch("rest", time.perf_counter) as watch:
        for owner, name, piece in (
            (loop, "augmented", "augmentation"),
            (estimator, "targets_of", "target"),
            (estimator, "loss_of", "forward"),
            (Tensor, "backward", "backward"),
            (current.state.optimizers["q"], "step", "optimiser"),
            (loop, "advance", "averages"),
        ):
            watch.wrap(owner, name, phase=piece)
        train()
    spent = {piece: 1e3 * seconds / len(batches) for (piece, _), seconds in watch.seconds.items() if piece != "rest"}
    step = 1e3 * sum(watch.seconds.values()) / len(batches)
    network = spent["forward"] + spent["backward"]
    return {
        "estimator": current.settings.algo,
        "step (ms)": step,
        **{f"{piece} (ms)": value for piece, value in spent.items()},
        "share of forward and backward": f"{network / step:.0%}",
        "share of forward, backward and target": f"{(network + spent['target']) / step:.0%}",
    }


def measure(settings: TrainingSettings) -> Result:
    """Return transitions a second of training, and where a step's time goes."""
    pool, rows, pieces = open_shards(settings.shards), list[Row](), list[Row]()
    random.seed(0)
    torch.manual_seed(0)
    faster: dict[tuple[str, str], float] = {}
    # One estimator after the other: a turn of ours and one of its rival then lie within seconds of each other.
    for algo in ("mc", "dql", "ddpg"):
        # In the data's own colours: the rivals have no others.
        with training_of(algo, settings.shards, pool, color=0.0) as current:
            batches = ready(current, pool, settings.steps)
            seconds = take_turns(rivals_of(current, batches), settings.turns)
            if algo != "ddpg":
                pieces.append(pieces_row(current, batches * settings.turns))
            precision = current.state.networks.precision.name
        rows += [{"estimator": algo, **row} for row in compared("training", "transition", seconds, OURS)]
        faster |= {(algo, name): median_ratio(values, seconds[OURS]) for name, values in seconds.items()}
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
