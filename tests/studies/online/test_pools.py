import dataclasses
from pathlib import Path

import numpy as np

from graspq.datasets.dataset import open_shards
from graspq.studies.online.pools import PoolOfRounds


def batches(pool, count=4):
    with pool.batches(16, seed=3, start_step=5, prefetch=0) as loader:
        return [next(loader) for _ in range(count)]


def test_a_pool_of_rounds_gives_the_batches_of_a_plain_pool_of_the_same_blocks(base: Path) -> None:
    whole = open_shards([base])
    first = dataclasses.replace(whole, blocks=whole.blocks[:5])
    for buffer_bytes in (2**30, 1):
        pools = PoolOfRounds(first, buffer_bytes)
        for more in (6, 8):
            plain = dataclasses.replace(whole, blocks=whole.blocks[:more])
            made = pools.of(whole.blocks[5:more])
            for ours, theirs in zip(batches(made), batches(plain), strict=True):
                np.testing.assert_array_equal(ours.image, theirs.image)
                np.testing.assert_array_equal(ours.next_image, theirs.next_image)
                np.testing.assert_array_equal(ours.action, theirs.action)


def test_the_next_round_reads_only_what_is_new(base: Path) -> None:
    whole = open_shards([base])
    pools = PoolOfRounds(dataclasses.replace(whole, blocks=whole.blocks[:5]), 2**30)
    before, after = pools.of(whole.blocks[5:6]), pools.of(whole.blocks[5:7])
    batches(before)
    kept = before.read_block(whole.blocks[0])
    assert after.read_block(whole.blocks[0]) is kept


def test_other_returns_are_made_for_the_blocks_of_all_rounds(base: Path) -> None:
    whole = open_shards([base])
    made = PoolOfRounds(dataclasses.replace(whole, blocks=whole.blocks[:5]), 2**30).of(whole.blocks[5:])
    for ref in whole.blocks:
        ours, theirs = made.with_discount(0.5).read_block(ref), whole.with_discount(0.5).read_block(ref)
        np.testing.assert_array_equal(ours.records["mc_return"], theirs.records["mc_return"])
