"""Sharded Parquet datasets of grasps: episodes in, deterministic batches out.

Nothing here knows the simulator or the learner: an `episode.Episode` comes in, a `batch.TransitionBatch` goes out.
"""

import os

# Streaming frees a window of blocks at once and needs the memory again while it reads the next. Arrow's allocator gives
# pages back to the system after 10 ms; having them zeroed and mapped anew was a third of reading a block. It reads this
# setting, in milliseconds, when Arrow is loaded; whoever has set it, or imports pyarrow before graspq, decides himself.
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "10000")
