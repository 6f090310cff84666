"""The policy of `supervised`: it searches whole motions in the box of its training data and takes one step of them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from graspq.common.seeding import generator
from graspq.evaluate.policies import Policy
from graspq.evaluate.q_policy import QPolicy, SyntheticPolicy
from graspq.evaluate.settings import CemSettings
from graspq.sim.task import TASKS
from graspq.train.networks import QNetwork
from graspq.train.selection import StepMode

BEST = torch.tensor([1.0, -3.0, -4.0, 0.4])
EXTRA = {
    "synthetic_mean": torch.tensor([[0.5, -2.0, -4.0, 0.0], [0.0, 0.0, -0.5, 0.0]]),
    "synthetic_deviation": torch.tensor([[1.0, 1.0, 0.5, 1.0], [0.2, 0.2, 0.1, 0.2]]),
    "synthetic_low": torch.tensor([[-2.0, -4.0, -5.0, -2.0], [-0.5, -0.5, -0.7, -0.5]]),
    "synthetic_high": torch.tensor([[2.0, 4.0, -3.0, 2.0], [0.5, 0.5, -0.3, 0.5]]),
}


class Far(QNetwork):
    """Q(s, a) = -|a - BEST|²: the best motion spans several steps; remembers what it was asked about."""

    link = "identity"

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[torch.Tensor] = []

    def trunk(self, image, step):  # type: ignore[no-untyped-def]
        return ()

    def head(self, features, action):  # type: ignore[no-untyped-def]
        self.asked.append(action)
        return -(action - BEST).square().sum(-1)


def decided(network: Far, mode: StepMode, steps: list[int]) -> tuple[np.ndarray, np.ndarray | None]:
    cem = CemSettings(iterations=6, samples=256, elites=16, synthetic_step=mode)
    policy = SyntheticPolicy(network, cem, torch.device("cpu"), EXTRA, TASKS["regular"].settings)
    images = np.zeros((len(steps), 8, 8, 3), dtype=np.uint8)
    return policy.decide(images, np.asarray(steps), [generator("test", row) for row in range(len(steps))])


@pytest.mark.parametrize(("mode", "expected"), [("scale", [0.25, -0.75, -1.0, 0.1]), ("clip", [1.0, -1.0, -1.0, 0.4])])
def test_the_best_motion_is_found_beyond_one_steps_reach_and_its_first_step_taken(
    mode: StepMode, expected: list[float]
) -> None:
    actions, q = decided(Far(), mode, [0])
    np.testing.assert_allclose(actions, [expected], rtol=0, atol=0.03)
    assert q is not None and float(q[0]) == pytest.approx(0, abs=0.02), "Q of the motion, not of the step"


def test_each_row_searches_in_the_box_of_its_own_step_and_late_rows_in_the_last() -> None:
    network = Far()
    actions, _ = decided(network, "scale", [0, 1, 14])
    asked = torch.cat(network.asked, dim=1)
    for row, step in enumerate((0, 1, 1)):
        assert bool((asked[row] >= EXTRA["synthetic_low"][step]).all())
        assert bool((asked[row] <= EXTRA["synthetic_high"][step]).all())
    np.testing.assert_allclose(actions[1:, :3], [[0.5, -0.5, -0.7]] * 2, rtol=0, atol=0.01)


def test_a_run_of_supervised_acts_by_synthetic_search_and_one_of_mc_by_search(dataset: Path, run_folder: Path) -> None:
    from graspq.train.loop import train
    from graspq.train.settings import preset_settings

    settings = preset_settings(
        "paper", algo="supervised", shards=(str(dataset),), out=run_folder.parent / "supervised", steps=2, batch_size=8,
        validation_fraction=0.25, device="cpu", precision="float32", threads=1,
    )  # fmt: skip
    folder = train(settings).folder
    policy = Policy.from_run(folder)
    assert type(policy) is SyntheticPolicy and type(Policy.from_run(run_folder)) is QPolicy
    action = policy.act(np.zeros((64, 64, 3), dtype=np.uint8), 0)
    assert action.shape == (4,) and np.abs(action).max() <= 1
    assert policy.identity() == {"cem": CemSettings().to_json()}


def test_a_motion_ends_inside_the_workspace_where_the_pose_is_known() -> None:
    network, task = Far(), TASKS["regular"].settings
    low, high = (np.asarray(bound) for bound in task.workspace_bounds)
    # From the border where BEST leads out of the workspace in y, 3 limits below the least height that it may end at.
    pose = np.array([[0.55, -0.13 + 0.06, 0.015 + 3 * 0.06, 0.0]], dtype=np.float32)
    policy = SyntheticPolicy(network, CemSettings(), torch.device("cpu"), EXTRA, task)
    images, steps = np.zeros((1, 8, 8, 3), dtype=np.uint8), np.zeros(1, dtype=np.int64)
    policy.decide(images, steps, [generator("test", 0)], pose)
    asked = torch.cat([action[0] for action in network.asked]).numpy()
    ends = pose + asked * np.asarray(task.action_limits)
    assert (ends >= low - 1e-6).all() and (ends <= high + 1e-6).all()
    assert asked[:, 1].min() == pytest.approx(-1) and asked[:, 2].min() == pytest.approx(-3)
    network.asked.clear()
    policy.decide(images, steps, [generator("test", 0)])
    assert float(torch.cat([action[0] for action in network.asked])[:, 1].min()) < -2, "without a pose it is not cut"
