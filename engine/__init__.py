"""Units of work on processes of this machine or on a Ray cluster: the only place that starts processes."""

from graspq.engine.local import warm_up
from graspq.engine.running import run
from graspq.engine.schedule import LostUnitsError
from graspq.engine.settings import EngineSettings
from graspq.engine.work import Place, Work

__all__ = ["EngineSettings", "LostUnitsError", "Place", "Work", "run", "warm_up"]
