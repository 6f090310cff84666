"""The rival of collection: `KukaDiverseObjectEnv` as the PyBullet wheel ships it, with the paper's settings.

Its code runs unchanged. It imports two packages that are no longer to be had beside ours, and takes next to nothing
from them; the stand-ins below hold just that: from `gym` a base class, spaces and a generator, from `pkg_resources`
the order of two version numbers.
"""

import contextlib
import io
import random
import sys
import time
import types
from collections.abc import Iterator
from typing import Any

import numpy as np
from tallies import Tally

MAX_STEPS = 15  # T
IMAGE_SIZE = 64


def stand_ins() -> dict[str, types.ModuleType]:
    """Return the modules `gym` and `pkg_resources`, as far as the wheel's environments need them."""
    import gymnasium
    from packaging.version import parse

    modules = {name: types.ModuleType(name) for name in ("gym", "gym.envs", "gym.envs.registration", "pkg_resources")}
    registration, gym = modules["gym.envs.registration"], modules["gym"]
    registration.registry = types.SimpleNamespace(env_specs={})  # type: ignore[attr-defined]
    for name in ("make", "spec", "register"):
        setattr(registration, name, lambda *arguments, **settings: None)  # nobody makes an environment by name here
    modules["gym.envs"].registration = registration  # type: ignore[attr-defined]
    gym.__version__, gym.Env = "0.26.2", object  # type: ignore[attr-defined]
    gym.spaces, gym.utils, gym.envs = gymnasium.spaces, gymnasium.utils, modules["gym.envs"]  # type: ignore[attr-defined]
    modules["pkg_resources"].parse_version = parse  # type: ignore[attr-defined]
    parts = {"gym.spaces": gymnasium.spaces, "gym.utils": gymnasium.utils, "gym.utils.seeding": gymnasium.utils.seeding}
    return modules | parts


def make_environment() -> Any:
    """Return the environment: T = 15, 64 x 64 pictures, the policy chooses the height, all else as by default."""
    import graspq.sim.bullet  # noqa: F401  (imports PyBullet without its greeting)

    sys.modules.update(stand_ins())
    with contextlib.redirect_stdout(io.StringIO()):
        from pybullet_envs.bullet.kuka_diverse_object_gym_env import KukaDiverseObjectEnv

        return KukaDiverseObjectEnv(
            renders=False,
            isDiscrete=False,
            maxSteps=MAX_STEPS,
            removeHeightHack=True,
            width=IMAGE_SIZE,
            height=IMAGE_SIZE,
        )


def collecting(seed: int, grasps: int) -> Iterator[Tally | None]:
    """A player's part: `grasps` random grasps at a time, every frame kept as uint8, nothing written."""
    from graspq.policies.random import RandomPolicy

    # Its two sources of randomness are global.
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    draws, policy, environment = np.random.default_rng(seed), RandomPolicy(), make_environment()
    yield None
    while True:
        start, actions, successes = time.process_time(), 0, 0
        for _ in range(grasps):
            frames, done, debug = [np.asarray(environment.reset(), dtype=np.uint8)], False, {}
            while not done:
                image, _, done, debug = environment.step(policy.act(None, draws))
                frames.append(np.asarray(image, dtype=np.uint8))
            actions += len(frames) - 1
            successes += int(debug["grasp_success"] > 0)
        yield Tally(time.process_time() - start, grasps, actions, actions + grasps, successes)
