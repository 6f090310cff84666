"""The commands that a trial calls: `grasp-train` or `grasp-online`, then `grasp-eval`, each in this process."""

import contextlib
import importlib
import os
import shlex
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from graspq.common.errors import UserError, naming
from graspq.common.files import make_folder

MODULES = {
    "grasp-train": "graspq.train.cli",
    "grasp-online": "graspq.studies.online.cli",
    "grasp-eval": "graspq.evaluate.cli",
    "grasp-datagen": "graspq.datagen.cli",
}
PRESET = "paper"  # of the training command, where the sweep does not vary it


@dataclass(frozen=True)
class CommandLine:
    """A console script and its arguments."""

    script: str
    arguments: tuple[str, ...]

    def __str__(self) -> str:
        return shlex.join([self.script, *self.arguments])

    @property
    def main(self) -> click.Command:
        """The command behind the script."""
        found: click.Command = importlib.import_module(MODULES[self.script]).main
        return found

    def call(self, log: Path) -> tuple[int, str]:
        """Run the command with its output in `log`; return its exit status and the last line that it wrote."""
        make_folder(log.parent)
        with naming(log):
            with _output_to(log):
                print(f"$ {self}", flush=True)
                status = self._status()
            text = log.read_text(errors="replace")
        lines = [line.strip() for line in text.replace("\r", "\n").splitlines()]
        last = next((line for line in reversed(lines) if line), "")
        return status, " ".join(last.removeprefix("error: ").split())

    def _status(self) -> int:
        try:
            main: Any = self.main
            main(list(self.arguments), prog_name=self.script)
        except SystemExit as ended:
            return ended.code if isinstance(ended.code, int) else int(bool(ended.code))
        except Exception:
            traceback.print_exc()
            return 1
        return 0


@contextlib.contextmanager
def _output_to(log: Path) -> Iterator[None]:
    """Send what this process writes to both outputs to a file, also what native code writes."""
    kept = [os.dup(number) for number in (1, 2)]
    written = (sys.stdout, sys.stderr)
    with log.open("a", encoding="utf-8", buffering=1) as file:
        for stream in written:
            stream.flush()
        for number in (1, 2):
            os.dup2(file.fileno(), number)
        sys.stdout = sys.stderr = file
        try:
            yield
        finally:
            sys.stdout, sys.stderr = written
            try:
                file.flush()
            finally:
                for number, before in zip((1, 2), kept, strict=True):
                    os.dup2(before, number)
                    os.close(before)


def training_script(on_policy: bool) -> str:
    """Return the name of the script that trains."""
    return "grasp-online" if on_policy else "grasp-train"


def training_options(algo: str, on_policy: bool, chosen: Sequence[tuple[str, str]] = ()) -> dict[str, click.Option]:
    """Return the options of training by name: the common ones, and those of the estimator and of the networks.

    Args:
        algo: the estimator.
        on_policy: whether `grasp-online` trains.
        chosen: values of `preset` and `network`, which decide what other options there are.

    Raises:
        UserError: there is no such estimator or network.
    """
    command = CommandLine(training_script(on_policy), ())
    words = ["--algo", algo]
    for name, value in ({"preset": PRESET} | dict(chosen)).items():
        words += [f"--{name}", value]
    context = click.Context(command.main, info_name=command.script)
    context.meta["words"] = words
    return {one.name: one for one in command.main.get_params(context) if isinstance(one, click.Option) and one.name}


def words_for(options: Mapping[str, click.Option], values: Mapping[str, str]) -> list[str]:
    """Return what gives options their values on a command line.

    Raises:
        UserError: a switch has another value than true or false.
    """
    words: list[str] = []
    for name, value in values.items():
        option = options[name]
        if not option.is_flag:
            words += [option.opts[0], value]
        elif value in ("true", "false"):
            words.append(option.opts[0] if value == "true" else option.secondary_opts[0])
        else:
            raise UserError(f"--vary {name}: is a switch, expected true or false, got {value!r}")
    return words
