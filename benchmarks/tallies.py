"""What a stretch of collection came to, the same for us and for the rival."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Tally:
    """What was done in a turn.

    Attributes:
        core_seconds: of CPU time.
        grasps: episodes.
        actions: taken in them.
        frames: rendered.
        successes: episodes that ended with an object lifted.
    """

    core_seconds: float
    grasps: int
    actions: int
    frames: int
    successes: int
