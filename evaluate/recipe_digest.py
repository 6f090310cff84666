"""What decides what a run learned and how it acts, data and training seed apart; its digest stands beside every score.

Runs of one recipe on the same data differ in their training seed alone: together they are one row of a table.
"""

from collections.abc import Mapping
from typing import Any

from graspq.common.named_objects import source_digest
from graspq.evaluate.records import identity_digest
from graspq.train.search_settings import CemSettings
from graspq.train.settings import FREE

# What tells runs of one recipe apart, and what does not decide what is learned.
NOT_OF_A_RECIPE = FREE | {"seed"}


def of_a_recipe(training: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a run's settings that decides what is learned, but for data and seed."""
    return {name: value for name, value in training.items() if name not in NOT_OF_A_RECIPE}


def deciding(
    training: Mapping[str, Any], search: CemSettings, online: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return a recipe as JSON.

    Args:
        training: settings of the run, as `TrainSettings.to_json` gives them.
        search: of the policy.
        online: how its data were collected, where that was part of the run (grasp-online).
    """
    found: dict[str, Any] = {
        "search": search.to_json(),
        "training": of_a_recipe(training),
    }
    if online is not None:
        found["online"] = {name: value for name, value in online.items() if name != "split_seed"}
    own = [name for name in (training["algo"], training["network"]) if ":" in name]
    return found | ({"sources": {name: source_digest(name) for name in own}} if own else {})


def recipe_digest(config: Mapping[str, Any], search: CemSettings) -> str:
    """Return the SHA-256 of the recipe of a run, 64 hexadecimal digits; `config` is its `config.json`."""
    return identity_digest(deciding(config["settings"], search, config.get("online")))
