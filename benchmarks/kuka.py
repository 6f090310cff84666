"""The rival of collection: `KukaDiverseObjectEnv` as the PyBullet wheel ships it, with the paper's settings.

Its code runs unchanged. It imports two packages that are no longer to be had beside ours, and takes next to nothing
from them; the stand-ins below hold just that: from `gym` a base class, spaces and a generator, from `pkg_resources`
the order of two version numbers. It uses PyBullet's first physics client: it needs a process of its own.
"""

import contextlib
import io
import random
import sys
import time
import types
from typing import Any, NamedTuple

import numpy as np

from graspq.policies.random import RandomPolicy

MAX_STEPS = 15  # T


class Tally(NamedTuple):
    """What a stretch of collection came to, the same for us and for the rival; `begun` are seconds before its clock."""

    seconds: float
    grasps: int
    actions: int
    frames: int
    begun: float


def stand_ins() -> dict[str, types.ModuleType]:
    """Return the modules `gym` and `pkg_resources`, as far as the wheel's environments need them."""
    import gymnasium
    from packaging.version import parse

    modules = {name: types.ModuleType(name) for name in ("gym", "gym.envs", "gym.envs.registration", "pkg_resources")}
    nothing = dict.fromkeys(("make", "spec", "register"), lambda *given, **more: None)
    vars(modules["gym.envs.registration"]).update(registry=types.SimpleNamespace(env_specs={}), **nothing)
    vars(modules["gym.envs"]).update(registration=modules["gym.envs.registration"])
    shared = {"spaces": gymnasium.spaces, "utils": gymnasium.utils, "envs": modules["gym.envs"]}
    vars(modules["gym"]).update(__version__="0.26.2", Env=object, **shared)
    vars(modules["pkg_resources"]).update(parse_version=parse)
    parts = {"gym.spaces": gymnasium.spaces, "gym.utils": gymnasium.utils, "gym.utils.seeding": gymnasium.utils.seeding}
    return modules | parts


def make_environment() -> Any:
    """Return the environment: T = 15, 64 x 64 pictures, the policy chooses the height, all else as by default."""
    import graspq.sim.bullet  # noqa: F401  (imports PyBullet without its greeting)

    sys.modules.update(stand_ins())
    with contextlib.redirect_stdout(io.StringIO()):
        from pybullet_envs.bullet.kuka_diverse_object_gym_env import KukaDiverseObjectEnv

        settings = {"maxSteps": MAX_STEPS, "removeHeightHack": True, "width": 64, "height": 64}
        return KukaDiverseObjectEnv(renders=False, isDiscrete=False, **settings)


def kuka_grasps(seed: int, grasps: int) -> Tally:
    """Return what `grasps` random grasps came to, after one that is not counted: frames are kept, nothing written."""
    started = time.perf_counter()
    # Its two sources of randomness are global.
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    draws, policy, environment = np.random.default_rng(seed), RandomPolicy(), make_environment()
    frames: list[Any] = []
    for grasp in range(grasps + 1):
        if grasp == 1:
            start, frames = time.perf_counter(), []
        image, done = environment.reset(), False
        frames.append(np.asarray(image, dtype=np.uint8))
        while not done:
            image, _, done, _ = environment.step(policy.act(None, draws))
            frames.append(np.asarray(image, dtype=np.uint8))
    return Tally(time.perf_counter() - start, grasps, len(frames) - grasps, len(frames), start - started)
