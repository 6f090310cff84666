"""The report: one self-contained page from real runs and evaluations, also before anything is evaluated."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.evaluate.films import Film, write_films
from graspq.evaluate.records import FORMAT_VERSION, EpisodeRow, Evaluation, write_rows, write_summary
from graspq.evaluate.statistics import (
    Interval,
    holm,
    mean_success,
    object_counts,
    paired_difference,
    success_difference,
    wilson_interval,
)
from graspq.report.findings import calibration_of, gather
from graspq.report.page import render, write_report
from graspq.report.rows import comparisons, rows_of

VOID = {"meta", "img", "br", "line", "rect", "circle", "path", "input", "link"}


class Checker(HTMLParser):
    """Collects a page's references, and checks that its tags are nested."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.labels: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.references += [str(values[name]) for name in ("src", "href") if name in values]
        if tag == "img":
            self.images.append(values)
        if values.get("role") == "img":
            self.labels.append(str(values.get("aria-label")))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def checked(page: str) -> Checker:
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert all(reference.startswith("data:image/png;base64,") for reference in checker.references)
    assert "http://" not in page and "https://" not in page and "<script" not in page and "@import" not in page
    return checker


def make_evaluation(
    folder: Path,
    label: str,
    successes: np.ndarray,
    *,
    policy: str = "cem",
    seed: int = 0,
    films: int = 0,
    **more: object,
) -> Evaluation:
    """Write an evaluation of these outcomes with the real writers."""
    folder.mkdir(parents=True)
    rows = [
        EpisodeRow(index, seed, (f"test_{index % 20:03d}",), bool(success), "test_001" if success else None, 4,
                   "height", float(success), 0.8 if success else 0.3)
        for index, success in enumerate(successes)
    ]  # fmt: skip
    write_rows(folder, rows)
    frames = np.arange(3 * 64 * 64 * 3, dtype=np.uint32).astype(np.uint8).reshape(3, 64, 64, 3)
    write_films(folder, [Film(row, frames) for row in rows[:films]])
    count, total = int(sum(successes)), len(rows)
    summary = {
        "format_version": FORMAT_VERSION, "label": label, "task": "regular", "split": "test", "episodes": total,
        "successes": count, "success_rate": count / total, "ci95": list(wilson_interval(count, total)),
        "mean_steps": 4.0, "ends": {"height": total, "T": 0}, "policy": policy, "run": None, "checkpoint_step": None,
        "seed": seed, "object_set": {"name": "procedural", "sha256": "ab" * 32}, "command": f"grasp-eval {label}",
        "versions": {"numpy": "2"}, "code_revision": "abc", "job": {"policy": label, "task": {}},
    }  # fmt: skip
    summary |= more
    return write_summary(folder, summary)


@pytest.fixture
def scored(tmp_path: Path, run_folder: Path) -> Path:
    """Two runs with evaluations, and the baselines."""
    import shutil

    rng = np.random.default_rng(0)
    hard = rng.random(200)
    for name, rate in (("mc", 0.6), ("dql", 0.5)):
        shutil.copytree(run_folder, tmp_path / "runs" / name)
        config = read_checked_json(tmp_path / "runs" / name / "config.json", "run", "")
        config["settings"] |= {"algo": name, "out": name}
        write_checked_json(tmp_path / "runs" / name / "config.json", config)
        make_evaluation(tmp_path / f"runs/{name}/evaluations/regular-test-seed0-200", name, hard < rate, films=2)
    for name, rate in (("random", 0.2), ("oracle", 0.95)):
        make_evaluation(tmp_path / f"baselines/{name}", name, hard < rate, policy=name)
    return tmp_path


def test_a_page_with_everything_is_self_contained_and_says_what_was_measured(scored: Path) -> None:
    write_report([scored / "runs"], scored / "out.html", baselines=scored / "baselines")
    page = (scored / "out.html").read_text()
    checker = checked(page)
    rates = {}
    for label in checker.labels:
        match = re.match(
            r"(\w+): ([\d.]+)\N{NO-BREAK SPACE}%, 95 % interval ([\d.]+)\s–\s([\d.]+), 200 episodes", label
        )
        if match is not None:
            rates[match[1]] = tuple(map(float, match.groups()[1:]))
    hard = np.random.default_rng(0).random(200)
    assert list(rates) == ["random", "dql", "mc", "oracle"]
    for name, rate in (("random", 0.2), ("dql", 0.5), ("mc", 0.6), ("oracle", 0.95)):
        count = int((hard < rate).sum())
        expected = [count / 200, *wilson_interval(count, 200)]
        assert rates[name] == pytest.approx([100 * value for value in expected], abs=0.051)
    assert "mc succeeds in" in page and "of grasps of unseen objects" in page
    assert len(checker.images) == 2 * 2 * 3 and all(image["alt"] for image in checker.images)
    for section in ("success", "learning", "calibration", "films", "evaluations", "settings", "commands"):
        assert f'<section id="{section}">' in page
    assert "prefers-color-scheme:dark" in page and 'name="viewport"' in page
    assert "grasp-train --algo mc --shards" in page and "--batch-size 8" in page


def test_a_best_of_several_says_on_which_split_it_was_selected(scored: Path) -> None:
    said = "Best of 2 candidates: selected by success on these very scenes of the test split"
    assert said in render(gather([scored / "runs"], scored / "baselines"))
    assert "selected by" not in render(gather([scored / "runs" / "mc"], scored / "baselines"))


def test_runs_are_averaged_over_seeds_only_where_recipes_agree_and_seeds_differ(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for place, (recipe, seed) in enumerate([("a", 0), ("b", 0), ("b", 1), ("c", 0), ("c", 0), ("e", 0), ("e", 1)]):
        more = {"recipe_sha256": recipe, "data_sha256": "d", "training_seed": seed}
        more |= {"checkpoint_step": place if recipe == "e" else 3}
        make_evaluation(tmp_path / f"{place}", f"mc-{place}-seed{seed}", rng.random(50) < 0.5, **more)
    ((_, scores),) = gather([tmp_path], None).panels.items()
    assert sorted(len(row.scores) for row in rows_of(scores)) == [1, 1, 1, 1, 1, 2]
    assert "Over training seeds" in render(gather([tmp_path], None))
    assert "Over training seeds" not in render(gather([tmp_path / "0"], None))


@pytest.fixture
def several(tmp_path: Path) -> Path:
    """Three seeds of two recipes, one run of a third, and the baselines."""
    rng = np.random.default_rng(2)
    hard = rng.random(100)
    suits = np.where(np.arange(100) % 20 < 8, 0.4, -0.4)  # dql takes some of the 20 objects well, others badly
    for algo, rates in (("mc", (0.3, 0.4, 0.35)), ("dql", (0.8, 0.85, 0.9)), ("pcl", (0.25,))):
        for seed, rate in enumerate(rates):
            more = {"recipe_sha256": algo, "data_sha256": "d", "training_seed": seed, "algo": algo}
            success = hard + 0.1 * rng.normal(size=100) < rate + (suits if algo == "dql" else 0)
            make_evaluation(tmp_path / f"runs/{algo}{seed}", f"{algo}-10k-seed{seed}", success, films=1, **more)
    for name, rate in (("random", 0.2), ("oracle", 0.99)):
        make_evaluation(tmp_path / f"baselines/{name}", name, hard < rate, policy=name)
    return tmp_path


def test_runs_of_one_recipe_are_one_row_with_the_interval_over_runs_scenes_and_objects(several: Path) -> None:
    ((_, scores),) = gather([several / "runs"], several / "baselines").panels.items()
    rows = rows_of(scores)
    assert [row.name for row in rows] == ["random", "pcl-10k-seed0", "mc-10k", "dql-10k", "oracle"]
    files = [several / f"runs/dql{seed}" for seed in range(3)]
    success = np.array([[row.success for row in Evaluation.load(folder).rows()] for folder in files])
    counts = object_counts([(f"test_{index % 20:03d}",) for index in range(100)])
    expected = mean_success(success, counts)
    assert (rows[3].rate.value, rows[3].rate.low) == pytest.approx((expected.value, expected.low))
    assert rows[1].rate == Interval(rows[1].scores[0].rate, *wilson_interval(rows[1].scores[0].successes, 100))
    page = render(gather([several / "runs"], several / "baselines"))
    checker = checked(page)
    assert f"dql-10k succeeds in {100 * expected.value:.1f}" in page
    assert "3 training seeds" in page and len(re.findall('class="run"', page)) == 6
    assert len(checker.images) == 3 * 3, "films of the first run of a row"
    assert any(
        label.startswith("Performance profile. Success rates of single runs: mc-10k: ") for label in checker.labels
    )
    assert page.count('class="band"') == 2
    again = render(gather([several / "runs"], several / "baselines"))
    assert again == page, "draws are the same each time"


def test_the_best_row_is_compared_with_every_other_but_the_oracle_by_holms_correction(several: Path) -> None:
    ((_, scores),) = gather([several / "runs"], several / "baselines").panels.items()
    rows = {row.name: row for row in rows_of(scores)}
    found = comparisons(list(rows.values()))
    assert [one.other.name for one in found] == ["mc-10k", "pcl-10k-seed0", "random"]
    counts = object_counts([scene[2] for scene in rows["dql-10k"].scenes])
    for one in found:
        expected = success_difference(rows["dql-10k"].success, one.other.success, counts)
        assert (one.difference, one.p_value, one.scenes) == (expected, expected.p_value, 100)
    assert found[0].difference != success_difference(rows["dql-10k"].success, rows["mc-10k"].success)
    assert [one.adjusted for one in found] == holm([one.p_value for one in found])
    assert any(one.adjusted > one.p_value for one in found)


def test_measures_of_validation_are_correlated_with_success_where_checkpoints_are_scored(scored: Path) -> None:
    assert "Choosing without a simulator" not in render(gather([scored / "runs"], None))
    rng = np.random.default_rng(3)
    for step, rate in ((2, 0.1), (4, 0.9)):
        for algo in ("mc", "dql"):
            folder = scored / f"runs/{algo}/evaluations/step{step}"
            make_evaluation(
                folder, algo, rng.random(50) < rate, checkpoint_step=step, job={"task": {}, "network": step}
            )
    page = render(gather([scored / "runs"], None))
    checked(page)
    assert "Choosing without a simulator" in page and re.search(r"held-back loss</td><td class=.num.>4</td>", page)


def test_a_run_that_was_never_evaluated_has_a_page_too(run_folder: Path) -> None:
    page = render(gather([run_folder], None))
    checked(page)
    assert "Nothing has been evaluated yet" in page
    assert "At the end, loss: mc, training" in page


def test_evaluations_without_a_run_have_a_page_too(tmp_path: Path) -> None:
    make_evaluation(tmp_path / "random", "random", np.array([True, False]), policy="random")
    page = render(gather([tmp_path], None))
    checked(page)
    assert "Evaluation of the baselines" in page


def test_names_from_users_are_escaped(tmp_path: Path) -> None:
    make_evaluation(tmp_path / "e", "<script>alert(1)</script>", np.array([True, False]))
    page = render(gather([tmp_path], None))
    assert "<script>" not in page and "&lt;script&gt;" in page


def test_baselines_of_other_scenes_are_left_out(scored: Path) -> None:
    for name, change in (("split", {"split": "train"}), ("settings", {"job": {"task": {"finger_force": 1.0}}})):
        folder = scored / "baselines" / name
        evaluation = make_evaluation(folder, "random", np.array([True]), policy="random")
        summary = {key: value for key, value in evaluation.summary.items() if key != "files"}
        write_summary(folder, {**summary, **change})
    ((scenes, scores),) = gather([scored / "runs"], scored / "baselines").panels.items()
    assert scenes[:2] == ("regular", "test")
    assert [score.name for score in scores] == ["random", "dql", "mc", "oracle"]


def test_seeds_are_pooled_and_of_one_seed_the_longest_evaluation_counts(tmp_path: Path) -> None:
    make_evaluation(tmp_path / "a", "mc", np.array([True] * 10), seed=0)
    make_evaluation(tmp_path / "b", "mc", np.array([True] * 10 + [False] * 10), seed=0)
    make_evaluation(tmp_path / "c", "mc", np.array([False] * 30), seed=1)
    ((score,),) = gather([tmp_path], None).panels.values()
    assert (score.successes, score.episodes) == (10, 50)


def test_differences_are_those_of_scenes_that_both_policies_met(scored: Path) -> None:
    findings = gather([scored / "runs"], scored / "baselines")
    (first, random) = comparisons(rows_of(next(iter(findings.panels.values()))))
    hard = np.random.default_rng(0).random(200)
    assert (first.other.name, random.other.name) == ("dql", "random")
    expected = paired_difference(hard < 0.6, hard < 0.5)
    assert first.difference == Interval(expected.difference, expected.low, expected.high)
    assert (first.p_value, first.adjusted) == (expected.p_value, min(1.0, expected.p_value))


def test_calibration_of_rollouts_is_binned_by_q() -> None:
    row = EpisodeRow(0, 0, (), True, None, 1, "T", 1.0, 0.0)
    rows = [replace(row, q=0.82, success=True), replace(row, q=0.88, success=False), replace(row, q=1.0, success=True)]
    rows.append(replace(row, q=None, success=False))
    bins = calibration_of(rows)
    assert bins == [(pytest.approx(0.85), 0.5, 2), (1.0, 1.0, 1)]
    assert calibration_of([]) == []


def test_the_command_writes_the_page_and_refuses_what_holds_nothing(
    run_folder: Path, grasp_report: Callable[..., SimpleNamespace], tmp_path: Path
) -> None:
    done = grasp_report(run_folder, "--out", tmp_path / "report.html", "--title", "Two <networks>")
    assert done.code == 0
    assert "Two &lt;networks&gt;" in (tmp_path / "report.html").read_text()
    (tmp_path / "empty").mkdir()
    for folder, said in (("absent", "no such folder"), ("empty", "neither a run of grasp-train")):
        done = grasp_report(tmp_path / folder, "--out", tmp_path / "none.html")
        assert done.code == 2 and len(done.lines) == 1 and said in done.lines[0]
    (tmp_path / "file").write_text("")
    done = grasp_report(run_folder, "--out", tmp_path / "file" / "report.html")
    assert done.code == 2 and "cannot write the report here" in done.lines[0]
    assert not (tmp_path / "none.html").exists()


def test_a_report_needs_no_simulator_and_one_on_evaluations_no_pytorch_either(scored: Path) -> None:
    script = (
        "import sys; sys.modules['pybullet'] = None\n"
        "from pathlib import Path; from graspq.report.page import write_report\n"
        f"write_report([Path({str(scored / 'baselines')!r})], Path({str(scored / 'out.html')!r}))\n"
        "assert 'torch' not in sys.modules\n"
        f"write_report([Path({str(scored / 'runs')!r})], Path({str(scored / 'out.html')!r}))\n"
        "print([name for name in sys.modules if name.startswith('graspq.sim')])\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", script], cwd=scored, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
