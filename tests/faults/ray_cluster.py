"""Ray: a node that is killed, a head that is killed and started again, an object store that is full."""

import contextlib
import importlib.util
import logging
import signal
import time
from collections.abc import Iterable, Iterator
from typing import Any

from tests.faults.commands import Running, line_of
from tests.faults.harness import MADE, Fault, NotHereError, Tried, Work
from tests.faults.workers import with_a_worker

# So many that it still runs when the fault comes.
MADE["collection for Ray"] = (
    "data/regular-120",
    ("grasp-datagen --size 120 --objects objects --out data/regular-120 --seed 0 --workers 0",),
)
COLLECT = with_a_worker(line_of("collection for Ray", "objects"))
FAULTS = ("a node killed", "the head killed", "the object store full", "the command killed", "a Ray of its own")
_STORE = 80 * 2**20
_PATIENT = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500, "health_check_failure_threshold": 4}


class Ray:
    """Faults of a Ray cluster on this machine."""

    name = "Ray"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each fault."""
        if importlib.util.find_spec("ray") is None:
            raise NotHereError("Ray is not installed")
        for name in () if short else FAULTS:
            yield Fault(self.name, "grasp-datagen", name)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Collect on a cluster, do it, and collect again."""
        work.made("objects")
        with COLLECT.case(work) as case:
            if fault.name == "a Ray of its own":
                ended = Running(work, [*COLLECT.words, "--engine", "ray"], case).ended()
                broken = ended.broken()
                return broken if broken is not None else COLLECT.fits(case, work)
            full = fault.name == "the object store full"
            with _cluster({"automatic_object_spilling_enabled": False} if full else {}) as cluster:
                words = [*COLLECT.words, "--engine", "ray", "--ray-address", cluster.address]
                with _filled(cluster.address) if full else contextlib.nullcontext():
                    running = Running(work, words, case)
                    running.until((case / COLLECT.result).exists)
                    time.sleep(3.0)
                    if running.process.poll() is not None and not full:
                        return Tried("silently wrong", f"the fault did not happen: ended; {running.ended().line}")
                    if fault.name == "a node killed":
                        cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
                    elif fault.name == "the head killed":
                        cluster.remove_node(cluster.head_node, allow_graceful=False)
                    elif fault.name == "the command killed":
                        running.process.kill()
                    ended = running.ended()
            killed = fault.name == "the command killed" and ended.rc == -signal.SIGKILL
            broken = ended.broken()
            if broken is not None and not killed:
                return broken
            if not killed and ended.rc != 0 and not (ended.rc == 1 and ended.line) and not ended.one_line:
                return Tried("lost", f"exit status {ended.rc}: {ended.line}")
            after = COLLECT.goes_on(case, work)
            said = ended.rc not in (0, -9)
            return Tried("detected", ended.line) if said and after.outcome == "survived" else after


@contextlib.contextmanager
def _cluster(more: dict[str, Any]) -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    logging.disable(logging.WARNING)
    head = {"num_cpus": 1, "object_store_memory": _STORE, "_system_config": _PATIENT | more}
    made = Cluster(initialize_head=True, head_node_args=head)
    try:
        made.add_node(num_cpus=1, object_store_memory=_STORE)
        yield made
    finally:
        made.shutdown()
        logging.disable(logging.NOTSET)


@contextlib.contextmanager
def _filled(address: str) -> Iterator[None]:
    """Hold so many objects in the store of the head that nothing more fits."""
    import numpy as np
    import ray

    ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    held = []
    with contextlib.suppress(ray.exceptions.RayError):
        for size in [4 * 2**20] * 100 + [2**17] * 100:
            held.append(ray.put(np.zeros(size, np.uint8)))
    try:
        yield
    finally:
        held.clear()
        ray.shutdown()
