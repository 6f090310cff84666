"""The context of one update, for tests that look at targets alone: what they do not set is plain."""

import contextlib
from typing import Any

from graspq.train.state import Context, Networks, seeded


def plain_context(networks: Networks, lagged: Networks, **given: Any) -> Context:
    """Return a context in float32 at the start of a training, with discount 0.9 and 16 candidates."""
    plain: dict[str, Any] = {
        "loss": "squared",
        "discount": 0.9,
        "candidates": 16,
        "generator": seeded("tests/draws"),
        "progress": 0.0,
        "autocast": contextlib.nullcontext,
        "extra": {},
    }
    return Context(networks=networks, lagged_networks=lagged, **plain | given)
