"""The rules of the house, read from the source: imports, packaging, names that others own."""

import ast
import dataclasses
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from graspq.common.options import flag, shown_value
from graspq.common.text import markdown
from graspq.studies.study.comparisons import scored_rows
from graspq.studies.study.publishing import row_table
from graspq.studies.study.scores import read_scores
from graspq.train.estimators import ESTIMATORS, as_markdown

ROOT = Path(__file__).resolve().parent.parent
# What each folder may import (DESIGN, section 1).
MAY_IMPORT = {
    "common": set(),
    "engine": {"common"},
    "objects": {"common"},
    "sim": {"objects", "common"},
    "datasets": {"engine", "common"},
    "train": {"datasets", "common"},
    "policies": {"sim", "train", "objects", "common"},
    "datagen": {"engine", "policies", "sim", "objects", "datasets", "common"},
    "evaluate": {"engine", "policies", "sim", "objects", "train", "datasets", "common"},
    "report": {"evaluate", "train", "datasets", "objects", "common"},
    "studies": {
        "engine",
        "policies",
        "sim",
        "objects",
        "datagen",
        "datasets",
        "train",
        "evaluate",
        "report",
        "common",
    },
}
MAY_IMPORT["benchmarks"] = set(MAY_IMPORT)


def sources(folder):
    return sorted((ROOT / folder).rglob("*.py"))


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_a_folder_imports_only_what_the_design_allows(folder):
    assert sources(folder)
    for path in sources(folder):
        ours = {name.split(".")[1] for name in imported(path) if name.startswith("graspq.")}
        assert ours <= MAY_IMPORT[folder] | {folder}, path


@pytest.mark.parametrize("folder", sorted(set(MAY_IMPORT) - {"sim", "benchmarks"}))
def test_pybullet_is_imported_inside_sim_alone(folder):
    for path in sources(folder):
        assert not any(name.split(".")[0].startswith("pybullet") for name in imported(path)), path


def test_processes_are_started_inside_engine_alone():
    starters = {"subprocess", "multiprocessing", "concurrent.futures.process"}
    for folder in sorted(set(MAY_IMPORT) - {"engine"}):
        for path in sources(folder):
            # One exception: `git` says which revision of the code made a result.
            if path != ROOT / "common" / "provenance.py":
                assert not any(name in starters or name.split(".")[0] in starters for name in imported(path)), path
                assert "ProcessPoolExecutor" not in path.read_text(), path


def test_training_data_tools_and_reports_run_without_pybullet(tmp_path):
    code = (
        "import sys; sys.modules['pybullet'] = None; sys.modules['pybullet_data'] = None\n"
        "import graspq, graspq.train.cli, graspq.train.loop, graspq.datasets.cli, graspq.report.cli\n"
        "import graspq.objects.cli, graspq.datagen.cli, graspq.evaluate.cli, graspq.report.page\n"
    )
    subprocess.run([sys.executable, "-P", "-c", code], check=True, cwd=tmp_path, timeout=120)


def test_the_wheel_lives_beside_hugging_faces_datasets_and_evaluate(tmp_path):
    target = tmp_path / "site"
    copy = tmp_path / "source"
    names = [*MAY_IMPORT, "graspq", "pyproject.toml", "README.md", "LICENSE"]
    copy.mkdir()
    for name in names:
        subprocess.run(["cp", "-r", str(ROOT / name), str(copy)], check=True)
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--target"]
    subprocess.run([*install, str(target), str(copy)], check=True, timeout=300)
    assert not (target / "datasets").exists()
    code = (
        "import datasets, evaluate, graspq, graspq.datasets.dataset, graspq.evaluate.statistics\n"
        f"assert graspq.__file__.startswith({str(target)!r}), graspq.__file__\n"
        "assert hasattr(datasets, 'load_dataset') and hasattr(evaluate, 'load')\n"
        "assert graspq.datasets.__name__ == 'graspq.datasets'\n"
    )
    environment = {"PYTHONPATH": str(target), "PATH": "/usr/bin:/bin", "HF_HUB_OFFLINE": "1", "HOME": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=environment, timeout=120)


def test_every_package_is_listed_and_every_command_answers_help_and_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    mapped = project["tool"]["setuptools"]["package-dir"]
    assert set(mapped) == set(project["tool"]["setuptools"]["packages"])
    assert {folder.split("/")[0] for folder in mapped.values()} == set(MAY_IMPORT) | {"graspq"}
    for script in project["project"]["scripts"]:
        for option, expected in (("--help", "Usage:"), ("--version", "graspq, version")):
            command = [str(Path(sys.executable).with_name(script)), option]
            done = subprocess.run(command, capture_output=True, text=True, timeout=60)
            assert done.returncode == 0, done.stderr
            assert expected in done.stdout


def test_the_readmes_table_of_estimators_is_the_code():
    readme = (ROOT / "README.md").read_text()
    start = readme.index("\n", readme.index("<!-- estimators:")) + 1
    assert readme[start : readme.index("<!-- end of estimators -->")] == as_markdown()


def test_the_readmes_table_of_success_is_that_of_the_published_study():
    readme = (ROOT / "README.md").read_text()
    start = readme.index("\n", readme.index("<!-- study 10k:")) + 1
    shown = readme[start : readme.index("<!-- end of study 10k -->")]
    assert shown == reached(read_scores([ROOT / "results/study-10k.jsonl"]))


def reached(table):
    """Return columns of the table in RESULTS.md, and how long a training took."""
    [(place, rows)] = scored_rows(table).items()
    seconds = {f"`{row.name}`": [one["training_seconds"] for one in row.rows] for row in rows.values()}
    lines = []
    for line in re.findall(r"^\| (.+) \|$", row_table({place: rows}, table), re.MULTILINE)[1:]:
        name, _, _, success, interval, rates, *_ = line.split(" | ")
        name = name.partition(" (")[0]  # how many trainings are done the rates tell
        here = seconds.get(name, [])
        lines.append([name, success, interval, rates, f"{sum(here) / len(here) / 60:.1f}" if here else ""])
    return markdown(["estimator", "success", "95 % interval", "each seed", "minutes of a training"], lines)


@pytest.mark.parametrize(
    "page", ["README.md", "RESULTS.md", *(f"docs/{one.name}" for one in (ROOT / "docs").glob("*.md"))]
)
def test_files_that_a_page_names_exist(page):
    assert links_without_a_file(ROOT / page) == []


def links_without_a_file(page):
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()) if "://" not in link]
    return [link for link in links if not found(page, *link.partition("#")[::2])]


def found(page, name, anchor):
    path = page.parent / name if name else page
    return path.exists() and (not anchor or anchor in anchors(path))


def anchors(page):
    """Return what the headings of a page are called in links."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_index_of_the_estimators_pages_holds_the_readmes_table():
    lines = as_markdown().splitlines()[2:]
    index = (ROOT / "docs/estimators/README.md").read_text()
    assert [line for line in lines if line not in index] == []


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_page_of_an_estimator_has_its_options_and_the_differences_that_its_code_lists(name):
    row, page = ESTIMATORS[name], ROOT / f"docs/estimators/{name}.md"
    text = page.read_text()
    assert links_without_a_file(page) == []
    values = [(field, row.settings(), row.paper) for field in dataclasses.fields(row.settings)]
    wanted = [
        f"| `{flag(field.name)}` | "
        + " | ".join(shown_value(field, getattr(one, field.name)) for one in (default, paper))
        for field, default, paper in values
    ]
    assert re.findall(r"^(\| `--[a-z-]+` \| [^|]+ \| [^|]+) \|", text, re.MULTILINE) == wanted
    code = (ROOT / f"train/estimators/{name.replace('-', '_')}.py").read_text()
    listed = [
        int(one) for part in code.split("Differs:")[1:] for one in re.findall(r"\b(\d+)\. ", part.split('"""')[0])
    ]
    section = text[text.index("## Differences") : text.index("## Measurements")]
    assert [int(one) for one in re.findall(r"^(\d+)\. ", section, re.MULTILINE)] == sorted(listed)


def test_tests_mirror_the_folders():
    for folder in MAY_IMPORT:
        modules = {name for path in sources(folder) for name in (path.stem, path.parent.name)}
        for test in (ROOT / "tests" / folder).rglob("test_*.py"):
            inside = test.parent.relative_to(ROOT / "tests")
            assert (ROOT / inside).is_dir(), test
            here = modules if inside == Path(folder) else {path.stem for path in sources(inside)}
            assert test.stem.removeprefix("test_") in here | {"mirror", "learning"}, test
