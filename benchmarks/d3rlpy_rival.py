"""One gradient step of d3rlpy's DDPG on pictures, with its own default network and settings: a rival of `training.py`.

It needs d3rlpy 2.8.1, which pins an old gymnasium: in an environment of its own, or beside ours by
`pip install --no-deps d3rlpy==2.8.1 gym==0.26.2 gym-notices cloudpickle h5py structlog colorama dataclasses-json
marshmallow typing-inspect mypy-extensions scikit-learn joblib threadpoolctl narwhals`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import click
import numpy as np
from torch import Tensor


def update_by_d3rlpy(batches: Sequence[dict[str, Tensor]]) -> Callable[[], None] | None:
    """Return what takes one step on each batch; None, with a line, where d3rlpy is not there."""
    try:
        import d3rlpy
        from d3rlpy.dataset import TransitionMiniBatch
    except ImportError as error:
        click.echo(f"d3rlpy is left out ({error}): benchmarks/d3rlpy_rival.py says what it needs", err=True)
        return None
    scaler = d3rlpy.preprocessing.PixelObservationScaler()
    config = d3rlpy.algos.DDPGConfig(batch_size=len(batches[0]["action"]), gamma=0.9, observation_scaler=scaler)
    algorithm = config.create(device=False)
    algorithm.create_impl(tuple(batches[0]["image"].shape[1:]), batches[0]["action"].shape[1])

    def mini(batch: dict[str, Tensor]) -> Any:
        columns = {name: tensor.float().numpy() for name, tensor in batch.items()}
        return TransitionMiniBatch(
            observations=columns["image"],
            actions=columns["action"],
            rewards=columns["reward"][:, None],
            next_observations=columns["next_image"],
            next_actions=np.zeros_like(columns["action"]),
            terminals=columns["terminal"][:, None],
            intervals=np.ones((len(columns["action"]), 1), np.float32),
            transitions=[],
        )

    minis = [mini(batch) for batch in batches]

    def take_steps() -> None:
        for batch in minis:
            algorithm.update(batch)

    return take_steps
