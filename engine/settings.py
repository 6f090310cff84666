"""What commands that hand out work have as options: which engine, how many workers."""

from dataclasses import dataclass
from typing import Literal

from graspq.common.errors import UserError
from graspq.common.options import Settings, setting

ENGINE_OPTIONS = frozenset({"engine", "ray_address", "workers"})


@dataclass(frozen=True)
class EngineSettings(Settings):
    """Where units of work are done; changes no result."""

    engine: Literal["local", "ray"] = setting(
        "local", help="Workers are processes of this machine, or actors of Ray (pip install 'graspq[ray]')."
    )
    ray_address: str | None = setting(
        None,
        help="Ray cluster that is there: an address, or auto; a Ray of this machine's own is started where not given.",
    )
    workers: int | None = setting(
        None, help="Number of workers; all cores where not given, 0 for this process itself.", minimum=0, maximum=4096
    )

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UserError: a value is unknown or out of range, or an address is given to the local engine.
        """
        super().__post_init__()
        if self.ray_address is not None and self.engine != "ray":
            raise UserError(f"--ray-address: {self.ray_address!r} is for --engine ray, which is not asked for")

    @property
    def where(self) -> "EngineSettings":
        """Only these options, of whichever command's settings."""
        return EngineSettings(engine=self.engine, ray_address=self.ray_address, workers=self.workers)
