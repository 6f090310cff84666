"""Files from a stranger: whatever they say, a command answers with one line, opens nothing elsewhere and runs nothing.

Each is signed as its own program would sign it: a stranger can reckon a digest too.
"""

import hashlib
import json
import os
import shutil
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from graspq.common.checksums import with_checksum
from graspq.datasets.manifest import _digest_of
from tests.faults.bits import FREEZE, LOAD, PLAN_SWEEP, REPORT_RUN, REPORT_SCORES, REPORT_SWEEP, SET, TRAIN, VERIFY
from tests.faults.harness import Fault, Tried, Work

SECRET = "nobody-is-to-read-this"
FACES = "1 3 4,1 4 2,5 6 8,5 8 7,1 2 6,1 6 5,3 7 8,3 8 4,1 5 7,1 7 3,2 4 8,2 8 6"
BOX = "\n".join(
    [f"v {x} {y} {z}" for x in (0, 0.05) for y in (0, 0.05) for z in (0, 0.05)]
    + [f"f {face}" for face in FACES.split(",")]
)
SECRETS = {name: f"# {SECRET}\n{BOX}\n".encode() for name in ("secret", "secret.obj", "secret.urdf", "secret.mtl")}
# Right, so that who follows a path out of its folder finds nothing wrong.
SECRET_SHA256 = hashlib.sha256(SECRETS["secret"]).hexdigest()
PASSWD_SHA256 = hashlib.sha256(Path("/etc/passwd").read_bytes()).hexdigest()
DATA, RUN = Path("data/regular-24"), Path("runs/mc")
Change = Callable[[Path], None]


def _json(name: str, sign: Callable[[dict[str, Any]], str], change: Callable[[dict[str, Any]], Any]) -> Change:
    """Return what changes a JSON file below a case, and signs it anew."""

    def changed(case: Path) -> None:
        path = sorted(case.glob(name))[0]
        values = json.loads(path.read_text())
        for entry in ("digest", "checksum"):
            values.pop(entry, None)
        path.write_text(sign(change(values) or values), errors="surrogatepass")
        path.with_name(f"{path.name}.sha256").unlink(missing_ok=True)

    return changed


def _signed_manifest(values: dict[str, Any]) -> str:
    try:
        digest = _digest_of(values)
    except ValueError:
        digest = "0" * 64
    return json.dumps({**values, "digest": digest}, indent=2, ensure_ascii=False) + "\n"


def _signed_state(values: dict[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    return json.dumps({**values, "digest": digest}, indent=2) + "\n"


def _checked(values: dict[str, Any]) -> str:
    return with_checksum(values, indent=2)


def _put(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """Return what sets the entry at `a.0.b` of a JSON object."""

    def put(values: dict[str, Any]) -> None:
        *way, last = path.split(".")
        place: Any = values
        for key in way:
            place = place[int(key) if isinstance(place, list) else key]
        place[int(last) if isinstance(place, list) else last] = value

    return put


def manifest(path: str, value: Any) -> Change:
    """Return a change of the dataset's manifest."""
    return _json(f"{DATA}/manifest.json", _signed_manifest, _put(path, value))


def record(path: str, value: Any, name: str = "objects/object_set.json") -> Change:
    """Return a change of an object set."""
    return _json(name, lambda values: json.dumps(values, indent=2), _put(path, value))


def config(path: str, value: Any) -> Change:
    """Return a change of a run's configuration."""
    return _json(f"{RUN}/config.json", _checked, _put(path, value))


def state(path: str, value: Any) -> Change:
    """Return a change of the description of a checkpoint."""
    return _json(f"{RUN}/checkpoints/step-00000008/state.json", _signed_state, _put(path, value))


def score(path: str, value: Any) -> Change:
    """Return a change of an evaluation."""
    return _json("scores/*/eval.json", _checked, _put(path, value))


def text(name: str, content: str | bytes) -> Change:
    """Return what writes a file over."""

    def write(case: Path) -> None:
        path = sorted(case.glob(name))[0] if "*" in name else case / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        if path.name == "object_set.json":
            path.with_name(f"{path.name}.sha256").unlink(missing_ok=True)

    return write


def replaced(name: str, old: str, new: str) -> Change:
    """Return what replaces text in a file."""

    def replace(case: Path) -> None:
        path = sorted(case.glob(name))[0]
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))

    return replace


def linked(name: str, target: str) -> Change:
    """Return what puts a link in the place of a file or folder."""

    def link(case: Path) -> None:
        path = sorted(case.glob(name))[0]
        shutil.move(path, case / "moved")
        path.symlink_to(case / "moved" if target == "moved" else target)

    return link


def pipe(name: str) -> Change:
    """Return what puts a named pipe in the place of a file: whoever opens it waits for ever."""

    def put(case: Path) -> None:
        path = sorted(case.glob(name))[0]
        path.unlink()
        os.mkfifo(path)

    return put


def table(name: str, make: Callable[[pa.Table], pa.Table], **options: Any) -> Change:
    """Return what writes the first shard of a table anew, and lists it in the manifest."""

    def write(case: Path) -> None:
        path = sorted((case / DATA / name).glob("*.parquet"))[0]
        file = pq.ParquetFile(path)
        groups = [make(file.read_row_group(index)) for index in range(file.num_row_groups)]
        with pq.ParquetWriter(path, groups[0].schema, compression="zstd", **options) as writer:
            for group in groups:
                writer.write_table(group, row_group_size=max(1, group.num_rows))
        relist(case, path)

    return write


def raw(name: str, change: Callable[[bytes], bytes]) -> Change:
    """Return what changes the bytes of the first shard of a table, and lists it in the manifest."""

    def write(case: Path) -> None:
        path = sorted((case / DATA / name).glob("*.parquet"))[0]
        path.write_bytes(change(path.read_bytes()))
        relist(case, path)

    return write


def relist(case: Path, path: Path) -> None:
    """List a shard's file with the bytes that it has now."""
    content, listed = path.read_bytes(), f"{path.parent.name}/{path.name}"
    of_manifest = case / DATA / "manifest.json"
    values = json.loads(of_manifest.read_text())
    for entry in values["shards"]:
        if listed in entry["files"]:
            entry["files"][listed] = hashlib.sha256(content).hexdigest()
            entry["sizes"][listed] = len(content)
    values.pop("digest")
    of_manifest.write_text(_signed_manifest(values))


def _column(name: str, array: Callable[[pa.ChunkedArray], Any]) -> Callable[[pa.Table], pa.Table]:
    return lambda found: found.set_column(found.column_names.index(name), name, array(found.column(name)))


def _many_rows(found: pa.Table) -> pa.Table:
    row = found.slice(0, 1)
    return pa.concat_tables([row] * 100_000)


def weights(make: Callable[[bytes], bytes]) -> Change:
    """Return what changes the weights that act, and lists them in `state.json`."""

    def write(case: Path) -> None:
        folder = case / RUN / "checkpoints" / "step-00000008"
        path = folder / "q.safetensors"
        content = make(path.read_bytes())
        path.write_bytes(content)
        digest = hashlib.sha256(content).hexdigest()
        _json(
            str((folder / "state.json").relative_to(case)),
            _signed_state,
            lambda values: values["files"].update({path.name: digest}),
        )(case)

    return write


def elsewhere_in_state(case: Path) -> None:
    """List a file outside of a checkpoint's folder with its right digest."""
    digest = hashlib.sha256((case / RUN / "config.json").read_bytes()).hexdigest()
    _json(
        f"{RUN}/checkpoints/step-00000008/state.json",
        _signed_state,
        lambda values: values["files"].update({"../../config.json": digest}),
    )(case)


def _header(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
    def make(content: bytes) -> bytes:
        (length,) = struct.unpack("<Q", content[:8])
        values = json.loads(content[8 : 8 + length])
        header = json.dumps(change(values) or values).encode()
        return struct.pack("<Q", len(header)) + header + content[8 + length :]

    return make


def _nan(content: bytes) -> bytes:
    (length,) = struct.unpack("<Q", content[:8])
    return content[: 8 + length] + struct.pack("<f", float("nan")) * ((len(content) - 8 - length) // 4)


def _bytes_of(value: Any) -> Callable[[dict[str, Any]], None]:
    def put(values: dict[str, Any]) -> None:
        name = next(name for name in values if name != "__metadata__")
        values[name] |= value

    return put


def _row_of(**changed: Any) -> str:
    row = {"id": "mc", "algo": "mc", "status": "done", "steps": 4, "success_rate": 0.5}
    return json.dumps(row | changed) + "\n"


BRACKETS, DIGITS = "[" * 100_000, "9" * 5_000
LAST_OBJ, LAST_URDF = "objects/meshes/train_000.obj", "objects/meshes/train_000.urdf"

# Command, what it needs, and name -> change; all must be refused in one line unless `FINE` says otherwise.
HOSTILE: dict[str, tuple[str, tuple[str, ...], dict[str, Change]]] = {
    "object set": (
        SET,
        ("objects",),
        {
            "mesh ../": record("objects.0.mesh", "../secret.obj"),
            "mesh of root": record("objects.0.mesh", "/etc/passwd"),
            "urdf ../": record("objects.0.urdf", "../../secret.urdf"),
            "sha256 of a file elsewhere": record("objects.0.sha256", {"../secret": SECRET_SHA256}),
            "sha256 a list": record("objects.0.sha256", ["meshes/train_000.obj", "meshes/train_000.urdf"]),
            "id ../": record("objects.0.object_id", "../../secret"),
            "id of a million letters": record("objects.0.object_id", "a" * 1_000_000),
            "id with markup": record("objects.0.object_id", "<script>alert(1)</script>"),
            "id with an end of line": record("objects.0.object_id", "a\nb"),
            "mass of 10^400": record("objects.0.mass", 10**400),
            "mass of 1e300": record("objects.0.mass", 1e300),
            "mass not a number": record("objects.0.mass", float("nan")),
            "mass true": record("objects.0.mass", "1"),
            "inertia of 2": record("objects.0.inertia", [1, 2]),
            "colour of 7": record("objects.0.color", [7, 0, 0, 1]),
            "objects a word": record("objects", "objects"),
            "objects none": record("objects", []),
            "objects twice": _json(
                "objects/object_set.json",
                lambda values: json.dumps(values),
                lambda values: values["objects"].append(values["objects"][0]),
            ),
            "format 10^18": record("format_version", 10**18),
            "100,000 brackets": text("objects/object_set.json", BRACKETS),
            "seed of 5,000 digits": text("objects/object_set.json", f'{{"seed": {DIGITS}}}'),
            "empty": text("objects/object_set.json", ""),
            "no UTF-8": text("objects/object_set.json", b"\xff\xfe\x00"),
            "OBJ linked": linked(LAST_OBJ, "moved"),
            "folder of meshes linked": linked("objects/meshes", "moved"),
            "OBJ a link to a device": linked(LAST_OBJ, "/dev/zero"),
            "OBJ a pipe": pipe(LAST_OBJ),
            "object_set.json a pipe": pipe("objects/object_set.json"),
            "URDF names a mesh elsewhere": replaced(LAST_URDF, "train_000.obj", "../../secret.obj"),
            "URDF no XML": text(LAST_URDF, "no XML"),
            "OBJ of index 3,000,000,000": text(LAST_OBJ, "o part_0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3000000000\n"),
            "OBJ of NaN": text(LAST_OBJ, "o part_0\nv nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        },
    ),
    "object set of a stranger, signed": (
        "grasp-objects show objects --out fresh.png",
        ("objects",),
        {
            "OBJ of index 3,000,000,000": text(LAST_OBJ, "o part_0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3000000000\n"),
            "OBJ of index 10^30": text(LAST_OBJ, f"o part_0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {10**30}\n"),
            "OBJ of index 0": text(LAST_OBJ, "o part_0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n"),
            "OBJ of index -1": text(LAST_OBJ, "o part_0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 1 2\n"),
            "OBJ of NaN": text(LAST_OBJ, "o part_0\nv nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            "OBJ of 1e999": text(LAST_OBJ, "o part_0\nv 1e999 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            "OBJ of 5,000 digits": text(LAST_OBJ, f"o part_0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {DIGITS}\n"),
            "OBJ without a part": text(LAST_OBJ, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            "OBJ of a part without faces": text(LAST_OBJ, "o part_0\nv 0 0 0\no part_1\n"),
            "OBJ of rows of four": text(LAST_OBJ, "o part_0\nv 0 0 0 1\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            "OBJ empty": text(LAST_OBJ, ""),
            "OBJ no UTF-8": text(LAST_OBJ, b"\xff\xff"),
            "OBJ that names a material elsewhere": text(LAST_OBJ, "mtllib ../../secret.mtl\n"),
            "OBJ a pipe": pipe(LAST_OBJ),
        },
    ),
    "manifest": (
        VERIFY,
        ("dataset",),
        {
            "files ../": manifest("files", {"../../secret": SECRET_SHA256}),
            "files of root": manifest("files", {"/etc/passwd": PASSWD_SHA256}),
            "files a list": manifest("files", ["README.md"]),
            "shard ../": manifest("shards.0.name", "../../secret"),
            "shard's digests lists": _json(
                f"{DATA}/manifest.json",
                _signed_manifest,
                lambda values: values["shards"][0].update(files={name: [1] for name in values["shards"][0]["files"]}),
            ),
            "shard's files elsewhere": manifest("shards.0.files", {"../secret.parquet": "0" * 64}),
            "blocks of 10^18": manifest("shards.0.blocks", 10**18),
            "blocks of 10^9": manifest("shards.0.blocks", 10**9),
            "rows of 10^18": manifest("shards.0.rows", 10**18),
            "episodes of 10^18": manifest("shards.0.episodes", 10**18),
            "successes of 10^400": manifest("shards.0.successes", 10**400),
            "blocks of -1": manifest("shards.0.blocks", -1),
            "blocks of 0": manifest("shards.0.blocks", 0),
            "blocks true": manifest("shards.0.blocks", True),
            "blocks a word": manifest("shards.0.blocks", "2"),
            "first block of 10^18": manifest("shards.2.first_block", 10**18),
            "seeds none": manifest("shards.0.seeds", None),
            "shards a number": manifest("shards", 5),
            "shards of numbers": manifest("shards", [5]),
            "block size 0": manifest("settings.block_size", 0),
            "block size 10^18": manifest("settings.block_size", 10**18),
            "images of 10^9": manifest("image_shape", [10**9, 10**9, 3]),
            "images of 0": manifest("image_shape", [0, 64, 3]),
            "images a word": manifest("image_shape", "abc"),
            "discount 7": manifest("discount", 7),
            "discount a word": manifest("discount", "1"),
            "action a list": manifest("action", [1]),
            "action of words": manifest("action.limits", ["a", "b", "c", "d"]),
            "action of 10^400": manifest("action.limits", [10**400] * 4),
            "task a word": manifest("task", "regular"),
            "task without a name": manifest("task.name", None),
            "task of 10^18 steps": manifest("task.max_steps", 10**18),
            "settings a word": manifest("settings", "fast"),
            "object set a word": manifest("object_set", "own"),
            "object set without a name": manifest("object_set", {"sha256": "0" * 64}),
            "blocks of a shard a list": manifest("settings.blocks_per_shard", [2]),
            "phi range of one": manifest("phi_range", [1]),
            "format a list": manifest("format_version", [2]),
            "format 10^18": manifest("format_version", 10**18),
            "an entry more": manifest("more", 1),
            "a lone surrogate": manifest("task.name", "\ud800"),
            "100,000 brackets": text(f"{DATA}/manifest.json", BRACKETS),
            "5,000 digits": text(f"{DATA}/manifest.json", f'{{"format_version": {DIGITS}}}'),
            "a list": text(f"{DATA}/manifest.json", "[]"),
            "empty": text(f"{DATA}/manifest.json", ""),
            "a pipe": pipe(f"{DATA}/shards/*.parquet"),
        },
    ),
    "shard": (
        TRAIN,
        ("dataset",),
        {
            "images of 64 bits": table("shards", _column("image", lambda column: column.cast(pa.large_binary()))),
            "images of numbers": table("shards", _column("image", lambda column: pa.array(range(len(column))))),
            "images without one": table(
                "shards", _column("image", lambda column: pa.array([None] * len(column), pa.binary()))
            ),
            "images of another width": table(
                "shards", _column("image", lambda column: pa.array([b"P6 1 1 255\n000"] * len(column), pa.binary()))
            ),
            "images of 10 MB": table(
                "shards", _column("image", lambda column: pa.array([bytes(10**7)] * len(column), pa.binary()))
            ),
            "actions of words": table(
                "shards", _column("action", lambda column: pa.array(["a"] * len(column), pa.string()))
            ),
            "actions of three parts": table(
                "shards",
                _column("action", lambda column: pa.array([[0.0] * 3] * len(column), pa.list_(pa.float32(), 3))),
            ),
            "actions of varying parts": table(
                "shards", _column("action", lambda column: pa.array([[0.0]] * len(column), pa.list_(pa.float32())))
            ),
            "rewards of 64 bits": table("shards", _column("reward", lambda column: column.cast(pa.float64()))),
            "rewards missing": table("shards", lambda found: found.drop_columns(["reward"])),
            "rewards null": table(
                "shards", _column("reward", lambda column: pa.array([None] * len(column), pa.float32()))
            ),
            "terminal a number": table("shards", _column("terminal", lambda column: column.cast(pa.int8()))),
            "terminal never": table("shards", _column("terminal", lambda column: pa.array([False] * len(column)))),
            "100,000 rows a block": table("shards", _many_rows),
            "no rows": table("shards", lambda found: found.slice(0, 0)),
            "no Parquet": raw("shards", lambda content: b"P6 64 64 255\n"),
            "footer of 2 GB": raw("shards", lambda content: content[:-8] + struct.pack("<I", 2**31 - 1) + b"PAR1"),
            "footer of 0": raw("shards", lambda content: content[:-8] + struct.pack("<I", 0) + b"PAR1"),
            "footer of noise": raw("shards", lambda content: content[:-200] + bytes(range(192)) + content[-8:]),
            "first page of noise": raw("shards", lambda content: content[:4] + b"\xff" * 64 + content[68:]),
        },
    ),
    "episodes": (
        VERIFY,
        ("dataset",),
        {
            "steps of words": table(
                "episodes", _column("steps", lambda column: pa.array(["a"] * len(column), pa.string()))
            ),
            "poses null": table(
                "episodes", _column("final_pose", lambda column: pa.array([None] * len(column), column.type))
            ),
            "ids missing": table("episodes", lambda found: found.drop_columns(["object_ids"])),
            "no rows": table("episodes", lambda found: found.slice(0, 0)),
            "last image of another width": table(
                "episodes", _column("final_image", lambda column: pa.array([b"P6"] * len(column), pa.binary()))
            ),
        },
    ),
    "weights": (
        LOAD,
        ("dataset", "run"),
        {
            "header of 2^63": weights(lambda content: struct.pack("<Q", 2**63 - 1) + content[8:]),
            "header of 99 MB": weights(lambda content: struct.pack("<Q", 99 * 10**6) + content[8:]),
            "header of 0": weights(lambda content: struct.pack("<Q", 0) + content[8:]),
            "header of brackets": weights(lambda content: struct.pack("<Q", 100_000) + BRACKETS.encode()),
            "empty": weights(lambda content: b""),
            "cut": weights(lambda content: content[:-5]),
            "not finite": weights(_nan),
            "shape of 10^18": weights(_header(_bytes_of({"shape": [10**18]}))),
            "shape of another network": weights(_header(_bytes_of({"shape": [1]}))),
            "offsets beyond the end": weights(_header(_bytes_of({"data_offsets": [0, 10**12]}))),
            "offsets backwards": weights(_header(_bytes_of({"data_offsets": [100, 0]}))),
            "type unknown": weights(_header(_bytes_of({"dtype": "PICKLE"}))),
            "type of 64 bits": weights(_header(_bytes_of({"dtype": "F64"}))),
        },
    ),
    "checkpoint": (
        LOAD,
        ("dataset", "run"),
        {
            "files ../": elsewhere_in_state,
            "files a list": state("files", ["q.safetensors"]),
            "files without one": _json(
                f"{RUN}/checkpoints/step-00000008/state.json",
                _signed_state,
                lambda values: values.update(
                    files={name: digest for name, digest in values["files"].items() if "kept" not in name}
                ),
            ),
            "step a word": state("step", "8"),
            "step 10^18": state("step", 10**18),
            "parts of numbers": state("parts", [1, 2]),
            "parts unknown": state("parts", ["nobody"]),
            "parts none": state("parts", []),
            "network a word": state("network", "paper"),
            "network empty": state("network", {}),
            "format 99": state("format", 99),
            "100,000 brackets": text(f"{RUN}/checkpoints/step-00000008/state.json", BRACKETS),
            "a pipe": pipe(f"{RUN}/checkpoints/step-00000008/state.json"),
        },
    ),
    "run": (
        LOAD,
        ("dataset", "run"),
        {
            "settings a word": config("settings", "default"),
            "settings empty": config("settings", {}),
            "algo a number": config("settings.algo", 5),
            "algo unknown": config("settings.algo", "nobody"),
            "algo of no module": config("settings.algo", "no_such_module:row"),
            "network a word": config("network", "paper"),
            "network of 10^9 units": config("network.settings.width", 10**9),
            "network of other images": config("network.image_shape", [10**9, 64, 3]),
            "dataset a word": config("dataset", "regular"),
            "task a word": config("dataset.task", "regular"),
            "task of 10^18 pixels": config("dataset.task.image_size", 10**18),
            "task of 10^18 objects": config("dataset.task.objects_per_bin", 10**18),
            "task of no time": config("dataset.task.time_step", "fast"),
            "task of another simulator": config("dataset.task.simulator_version", 99),
            "task unknown": config("dataset.task.name", "nothing"),
            "shards a number": config("settings.shards", 5),
            "shards of numbers": config("settings.shards", [5]),
            "object set a word": config("dataset.object_set", "own"),
            "100,000 brackets": text(f"{RUN}/config.json", BRACKETS),
            "a pipe": pipe(f"{RUN}/config.json"),
        },
    ),
    "run in a report": (
        REPORT_RUN,
        ("run",),
        {
            "settings a word": config("settings", "default"),
            "versions a list": config("versions", ["torch"]),
            "metrics a list": text(f"{RUN}/metrics.jsonl", "[]\n"),
            "metrics of words": text(f"{RUN}/metrics.jsonl", '{"step": "a", "loss": "b"}\n'),
            "metrics without a step": text(f"{RUN}/metrics.jsonl", '{"loss": 1}\n'),
            "validation a word": text(f"{RUN}/metrics.jsonl", '{"step": 1, "validation": "good"}\n'),
            "metrics of brackets": text(f"{RUN}/metrics.jsonl", BRACKETS + "\n"),
            "metrics of 5,000 digits": text(f"{RUN}/metrics.jsonl", f'{{"step": {DIGITS}}}\n'),
            "metrics of noise": text(f"{RUN}/metrics.jsonl", b"\xff\x00\n"),
            "metrics a pipe": pipe(f"{RUN}/metrics.jsonl"),
        },
    ),
    "evaluation in a report": (
        REPORT_SCORES,
        ("evaluation",),
        {
            "successes a word": score("successes", "all"),
            "successes more than episodes": score("successes", 10**9),
            "episodes 0": score("episodes", 0),
            "episodes 10^400": score("episodes", 10**400),
            "rate of 7": score("success_rate", 7),
            "interval of one": score("ci95", [0.5]),
            "interval of words": score("ci95", ["a", "b"]),
            "task a number": score("task", 5),
            "label a list": score("label", []),
            "job a word": score("job", "done"),
            "seed a word": score("seed", "0"),
            "policy a number": score("policy", 5),
            "files a list": score("files", ["episodes.jsonl"]),
            "object set a word": score("object_set", "own"),
            "versions a list": score("versions", []),
            "ends a list": score("ends", [0]),
            "checkpoint a list": score("checkpoint_step", [8]),
            "digest of the object set a number": score("object_set.sha256", 5),
        },
    ),
    "table of a sweep": (
        REPORT_SWEEP,
        ("sweep",),
        {
            "id a number": text("sweep/sweep.jsonl", _row_of(id=5)),
            "id ../": text("sweep/sweep.jsonl", _row_of(id="../../secret")),
            "rate a word": text("sweep/sweep.jsonl", _row_of(success_rate="high")),
            "steps a word": text("sweep/sweep.jsonl", _row_of(steps="many")),
            "algo a list": text("sweep/sweep.jsonl", _row_of(algo=[])),
            "brackets": text("sweep/sweep.jsonl", BRACKETS),
        },
    ),
    "plan of a sweep": (
        PLAN_SWEEP,
        ("dataset", "sweep"),
        {
            "jobs a word": _json("sweep/plan.json", _checked, _put("jobs", "many")),
            "jobs of numbers": _json("sweep/plan.json", _checked, _put("jobs", [1])),
            "format 10^18": _json("sweep/plan.json", _checked, _put("format_version", 10**18)),
            "brackets": text("sweep/plan.json", BRACKETS),
        },
    ),
    "frozen recipe": (
        FREEZE,
        ("dataset", "study"),
        {
            "rows a word": _json("recipe.json", _checked, _put("rows", "all")),
            "digest a word": _json("recipe.json", _checked, _put("digest", "0")),
            "brackets": text("recipe.json", BRACKETS),
        },
    ),
}


def repr_of(number: int) -> str:
    """Return a word of TOML."""
    return f"'{number}'"


MANY = [repr_of(number) for number in range(10_000)]
MANY_JOBS = f"splits = [{', '.join(MANY)}]\ntasks = [{', '.join(MANY)}]\nobjects = [{', '.join(MANY)}]"
MANY_OPTIONS = ", ".join(
    f"{name} = [{', '.join(map(str, range(1, 1001)))}]" for name in ("shift", "batch_size", "save_every", "cem_samples")
)
# Plans that a user gets from a stranger: whole files, and the command that reads them.
PLANS: dict[str, tuple[str, str]] = {
    "100,000 brackets": ("study", f"rows = {BRACKETS}"),
    "5,000 digits": ("study", f"seeds = {DIGITS}"),
    "seeds of 10^18": ("study", f"rows = ['mc']\nsizes = ['24']\nseeds = {10**18}"),
    "seeds of -1": ("study", "rows = ['mc']\nsizes = ['24']\nseeds = -1"),
    "10^12 rows": ("study", f"rows = [{{algo = 'mc', {MANY_OPTIONS}}}]\nsizes = ['24']"),
    "sizes of lists": ("study", "rows = ['mc']\nsizes = [[1]]"),
    "size of 10^30": ("study", f"rows = ['mc']\nsizes = ['{10**30}']"),
    "tasks of numbers": ("study", "rows = ['mc']\nsizes = ['24']\ntasks = [1]"),
    "policies of numbers": ("study", "rows = ['mc']\nsizes = ['24']\npolicies = [1]"),
    "a name of a number": ("study", "rows = [{algo = 'mc', name = 5}]\nsizes = ['24']"),
    "an option not finite": ("study", "rows = ['mc']\nsizes = ['24']\noptions = {learning_rate = inf}"),
    "an option of a table": ("study", "rows = ['mc']\nsizes = ['24']\noptions = {learning_rate = {a = 1}}"),
    "episodes of 10^18": ("study", f"rows = ['mc']\nsizes = ['24']\nepisodes = {10**18}"),
    "threads of 10^9": ("study", f"rows = ['mc']\nsizes = ['24']\nthreads = {10**9}"),
    "no UTF-8": ("study", "\udcff"),
    "jobs of 10^12": ("jobs", f"policies = ['random']\n{MANY_JOBS}"),
    "jobs of 10^18 episodes": ("jobs", f"policies = ['random']\nepisodes = {10**18}"),
    "jobs of brackets": ("jobs", f"jobs = {BRACKETS}"),
    "jobs of a policy of no module": ("jobs", "policies = ['no_such_module:make']"),
    "jobs of a seed of 5,000 digits": ("jobs", f"policies = ['random']\nseeds = [{DIGITS}]"),
}
READS = {
    "study": "grasp-study run hostile.toml --out fresh --dry-run",
    "jobs": "grasp-eval --jobs hostile.toml --objects objects --out fresh --plan --workers 0",
}
# Folders of meshes that are made an object set: name -> files, and whether the import must refuse.
URDF = "<robot name='a'><link name='b'><visual><geometry><mesh filename='{}'/></geometry></visual></link></robot>"
IMPORTS: dict[str, dict[str, str]] = {
    "URDF names ../": {"a.urdf": URDF.format("../secret.obj")},
    "URDF names a file of root": {"a.urdf": URDF.format("/etc/passwd")},
    "URDF names file://": {"a.urdf": URDF.format("file:///etc/passwd")},
    "URDF names package://..": {"a.urdf": URDF.format("package://../secret.obj")},
    "URDF names a link": {"a.urdf": URDF.format("linked.obj")},
    "URDF names a name of 10^5 letters": {"a.urdf": URDF.format("a" * 100_000)},
    "URDF no XML": {"a.urdf": "no XML"},
    "URDF of an unknown encoding": {"a.urdf": "<?xml version='1.0' encoding='nobody'?><robot/>"},
    "URDF of entities": {
        "a.urdf": "<!DOCTYPE r [<!ENTITY a 'aaaaaaaaaa'>"
        + "".join(f"<!ENTITY {chr(98 + i)} '{f'&{chr(97 + i)};' * 10}'>" for i in range(12))
        + "]><robot>&m;</robot>"
    },
    "URDF of an outer entity": {
        "a.urdf": "<!DOCTYPE r [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><robot name='a'>&a;</robot>"
    },
    "URDF 100,000 deep": {"a.urdf": "<a>" * 100_000 + "</a>" * 100_000},
    "URDF of a scale of NaN": {"a.urdf": URDF.format("b.obj' scale='nan nan nan"), "b.obj": BOX},
    "OBJ of index 3,000,000,000": {"a.obj": BOX + "\nf 1 2 3000000000\n"},
    "OBJ of NaN": {"a.obj": BOX.replace("v 0 0 0", "v nan 0 0")},
    "OBJ empty": {"a.obj": ""},
    "STL of 4,000,000,000 triangles": {"a.stl": "\0" * 80 + "\xff\xff\xff\xff"},
    "a link to a mesh elsewhere": {"linked.obj": "link"},
}


class Hostile:
    """The kind."""

    name = "hostile file"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return all; of every fourth group one in the short form, which leaves out what trains."""
        for group, (command, _, changes) in list(HOSTILE.items())[:: 4 if short else 1]:
            if not short or command != TRAIN:
                for what in list(changes)[: 1 if short else None]:
                    yield Fault(self.name, command.split()[0], f"{group}: {what}")
        for what, (reads, _) in list(PLANS.items())[: 1 if short else None]:
            yield Fault(self.name, READS[reads].split()[0], f"plan: {what}")
        for what in list(IMPORTS)[: 1 if short else None]:
            yield Fault(self.name, "grasp-objects", f"import: {what}")
        yield Fault(self.name, "grasp-report", "markup")
        yield Fault(self.name, "grasp-eval", "pickle")
        yield Fault(self.name, "grasp-report", "pickle")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Make the file and let the command read it; memory is bounded, so that nothing is allocated by its word."""
        group, _, what = fault.name.partition(": ")
        if group == "plan":
            return self._plan(what, work)
        if group == "import":
            return self._import(what, work)
        if group == "markup":
            return self._markup(work)
        if group == "pickle":
            return self._pickle(work) if fault.command == "grasp-eval" else self._pickled_films(work)
        command, needs, changes = HOSTILE[group]
        with work.copy(*needs) as case:
            _secrets(case)
            changes[what](case)
            return _refused(command.split(), case, work, NAMES[group])

    def _plan(self, what: str, work: Work) -> Tried:
        reads, content = PLANS[what]
        with work.copy("dataset", "objects") as case:
            (case / "hostile.toml").write_text(content, errors="surrogateescape")
            return _refused(READS[reads].split(), case, work, ("hostile.toml", "policy no_such_module"))

    def _import(self, what: str, work: Work) -> Tried:
        with work.copy() as case:
            _secrets(case)
            source = case / "source"
            source.mkdir()
            for name, content in IMPORTS[what].items():
                if content == "link":
                    (source / name).symlink_to(case / "secret.obj")
                else:
                    (source / name).write_bytes(content.encode("latin-1"))
            (source / "linked.obj").unlink(missing_ok=True)
            (source / "linked.obj").symlink_to(case / "secret.obj")
            return _refused(["grasp-objects", "make", "import", "source", "fresh"], case, work, ("source",))

    def _markup(self, work: Work) -> Tried:
        """Names with markup stand in a report as text."""
        markup = "<script>alert(1)</script><img src=x onerror=alert(1)>"
        with work.copy("evaluation") as case:
            for entry in ("label", "task", "split", "command"):
                score(entry, markup)(case)
            ran = work.forked(["grasp-report", "scores", "--out", "fresh.html", "--title", markup], case)
            if ran.broken() is not None or ran.rc != 0:
                return ran.broken() or Tried("silently wrong", ran.line)
            page = (case / "fresh.html").read_text()
            bad = "<script>alert" in page or "<img src=x" in page
            return Tried("silently wrong", "markup in the page") if bad else Tried("survived", "as text")

    def _pickle(self, work: Work) -> Tried:
        """A checkpoint of a pickle runs nothing."""
        with work.copy("dataset", "run") as case:
            weights(lambda content: PICKLE)(case)
            return _refused(LOAD.split(), case, work, ("runs/mc",))

    def _pickled_films(self, work: Work) -> Tried:
        """Films of pickled arrays run nothing."""
        with work.copy("evaluation") as case:
            path = next(case.glob("scores/*/films.npz"))
            with np.load(path) as found:
                names = list(found)
            np.savez(path, **{name: np.array([Runs()], dtype=object) for name in names})
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            change = _json("scores/*/eval.json", _checked, lambda values: values["files"].update({path.name: digest}))
            change(case)
            return _refused(REPORT_SCORES.split(), case, work, ("scores",))


class Runs:
    """What makes a file in the working folder when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch ran",)


PICKLE = b"cos\nsystem\n(S'touch ran'\ntR."
ROOM = 2**30  # bytes of address space that a command gets besides what it has when it begins
# What a refusal names: the file or its folder.
NAMES = {
    "object set": ("objects",), "object set of a stranger, signed": ("objects",),
    "manifest": ("data/regular-24",), "shard": ("data/regular-24",), "episodes": ("data/regular-24",),
    "weights": ("runs/mc",), "checkpoint": ("runs/mc",),
    "run": ("runs/mc",), "run in a report": ("runs/mc",),
    "evaluation in a report": ("scores",), "table of a sweep": ("sweep",), "plan of a sweep": ("sweep",),
    "frozen recipe": ("recipe.json",),
}  # fmt: skip


def limits(work: Work) -> dict[str, int]:
    """Return the bound of a command's memory: little more than it has; nothing is allocated by a file's word."""
    return {"RLIMIT_AS": work.address_space() + ROOM}


def _secrets(case: Path) -> None:
    for name, content in SECRETS.items():
        (case / name).write_bytes(content)


def _refused(words: Sequence[str], case: Path, work: Work, names: tuple[str, ...]) -> Tried:
    """Run a command that must refuse and name the file, tell nothing of files elsewhere, and write none there."""
    places = (case, case.parent)
    before = [{path.name for path in place.iterdir()} for place in places]
    ran = work.forked(words, case, seconds=120, limits=limits(work))
    if SECRET in ran.stdout + ran.stderr:
        return Tried("silently wrong", "tells what is in a file elsewhere")
    new = {path.name for place, names_before in zip(places, before, strict=True) for path in place.iterdir()
           if path.name not in names_before and not path.name.startswith("fresh")}  # fmt: skip
    if new - {"said", "temporary"}:
        return Tried("silently wrong", f"has made {sorted(new)}")
    if any((case / name).exists() and (case / name).read_bytes() != content for name, content in SECRETS.items()):
        return Tried("silently wrong", "has changed a file elsewhere")
    return ran.refused(*names)
