"""Sharded Parquet datasets of grasps: episodes in, deterministic batches out.

Nothing here knows the simulator or the learner: an `episode.Episode` comes in, a `batch.TransitionBatch` goes out.
"""
