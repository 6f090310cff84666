"""The on-policy run: a round is some grasps of the latest policy and then some training steps on all data so far.

What happens in a round depends on the settings, the data and the weights at its start alone, so that a run that was
killed at any moment and started again ends in the same dataset, weights and metrics (but for its figures of speed; one
that was stopped by SIGINT in training leaves a checkpoint and a row of metrics there besides).
"""

from dataclasses import dataclass

import click

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.engine.plan import Step, carry_out
from graspq.evaluate.scenes import find_object_set
from graspq.objects.object_set import ObjectSet
from graspq.policies.exploring import ExploringPolicy
from graspq.policies.of_run import load
from graspq.policies.random import RandomPolicy
from graspq.sim.task import Task, task_from_json
from graspq.studies.online.growth import GrowingDataset
from graspq.studies.online.pools import PoolOfRounds
from graspq.studies.online.resolve import Plan
from graspq.train.loop import train_until
from graspq.train.run import Run
from graspq.train.session import Session, session


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
        rounds = [_Round(number, plan, current, growing, pools, show_progress) for number in range(plan.online.rounds)]
        carry_out([unit for one in rounds for unit in one.units()], lambda ending: None, keep_going=False)
    return current.run


def _objects(plan: Plan, task: Task, pool: ShardPool) -> ObjectSet:
    """Return the object set, after drawing from it once so that a wrong one fails now."""
    wanted = str(pool.object_set["sha256"])
    objects = find_object_set(task, plan.online.objects, wanted, pool.folders)
    task.draw(objects, "train", generator("online/check"))
    return objects


@dataclass(frozen=True)
class _Round:
    """Round `number`, from 0, of a run: its two units of the plan."""

    number: int
    plan: Plan
    current: Session
    growing: GrowingDataset
    pools: PoolOfRounds
    show_progress: bool

    def units(self) -> tuple[Step, Step]:
        which = f"round {self.number + 1}"
        return (
            Step(f"grasps of {which}", self.collected, self.collect),
            Step(f"training of {which}", self.trained, self.train),
        )

    def trained(self) -> bool:
        return self.current.state.step >= self.plan.border(self.number + 1)

    def train(self) -> None:
        pool = self.pools.of(self.growing.blocks_of(self.number + 1))
        train_until(self.plan.border(self.number + 1), self.current, pool, self.show_progress)

    def collected(self) -> bool:
        """Return whether the row of metrics is there, which is written after the grasps."""
        rows = (row["online"]["round"] for row in self.current.run.metrics() if "online" in row)
        return self.trained() or self.number + 1 in rows

    def collect(self) -> None:
        online, step, number = self.plan.online, self.plan.border(self.number), self.number + 1
        if self.current.state.step == step:
            self.current.save()
        exploration = online.exploration(step)
        latest = load(self.current.run.folder, step, cem=online.cem, device="cpu")
        policy = ExploringPolicy(exploration, RandomPolicy(online.descend_probability), latest)
        entry = self.growing.collect(self.number, policy)
        row = {
            "round": number,
            "grasps": entry.episodes,
            "successes": entry.successes,
            "success_rate": entry.successes / entry.episodes,
            "mean_steps": entry.rows / entry.episodes,
            "exploration": exploration,
            "grasps_so_far": sum(ref.episodes for ref in self.growing.blocks_of(number)),
        }
        self.current.run.append_metrics({"step": step, "online": row})
        if self.show_progress:
            click.echo(
                f"round {number} of {online.rounds}, step {step}: {entry.episodes} grasps, "
                f"exploration {exploration:.3f}, success rate {row['success_rate']:.3f}",
                err=True,
            )
