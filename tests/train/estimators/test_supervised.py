"""`supervised`: its labels, the motions it measures in the data, and what a search is given of them."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.checkpoint import load_acting
from graspq.train.estimators import ESTIMATORS
from graspq.train.estimators.supervised import (
    SearchOfMotions,
    SupervisedSettings,
    measured_motions,
    motions_at,
    one_step_of,
)
from graspq.train.loop import train
from graspq.train.selection import SearchSpace
from graspq.train.settings import TrainSettings


def motions_of(pool: ShardPool, step: int) -> np.ndarray:
    blocks = [pool.read_block(ref) for ref in pool.blocks]
    records = np.concatenate([block.records for block in blocks])
    return records["synthetic_action"][records["step"] == step]


def test_the_motions_of_each_step_are_measured_and_steps_never_seen_take_the_last_seen_ones(dataset: Path) -> None:
    pool = open_shards([dataset])
    extra = measured_motions(pool, SupervisedSettings())
    assert not bool(extra.pop("use_pose")), "the pose is an option"
    assert bool(measured_motions(pool, SupervisedSettings(use_pose=True))["use_pose"])
    assert {name: list(tensor.shape) for name, tensor in extra.items()} == {
        f"synthetic_{name}": [15, 4] for name in SearchSpace._fields
    }
    for step in (0, 1):
        motions = motions_of(pool, step)
        for name, expected in (("low", motions.min(0)), ("high", motions.max(0))):
            assert np.array_equal(extra[f"synthetic_{name}"][step].numpy(), expected)
        np.testing.assert_allclose(extra["synthetic_mean"][step], motions.mean(0), rtol=0, atol=1e-5)
        np.testing.assert_allclose(extra["synthetic_deviation"][step], motions.std(0), rtol=0, atol=1e-4)
    assert not torch.equal(extra["synthetic_low"][0], extra["synthetic_low"][1])
    for tensor in extra.values():
        assert torch.equal(tensor[2:], tensor[1].expand(13, -1)), "no episode has a third step"


def test_a_motion_seen_once_gives_numbers_and_no_nan(dataset: Path) -> None:
    pool = open_shards([dataset])
    few = dataclasses.replace(pool, blocks=pool.blocks[:1])
    assert all(bool(tensor.isfinite().all()) for tensor in measured_motions(few, SupervisedSettings()).values())


def test_a_search_gets_the_row_of_its_step_and_the_last_row_after_it() -> None:
    extra = {f"synthetic_{name}": torch.arange(3.0).unsqueeze(1) + 10 * i for i, name in enumerate(SearchSpace._fields)}
    space = motions_at(extra, torch.tensor([1, 0, 7]))
    assert torch.equal(space.mean, torch.tensor([[1.0], [0.0], [2.0]]))
    assert torch.equal(space.high, torch.tensor([[31.0], [30.0], [32.0]]))


def test_the_box_is_of_the_training_part_alone_and_lies_in_the_checkpoint(
    settings: Callable[..., TrainSettings],
) -> None:
    chosen = settings("supervised", steps=2, validation_fraction=0.5)
    run = train(chosen)
    training, _ = open_shards(chosen.shards).split(0.5, chosen.seed)
    kept = load_acting(run.folder).kept
    expected = measured_motions(training, SupervisedSettings())
    assert kept.keys() == expected.keys()
    assert all(torch.equal(kept[name], expected[name]) for name in expected)


def test_labels_are_outcomes_without_discount_whatever_the_datasets_discount_is(
    settings: Callable[..., TrainSettings],
    two_states: SimpleNamespace,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = two_states.dataset(tmp_path / "discounted", 30, discount=0.5)
    chosen, seen = settings("supervised", shards=(str(folder),), steps=2), []
    row = ESTIMATORS["supervised"]
    watching = dataclasses.replace(row.target_value, target=lambda batch, *_: seen.append(batch) or batch.mc_return)
    monkeypatch.setitem(ESTIMATORS, "supervised", dataclasses.replace(row, target_value=watching))
    train(chosen)
    returns = torch.cat([batch.mc_return.flatten() for batch in seen])
    assert set(returns.tolist()) == {0.0, 1.0}
    assert set(open_shards([folder]).read_block(open_shards([folder]).blocks[0]).records["mc_return"].tolist()) > {0.5}


def test_the_row_regresses_on_synthetic_actions() -> None:
    row = ESTIMATORS["supervised"]
    batch = SimpleNamespace(action="logged", synthetic_action="synthetic")
    assert row.regressed_action(batch) == "synthetic" and isinstance(row.action_selection, SearchOfMotions)  # type: ignore[arg-type]


def test_a_step_of_a_motion_is_scaled_along_its_line_or_clipped_and_a_short_motion_is_one_step() -> None:
    motion = torch.tensor([[1.0, -2.0, -4.0, 0.5], [0.1, 0.0, -0.9, 1.0]])
    scaled, clipped = one_step_of(motion, "scale"), one_step_of(motion, "clip")
    assert torch.equal(scaled, torch.tensor([[0.25, -0.5, -1.0, 0.125], [0.1, 0.0, -0.9, 1.0]]))
    assert torch.equal(clipped, torch.tensor([[1.0, -1.0, -1.0, 0.5], [0.1, 0.0, -0.9, 1.0]]))
