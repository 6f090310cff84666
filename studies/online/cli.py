"""`grasp-online`: the paper's on-policy setting.

The way on: `resolve` (what a command line means) -> `rounds` -> `growth` (their grasps) and `train.loop`.
"""

import importlib.util
import os
from typing import Any

import click

from graspq.common.errors import UserError
from graspq.common.options import given_options, parameters, with_version
from graspq.studies.online.settings import OnlineSettings
from graspq.train.options import TrainingCommand, value_of
from graspq.train.run import Run


class OnlineCommand(TrainingCommand):
    """The options of the rounds, and those of training: of the `--algo` that is given, or of the start run's."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse; a start run says which estimator and networks the options are of."""
        start = value_of("--start", args)
        if start is not None:
            settings = Run.open(start).config["settings"]
            for option in ("--algo", "--network"):
                if value_of(option, args) is None:
                    args = [*args, option, str(settings.get(option[2:]))]
        return super().parse_args(ctx, args)

    def groups(self, ctx: click.Context) -> list[tuple[str, list[click.Parameter]]]:
        """Return the groups of options; the rounds say how many steps there are."""
        (name, first), *others = super().groups(ctx)
        rounds = ("Rounds", parameters(OnlineSettings))
        for one in first:
            one.required = False  # the start run says what is not given
        return [rounds, (name, [one for one in first if one.name != "steps"]), *others]


@click.command(cls=OnlineCommand)
@with_version
@click.pass_context
def main(context: click.Context, /, **_: Any) -> None:
    """Alternate training with fresh grasps of the latest policy: `grasp-online --start runs/dql-regular-10k-seed0`.

    Each round first collects --grasps with the policy as it stands, a random action taking the place of the policy's
    with a probability that falls linearly with the training steps; then it trains --steps-per-round on the base pool
    and all grasps of the rounds so far. The grasps are shards of the dataset RUN/dataset, which grasp-data and
    grasp-train read like any other; RUN is a run for grasp-eval and grasp-report. The network computes on --device,
    the policy that collects on the CPU in --workers processes.

    With --start every training option that is not given is that of the start run, but for the learning rate, which is
    constant (see --learning-rate, --schedule and --warmup). Without it training begins from scratch with --algo on
    --shards. Held-back blocks stay those of the base pool.

    The same command goes on where an earlier one was stopped or killed: the result is the same.
    """
    if importlib.util.find_spec("pybullet") is None:
        raise UserError("grasp-online needs the simulator, PyBullet is not installed; run: pip install 'graspq[sim]'")
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise UserError("grasp-online runs in one process, WORLD_SIZE says several; start it without torchrun")
    # Imported late: --help must not wait for the simulator.
    from graspq.studies.online.resolve import resolve
    from graspq.studies.online.rounds import run_online

    plan = resolve(given_options(context))
    click.echo(f"{plan.train.algo}: {plan.train.run_folder}", err=True)
    click.echo(_summary(run_online(plan, show_progress=True)))


def _summary(run: Run) -> str:
    """Return one line on how the run ended."""
    rows = run.metrics()
    parts = [str(run.folder), f"step {max(row['step'] for row in rows)}"]
    rounds = [row["online"] for row in rows if "online" in row]
    grasps = sum(row["grasps"] for row in rounds)
    parts.append(f"{len(rounds)} rounds, {grasps} grasps, success rate {rounds[0]['success_rate']:.3f} in the first")
    parts[-1] += f" and {rounds[-1]['success_rate']:.3f} in the last"
    losses = [row["loss"] for row in rows if "loss" in row]
    return "; ".join(parts + [f"loss {loss:.4f}" for loss in losses[-1:]])
