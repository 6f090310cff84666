"""Policies of runs: the search finds the top, an actor points, and both travel to other processes as they are."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.policies.of_run import RunPolicy, load
from graspq.sim.observation import Observation
from graspq.sim.task import TASKS
from graspq.train.networks.network import QNetwork, StateNetwork
from graspq.train.search_settings import CemSettings
from graspq.train.selection import pointed

FIVE_LINES = """
import numpy as np
from graspq.policies.of_run import load
from graspq.sim.observation import Observation
policy = load({run!r})
image = np.zeros((64, 64, 3), dtype=np.uint8)  # the camera's frame
pose = np.array([0.55, 0, 0.28, 0], dtype=np.float32)
print(policy.act(Observation(image, 0, pose), np.random.default_rng(3)).tolist())
"""
BEST = torch.tensor([1.0, -3.0, -4.0, 0.4])
KEPT = {
    "synthetic_mean": torch.tensor([[0.5, -2.0, -4.0, 0.0], [0.0, 0.0, -0.5, 0.0]]),
    "synthetic_deviation": torch.tensor([[1.0, 1.0, 0.5, 1.0], [0.2, 0.2, 0.1, 0.2]]),
    "synthetic_low": torch.tensor([[-2.0, -4.0, -5.0, -2.0], [-0.5, -0.5, -0.7, -0.5]]),
    "synthetic_high": torch.tensor([[2.0, 4.0, -3.0, 2.0], [0.5, 0.5, -0.3, 0.5]]),
    "use_pose": torch.tensor(False),
}


class Hill(QNetwork):
    """Q(s, a) = exp(-|a - a*(s)|²), with a*(s) read off the first pixels: the best action is known."""

    link = "identity"
    trunks = 0

    def trunk(self, image, step):
        self.trunks += 1
        return (image[:, 0, :4, 0].float() / 127.5 - 1,)

    def head(self, features, action):
        return (-(action - features[0].unsqueeze(1)).square().sum(-1)).exp()


class Far(QNetwork):
    """Q(s, a) = -|a - BEST|²: the best motion spans several steps; remembers what it was asked about."""

    link = "identity"

    def __init__(self):
        super().__init__()
        self.asked = []

    def trunk(self, image, step):
        return ()

    def head(self, features, action):
        self.asked.append(action[0])
        return -(action - BEST).square().sum(-1)


class FirstPixels(StateNetwork):
    """Outputs that are read off the first pixels."""

    def __init__(self, outputs):
        super().__init__()
        self.outputs = outputs

    def forward(self, image, step):
        return image[:, 0, : self.outputs, 0].float() / 127.5 - 1


class Sum(QNetwork):
    """Q(s, a) = Σ a + step."""

    link = "identity"

    def trunk(self, image, step):
        return (step.float(),)

    def head(self, features, action):
        return action.sum(-1) + features[0].unsqueeze(1)


def observation(seed=0, step=0, pose=(0.55, 0.0, 0.28, 0.0)):
    image = np.random.default_rng(seed).integers(0, 256, size=(64, 64, 3), dtype=np.uint8)
    return Observation(image, step, np.array(pose, dtype=np.float32))


def acting_by(run, networks, kept=None, **cem):
    """Return the policy of a run with other networks in it."""
    # These networks read single pixels: shifted they would see something else.
    policy = load(run, cem=CemSettings(views=1, **cem))
    policy.acting.networks.clear()
    policy.acting.networks.update(networks)
    policy.acting.kept.update(kept or {})
    return policy


def test_the_search_finds_the_top_of_a_hill_with_one_trunk_and_says_how_high_it_is(run_of):
    policy = acting_by(run_of("mc"), {"q": Hill()}, iterations=6, samples=256, elites=16)
    for seed in range(5):
        seen = observation(seed)
        # Tops within reach of where the search starts, straight down.
        seen.image[0, :4, 0] = seen.image[0, :4, 0] // 2 + 64
        seen.image[0, 2, 0] //= 8
        wanted = seen.image[0, :4, 0].astype(np.float32) / 127.5 - 1
        action = policy.act(seen, generator("test", seed))
        assert action.dtype == np.float32 and np.abs(action - wanted).max() < 0.05
        assert policy.q == pytest.approx(np.exp(-np.square(action - wanted).sum()), abs=1e-6)
    assert policy._placed.networks["q"].trunks == 5


def test_a_policy_travels_as_bytes_and_decides_the_same_afterwards(run_of):
    for algo in ("mc", "ddpg", "supervised"):
        policy = load(run_of(algo))
        twin = pickle.loads(pickle.dumps(policy))
        assert (twin.name, twin.identity()) == (f"{algo}@2", policy.identity())
        for step in (0, 7):
            ours, theirs = (who.act(observation(step, step), generator("x", step)) for who in (policy, twin))
            assert np.array_equal(ours, theirs) and policy.q == twin.q


def test_a_network_whose_class_stands_inside_a_function_is_refused_by_name_where_it_would_travel(run_of):
    class Inner(torch.nn.Module):
        pass

    policy = load(run_of("mc"))
    policy.acting.networks["q"].inner = Inner()
    with pytest.raises(UserError, match=r"--network paper: cannot be sent to workers .*--workers 0"):
        pickle.dumps(policy)


def test_a_few_lines_of_python_act_as_the_run_does(run_of, tmp_path):
    script = FIVE_LINES.format(run=str(run_of("mc")))
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    seen = Observation(np.zeros((64, 64, 3), np.uint8), 0, np.array([0.55, 0, 0.28, 0], np.float32))
    policy, rng = load(run_of("mc")), np.random.default_rng(3)
    action = policy.act(seen, rng)
    assert action.shape == (4,) and np.abs(action).max() <= 1
    assert done.stdout.strip() == str(action.tolist())
    assert not np.array_equal(action, policy.act(seen, rng)), "the noise goes on"


def test_an_earlier_checkpoint_acts_otherwise_and_a_missing_one_is_refused(run_of):
    early, late = load(run_of("mc"), 1), load(run_of("mc"))
    early.act(observation(), generator("x")), late.act(observation(), generator("x"))
    assert early.q != late.q and early.identity()["network"] != late.identity()["network"]
    with pytest.raises(UserError, match="no checkpoint of step 3"):
        load(run_of("mc"), 3)
    with pytest.raises(UserError, match="a checkpoint, expected its run; name"):
        load(run_of("mc") / "checkpoints" / "step-00000002")


def test_an_actor_acts_where_it_points_inside_the_box_and_tells_q_of_that(run_of):
    policy = acting_by(run_of("ddpg"), {"actor": FirstPixels(4), "q": Sum()})
    seen = [observation(seed, seed) for seed in range(5)]
    actions = np.stack([policy.act(one, generator("test", one.step)) for one in seen])
    outputs = torch.from_numpy(np.stack([one.image[0, :4, 0] for one in seen])).float() / 127.5 - 1
    assert np.array_equal(actions, pointed(outputs, TASKS["regular"].action).clamp(-1, 1).numpy())
    assert (actions == -1).any(), "the test wants an action beyond the box"
    assert policy.q == pytest.approx(actions[-1].sum() + 4, abs=1e-5)


def test_a_distribution_acts_by_its_mean_and_tells_the_value_of_the_state(run_of):
    seen, noise = observation(3), generator("test")
    policy = acting_by(run_of("pcl"), {"actor": FirstPixels(8), "v": FirstPixels(1)})
    alone = acting_by(run_of("pcl"), {"actor": FirstPixels(4)})
    assert np.array_equal(policy.act(seen, noise), alone.act(seen, noise))
    assert policy.q == pytest.approx(seen.image[0, 0, 0] / 127.5 - 1, abs=1e-6)
    assert alone.q is None


@pytest.mark.parametrize("algo", ["ddpg", "pcl"])
def test_a_run_with_an_actor_needs_no_noise_and_no_search(run_of, algo):
    policy = load(run_of(algo))
    first, again = (policy.act(observation(), generator(name)) for name in ("a", "b"))
    assert np.array_equal(first, again) and first[2] < -0.9
    assert policy.q is not None and "cem" not in policy.identity()


@pytest.mark.parametrize(("mode", "expected"), [("scale", [0.25, -0.75, -1.0, 0.1]), ("clip", [1.0, -1.0, -1.0, 0.4])])
def test_supervised_finds_motions_beyond_one_steps_reach_and_takes_their_first_step(run_of, mode, expected):
    cem = {"iterations": 6, "samples": 256, "elites": 16, "synthetic_step": mode}
    policy = acting_by(run_of("supervised"), {"q": Far()}, KEPT, **cem)
    action = policy.act(observation(pose=(0.55, 0.12, 0.28, 0.0)), generator("test"))
    np.testing.assert_allclose(action, expected, rtol=0, atol=0.03)
    assert policy.q == pytest.approx(0, abs=0.02), "Q of the motion, not of the step"


def test_supervised_searches_in_the_box_of_its_step_and_late_ones_in_the_last(run_of):
    policy = acting_by(run_of("supervised"), {"q": Far()}, KEPT)
    for step, box in ((0, 0), (1, 1), (14, 1)):
        policy.act(observation(step=step, pose=(0.55, 0.12, 0.28, 0.0)), generator("test", step))
        asked = torch.cat(policy._placed.networks["q"].asked)
        policy._placed.networks["q"].asked.clear()
        assert bool((asked >= KEPT["synthetic_low"][box]).all()) and bool((asked <= KEPT["synthetic_high"][box]).all())


def test_a_motion_of_supervised_ends_inside_the_workspace_where_it_may_use_the_pose(run_of):
    task = TASKS["regular"]
    low, high = (np.asarray(bound) for bound in task.settings.workspace_bounds)
    # From the border where BEST leads out of the workspace in y, 3 limits below the least height that it may end at.
    pose = np.array([0.55, -0.13 + 0.06, 0.015 + 3 * 0.06, 0.0], dtype=np.float32)
    asked = []
    for use_pose in (True, False):
        policy = acting_by(run_of("supervised"), {"q": Far()}, KEPT | {"use_pose": torch.tensor(use_pose)})
        policy.act(observation(pose=pose), generator("test"))
        asked.append(torch.cat(policy._placed.networks["q"].asked).numpy())
    asked, blind = asked
    assert blind[:, 1].min() < -2 and blind[:, 2].min() < -4
    ends = pose + asked * np.asarray(task.action.limits)
    assert (ends >= low - 1e-6).all() and (ends <= high + 1e-6).all()
    assert asked[:, 1].min() == pytest.approx(-1) and asked[:, 2].min() == pytest.approx(-3)


def test_the_estimator_of_a_run_says_how_it_acts(run_of):
    assert isinstance(load(run_of("mc")), RunPolicy)
    searching = {algo: load(run_of(algo)).searches for algo in ("mc", "supervised", "ddpg", "pcl")}
    assert searching == {"mc": True, "supervised": True, "ddpg": False, "pcl": False}
