"""How much the memory of a collecting worker grows in its life: the native code of the simulator leaks.

python benchmarks/worker_memory.py --scenes 10000
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graspq.benchmarks.collection import TASK
from graspq.benchmarks.harness import Ratio, Result, Row, alone, command, resident_bytes
from graspq.common.options import Settings, setting
from graspq.datagen.collect import BLOCKS_PER_WORKER, collect_block
from graspq.datagen.settings import CollectionSettings
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim.episode import GraspSimulation

READINGS = 20


@dataclass(frozen=True)
class MemorySettings(Settings):
    """Settings of this benchmark."""

    scenes: int = setting(500, help="Bins to fill, each for one grasp.", minimum=READINGS)


def filled_bins(objects: Path, scenes: int) -> list[Row]:
    """Return the resident memory of this process every so many bins."""
    rows: list[Row] = []
    with GraspSimulation(TASK, ObjectSet.load(objects)) as simulation:
        for block in range(scenes):
            collect_block(simulation, CollectionSettings(block_size=1), block, 1)
            if (block + 1) % (scenes // READINGS) == 0:
                rows.append({"bins filled": block + 1, "resident MB": resident_bytes() / 1e6})
    return rows


def measure(settings: MemorySettings) -> Result:
    """Return the growth over the second half of the bins, for the bins of a worker's life."""
    rows = alone(filled_bins, default_object_set("regular").folder, settings.scenes)
    bins, memory = np.array([list(row.values()) for row in rows[len(rows) // 2 :]]).T
    growth = float(np.polyfit(bins, memory, 1)[0]) * BLOCKS_PER_WORKER
    return Result(
        [Ratio("growth of a worker's memory in its life, MB", growth)],
        {"Memory of a worker": rows[:: len(rows) // 5]},
        {"bins in a worker's life": BLOCKS_PER_WORKER},
    )


main = command(MemorySettings, measure)


if __name__ == "__main__":
    main()
