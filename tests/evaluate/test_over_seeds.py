"""Runs that differ in their training seed alone as one line: which belong together, and what it says."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspq.evaluate.over_seeds import lines_over_seeds, name_of_runs, over_seeds
from graspq.evaluate.records import EpisodeRow, Evaluation, write_rows, write_summary
from graspq.evaluate.statistics import mean_success, object_counts


def evaluation(folder: Path, success: np.ndarray, **changed: Any) -> Evaluation:
    folder.mkdir()
    ids = [(f"o{index % 7}", f"o{index % 3}") for index in range(len(success))]
    write_rows(
        folder,
        [EpisodeRow(index, 0, ids[index], bool(one), None, 4, "T", 0.0, None) for index, one in enumerate(success)],
    )
    summary = {
        "label": folder.name, "recipe_sha256": "r", "data_sha256": "d", "training_seed": 0, "checkpoint_step": 5,
        "task": "regular", "split": "test", "seed": 0, "episodes": len(success), "job": {"task": {"a": 1}},
    }  # fmt: skip
    return write_summary(folder, summary | changed)


def test_runs_of_one_recipe_are_one_line_over_runs_scenes_and_objects(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    success = rng.random((3, 40)) < 0.4 + 0.5 * (np.arange(40) % 3 == 0)
    found = [evaluation(tmp_path / f"mc-seed{2 - n}", success[n], training_seed=2 - n) for n in range(3)]
    (line,) = over_seeds(found)
    assert (line.name, line.training_seeds, line.task, line.split) == ("mc", (0, 1, 2), "regular", "test")
    counts = object_counts([(f"o{index % 7}", f"o{index % 3}") for index in range(40)])
    expected = mean_success(success, counts)
    assert (line.rate.value, line.rate.error) == pytest.approx((expected.value, expected.error))
    assert expected.error > mean_success(success).error
    text = lines_over_seeds([line])
    assert "3 training seeds" in text and f"{100 * expected.value:.1f} %" in text


@pytest.mark.parametrize(
    "changed",
    [
        {"recipe_sha256": "other"}, {"data_sha256": "other"}, {"checkpoint_step": 6}, {"split": "train"}, {"seed": 1},
        {"job": {"task": {"a": 2}}}, {"training_seed": 0}, {"recipe_sha256": None},
    ],
)  # fmt: skip
def test_what_differs_in_more_than_the_training_seed_is_no_line(tmp_path: Path, changed: dict[str, Any]) -> None:
    success = np.arange(10) % 3 == 0
    first = evaluation(tmp_path / "mc-seed0", success)
    second = evaluation(tmp_path / "mc-seed1", success, **({"training_seed": 1} | changed))
    alone = [evaluation(tmp_path / f"one{seed}", success[:1], training_seed=seed) for seed in (0, 1)]
    assert over_seeds([first, second]) == over_seeds(alone) == [] and lines_over_seeds([]) == ""


def test_runs_are_called_what_their_names_have_in_common() -> None:
    assert name_of_runs(["mc-10k-seed0", "mc-10k-seed12"]) == "mc-10k"
    assert name_of_runs(["seed0", "seed1"]) == "seed0 and 1 more"
    assert name_of_runs(["a", "b", "c"]) == "a and 2 more"
