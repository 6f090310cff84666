"""A trial of a sweep: one training and its evaluation; a unit of the sweep's plan.

How far it is stands in its own files alone: the run's checkpoints, the evaluation's record, the note of a failure.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.common.errors import MachineError, UserError
from graspq.common.options import INTERRUPTED
from graspq.evaluate.records import Evaluation, finished_below
from graspq.studies.sweep.commands import PRESET, CommandLine, training_options, training_script, words_for
from graspq.studies.sweep.settings import GRASPS_PER_ROUND, STEPS_PER_ROUND, SweepSettings
from graspq.train.run import Run, step_of

# Options of training by name, each with its value as a command line gives it.
Options = tuple[tuple[str, str], ...]
SCENES_SEED = 0
_SHORT = {"learning_rate": "lr", "exploration_steps": "exploration"}


@dataclass(frozen=True)
class State:
    """What a trial's files say.

    Attributes:
        trial: the trial.
        steps: training step of the newest checkpoint; 0 before the first.
        training_seconds: time spent in training steps that count; None before the first row of metrics.
        evaluation: the score of the last step; None before.
        reason: why it failed, in one line; None if it did not.
    """

    trial: "Trial"
    steps: int
    training_seconds: float | None
    evaluation: Evaluation | None
    reason: str | None

    @property
    def status(self) -> Literal["done", "failed", "to do"]:
        """In a word: trained to the last step and scored, or failed, or neither."""
        return "done" if self.evaluation is not None else "failed" if self.reason is not None else "to do"


@dataclass(frozen=True)
class Trial:
    """One training and its evaluation.

    Attributes:
        settings: of the sweep, complete.
        algo: the estimator.
        options: what varies besides.
        seed: seed of the training.
    """

    settings: SweepSettings
    algo: str
    options: Options
    seed: int

    @property
    def name(self) -> str:
        """What varies: `dql-lr0.001-width32-discount0.9-seed0`; a grid that grows keeps the names it has."""
        parts = [self.algo, *(f"{_SHORT.get(name, name)}{value}" for name, value in self.options), f"seed{self.seed}"]
        return "-".join(re.sub(r"[^A-Za-z0-9._+-]+", ".", part) for part in parts)

    def to_json(self) -> dict[str, Any]:
        """Return what varies as plain JSON values, the name first."""
        return {"id": self.name, "algo": self.algo, "options": dict(self.options), "seed": self.seed}

    @classmethod
    def from_json(cls, settings: SweepSettings, values: dict[str, Any]) -> "Trial":
        """Return the trial that `to_json` wrote."""
        return cls(settings, values["algo"], tuple(values["options"].items()), values["seed"])

    @property
    def run_folder(self) -> Path:
        """Where the training run is."""
        return self.settings.folder / "runs" / self.name

    @property
    def log(self) -> Path:
        """Where the output of the commands is."""
        return self.settings.folder / "logs" / f"{self.name}.log"

    @property
    def failure_note(self) -> Path:
        """Where it is noted that the trial failed."""
        return self.settings.folder / "failures" / f"{self.name}.json"

    @property
    def outputs(self) -> tuple[Path, ...]:
        """All that it writes, as far as it is there."""
        return self.run_folder, self.log, self.failure_note

    def state(self) -> State:
        """Return how far it is.

        Raises:
            UserError: the note of its failure cannot be read.
        """
        run = run_in(self.run_folder)
        steps, seconds = trained_steps(run), training_seconds(run) if run is not None else None
        if run is not None and steps >= (self.settings.steps or 0):
            for found in finished_below(run.folder / "evaluations"):
                if self._is_asked(found.summary):
                    return State(self, steps, seconds, found, None)
        return State(self, steps, seconds, None, self._failure(steps))

    def _failure(self, steps: int) -> str | None:
        if not self.failure_note.exists():
            return None
        note = read_checked_json(self.failure_note, "note of a failure", "delete it, and the trial is done again")
        of_a_run_that_is_gone = steps < note.get("steps", 0)
        return None if of_a_run_that_is_gone else str(note.get("reason"))

    def _is_asked(self, summary: dict[str, Any]) -> bool:
        """Return whether an evaluation is of the last step, and of the sweep's search on its scenes."""
        own = self.settings
        asked = {
            "checkpoint_step": own.steps, "split": own.split, "episodes": own.episodes, "seed": SCENES_SEED,
        }  # fmt: skip
        searched = summary.get("cem") in (None, own.cem.to_json())
        return searched and all(summary.get(name) == value for name, value in asked.items())

    def done(self) -> bool:
        """Return whether the score is there, or the note that there will be none."""
        return self.state().status != "to do"

    def training_command(self) -> CommandLine:
        """Return the command that trains to the last step, from where it is.

        Raises:
            UserError: a switch has another value than true or false.
        """
        own, given = self.settings, {"preset": PRESET} | dict(self.options)
        words = ["--algo", self.algo, "--shards", *own.shards]
        words += words_for(training_options(self.algo, own.on_policy, self.options), given)
        words += ["--seed", str(self.seed), "--threads", str(own.threads), "--device", own.device]
        words += ["--out", str(self.run_folder)]
        if own.on_policy:
            rounds = (own.steps or 0) // STEPS_PER_ROUND
            words += ["--rounds", str(rounds), "--steps-per-round", str(STEPS_PER_ROUND)]
            words += [] if "grasps" in given else ["--grasps", str(GRASPS_PER_ROUND)]
            words += ["--workers", self._workers, *self._objects, *own.cem.words()]
        else:
            words += ["--steps", str(own.steps)]
        return CommandLine(training_script(own.on_policy), tuple(words))

    def evaluation_command(self) -> CommandLine:
        """Return the command that scores the run."""
        own = self.settings
        words = [str(self.run_folder), "--split", own.split, "--episodes", str(own.episodes)]
        words += ["--seed", str(SCENES_SEED), "--workers", self._workers, "--device", own.device]
        return CommandLine("grasp-eval", (*words, *self._objects, *own.cem.words()))

    @property
    def _workers(self) -> str:
        """How many processes simulate for it: one is its own."""
        threads = self.settings.threads or 1
        return str(threads if threads > 1 else 0)

    @property
    def _objects(self) -> list[str]:
        return ["--objects", str(self.settings.objects)] if self.settings.objects is not None else []

    def next_command(self) -> CommandLine | None:
        """Return what it needs next, or None where it is scored."""
        state = self.state()
        if state.evaluation is not None:
            return None
        return self.training_command() if state.steps < (self.settings.steps or 0) else self.evaluation_command()

    def run(self) -> None:
        """Run the commands that it needs, one after the other, from where it is.

        Raises:
            UserError: one failed, which is noted: it is not run again unless asked.
            MachineError: the machine failed one, which is not noted.
            KeyboardInterrupt: a command was asked to end; it has kept what it had.
        """
        before: CommandLine | None = None
        while (command := self.next_command()) is not None:
            status, last = command.call(self.log)
            if status == INTERRUPTED:
                raise KeyboardInterrupt
            if status == MachineError.exit_code:  # no fault of the trial's: the same command tries it again
                raise MachineError(f"{last} (in {self.log})")
            if status != 0:
                reason = last or f"{command.script} ended with status {status}"
            elif command == before:
                reason = f"{command.script} ended without an error and without a result"
            else:
                before = command
                continue
            self.note_failure(str(command), status, reason)
            raise UserError(reason)

    def note_failure(self, command: str, exit_status: int, reason: str) -> None:
        """Note durably that it failed; the note is void once the run is deleted that it is of."""
        note = {"id": self.name, "command": command, "exit_status": exit_status, "reason": reason}
        write_checked_json(self.failure_note, note | {"steps": trained_steps(run_in(self.run_folder))})


def run_in(folder: Path) -> Run | None:
    """Return the training run in a folder, or None where there is none yet."""
    try:
        return Run.open(folder)
    except UserError:
        return None


def trained_steps(run: Run | None) -> int:
    """Return the step of a run's newest checkpoint; 0 without one."""
    newest = run.latest_checkpoint() if run is not None else None
    return (step_of(newest) or 0) if newest is not None else 0


def training_seconds(run: Run) -> float | None:
    """Return the seconds that a run's training steps took, over all times it was resumed; None without a row.

    Σ (steps of the row × batch size / samples per second) over the rows of `metrics.jsonl`: what was lost by a kill
    does not count, nor do validation and checkpoints.
    """
    batch_size = run.config["settings"].get("batch_size")
    seconds, last = 0.0, 0
    for row in run.metrics():
        if "samples_per_second" in row and batch_size is not None and row["samples_per_second"] > 0:
            seconds += (row["step"] - last) * batch_size / row["samples_per_second"]
            last = row["step"]
    return round(seconds, 1) if last > 0 else None
