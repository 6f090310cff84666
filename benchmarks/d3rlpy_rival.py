"""One gradient step of d3rlpy's DDPG on pictures, with its own default network and settings: a rival of `training.py`.

It needs d3rlpy 2.8.1, which pins an old gymnasium: in an environment of its own, or beside ours by
`pip install --no-deps d3rlpy==2.8.1 gym==0.26.2 gym-notices cloudpickle h5py structlog colorama dataclasses-json
marshmallow typing-inspect mypy-extensions scikit-learn joblib threadpoolctl narwhals`.
"""

from collections.abc import Callable
from typing import Any

import click
import numpy as np
from torch import Tensor


def by_d3rlpy(batches: list[dict[str, Tensor]], settings: Any) -> Callable[[], None] | None:
    """Return what takes one step of d3rlpy's DDPG on each batch; None, with a line, where d3rlpy is not there."""
    try:
        import d3rlpy
        from d3rlpy.dataset import TransitionMiniBatch
    except ImportError as error:
        click.echo(f"d3rlpy is left out ({error}): `benchmarks/d3rlpy_rival.py` says what it needs", err=True)
        return None
    scaler = d3rlpy.preprocessing.PixelObservationScaler()
    config = d3rlpy.algos.DDPGConfig(batch_size=settings.batch_size, gamma=0.9, observation_scaler=scaler)
    algorithm = config.create(device=False)
    algorithm.create_impl(tuple(batches[0]["image"].shape[1:]), batches[0]["action"].shape[1])
    column = {name: [b[name].float().numpy() for b in batches] for name in batches[0]}
    mini = [
        TransitionMiniBatch(
            observations=image,
            actions=action,
            rewards=reward[:, None],
            next_observations=next_image,
            next_actions=np.zeros_like(action),
            terminals=terminal[:, None],
            intervals=np.ones((len(action), 1), np.float32),
            transitions=[],
        )
        for image, action, reward, next_image, terminal in zip(
            *(column[name] for name in ("image", "action", "reward", "next_image", "terminal")), strict=True
        )
    ]

    def run() -> None:
        for batch in mini:
            algorithm.update(batch)

    return run
