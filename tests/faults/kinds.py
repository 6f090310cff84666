"""All kinds of faults, in the order of the table."""

from tests.faults.bits import Bits
from tests.faults.crash_points import CrashPoints, KilledByStrace
from tests.faults.failing_calls import FullDisk, Limits, ReadOnly, failing_calls
from tests.faults.fuzz import Fuzz
from tests.faults.harness import Kind
from tests.faults.hostile import Hostile
from tests.faults.power_loss import PowerLoss
from tests.faults.ray_cluster import Ray
from tests.faults.reproducible import Reproducible
from tests.faults.shards import Shards
from tests.faults.signals import Signals, Suspended
from tests.faults.streams import ClosedStreams
from tests.faults.surroundings import Clock, Paths, Surroundings
from tests.faults.together import Together
from tests.faults.workers import Workers

KINDS: list[Kind] = [
    CrashPoints(),
    CrashPoints("SIGKILL in the midst of a write", half=True),
    KilledByStrace(),
    PowerLoss(),
    *failing_calls(),
    FullDisk(),
    ReadOnly(),
    Limits("few open files (ulimit -n)", "RLIMIT_NOFILE", (64, 16, 10, 7)),
    Limits("little memory (ulimit -v), MiB above the start", "RLIMIT_AS", (64, 128, 256)),
    Bits(),
    Shards(),
    Hostile(),
    Fuzz(),
    Together(),
    Workers(),
    Signals(),
    Suspended(),
    Clock(),
    ClosedStreams(),
    Surroundings(),
    Paths(),
    Ray(),
    Reproducible(),
]
