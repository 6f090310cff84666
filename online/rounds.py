"""The on-policy run: a round is some grasps of the latest policy and then some training steps on all data so far.

What happens in a round depends on the settings, the data and the weights at its start alone, so that a run that was
killed at any moment and started again ends in the same dataset, weights and metrics (but for its figures of speed; one
that was stopped by SIGINT in training leaves a checkpoint and a row of metrics there besides).
"""

from typing import Any

import click

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.datasets.dataset import open_shards
from graspq.datasets.manifest import ShardEntry
from graspq.datasets.pool import ShardPool
from graspq.evaluate.scenes import find_object_set
from graspq.objects.object_set import ObjectSet
from graspq.online.growth import GrowingDataset
from graspq.online.pools import PoolOfRounds
from graspq.online.resolve import Plan
from graspq.policies.exploring import ExploringPolicy
from graspq.policies.of_run import load
from graspq.policies.random import RandomPolicy
from graspq.sim.task import Task, task_from_json
from graspq.train.loop import Session, session
from graspq.train.run import Run


def run_online(plan: Plan, *, show_progress: bool = False) -> Run:
    """Do all rounds of a plan, from where its run folder stands.

    Args:
        plan: everything about the run.
        show_progress: show a progress bar on standard error.

    Raises:
        UserError: data, object set, run folder or a setting are not usable; see the message.
        DivergedError: a loss or weight was not finite.
        KeyboardInterrupt: SIGINT or SIGTERM came; the same plan goes on where it was.
    """
    pool = open_shards(plan.train.shards)
    if plan.start is not None and plan.start.task != pool.task:
        raise UserError(
            f"--shards: of another task than that of {plan.start.folder}; leave the option out, or start from scratch"
        )
    training, held_back = pool.split(plan.train.validation_fraction, plan.split_seed)
    task = task_from_json(pool.task)
    objects = _objects(plan, task, pool)
    extra = {
        "command": "grasp-online",
        "online": plan.described(),
        "start_run": None if plan.start is None else str(plan.start.folder),
    }
    start = None if plan.start is None else plan.start.checkpoint
    with session(plan.train, pool, training, held_back, start=start, described=extra) as current:
        growing = GrowingDataset.open(current.run.folder, plan, task, objects, pool)
        pools = PoolOfRounds(training, plan.train.buffer_bytes)
        _Rounds(plan, current, growing, pools).do(show_progress)
    return current.run


def _objects(plan: Plan, task: Task, pool: ShardPool) -> ObjectSet:
    """Return the object set, after drawing from it once so that a wrong one fails now."""
    wanted = str(pool.object_set["sha256"])
    objects = find_object_set(task, plan.online.objects, wanted, pool.folders)
    task.draw(objects, "train", generator("online/check"))
    return objects


class _Rounds:
    """The rounds of one process's part of a run."""

    def __init__(self, plan: Plan, current: Session, growing: GrowingDataset, pools: PoolOfRounds) -> None:
        self.plan, self.current, self.growing, self.pools = plan, current, growing, pools
        self._noted = {row["online"]["round"] for row in current.run.metrics() if "online" in row}

    def do(self, show_progress: bool) -> None:
        """Do what is left of all rounds."""
        for number in range(self.plan.online.rounds):
            end = self.plan.border(number + 1)
            if self.current.state.step >= end:
                continue
            self._collect(number, show_progress)
            pool = self.pools.of(self.growing.blocks_of(number + 1))
            self.current.steps(pool, end, show_progress)

    def _collect(self, number: int, show_progress: bool) -> None:
        online, step = self.plan.online, self.plan.border(number)
        if self.current.state.step == step:
            self.current.save()
        exploration = online.exploration(step)
        random = RandomPolicy(online.descend_probability)
        latest = load(self.current.run.folder, step, cem=online.cem, device="cpu")
        policy = ExploringPolicy(exploration, random, latest)
        entry = self.growing.collect(number, policy)
        if number + 1 not in self._noted:
            self.current.run.append_metrics({"step": step, "online": _row(number, entry, exploration, self.growing)})
            self._noted.add(number + 1)
        if show_progress:
            rate = entry.successes / entry.episodes
            click.echo(
                f"round {number + 1} of {online.rounds}, step {step}: {entry.episodes} grasps, "
                f"exploration {exploration:.3f}, success rate {rate:.3f}",
                err=True,
            )


def _row(number: int, entry: ShardEntry, exploration: float, growing: GrowingDataset) -> dict[str, Any]:
    """Return what `metrics.jsonl` says of a round's grasps."""
    blocks = growing.blocks_of(number + 1)
    return {
        "round": number + 1,
        "grasps": entry.episodes,
        "successes": entry.successes,
        "success_rate": entry.successes / entry.episodes,
        "mean_steps": entry.rows / entry.episodes,
        "exploration": exploration,
        "grasps_so_far": sum(ref.episodes for ref in blocks),
    }
