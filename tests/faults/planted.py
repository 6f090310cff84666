"""Defects that are planted in a copy of the source: each must turn its kind of fault red.

`python -P tests/faults --planted` tries them all, and names a fault that found each.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.faults.crash_points import stage_of
from tests.faults.harness import GOOD, MADE, ROOT, Fault, Kind, Outcome, Tried, Work
from tests.faults.system_calls import SCENARIOS


@dataclass(frozen=True)
class Planted:
    """A defect: a textual change of a file.

    Attributes:
        name: what is wrong then.
        file: path of the file below the root.
        old: a text that stands there once.
        new: what takes its place.
        kind: name of the kind of fault that must find it.
        commands: whose faults are tried, in this order, until one finds it.
        most: at most so many faults are tried of each command, evenly spread; all where it is 0.
        names: only faults whose name holds one of these; all where there are none.
        outcome: that the fault must have; "" for any that is not good.
    """

    name: str
    file: str
    old: str
    new: str
    kind: str
    commands: tuple[str, ...]
    most: int = 0
    names: tuple[str, ...] = ()
    outcome: Outcome | Literal[""] = ""


FILES = "common/files.py"
RENAMED = "            temporary.replace(path)\n            fsync_folder(path.parent)\n    except"
PLANTED = [
    Planted(
        "a file is not synced before its rename",
        FILES,
        "            fsync_folder(temporary)\n",
        "",
        "power loss",
        ("grasp-eval", "grasp-datagen"),
        12,
    ),
    Planted(
        "a folder is not synced after a rename in it",
        FILES,
        RENAMED,
        "            temporary.replace(path)\n    except",
        "power loss",
        ("grasp-eval", "grasp-datagen"),
    ),
    Planted(
        "a new folder is not synced in the one above",
        FILES,
        "    for one in new:\n        fsync_folder(one.parent)\n",
        "",
        "power loss",
        ("grasp-objects make", "grasp-eval"),
    ),
    Planted(
        "the files of a folder are not synced before its rename",
        FILES,
        '            for part in [*temporary.rglob("*"), temporary]:\n                fsync_folder(part)\n',
        "",
        "power loss",
        ("grasp-objects make",),
    ),
    Planted(
        "a checkpoint outlives the metrics before it",
        "train/session.py",
        "            self.run.sync_metrics()\n",
        "",
        "power loss",
        ("grasp-train",),
    ),
    Planted(
        "a file has its name before it is written",
        FILES,
        "    temporary = _temporary(path)\n    try:\n        with naming(path, temporary):\n            yield",
        "    temporary = path\n    try:\n        with naming(path, temporary):\n            yield",
        "SIGKILL in the midst of a write",
        ("grasp-datagen", "grasp-train"),
    ),
    Planted(
        "what a killed writer has left stays for ever",
        FILES,
        "            _remove(leftover)\n\n\ndef _alive",
        "            pass\n\n\ndef _alive",
        "SIGKILL at a system call",
        ("grasp-eval",),
        12,
    ),
    Planted(
        "grasp-datagen forgets its shards",
        "datagen/making.py",
        "        manifest = _existing(folder) or fresh\n",
        "        manifest = fresh\n",
        "SIGKILL at a system call",
        ("grasp-datagen, growing",),
        12,
        outcome="lost",
    ),
    Planted(
        "a training ignores its checkpoints",
        "train/session.py",
        "            return run, newest_whole(run)\n",
        "            return run, None\n",
        "SIGKILL at a system call",
        ("grasp-train",),
        12,
        outcome="lost",
    ),
    Planted(
        "metrics that cannot be written are left out",
        "train/run.py",
        '        with naming(self.metrics_file), self.metrics_file.open("a") as file:',
        '        with contextlib.suppress(OSError), self.metrics_file.open("a") as file:',
        "EIO in write",
        ("grasp-train",),
    ),
    Planted(
        "a failure of the disk is taken for a defect",
        "common/options.py",
        "            if failure is None:\n",
        "            if failure is not None:\n",
        "EIO in fsync",
        ("grasp-eval", "grasp-train"),
    ),
    Planted(
        "checksums are not compared",
        "common/checksums.py",
        "if found is None or found[1].decode() != _checksum(blank):",
        "if found is None:",
        "bit",
        ("grasp-report",),
        30,
        ("config.json ", "eval.json ", "sweep.jsonl "),
    ),
    Planted(
        "films are not compared with eval.json",
        "evaluate/films.py",
        "if not evaluation.has(FILMS_FILE):",
        "if False:",
        "bit",
        ("grasp-report",),
        12,
        ("films.npz ",),
    ),
    Planted(
        "object_set.json is not compared with its digest",
        "objects/object_set.py",
        "        _check_own(path)\n",
        "",
        "bit",
        ("grasp-eval",),
        30,
        ("object set ",),
    ),
    Planted(
        "what a manifest lists is not compared with it",
        "datasets/verify.py",
        "        if sha256_of(path) != digest:",
        "        if False:",
        "bit",
        ("grasp-data verify",),
        20,
        ("card ", "OBJ of a dataset "),
    ),
    Planted(
        "grasp-datagen believes that listed shards are whole",
        "datagen/making.py",
        "            found[entry.first_block] = reason\n",
        "            pass\n",
        "shard",
        ("grasp-datagen",),
        4,
        ("missing, shards", "cut in half, shards"),
    ),
    Planted(
        "the kinds of a manifest are not checked",
        "datasets/manifest.py",
        "        _check_kinds(self)\n",
        "",
        "hostile file",
        ("grasp-data",),
        30,
        ("manifest: ",),
    ),
    Planted(
        "a pipe is waited for",
        "common/files.py",
        "            if not stat.S_ISREG(path.stat().st_mode):\n",
        "            if False:\n",
        "hostile file",
        ("grasp-eval",),
        1,
        ("run: a pipe",),
    ),
    Planted(
        "weights need not be finite",
        "train/checkpoint.py",
        "    if broken is not None:\n",
        "    if False:\n",
        "hostile file",
        ("grasp-eval",),
        1,
        ("weights: not finite",),
    ),
    Planted(
        "two trainings work in one folder",
        "train/run.py",
        'with locked(writable_folder(folder, "run"), "training"):',
        'with contextlib.nullcontext(writable_folder(folder, "run")):',
        "two commands on one folder",
        ("grasp-train",),
        0,
        ("a training twice, at once",),
    ),
    Planted(
        "a stream that is closed stays closed",
        "common/options.py",
        "        whole_streams()\n",
        "",
        "streams",
        ("grasp-train",),
        0,
        ("all closed",),
    ),
    Planted(
        "a folder that a worker still holds is not waited for",
        "common/files.py",
        "LOCK_SECONDS = 10.0",
        "LOCK_SECONDS = 0.0",
        "workers",
        ("grasp-sweep",),
        0,
        ("the command killed, its worker slow",),
    ),
    Planted(
        "temporary folders of killed processes are not swept",
        "common/files.py",
        "            _remove_forsaken(leftover)\n",
        "            pass\n",
        "workers",
        ("grasp-datagen",),
        0,
        ("all killed",),
    ),
    Planted(
        "a scene depends on the hash seed",
        "datagen/collect.py",
        'simulation.reset(generator("datagen/scene", seed))',
        'simulation.reset(generator("datagen/scene", seed, hash("scene") % 99))',
        "reproducibility",
        ("grasp-datagen",),
        0,
        ("another hash seed",),
    ),
]


def source_with(planted: Planted, folder: Path) -> Path:
    """Return a folder to import `graspq` from, in which a defect is planted."""
    site = folder / "site"
    shutil.rmtree(site, ignore_errors=True)
    shutil.copytree(ROOT / "graspq", site / "graspq")
    for init in ROOT.glob("*/__init__.py"):
        if init.parent.name != "graspq":
            shutil.copytree(init.parent, site / "graspq" / init.parent.name)
    path = site / "graspq" / planted.file
    text = path.read_text()
    if text.count(planted.old) != 1:
        raise ValueError(f"{planted.name}: its text stands {text.count(planted.old)} times in {planted.file}")
    path.write_text(text.replace(planted.old, planted.new))
    return site


def found_by(planted: Planted, kind: Kind, work: Work) -> tuple[Fault, Tried] | None:
    """Return a fault that turned red with the defect and not without it, or None where the defect was not found.

    Args:
        planted: the defect.
        kind: of the name that it asks for.
        work: with the sound code; its inputs are used.
    """
    for name in MADE:  # with the sound code, before the other can
        work.made(name)
    for scenario in SCENARIOS:
        stage_of(work).start(scenario)
    folder = work.folder / "planted" / "-".join(planted.name.split())
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("inputs", "starts"):
        (work.folder / name).mkdir(exist_ok=True)
        if not (folder / name).is_symlink():
            (folder / name).symlink_to(work.folder / name)
    with Work(folder, source_with(planted, folder), work.shim) as broken:
        for fault in _asked(planted, list(kind.faults(broken, False))):
            tried = kind.tried(fault, broken)
            if tried.outcome not in GOOD and tried.outcome == (planted.outcome or tried.outcome):
                sound = kind.tried(fault, work)
                if sound.outcome not in GOOD:
                    raise RuntimeError(f"{fault.name} is red without the defect, too: {sound.outcome}: {sound.said}")
                return fault, tried
    return None


def _asked(planted: Planted, faults: Sequence[Fault]) -> Iterator[Fault]:
    for command in planted.commands:
        here = [fault for fault in faults if fault.command == command]
        here = [fault for fault in here if not planted.names or any(name in fault.name for name in planted.names)]
        count = min(planted.most or len(here), len(here))
        yield from (here[(2 * one + 1) * len(here) // (2 * count)] for one in range(count))
        yield from here[-1:]
