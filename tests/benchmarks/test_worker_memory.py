"""The memory of a collecting worker."""

from graspq.benchmarks.worker_memory import READINGS, filled_bins
from graspq.objects.object_set import ObjectSet


def test_memory_is_read_at_even_distances(regular_objects: ObjectSet) -> None:
    rows = filled_bins(regular_objects.folder, 2 * READINGS)
    assert [row["bins filled"] for row in rows] == list(range(2, 2 * READINGS + 1, 2))
    assert all(50 < row["resident MB"] < 5_000 for row in rows)
