"""Runs of a few steps on real grasps."""

import functools
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def run_of(collect_regular, regular_objects, tmp_path_factory):
    """Return what trains an estimator for two steps and returns the run's folder, with checkpoints of both steps."""
    from graspq.train.loop import train
    from graspq.train.settings import complete

    dataset = collect_regular(tmp_path_factory.mktemp("data") / "regular", regular_objects, 4, 3)

    @functools.cache
    def make(algo: str) -> Path:
        settings = complete(
            {
                "algo": algo,
                "shards": (str(dataset),),
                "out": tmp_path_factory.mktemp("runs") / algo,
                "steps": 2,
                "batch_size": 8,
                "save_every": 1,
                "validation_fraction": 0.25,
                "device": "cpu",
                "precision": "float32",
                "threads": 1,
            },
            "paper",
        )
        return train(settings).folder

    return make
