import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from graspq.datasets.cli import main
from graspq.datasets.manifest import Manifest


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_info_prints_what_the_manifest_says(dataset, many_blocks):
    result = run("info", dataset, many_blocks)
    assert result.exit_code == 0
    lines = {line[:17].strip(): line[17:].split("  ") for line in result.output.splitlines()}
    manifest = Manifest.load(dataset)
    for name, value in {
        "format": "2",
        "task": "regular",
        "episodes": "24",
        "rows": str(manifest.rows),
        "shards": "3",
        "object set": "drawn",
        "discount": "1",
        "action limits": "0.06, 0.06, 0.05 m, 0.7 rad",
        "manifest digest": manifest.digest()[:16],
        "success rate": f"{manifest.successes / 24:.4f}",
    }.items():
        assert lines[name][0].strip() == value
    assert lines["episodes"][-1].strip() == "800"


def test_verify_ends_with_zero_for_an_intact_dataset(dataset):
    result = run("verify", dataset)
    assert result.exit_code == 0
    assert "no fault in 10 files" in result.output


def test_verify_ends_with_two_and_a_line_for_each_fault(new_dataset):
    folder = new_dataset()
    for path in (folder / "shards").iterdir():
        path.write_bytes(path.read_bytes()[:-1])
    result = run("verify", folder)
    assert result.exit_code == 2
    assert sum(line.startswith("fault: ") for line in result.output.splitlines()) == 3


def test_show_writes_a_picture(dataset, tmp_path):
    result = run("show", dataset, "--episodes", 2, "--out", tmp_path / "strip.png", "--success")
    assert result.exit_code == 0
    assert (tmp_path / "strip.png").stat().st_size > 5000


@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "nothing"),
        ("info",),
        ("verify", "nothing"),
        ("show", "nothing"),
        ("show", "{dataset}", "--episodes", "0"),
        ("show", "{dataset}", "--episodes", "many"),
        ("show", "{dataset}", "--seed", "-1"),
        ("export",),
    ],
)
def test_a_mistake_gives_one_line_and_status_two(dataset, arguments):
    result = run(*(argument.format(dataset=dataset) for argument in arguments))
    assert result.exit_code == 2
    assert len(result.output.strip().splitlines()) == 1


def test_the_installed_command_starts_without_matplotlib_and_torch(dataset, tmp_path):
    code = "import sys, graspq.datasets.cli; print({'matplotlib', 'torch', 'pybullet'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert done.stdout.strip() == "set()"
    command = Path(sys.executable).with_name("grasp-data")
    done = subprocess.run([command, "--version"], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert "graspq" in done.stdout
