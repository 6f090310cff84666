"""What a `grasp-online` command line means: complete settings, the run to go on from, and the step of each round.

Nothing is opened for writing here.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.common.options import flag
from graspq.studies.online.settings import OnlineSettings
from graspq.train.checkpoint import STATE_FILE, describe
from graspq.train.run import Run
from graspq.train.settings import TrainSettings, complete, with_options


@dataclasses.dataclass(frozen=True)
class Start:
    """The run that is gone on from.

    Attributes:
        folder: of the run.
        checkpoint: folder of the checkpoint.
        step: its training step.
        sha256: of its `state.json`, which holds those of all weights and moments.
        settings: of the run.
        task: settings of the task of its data, as JSON.
    """

    folder: Path
    checkpoint: Path
    step: int
    sha256: str
    settings: TrainSettings
    task: dict[str, Any]

    @classmethod
    def open(cls, folder: Path, step: int | None = None) -> "Start":
        """Return the run in `folder` at a checkpoint, its last where no step is given.

        Raises:
            UserError: there is no run or checkpoint, or it is damaged or was itself made by `grasp-online`.
        """
        run = Run.open(folder)
        if "online" in run.config:
            raise UserError(f"--start: {folder} is a run of grasp-online; name one of grasp-train")
        checkpoint = run.checkpoint(step)
        try:
            settings = TrainSettings.from_json(run.config["settings"])
            task = dict(run.config["dataset"]["task"])
        except (KeyError, TypeError, ValueError) as error:
            reason = error.message if isinstance(error, UserError) else repr(error)
            raise UserError(f"{folder / 'config.json'}: not the configuration of a training run ({reason})") from None
        found = int(describe(checkpoint)["step"])
        return cls(folder, checkpoint, found, sha256_of(checkpoint / STATE_FILE), settings, task)


@dataclasses.dataclass(frozen=True)
class Plan:
    """A whole on-policy run.

    Attributes:
        online: settings of the rounds.
        train: settings of the training; its `steps` are those of the last round's end.
        start: the run that is gone on from; None from scratch.
    """

    online: OnlineSettings
    train: TrainSettings
    start: Start | None

    @property
    def split_seed(self) -> int:
        """Seed by which the base pool's held-back blocks are chosen: the start run has not seen them."""
        return self.train.seed if self.start is None else self.start.settings.seed

    def border(self, number: int) -> int:
        """Return the training step at which round `number` (from 0) collects; that of one more is where it ends."""
        first = 0 if self.start is None else self.start.step
        return first + number * self.online.steps_per_round

    def described(self) -> dict[str, Any]:
        """Return what `config.json` says of it beside the settings of training; all of it decides the result."""
        start = None if self.start is None else {"step": self.start.step, "sha256": self.start.sha256}
        return self.online.deciding() | {"start": start, "split_seed": self.split_seed}


def resolve(given: Mapping[str, Any]) -> Plan:
    """Return the plan of a command line.

    Args:
        given: options by name: those of `OnlineSettings`, those of `grasp-train` but for `steps`, and `preset`.

    Raises:
        UserError: a value is unknown or does not go with the start run, or that is not there.
    """
    own = {field.name for field in dataclasses.fields(OnlineSettings)}
    online = OnlineSettings(**{name: value for name, value in given.items() if name in own})
    training = {name: value for name, value in given.items() if name not in own}
    steps = online.rounds * online.steps_per_round
    if online.start is None:
        if online.checkpoint is not None:
            raise UserError("--checkpoint: is that of a start run; give --start too")
        start, train = None, _from_scratch(training, steps)
    else:
        start = Start.open(online.start, online.checkpoint)
        train = _going_on(start, training, start.step + steps)
    if train.out is None:
        named = train.run_folder
        train = dataclasses.replace(train, out=named.with_name(f"online-{named.name}"))
    return Plan(online, train, start)


def _from_scratch(given: Mapping[str, Any], steps: int) -> TrainSettings:
    for name in ("algo", "shards"):
        if name not in given:
            raise UserError(f"{flag(name)}: is needed from scratch; give it, or a run to go on from with --start")
    options = {"schedule": "constant"} | {name: value for name, value in given.items() if name != "preset"}
    return complete(options | {"steps": steps}, given.get("preset", "default"))


def _going_on(start: Start, given: Mapping[str, Any], steps: int) -> TrainSettings:
    before = start.settings
    if "preset" in given:
        raise UserError(f"--preset: {start.folder} has its settings already; leave the option out, or --start")
    # What the weights were trained with cannot change on the way.
    fixed = {"algo": before.algo, "network": before.network, **before.network_own.to_json()}
    fixed |= {"loss": before.own.loss} if hasattr(before.own, "loss") else {}
    for name, theirs in fixed.items():
        if name in given and given[name] != theirs:
            raise UserError(
                f"{flag(name)}: {start.folder} was trained with {theirs}, got {given[name]}; "
                "leave the option out, or train from scratch without --start"
            )
    rate = before.learning_rate if before.schedule == "constant" else before.learning_rate / 10
    # What rose over the start run's steps stays risen: the rate, and the correction of corr-mc.
    onward: dict[str, Any] = {"out": None, "schedule": "constant", "warmup": 0.0, "learning_rate": rate}
    onward |= {"anneal": 0.0} if hasattr(before.own, "anneal") else {}
    return with_options(before, onward | dict(given) | {"steps": steps})
