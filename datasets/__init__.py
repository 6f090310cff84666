"""Sharded Parquet datasets of grasps: episodes in, deterministic batches out.

Nothing here knows the simulator or the learner: an `episode.Episode` comes in, a `batch.TransitionBatch` goes out.
"""

import os

# Streaming frees a window of blocks at once and needs the memory again for the next one. Arrow's allocator gives pages
# back to the system after 10 ms, and having them zeroed and mapped anew takes a third of the time: with 10 s a stream
# gives 1.6 times the batches. Arrow reads this setting, in milliseconds, when it is loaded; one that is set stays.
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "10000")
