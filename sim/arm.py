"""The Panda under Cartesian position control, its gripper vertical.

Set-points run along straight lines with eased speed, one a simulation step, through the closed-form kinematics; motors
do the rest. Where the gripper meets nothing on its way the arm may be put there without being simulated.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from graspq.sim import kinematics, robot_model
from graspq.sim.bullet import bullet
from graspq.sim.clearance import Boxes
from graspq.sim.task import TaskSettings
from graspq.sim.world import Body, World

_PARKED = (0.45, 0.0, 0.55, 0.0)  # over the bin and out of the way of falling objects
_ARM_FORCE = 150.0  # newton metres, more than the real arm's so that set-points are followed
_ARM_GAIN = 0.35
_FINGER_SPEED = 0.3  # metres a second
_TCP_LINK = 11
_ASK_EVERY = 6  # simulation steps


class Arm:
    """Arm and parallel-jaw gripper; poses are (x, y, z, phi): metres in the world, radians about z, unwrapped."""

    def __init__(self, world: World, task: TaskSettings) -> None:
        self.task = task
        self.client = world.client
        self.world = world
        self.body = world.load_urdf(robot_model.panda_urdf(), fixed=True)
        self.number = self.body.number
        self.fingers = robot_model.FINGER_LINKS
        # No shape of the arm touches another one; only hand and fingers have any.
        for finger in self.fingers:
            self.body.change_dynamics(
                finger,
                lateralFriction=task.finger_friction,
                spinningFriction=task.rolling_friction,
                rollingFriction=0.0,
                restitution=0.0,
            )
        self.place((*self.home()[:3], 0.0))
        self.gripper = Boxes([self._bounds(link) for link in (robot_model.HAND_LINK, *self.fingers)])
        self.between_pads = Boxes([self._between_pads()])

    def _bounds(self, link: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of a link relative to the tool centre point."""
        low, high = self.body.bounds(link)
        return low - self.commanded[:3], high - self.commanded[:3]

    def _between_pads(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of what the open fingers sweep as they close, themselves included."""
        lows, highs = zip(*(self._bounds(finger) for finger in self.fingers), strict=True)
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def home(self) -> np.ndarray:
        """Return the pose at which an episode starts."""
        return np.array([self.task.bin_center_x, 0.0, self.task.home_height, 0.0])

    def place(self, pose: Sequence[float] | np.ndarray, *, open_gripper: bool = True) -> None:
        """Put the arm at a pose at once, at rest, awake, the gripper open or closed."""
        self.body.change_dynamics(
            activationState=bullet.ACTIVATION_STATE_WAKE_UP | bullet.ACTIVATION_STATE_DISABLE_SLEEPING
        )
        self.commanded = np.array(pose, dtype=float)
        self._joints = kinematics.joint_angles(*self.commanded)
        for joint, angle in zip(robot_model.ARM_JOINTS, self._joints, strict=True):
            bullet.resetJointState(self.number, joint, angle, 0.0, physicsClientId=self.client)
        opening = robot_model.FINGER_OPENING if open_gripper else 0.0
        for finger in self.fingers:
            bullet.resetJointState(self.number, finger, opening, 0.0, physicsClientId=self.client)
        self._hold(self._joints, (0.0,) * 7)
        self.grip(open_gripper=open_gripper)

    def park(self) -> None:
        """Put the arm where no falling object can meet it, asleep until `place`: a sleeping arm costs no time."""
        self.place(_PARKED)
        self.body.change_dynamics(
            activationState=bullet.ACTIVATION_STATE_SLEEP | bullet.ACTIVATION_STATE_ENABLE_SLEEPING
        )

    def grip(self, *, open_gripper: bool) -> None:
        """Command the fingers; they move while simulation steps pass."""
        goal = robot_model.FINGER_OPENING if open_gripper else 0.0
        for finger in self.fingers:
            bullet.setJointMotorControl2(
                self.number,
                finger,
                bullet.POSITION_CONTROL,
                targetPosition=goal,
                positionGain=0.3,
                velocityGain=1.0,
                force=self.task.finger_force,
                maxVelocity=_FINGER_SPEED,
                physicsClientId=self.client,
            )

    def move(
        self,
        pose: Sequence[float] | np.ndarray,
        steps: int,
        hold: int = 0,
        is_in_vain: Callable[[], bool] | None = None,
    ) -> bool:
        """Move in a straight line to a pose in `steps` simulation steps, then hold it for `hold` more.

        Args:
            pose: where to.
            steps: of the way.
            hold: at its end.
            is_in_vain: asked every few steps on the way whether to stop there.

        Returns:
            Whether the arm went all the way.
        """
        for index, here in enumerate(self._way(pose, steps), start=1):
            joints = kinematics.joint_angles(*here)
            speeds = [(now - before) / self.world.time_step for now, before in zip(joints, self._joints, strict=True)]
            self._hold(joints, speeds)
            self._joints = joints
            self.world.step()
            if is_in_vain is not None and index % _ASK_EVERY == 0 and is_in_vain():
                self.commanded = np.array(here)
                return False
        if hold > 0:
            self._hold(self._joints, (0.0,) * 7)
            self.world.step(hold)
        self.commanded = np.array(pose, dtype=float)
        return True

    def carry(self, pose: Sequence[float] | np.ndarray, steps: int, *, open_gripper: bool = True) -> None:
        """Put the arm at a pose, at rest; whoever watches the world sees the way that `move` would take."""
        if self.world.is_watched:
            for here in list(self._way(pose, steps))[:-1]:
                self.place(here, open_gripper=open_gripper)
                self.world.show()
        self.place(pose, open_gripper=open_gripper)
        self.world.show()

    def _way(self, pose: Sequence[float] | np.ndarray, steps: int) -> Iterator[list[float]]:
        """Yield `steps` poses along the straight line from the commanded pose to another one, which comes last."""
        # Plain numbers: NumPy's overhead on four of them would be felt at 240 set-points a second.
        start, goal = self.commanded.tolist(), [float(value) for value in pose]
        way = [there - here for here, there in zip(start, goal, strict=True)]
        for index in range(1, steps + 1):
            # Cosine easing: a jump in speed would jerk objects out of the gripper.
            eased = 0.5 - 0.5 * math.cos(math.pi * index / steps)
            yield [here + part * eased for here, part in zip(start, way, strict=True)]

    def _hold(self, joints: Sequence[float], speeds: Sequence[float]) -> None:
        bullet.setJointMotorControlArray(
            self.number,
            robot_model.ARM_JOINTS,
            bullet.POSITION_CONTROL,
            targetPositions=joints,
            targetVelocities=speeds,
            positionGains=(_ARM_GAIN,) * 7,
            velocityGains=(1.0,) * 7,
            forces=(_ARM_FORCE,) * 7,
            physicsClientId=self.client,
        )

    def pose(self) -> np.ndarray:
        """Return the measured pose of the tool centre point, float64 [4]."""
        link = bullet.getLinkState(self.number, _TCP_LINK, computeForwardKinematics=1, physicsClientId=self.client)
        base = bullet.getJointState(self.number, 0, physicsClientId=self.client)[0]
        wrist = bullet.getJointState(self.number, 6, physicsClientId=self.client)[0]
        return np.array([*link[4], kinematics.wrist_turn(base, wrist)])

    def link_poses(self) -> list[tuple[float, ...]]:
        """Return the pose of each of `robot_model.visible_links`: position (metres) and quaternion (xyzw)."""
        links = [visible.link for visible in robot_model.visible_links()]
        states = bullet.getLinkStates(self.number, links, computeForwardKinematics=1, physicsClientId=self.client)
        return [state[4] + state[5] for state in states]

    def finger_gap(self) -> float:
        """Return the distance between the pads, metres."""
        client = self.client
        return float(sum(bullet.getJointState(self.number, f, physicsClientId=client)[0] for f in self.fingers))

    def tip_height(self) -> float:
        """Return the measured height of the finger tips, metres."""
        return float(self.pose()[2] + (self.gripper.centers - self.gripper.halves)[:, 2].min())

    def is_touching(self, bodies: Sequence[Body]) -> bool:
        """Return whether hand or fingers touched one of the bodies in the last simulation step."""
        contacts = bullet.getContactPoints(bodyA=self.number, physicsClientId=self.client)
        numbers = {body.number for body in bodies}
        return any(contact[2] in numbers for contact in contacts)
