"""A thin object layer over PyBullet: a world owns its client, and bodies know their world.

Several worlds live side by side in one process; no call can reach another world's client by mistake.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from graspq.common.errors import UserError
from graspq.sim.bullet import bullet

Vector = Sequence[float] | np.ndarray
_GRAVITY = 9.81  # metres a second squared


class World:
    """One physics client, without graphics unless asked for (`gui=True` opens PyBullet's window)."""

    def __init__(self, *, time_step: float, solver_iterations: int, gui: bool = False) -> None:
        """Connect.

        Args:
            time_step: seconds a simulation step.
            solver_iterations: constraint solver's iterations a step.
            gui: open a window (needs a display).

        Raises:
            RuntimeError: the window cannot be opened.
            UserError: a window was asked for and there is no display.
        """
        if gui and sys.platform == "linux" and not os.environ.get("DISPLAY"):
            # PyBullet ends the whole process where it finds no display.
            raise UserError("PyBullet's window needs a display (DISPLAY is not set); use render_mode='rgb_array'")
        self.client = bullet.connect(bullet.GUI if gui else bullet.DIRECT)
        if self.client < 0:
            raise RuntimeError("PyBullet could not open its window; is there a display?")
        self.gui = gui
        self._after_step: Callable[[], None] | None = None
        self._pace = time_step, solver_iterations
        self.reset()

    def reset(self) -> None:
        """Empty the world. Everything that follows is a function of the calls that follow."""
        bullet.resetSimulation(physicsClientId=self.client)
        bullet.setGravity(0, 0, -_GRAVITY, physicsClientId=self.client)
        # Overlapping pairs in a fixed order: without it the solver may meet contacts in another order each run.
        bullet.setPhysicsEngineParameter(
            deterministicOverlappingPairs=1, enableFileCaching=1, physicsClientId=self.client
        )
        self._set_pace(*self._pace)

    def _set_pace(self, time_step: float, solver_iterations: int) -> None:
        self.time_step = time_step
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=time_step, numSolverIterations=solver_iterations, physicsClientId=self.client
        )

    @contextlib.contextmanager
    def paced(self, time_step: float, solver_iterations: int) -> Iterator[None]:
        """Simulate with another time step (seconds) and other iterations, until the `with` statement ends."""
        self._set_pace(time_step, solver_iterations)
        try:
            yield
        finally:
            self._set_pace(*self._pace)

    def step(self, count: int = 1) -> None:
        """Advance by `count` simulation steps."""
        for _ in range(count):
            bullet.stepSimulation(physicsClientId=self.client)
            self.show()

    @property
    def is_watched(self) -> bool:
        """Whether somebody watches; see `watched`."""
        return self._after_step is not None

    def show(self) -> None:
        """Let who watches see the world as it is."""
        if self._after_step is not None:
            self._after_step()

    @contextlib.contextmanager
    def watched(self, after_step: Callable[[], None]) -> Iterator[None]:
        """Call `after_step` after each simulation step and with each `show`, until the `with` statement ends."""
        self._after_step = after_step
        try:
            yield
        finally:
            self._after_step = None

    def load_urdf(
        self, path: Path, *, fixed: bool = False, rigid: bool = False, flags: int = 0, position: Vector = (0, 0, 0)
    ) -> "Body":
        """Load a URDF with the inertia its file states; `rigid` makes a single link a plain, cheaper rigid body."""
        flags |= bullet.URDF_USE_INERTIA_FROM_FILE | bullet.URDF_ENABLE_CACHED_GRAPHICS_SHAPES
        number = bullet.loadURDF(
            str(path),
            basePosition=position,
            useMaximalCoordinates=rigid,
            useFixedBase=fixed,
            flags=flags,
            physicsClientId=self.client,
        )
        return Body(self, number)

    def add_box(self, half_extents: Vector, position: Vector, color: Vector) -> "Body":
        """Add an immovable box (half extents and position in metres, colour RGBA in 0..1)."""
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half_extents, physicsClientId=self.client)
        visual = bullet.createVisualShape(
            bullet.GEOM_BOX, halfExtents=half_extents, rgbaColor=color, physicsClientId=self.client
        )
        return Body(self, self._fixed_body(shape, visual, position))

    def add_picture(self, half_extents: Vector, position: Vector, color: Vector) -> "Body":
        """Add an immovable box that nothing collides with (half extents and position in metres, RGBA in 0..1)."""
        visual = bullet.createVisualShape(
            bullet.GEOM_BOX, halfExtents=half_extents, rgbaColor=color, physicsClientId=self.client
        )
        return Body(self, self._fixed_body(-1, visual, position))

    def _fixed_body(self, shape: int, visual: int, position: Vector) -> int:
        number: int = bullet.createMultiBody(
            0, shape, visual, position, useMaximalCoordinates=True, physicsClientId=self.client
        )
        return number

    def close(self) -> None:
        """Disconnect; closing twice does nothing."""
        if self.client >= 0:
            bullet.disconnect(physicsClientId=self.client)
            self.client = -1

    def __enter__(self) -> "World":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Body:
    """One rigid or articulated body of a world."""

    def __init__(self, world: World, number: int) -> None:
        self.world, self.number = world, number

    def pose(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return T_world_body as position (3, metres) and quaternion (4, xyzw)."""
        position, orientation = bullet.getBasePositionAndOrientation(self.number, physicsClientId=self.world.client)
        return position, orientation

    def set_pose(self, position: Vector, orientation: Vector) -> None:
        """Put the body somewhere, at rest."""
        client = self.world.client
        bullet.resetBasePositionAndOrientation(self.number, position, orientation, physicsClientId=client)
        bullet.resetBaseVelocity(self.number, (0, 0, 0), (0, 0, 0), physicsClientId=client)

    def speed(self) -> float:
        """Return the greatest component of velocity, metres a second; turns count at a radius of 0.03 m."""
        linear, angular = bullet.getBaseVelocity(self.number, physicsClientId=self.world.client)
        return float(max(max(map(abs, linear)), 0.03 * max(map(abs, angular))))

    def apex(self) -> float:
        """Return the height that the body's centre reaches in free flight, metres."""
        client = self.world.client
        rising = bullet.getBaseVelocity(self.number, physicsClientId=client)[0][2]
        return float(self.pose()[0][2] + max(0.0, rising) ** 2 / (2.0 * _GRAVITY))

    def change_dynamics(self, link: int = -1, **values: Any) -> None:
        """Set dynamics properties of a link (-1 is the base); names as in PyBullet."""
        bullet.changeDynamics(self.number, link, physicsClientId=self.world.client, **values)

    def bounds(self, link: int = -1) -> tuple[np.ndarray, np.ndarray]:
        """Return the axis-aligned bounds of a link in the world, metres, grown by Bullet's contact margin."""
        low, high = bullet.getAABB(self.number, link, physicsClientId=self.world.client)
        return np.asarray(low), np.asarray(high)
