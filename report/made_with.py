"""What the runs of a report were made with: their settings side by side, commands, versions."""

import dataclasses
import shlex
from collections.abc import Sequence
from typing import Any

from graspq.common.errors import UserError
from graspq.common.options import flag, shown_value
from graspq.report.findings import Findings, RunData


def settings_tables(runs: Sequence[RunData]) -> dict[str, Any]:
    """Return the settings of runs side by side: those that differ, and those that all share with one value."""
    given = [_flat(run.settings) for run in runs]
    names = list(dict.fromkeys(name for one in given for name in one))
    rows = [(name, [one.get(name, "–") for one in given]) for name in names]
    return {
        "names": [run.name for run in runs],
        "differing": [row for row in rows if len(set(row[1])) > 1],
        "shared": [(name, cells[0]) for name, cells in rows if len(set(cells)) == 1],
    }


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """Return names and values as text; settings within settings are named `outer.inner`."""
    found: dict[str, str] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            found[prefix + name] = "–" if value is None else text
    return found


def command_lines(findings: Findings) -> list[str]:
    """Return the commands that made the runs and evaluations."""
    commands = [train_command(run) for run in findings.runs]
    commands += [one.summary["command"] for one in findings.evaluations if "command" in one.summary]
    return list(dict.fromkeys(commands))


def train_command(run: RunData) -> str:
    """Return the command line that makes a run again; settings at their default values are left out."""
    # Imported late: it imports PyTorch.
    from graspq.train.settings import NESTED, TrainSettings, complete

    try:
        given = TrainSettings.from_json(run.settings)
        usual = complete({"algo": given.algo, "shards": given.shards})
    except (KeyError, TypeError, UserError):
        return str(run.config.get("command", "grasp-train"))
    words = ["grasp-train", "--algo", given.algo, "--shards", *given.shards]
    for settings, defaults in ((given, usual), (given.own, usual.own), (given.network_own, usual.network_own)):
        for field in dataclasses.fields(settings):
            value = getattr(settings, field.name)
            if field.name not in ("algo", "shards", *NESTED) and value != getattr(defaults, field.name, ...):
                shown = shown_value(field, value)
                words += [shown] if isinstance(value, bool) else [flag(field.name), shown]
    return shlex.join(words)


def version_rows(findings: Findings) -> list[tuple[str, str]]:
    """Return package → versions over all runs and evaluations, code revisions last."""
    found: dict[str, dict[str, None]] = {}
    sources = [*(run.config for run in findings.runs), *(one.summary for one in findings.evaluations)]
    for source in sources:
        for name, version in (source.get("versions") or {}).items():
            found.setdefault(name, {})[str(version)] = None
    for source in sources:
        if source.get("code_revision"):
            found.setdefault("code revision", {})[str(source["code_revision"])] = None
    return [(name, ", ".join(values)) for name, values in found.items()]
