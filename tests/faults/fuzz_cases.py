"""Draws cases and tries each: `fuzz_cases.py TARGET SEED COUNT`, in a folder with copies of small real work.

A case may be refused with a `click.ClickException`, or be fine; anything else is shown with its traceback.
"""

import copy
import importlib
import inspect
import json
import random
import runpy
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import hypothesis
from hypothesis import strategies as st

DATA, RUN, SET = Path("data/regular-24"), Path("runs/mc"), Path("objects")
COUNTS: Counter[str] = Counter()
COMMANDS: dict[str, str] = runpy.run_path(str(Path(__file__).with_name("template.py")))["COMMANDS"]
HOSTILE: list[Any] = [
    None, True, False, -1, 0, 1, 2, 7, 10**9, 10**18, 2**63, 2**64, 10**400, -0.0, 0.5, 1e308, 1e-320, float("nan"),
    float("inf"), "", "a", "0", "../../etc/passwd", "/etc/passwd", "a\nb", "\x00", "\ud800", "a" * 5000, "é<b>&", [],
    [1], ["a"], [[]], [None], {}, {"a": 1}, {"": []}, [0] * 1000, "regular", "mc", "module:row", "no.such:thing",
]  # fmt: skip
WORDS = [
    "", "-", "--", "-1", "0", "1", "2", "1e9", "10k", "1M", "nan", "inf", "-inf", "1e400", "9" * 5000, str(10**18),
    "0x1", "a", "a=b", "a=1,2", "=", "=,", "mc", "dql", "regular", "targeted", "auto", "cpu", "paper", "random",
    "module:row", ":", "a:b", "../..", "/", "/etc/passwd", "/dev/null", "objects", "data/regular-24", "runs/mc", "*",
    "[", "**/*", "\udcff", "a\nb", "é", "a" * 5000, "true", "none", "validation", "test", "%", "{}", "$HOME",
]  # fmt: skip
LETTERS = st.characters(exclude_characters="\x00", exclude_categories=["Cs"])  # the system takes no zero byte in a word
values = st.one_of(
    st.sampled_from(HOSTILE), st.integers(), st.floats(), st.text(max_size=20), st.booleans(),
    st.lists(st.integers(), max_size=4),
)  # fmt: skip


def paths_of(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the ways to all entries of a JSON value; of long lists to the first two."""
    found = [way] if way else []
    if isinstance(value, dict):
        for name, inner in value.items():
            found += paths_of(inner, (*way, name))
    elif isinstance(value, list):
        for index, inner in enumerate(value[:2]):
            found += paths_of(inner, (*way, index))
    return found


def mutated(draw: Callable[[Any], Any], original: Any) -> Any:
    """Return a JSON value with one to three entries set to something else, removed, or added."""
    value = copy.deepcopy(original)
    for _ in range(draw(st.integers(1, 3))):
        ways = paths_of(value)
        if not ways:
            break
        *way, last = draw(st.sampled_from(ways))
        place = value
        for key in way:
            place = place[key]
        kind = draw(st.integers(0, 9))
        if kind == 0:
            del place[last]
        elif kind == 1 and isinstance(place, dict):
            place[draw(st.text(max_size=8))] = draw(values)
        else:
            place[last] = draw(values)
    return value


def write_json(path: Path, value: Any, indent: int | None = 2) -> None:
    """Write as a stranger would, who need not care for what is no JSON."""
    path.write_text(json.dumps(value, indent=indent), errors="surrogatepass")


def manifests(draw: Callable[[Any], Any]) -> None:
    """A manifest of anything, signed, read by `grasp-data info`, and by what opens its shards."""
    from graspq.datasets.cli import _described
    from graspq.datasets.dataset import Shard, open_shards
    from graspq.datasets.manifest import Manifest, _digest_of

    path = DATA / "manifest.json"
    original = path.read_bytes()
    try:
        value = mutated(draw, json.loads(original))
        if isinstance(value, dict) and draw(st.integers(0, 4)):
            try:
                digest = _digest_of(value)
            except ValueError:
                digest = ""
            value = {name: one for name, one in value.items() if name != "digest"} | {"digest": digest}
        rendered = json.dumps(value, indent=2, ensure_ascii=False) + "\n"
        path.write_text(rendered, errors="surrogatepass")
        found = Manifest.load(DATA)
        COUNTS["opened"] += 1
        _described(DATA, found)
        pool = open_shards([DATA], verify=False)
        for ref in pool.blocks[:1]:
            pool.read_block(ref)
        for shard in Shard.all_of(DATA)[:1]:
            shard.episode_rows()
    finally:
        path.write_bytes(original)


def object_sets(draw: Callable[[Any], Any]) -> None:
    """An object set of anything: its JSON, an OBJ or a URDF."""
    from graspq.objects.object_set import ObjectSet

    path = SET / draw(st.sampled_from(["object_set.json", "meshes/train_000.obj", "meshes/train_000.urdf"]))
    original = path.read_bytes()
    try:
        if path.suffix == ".json":
            path.with_name(f"{path.name}.sha256").unlink(missing_ok=True)
            write_json(path, mutated(draw, json.loads(original)))
        else:
            path.write_bytes(scrambled(draw, original))
        found = ObjectSet.load(SET)
        COUNTS["opened"] += 1
        for name in found.ids()[:2]:
            found.parts_of(name)
            found.urdf_of(name)
        found.verify()
    finally:
        path.write_bytes(original)


def scrambled(draw: Callable[[Any], Any], content: bytes) -> bytes:
    """Return bytes of which some are others, more, or fewer."""
    changed = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        if not changed:
            break
        start = draw(st.integers(0, len(changed) - 1))
        length = draw(st.sampled_from([0, 1, 1, 4, 8, 64]))
        piece = draw(
            st.one_of(
                st.binary(max_size=16),
                st.sampled_from([b"", b"\xff" * 8, b"\x00" * 8, b"nan", b"1e999", b" 3000000000", b"\n", b"f 1 2 3\n"]),
            )
        )
        changed[start : start + length] = piece
    return bytes(changed)


def shard_headers(draw: Callable[[Any], Any]) -> None:
    """A shard whose footer, page headers or end are others, listed in a manifest that is right."""
    import hashlib

    from graspq.datasets.dataset import Shard, open_shards
    from graspq.datasets.manifest import _digest_of

    table = draw(st.sampled_from(["shards", "episodes"]))
    path = sorted((DATA / table).glob("*.parquet"))[0]
    of_manifest = DATA / "manifest.json"
    original, listed = path.read_bytes(), of_manifest.read_bytes()
    try:
        footer = int.from_bytes(original[-8:-4], "little") + 8
        part = draw(st.sampled_from(["footer", "footer", "footer", "head", "length"]))
        if part == "footer":
            content = original[:-footer] + scrambled(draw, original[-footer:-8]) + original[-8:]
        elif part == "head":
            content = scrambled(draw, original[:200]) + original[200:]
        else:
            content = original[:-8] + draw(st.binary(min_size=4, max_size=4)) + original[-4:]
        path.write_bytes(content)
        value, name = json.loads(listed), f"{table}/{path.name}"
        for entry in value["shards"]:
            if name in entry["files"]:
                entry["files"][name], entry["sizes"][name] = hashlib.sha256(content).hexdigest(), len(content)
        value["digest"] = _digest_of(value)
        of_manifest.write_text(json.dumps(value, indent=2, ensure_ascii=False) + "\n")
        pool = open_shards([DATA])
        COUNTS["opened"] += 1
        for ref in pool.blocks[:2]:
            pool.read_block(ref)
        Shard.all_of(DATA)[0].episode_rows()
    finally:
        path.write_bytes(original)
        of_manifest.write_bytes(listed)


def runs(draw: Callable[[Any], Any]) -> None:
    """A run, a checkpoint, metrics or an evaluation of anything, signed; read for a policy and for a report."""
    import hashlib

    from graspq.common.checksums import with_checksum
    from graspq.policies.of_run import load
    from graspq.report.findings import gather
    from graspq.report.page import render

    score = next(Path("scores").glob("*/eval.json"))
    path = draw(
        st.sampled_from(
            [RUN / "config.json", RUN / "metrics.jsonl", RUN / "checkpoints/step-00000008/state.json", score]
        )
    )
    original = path.read_bytes()
    try:
        if path.name == "metrics.jsonl":
            rows = [json.loads(line) for line in original.splitlines()]
            rows = [{name: one for name, one in row.items() if name != "checksum"} for row in rows]
            rows = mutated(draw, rows)
            path.write_text("".join(json.dumps(row) + "\n" for row in rows))
        else:
            value = json.loads(original)
            for name in ("digest", "checksum"):
                value.pop(name, None)
            value = mutated(draw, value)
            if path.name == "state.json":
                value["digest"] = hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
                write_json(path, value)
            else:
                value.pop("checksum", None)
                try:
                    path.write_text(with_checksum(value, indent=2))
                except ValueError:
                    write_json(path, value)
        if path != score and path.name != "metrics.jsonl":
            load(RUN)
        else:
            render(gather([Path("scores"), Path("runs")], None))
        COUNTS["opened"] += 1
    finally:
        path.write_bytes(original)


def plans(draw: Callable[[Any], Any]) -> None:
    """A plan of a study or of evaluations."""
    from graspq.evaluate.jobs import read_jobs
    from graspq.evaluate.settings import EvalSettings
    from graspq.studies.study.cells import cells_of
    from graspq.studies.study.plan_file import KEYS, read_plan

    path = Path("drawn.toml")
    of_study = draw(st.booleans())
    keys = list(KEYS) if of_study else ["runs", "policies", "tasks", "splits", "objects", "seeds", "episodes", "cem"]
    lines = ['rows = ["mc"]', 'sizes = ["24"]'] if of_study else ['policies = ["random"]']
    for key in draw(st.lists(st.sampled_from(keys), max_size=4, unique=True)):
        lines = [line for line in lines if not line.startswith(f"{key} ")]
        lines.append(f"{key} = {draw(toml_values)}")
    text = "\n".join(lines)
    path.write_bytes(scrambled(draw, text.encode()) if draw(st.integers(0, 3)) == 0 else text.encode())
    if of_study:
        plan = read_plan(path)
        COUNTS["opened"] += 1
        if plan.values["seeds"] <= 3 and len(plan.rows) * len(plan.sizes) < 50:
            for cell in cells_of(plan, Path("study"))[:2]:
                str(cell.training_command())
    else:
        read_jobs(path, EvalSettings())
        COUNTS["opened"] += 1


toml_values = st.one_of(
    st.sampled_from(
        [
            "1",
            "-1",
            "0",
            str(10**18),
            "9" * 5000,
            "nan",
            "inf",
            "1e308",
            "true",
            '""',
            '"a"',
            "[]",
            "[1]",
            '["a"]',
            "[[]]",
            "{}",
            "{a = 1}",
            "1979-05-27",
            "[" * 2000,
            '["mc"]',
            '["24"]',
            '["10k"]',
            '[{algo = "mc"}]',
            '[{algo = "dql", discount = [0.5, 0.9]}]',
            "[{algo = 5}]",
            '[{algo = "mc", name = 5}]',
            '"off-policy"',
            '"paper"',
            '["random"]',
            '["oracle", "random"]',
            '[":"]',
            '"\\u0000"',
            "{learning_rate = inf}",
            "{iterations = -1}",
            "{samples = 100000000}",
            '{answer = "best"}',
            "{nothing = 1}",
        ]
    ),
    st.integers().map(str),
)


def command_lines(draw: Callable[[Any], Any]) -> None:
    """A command line of anything, as far as its settings."""
    from graspq.common.options import given_options

    name = draw(st.sampled_from(sorted(COMMANDS)))
    command = importlib.import_module(COMMANDS[name]).main
    words: list[str] = []
    context = None
    while isinstance(command, click.Group):
        chosen = draw(st.sampled_from([*sorted(command.commands), "nothing"]))
        context = click.Context(command, info_name=name, parent=context)
        found = command.commands.get(chosen)
        if found is None:
            command.resolve_command(context, [chosen])
            return
        command = found
    options = [one for parameter in command.params for one in (*parameter.opts, *parameter.secondary_opts)]
    options = [one for one in options if one not in ("--version", "--help")]
    # Most are options with values, so that some go through.
    for _ in range(draw(st.integers(0, 6))):
        if draw(st.integers(0, 3)):
            words.append(draw(st.sampled_from(options or ["a"])))
        words.append(draw(st.one_of(st.sampled_from(WORDS), st.text(LETTERS, max_size=6))))
    with command.make_context(name, list(words), parent=context) as made:
        settings = _settings_of(command)
        if settings is not None:
            built = settings(**{key: value for key, value in made.params.items() if value is not ...})
            built.to_json()
            COUNTS["opened"] += 1
        elif name == "grasp-train":
            from graspq.train.settings import complete

            given = given_options(made)
            complete(given, given.pop("preset", "default"))
            COUNTS["opened"] += 1
        elif name == "grasp-online":
            from graspq.studies.online.resolve import resolve

            resolve(given_options(made))
            COUNTS["opened"] += 1


def _settings_of(command: click.Command) -> Any:
    """Return the settings that `options_from` makes of a command's values."""
    function: Any = command.callback
    while function is not None:
        known = inspect.getclosurevars(function).nonlocals
        if "settings_type" in known:
            return known["settings_type"]
        function = getattr(function, "__wrapped__", None)
    return None


TARGETS: dict[str, Callable[[Callable[[Any], Any]], None]] = {
    "command line": command_lines,
    "manifest": manifests,
    "object set": object_sets,
    "shard header": shard_headers,
    "run": runs,
    "plan": plans,
}


def main() -> None:
    """Try a batch."""
    target, seed, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    case = TARGETS[target]

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count, deadline=None, database=None, suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.generate],
    )  # fmt: skip
    @hypothesis.given(st.data())
    def tried(data: st.DataObject) -> None:
        COUNTS["cases"] += 1
        random.seed(0)
        try:
            case(data.draw)
        except (click.ClickException, click.exceptions.Exit):
            COUNTS["refused"] += 1

    tried()
    print(f"{COUNTS['cases']} cases, {COUNTS['refused']} refused, {COUNTS['opened']} opened")
    if not COUNTS["opened"]:
        sys.exit("no case got as far as to be opened: these are no cases of what reads the file")


if __name__ == "__main__":
    main()
