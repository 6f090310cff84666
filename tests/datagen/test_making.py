"""The command as people run it: in processes of its own, killed, resumed, extended, given nonsense."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from graspq.common.files import sha256_of
from graspq.datasets.manifest import Manifest
from graspq.datasets.verify import verify

SMALL = ("--size", "130", "--seed", "3")


def command(*arguments):
    script = Path(sys.executable).with_name("grasp-datagen")
    return [str(script), *map(str, arguments)]


def run(*arguments, expect=0):
    done = subprocess.run(command(*arguments), capture_output=True, text=True, timeout=300)
    assert done.returncode == expect, done.stderr
    return done


def digests(folder):
    return {str(path.relative_to(folder)): sha256_of(path) for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def objects(regular_objects):
    return regular_objects.folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory, objects):
    folder = tmp_path_factory.mktemp("data") / "one"
    done = run(*SMALL, "--out", folder, "--objects", objects, "--workers", 1)
    assert re.search(r"130 regular grasps to collect .* about 728.0 kB and [\d.]+ s", done.stdout)
    return folder


def test_the_result_is_a_dataset_that_verifies(finished):
    manifest = Manifest.load(finished)
    assert manifest.episodes == 130
    assert verify(finished).faults == ()
    assert not list(finished.rglob(".tmp-*"))


def test_two_workers_give_the_same_bytes_as_one(finished, tmp_path, objects):
    run(*SMALL, "--out", tmp_path / "two", "--objects", objects, "--workers", 2)
    assert digests(tmp_path / "two") == digests(finished)


def test_killed_and_resumed_it_gives_the_same_bytes(finished, tmp_path, objects):
    folder = tmp_path / "killed"
    process = subprocess.Popen(
        command(*SMALL, "--out", folder, "--objects", objects, "--workers", 2), start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not (folder / "manifest.json").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.5)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert Manifest.load(folder).episodes < 130
    run(*SMALL, "--out", folder, "--objects", objects, "--workers", 2)
    assert digests(folder) == digests(finished)


def test_two_collections_into_one_folder_are_not_mixed(finished, tmp_path, objects):
    folder = tmp_path / "shared"
    arguments = (*SMALL, "--out", folder, "--objects", objects, "--workers", 1)
    with subprocess.Popen(command(*arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as first:
        while not (folder / "manifest.json").exists():
            assert first.poll() is None
            time.sleep(0.05)
        done = subprocess.run(command(*arguments), capture_output=True, text=True, timeout=300)
        assert f"{folder}: another grasp-datagen works here; waiting 10 s for its end" in done.stderr
        # Where the first was slower than that it was refused, else it found the work done.
        assert done.returncode == 0 or (done.returncode == 2 and "wait for its end" in done.stderr)
    assert digests(folder) == digests(finished)


def test_a_smaller_dataset_is_extended_to_the_same_bytes(finished, tmp_path, objects):
    folder = tmp_path / "extended"
    run("--size", "50", "--seed", "3", "--out", folder, "--objects", objects)
    assert Manifest.load(folder).episodes == 50
    run(*SMALL, "--out", folder, "--objects", objects)
    assert digests(folder) == digests(finished)


def test_damaged_and_missing_shards_are_made_again(finished, tmp_path, objects):
    folder = tmp_path / "damaged"
    shutil.copytree(finished, folder)
    steps, episodes = ((folder / part).glob("*.parquet") for part in ("shards", "episodes"))
    content = bytearray((path := next(steps)).read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    done = run(*SMALL, "--out", folder, "--objects", objects, "--workers", 1)
    assert f"{path}: damaged, its SHA-256 is not that of the manifest; it is made again" in done.stderr
    assert digests(folder) == digests(finished)
    next(episodes).unlink()
    refused = run("--size", "20", "--seed", "3", "--out", folder, "--objects", objects, expect=2)
    assert "ask for 130 grasps or more to make it again" in refused.stderr


def test_a_finished_dataset_is_left_alone(finished, objects):
    before = digests(finished)
    done = run(*SMALL, "--out", finished, "--objects", objects)
    assert "is complete: 130 grasps" in done.stdout
    assert digests(finished) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--size", "0"), "expected a whole number of at least 1, such as 2500, 10k or 1M"),
        (("--size", "-5"), "expected a whole number of at least 1"),
        (("--size", "many"), "expected a whole number of at least 1"),
        (("--task", "stacking"), "unknown task 'stacking'; choose from regular, targeted"),
        (("--seed", "-1"), "--seed: expected a number of at least 0, got -1"),
        (("--workers", "-1"), "--workers: expected a number of at least 0 and at most 4096, got -1"),
        (("--objects", "/nowhere"), "/nowhere"),
        (("--size", "900000M"), "and at most 1000M"),
        (("--size", "1000M"), "the disk has"),
    ],
)
def test_nonsense_is_one_line_and_status_two_and_writes_nothing(tmp_path, arguments, message):
    done = run("--out", tmp_path / "never", *arguments, expect=2)
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert not (tmp_path / "never").exists()


def test_other_settings_or_a_foreign_folder_are_refused_and_nothing_is_lost(finished, tmp_path, objects):
    before = digests(finished)
    done = run("--size", "130", "--seed", "4", "--out", finished, "--objects", objects, expect=2)
    assert "holds grasps made with settings.seed = 3, not 4" in done.stderr
    assert digests(finished) == before
    (tmp_path / "notes.txt").write_text("mine")
    done = run("--out", tmp_path, expect=2)
    assert "holds 'notes.txt' but no manifest.json" in done.stderr
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, objects):
    (tmp_path / "file").write_text("in the way")
    done = run("--size", "20", "--out", tmp_path / "file" / "data", "--objects", objects, expect=2)
    assert len(done.stderr.strip().splitlines()) == 1
