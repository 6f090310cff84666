"""Policies: the batch changes no decision, a user's object is checked, and five lines of Python are enough."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.evaluate.policies import Policy, RandomObservationPolicy, UserPolicy
from graspq.evaluate.q_policy import QPolicy
from graspq.evaluate.settings import CemSettings
from graspq.train.networks import QNetwork

FIVE_LINES = """
from graspq.evaluate.policies import Policy
import numpy as np
policy = Policy.from_run({run!r}, seed=3)
image = np.zeros((64, 64, 3), dtype=np.uint8)  # the camera's frame
print(policy.act(image, step=0).tolist())
"""


class Hill(QNetwork):
    """Q(s, a) = exp(-|a - a*(s)|²), with a*(s) read off the first pixels: the best action is known."""

    link = "identity"

    def __init__(self) -> None:
        super().__init__()
        self.trunks = 0

    def trunk(self, image, step):  # type: ignore[no-untyped-def]
        self.trunks += 1
        return (image[:, 0, :4, 0].float() / 127.5 - 1,)

    def head(self, features, action):  # type: ignore[no-untyped-def]
        return (-(action - features[0].unsqueeze(1)).square().sum(-1)).exp()


def states(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.integers(0, 256, size=(count, 64, 64, 3), dtype=np.uint8), np.arange(count) % 15


def test_cem_finds_the_top_of_a_hill_and_reports_its_height() -> None:
    network = Hill()
    policy = QPolicy(network, CemSettings(iterations=6, samples=256, elites=16), torch.device("cpu"))
    images, steps = states(5)
    # Tops within reach of where the search starts, straight down.
    images[:, 0, :4, 0] = images[:, 0, :4, 0] // 2 + 64
    images[:, 0, 2, 0] //= 8
    decision = policy.decide(images, steps, [generator("test", row) for row in range(5)])
    wanted = images[:, 0, :4, 0].astype(np.float32) / 127.5 - 1
    assert np.abs(decision.actions - wanted).max() < 0.05
    assert decision.actions.dtype == np.float32 and decision.q is not None
    assert decision.q == pytest.approx(np.exp(-np.square(decision.actions - wanted).sum(1)), abs=1e-6)
    assert network.trunks == 1


def test_a_decision_does_not_depend_on_who_shares_the_batch(run_folder: Path) -> None:
    policy = Policy.from_run(run_folder)
    images, steps = states(6)
    together = policy.decide(images, steps, [generator("test", row) for row in range(6)])
    for row in (0, 4):
        alone = [generator("test", row) if place == row else None for place in range(6)]
        others = images.copy()
        others[[place for place in range(6) if place != row]] = 0
        decision = policy.decide(others, steps, alone)
        assert np.array_equal(decision.actions[row], together.actions[row])
        assert decision.q is not None and together.q is not None
        assert decision.q[row] == together.q[row]


def test_five_lines_of_python_act_as_the_run_does(run_folder: Path, tmp_path: Path) -> None:
    script = FIVE_LINES.format(run=str(run_folder))
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    policy = Policy.from_run(run_folder, seed=3)
    image = np.zeros((64, 64, 3), dtype=np.uint8)
    action = policy.act(image, 0)
    assert action.shape == (4,) and action.dtype == np.float32 and np.abs(action).max() <= 1
    assert done.stdout.strip() == str(action.tolist())
    assert not np.array_equal(action, policy.act(image, 0))
    policy.seed(3)
    assert np.array_equal(action, policy.act(image, 0))


def test_an_earlier_checkpoint_acts_otherwise_and_a_missing_one_is_refused(run_folder: Path) -> None:
    images, steps = states(3)
    early, late = (
        Policy.from_run(run_folder, checkpoint=checkpoint)
        .decide(images, steps, [generator("x", i) for i in range(3)])
        .q
        for checkpoint in (2, 4)
    )
    assert early is not None and late is not None and not np.array_equal(early, late)
    with pytest.raises(UserError, match="no checkpoint of step 3"):
        Policy.from_run(run_folder, checkpoint=3)


def test_the_random_policy_draws_from_each_states_own_generator() -> None:
    policy = RandomObservationPolicy()
    images, steps = states(3)
    actions = policy.act_batch(images, steps, [generator("a", row) for row in range(3)])
    again = policy.decide(images, steps, [None, generator("a", 1), None]).actions
    assert np.array_equal(actions[1], again[1]) and not np.array_equal(actions[0], actions[1])


SOURCE = """
import numpy as np

class Down:
    def act(self, image, step):
        assert image.dtype == np.uint8 and image.ndim == 3
        return [0.0, 0.0, -1.0, 0.5]

class Batched:
    def act_batch(self, images, steps, generators):
        return np.stack([rng.uniform(-1, 1, 4) for rng in generators])

class Wrong:
    def __init__(self, answer): self.answer = answer
    def act(self, image, step): return self.answer

def down(): return Down()
def batched(): return Batched()
def three(): return Wrong([0.0, 0.0, 0.0])
def nan(): return Wrong([0.0, float("nan"), 0.0, 0.0])
def large(): return Wrong([0.0, 0.0, -3.0, 0.0])
def text(): return Wrong("down")
def nothing(): return None
def broken(): raise KeyError("weights")
class Fails:
    def act(self, image, step): return {}["weights"]
def fails(): return Fails()
"""


@pytest.fixture
def user_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    name = f"policy_of_{abs(hash(str(tmp_path)))}"
    (tmp_path / f"{name}.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    return name


def test_a_users_policy_acts_where_somebody_waits(user_module: str) -> None:
    images, steps = states(3)
    down = UserPolicy.load(f"{user_module}:down").decide(images, steps, [None, generator("u", 1), None]).actions
    assert down[1].tolist() == [0.0, 0.0, -1.0, 0.5]
    batched = UserPolicy.load(f"{user_module}:batched")
    actions = batched.decide(images, steps, [generator("u", 0), None, generator("u", 2)]).actions
    assert actions[2] == pytest.approx(generator("u", 2).uniform(-1, 1, 4))
    assert len(batched.identity()["source_sha256"]) == 64
    assert str(Path.cwd()) not in sys.path


@pytest.mark.parametrize(
    ("factory", "said"),
    [
        ("three", r"returned the shape \[3\], expected 4 finite numbers in \[-1, 1\]"),
        ("nan", "returned nan, expected 4 finite numbers"),
        ("large", r"returned -3.0, expected 4 finite numbers"),
        ("text", "returned str, expected 4 finite numbers"),
        ("nothing", r"expected an object with act\(image, step\), the factory returned NoneType"),
        ("broken", r"cannot be made, KeyError: 'weights' at policy_of_\d+.py:24"),
        ("fails", r"act\(\) failed, KeyError: 'weights' at policy_of_\d+.py:26"),
        ("absent", "has no function 'absent'"),
    ],
)
def test_a_users_mistake_in_a_policy_is_one_line(user_module: str, factory: str, said: str) -> None:
    images, steps = states(1)
    with pytest.raises(UserError, match=said) as caught:
        UserPolicy.load(f"{user_module}:{factory}").decide(images, steps, [generator("u", 0)])
    assert "\n" not in caught.value.message


def test_a_missing_module_and_a_name_without_factory_are_refused() -> None:
    with pytest.raises(UserError, match="ModuleNotFoundError: No module named 'no_such_module'"):
        UserPolicy.load("no_such_module:make")
    with pytest.raises(UserError, match="expected random, oracle, or module:factory"):
        UserPolicy.load("oracel")
