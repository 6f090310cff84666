from pathlib import Path

import pytest

from graspq.evaluate.cli import main as grasp_eval
from graspq.evaluate.records import find_evaluations

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def test_a_policy_of_ones_own_in_one_file_is_scored(regular_objects, tmp_path, monkeypatch):
    monkeypatch.chdir(EXAMPLES)
    words = ["--policy", "own_policy:GoesForColour", "--objects", str(regular_objects.folder), "--split", "train"]
    with pytest.raises(SystemExit) as ended:
        grasp_eval([*words, "--episodes", "8", "--workers", "0", "--out", str(tmp_path)], prog_name="grasp-eval")
    assert ended.value.code == 0
    (evaluation,) = find_evaluations(tmp_path)
    assert evaluation.summary["successes"] >= 4, "the random policy lifts two of eight"
