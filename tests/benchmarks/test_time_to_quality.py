"""Time to quality: when is validated, what counts as met, and trainings that are over are not run again."""

import json

import pytest

from graspq.benchmarks.time_to_quality import QualitySettings, measure, next_validation
from graspq.common.errors import UserError


def test_validations_come_every_so_many_transitions_and_later_every_two_per_cent():
    assert next_validation(0, 256) == 25
    assert next_validation(0, 32) == 200
    assert next_validation(100_000, 32) == 102_000


def mark(seconds, auc):
    return json.dumps({"step": 9, "transitions": 99, "seconds": seconds, "auc": auc}) + "\n"


@pytest.mark.parametrize(("auc", "expected"), [(0.8, 6.0), (0.7, "at least 20")])
def test_a_rival_that_never_met_the_bar_counts_as_the_limit(shards, tmp_path, auc, expected):
    (tmp_path / "default-seed0.jsonl").write_text(mark(5.0, 0.6) + mark(10.0, 0.76))
    (tmp_path / "paper-seed0.jsonl").write_text(mark(60.0, auc))
    result = measure(QualitySettings(shards=(shards,), work=tmp_path))
    assert result.ratios[0].value == expected


def test_the_default_settings_must_meet_the_bar(shards, tmp_path):
    (tmp_path / "default-seed0.jsonl").write_text(mark(5.0, 0.6))
    with pytest.raises(UserError, match=r"ended with a ROC AUC of 0\.6"):
        measure(QualitySettings(shards=(shards,), work=tmp_path))
