"""A run folder: its configuration, metrics and checkpoints, and the lock that keeps two trainings out of one folder.

It holds `config.json`, `metrics.jsonl`, `tensorboard/` and `checkpoints/step-NNNNNNNN/`.
"""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from graspq.common.checksums import (
    DamagedError,
    checked_lines,
    read_checked_json,
    read_checked_lines,
    with_checksum,
    write_checked_json,
)
from graspq.common.errors import UserError, naming
from graspq.common.files import fsync_folder, locked, remove_folder, remove_temporaries, writable_folder, write_text

KEPT_CHECKPOINTS = 3
REMEDY = "copy the run again, or train again with another --out"


def checkpoint_name(step: int) -> str:
    """Return the name of a checkpoint's folder."""
    return f"step-{step:08d}"


def step_of(checkpoint: Path) -> int | None:
    """Return the step in the name of a checkpoint's folder; None for other folders."""
    match = re.fullmatch(r"step-(\d{8,})", checkpoint.name)
    return int(match[1]) if match is not None else None


class Run:
    """A run folder that exists.

    Attributes:
        folder: the folder.
        config: the content of `config.json`.
    """

    def __init__(self, folder: Path, config: dict[str, Any]) -> None:
        self.folder, self.config = folder, config

    @classmethod
    def open(cls, folder: Path | str) -> "Run":
        """Return the run in `folder`.

        Raises:
            UserError: there is none.
            DamagedError: its `config.json` is not as it was written.
        """
        folder = Path(folder)
        config = read_checked_json(folder / "config.json", "training run (config.json)", REMEDY)
        if not _is_configuration(config):
            raise UserError(f"{folder / 'config.json'}: not the configuration of a training run; name another folder")
        return cls(folder, config)

    @classmethod
    def create_or_resume(cls, folder: Path, config: dict[str, Any], free: frozenset[str]) -> "Run":
        """Return the run of this configuration in `folder`: a new one, or the one that is there.

        A run that is there keeps its own `config.json`; settings in `free` may differ from it.

        Raises:
            UserError: the folder holds something else or a run of another configuration, or cannot be written.
        """
        _refuse_something_else(folder)
        writable_folder(folder, "run")
        if not (folder / "config.json").exists():
            write_checked_json(folder / "config.json", config)
            return cls(folder, config)
        run = cls.open(folder)
        run._refuse_other(config, free)
        return run

    def _refuse_other(self, config: dict[str, Any], free: frozenset[str]) -> None:
        ours, theirs = (_flat(one["settings"]) for one in (self.config, config))
        for name in sorted((ours.keys() | theirs.keys()) - free):
            if ours.get(name) != theirs.get(name):
                raise UserError(
                    f"{self.folder}: holds a run with {name} = {ours.get(name)}, not {theirs.get(name)}; "
                    "choose another folder with --out, or delete it"
                )
        for part in ("network", "dataset", "online"):  # "online" is that of grasp-online alone
            there, here = self.config.get(part), config.get(part)
            if there != here:
                raise UserError(
                    f"{self.folder}: holds a run with another {part} ({there}, now {here}); "
                    "choose another folder with --out, or delete it"
                )

    @classmethod
    @contextlib.contextmanager
    def held(cls, folder: Path, config: dict[str, Any], free: frozenset[str]) -> Iterator["Run"]:
        """Hold a folder for this process alone, remove what killed writers left, and yield its run.

        Of two that begin in one folder, the second finds the configuration of the first.

        Raises:
            UserError: another process trains in it; or see `create_or_resume`.
        """
        _refuse_something_else(folder)
        with locked(writable_folder(folder, "run"), "training"):
            run = cls.create_or_resume(folder, config, free)
            remove_temporaries(run.folder)
            remove_temporaries(run.checkpoints_folder)
            yield run

    @property
    def checkpoints_folder(self) -> Path:
        """Where the checkpoints are."""
        return self.folder / "checkpoints"

    def checkpoints(self) -> list[Path]:
        """Return the checkpoints' folders, oldest first."""
        found = [(step_of(path), path) for path in self.checkpoints_folder.glob("step-*")]
        return [path for step, path in sorted((step, path) for step, path in found if step is not None)]

    def latest_checkpoint(self) -> Path | None:
        """Return the newest checkpoint, or None before the first."""
        return next(reversed(self.checkpoints()), None)

    def checkpoint(self, step: int | None = None) -> Path:
        """Return the checkpoint of a step, or the newest.

        Raises:
            UserError: there is none.
        """
        known = {step_of(path): path for path in self.checkpoints()}
        if not known:
            raise UserError(f"{self.folder}: has no checkpoint yet; let grasp-train run on")
        if step is not None and step not in known:
            raise UserError(f"{self.folder}: has no checkpoint of step {step}, only of {', '.join(map(str, known))}")
        return known[step] if step is not None else self.checkpoints()[-1]

    def prune(self, step: int) -> None:
        """Remove all but the newest checkpoints up to a step; later ones, if any, are damaged and written again."""
        upto = [path for path in self.checkpoints() if (step_of(path) or 0) <= step]
        for path in upto[:-KEPT_CHECKPOINTS]:
            remove_folder(path)

    def forget_checkpoints_from(self, step: int) -> None:
        """Remove the checkpoints of a step and of later ones."""
        for path in self.checkpoints():
            if (step_of(path) or 0) >= step:
                remove_folder(path)

    @property
    def metrics_file(self) -> Path:
        """Where the metrics are."""
        return self.folder / "metrics.jsonl"

    def metrics(self) -> list[dict[str, Any]]:
        """Return the rows of `metrics.jsonl`; a line that a crash cut short is left out.

        A row of training has `step, loss, samples_per_second, learning_rate` and what the estimator's update measured,
        one of validation `step, validation: {...}`; see `validation.Validation`.

        Raises:
            DamagedError: a row is not as it was written.
        """
        if not self.metrics_file.exists():
            return []
        remedy = "copy the run again, or delete this file: the training goes on without what it says"
        rows = read_checked_lines(self.metrics_file, "metrics of a training run", remedy, grows=True)
        if not all(type(row.get("step")) is int and isinstance(row.get("validation", {}), dict) for row in rows):
            raise DamagedError(f"{self.metrics_file}: not the metrics of a training run; {remedy}")
        return rows

    def summary(self) -> str:
        """Return one line on how the training ended."""
        rows, parts = self.metrics(), [str(self.folder)]
        for last in [row for row in rows if "loss" in row][-1:]:
            parts.append(f"step {last['step']}, loss {last['loss']:.4f}")
            parts.append(f"{last['samples_per_second']:.0f} samples/s")
        for last in [row["validation"] for row in rows if "validation" in row][-1:]:
            parts.append(f"held-back loss {last['loss']:.4f}")
            auc = last["roc_auc_last_step"]
            parts += [f"ROC AUC of last steps {auc:.3f}"] if auc is not None else []
        return "; ".join(parts)

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Add a row to `metrics.jsonl`."""
        with naming(self.metrics_file), self.metrics_file.open("a") as file:
            file.write(with_checksum(row))

    def sync_metrics(self) -> None:
        """Put the rows so far on the disk: no checkpoint may outlive the rows of the steps before it."""
        if self.metrics_file.exists():
            fsync_folder(self.metrics_file)
            fsync_folder(self.folder)

    def forget_after(self, step: int) -> None:
        """Drop the metrics of later steps, which will be taken again."""
        rows = [row for row in self.metrics() if row["step"] <= step]
        if self.metrics_file.exists():
            write_text(self.metrics_file, checked_lines(rows))


def _is_configuration(config: dict[str, Any]) -> bool:
    """Return whether the parts of a configuration that are there are of their kinds."""
    settings, dataset = config.get("settings"), config.get("dataset", {})
    if not isinstance(settings, dict) or not isinstance(dataset, dict):
        return False
    parts = [config[name] for name in ("network", "online", "versions") if name in config]
    parts += [dataset[name] for name in ("task", "object_set") if name in dataset]
    shards = settings.get("shards", [])
    listed = isinstance(shards, list) and all(isinstance(shard, str) for shard in shards)
    return listed and all(isinstance(part, dict) for part in parts)


def _refuse_something_else(folder: Path) -> None:
    """Refuse a folder that holds other things than a run, before anything is written to it."""
    if not folder.is_dir() or (folder / "config.json").exists():
        return
    if any(not path.name.startswith(".") for path in folder.iterdir()):
        raise UserError(f"{folder}: not empty and not a training run; choose another folder with --out")


def _flat(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings with those of the estimator and of the networks beside the common ones."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= value if isinstance(value, dict) else {name: value}
    return flat
