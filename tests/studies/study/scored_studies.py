"""Scores of studies that were never run: rows of given success in the same scenes."""

from typing import Any

import numpy as np
import numpy.typing as npt

from graspq.evaluate.results_table import outcomes_text

SCENES = 400


def scenes(task: str = "regular", split: str = "test") -> dict[str, Any]:
    rng = np.random.default_rng(0)
    ids = [[f"object{number}" for number in rng.choice(40, 5, replace=False)] for _ in range(SCENES)]
    return {"kind": "scenes", "task": task, "split": split, "seed": 0, "object_ids": ids}


def outcomes(rate: float, seed: int) -> npt.NDArray[np.bool_]:
    """A run that succeeds where the scene is easier than its rate, but for a few scenes of its own."""
    hard = np.random.default_rng(1).random(SCENES)
    own = np.random.default_rng((2, seed)).random(SCENES)
    return (hard < rate) ^ (own < 0.02)


def score(success: npt.NDArray[np.bool_]) -> dict[str, Any]:
    return {
        "outcomes": outcomes_text(success), "successes": int(success.sum()), "episodes": len(success),
        "success_rate": float(success.mean()), "object_set_sha256": "a" * 64, "scored_by": "b" * 40,
    }  # fmt: skip


def runs(name: str, rate: float, *, seeds: int = 3, **changed: Any) -> list[dict[str, Any]]:
    common = {
        "kind": "run", "study": "s", "row": name, "algo": name, "options": {"preset": "default"}, "task": "regular",
        "size": "10k", "setting": "off-policy", "split": "test", "recipe_sha256": "c" * 64, "recipe_frozen": True,
        "status": "done", "steps": 100, "reason": None, "discount": 0.9,
        "data_sha256": "d" * 64, "trained_by": "b" * 40,
    }  # fmt: skip
    found = []
    for seed in range(seeds):
        success = outcomes(rate, 10 * sum(map(ord, name)) + seed)
        validation = {"loss": float(1 - success.mean()), "opc": float(1 - success.mean()), "last_steps": seed}
        found.append(common | score(success) | {"seed": seed, "validation": validation} | changed)
    return found


def reference(policy: str, rate: float) -> dict[str, Any]:
    return {"kind": "reference", "policy": policy, "task": "regular", "split": "test"} | score(outcomes(rate, 0))


def study(seeds: int = 3, **rates: float) -> list[dict[str, Any]]:
    """A study of these rows; an underscore in a name stands for a dash."""
    rows = [row for name, rate in rates.items() for row in runs(name.replace("_", "-"), rate, seeds=seeds)]
    return [scenes(), reference("random", 0.2), reference("oracle", 0.98), *rows]
