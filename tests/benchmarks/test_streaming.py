"""Waiting and memory of streaming training, in the shortest form."""

from graspq.benchmarks.streaming import StreamingSettings, memory_row, waiting_row


def small(tmp_path):
    from drawn_data import make_dataset

    make_dataset(tmp_path / "drawn", blocks=50, per_shard=25, size=16)
    return StreamingSettings(shards=(str(tmp_path / "drawn"),), turns=1, steps=2, memory_steps=8)


def test_waiting_is_a_share_of_a_step_and_memory_is_read_after_each(tmp_path):
    settings = small(tmp_path)
    row = waiting_row("mc", settings)
    assert 0 <= row["share of waiting"] < 1 and row["step, ms"] > 0
    memory = memory_row(settings)
    assert memory["epochs"] > 0 and memory["last quarter, MB"] > 50
    assert memory["growth"] == memory["last quarter, MB"] / memory["second quarter, MB"] - 1
