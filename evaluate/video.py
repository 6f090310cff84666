"""Videos of evaluated episodes: the same scenes and decisions as in the evaluation, filmed while the arm moves.

Filming changes nothing: the camera reads the world, and decisions are still made on the small observation.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graspq.common.errors import UserError
from graspq.common.files import committed
from graspq.common.seeding import generator
from graspq.evaluate.policies import Policy
from graspq.evaluate.workers import Stage, begin_episode

if TYPE_CHECKING:
    from graspq.sim.episode import GraspSimulation

FRAMES_PER_SECOND = 30
STEPS_PER_FRAME = 4  # of the simulation's 240 a second: half the real speed, in which a grasp can be followed
PAUSE = 15  # frames that the first and the last view of an episode are held
FORMATS = (".mp4", ".gif")
_BORDER = {True: (38, 160, 96), False: (200, 62, 48)}


def check_video_path(path: Path) -> None:
    """Refuse a video that could not be written, before anything is run.

    Raises:
        UserError: its ending is neither .mp4 nor .gif.
    """
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"--video: {path} should end in {' or '.join(FORMATS)}")


class _Filming:
    """Takes a frame after every few simulation steps of a simulation, while it is entered."""

    def __init__(self, simulation: "GraspSimulation", size: int) -> None:
        self.simulation, self.size = simulation, size
        self.frames: list[np.ndarray] = []
        self._steps = 0
        self._advance = simulation.world.step

    def shoot(self, times: int = 1) -> None:
        """Add the present view."""
        self.frames += [self.simulation.render(self.size)] * times

    def _step(self, count: int = 1) -> None:
        for _ in range(count):
            self._advance(1)
            self._steps += 1
            if self._steps % STEPS_PER_FRAME == 0:
                self.shoot()

    def __enter__(self) -> "_Filming":
        # All motion of an episode passes through the world's step: standing in for it shows every moment.
        self.simulation.world.step = self._step  # type: ignore[method-assign]
        return self

    def __exit__(self, *error: Any) -> None:
        self.simulation.world.step = self._advance  # type: ignore[method-assign]


def film_episode(
    simulation: "GraspSimulation", stage: Stage, policy: Policy | None, episode: int, environments: int, size: int
) -> tuple[np.ndarray, bool]:
    """Run one episode as the evaluation did, and film it.

    Args:
        simulation: of the stage's task and objects.
        stage: what determines the scenes.
        policy: who decides; None for the oracle.
        episode: index of the episode.
        environments: rows of the evaluation's batches, so that every decision comes out the same.
        size: width and height in pixels.

    Returns:
        uint8 [F, size, size, 3] frames, and whether the grasp succeeded.
    """
    from graspq.policies.oracle import Oracle

    seen = begin_episode(simulation, simulation.objects, stage.split, stage.seed, episode)
    rngs: list[np.random.Generator | None] = [None] * environments
    row, oracle = episode % environments, Oracle()
    rngs[row] = generator("evaluate/policy", stage.seed, episode)
    images = np.zeros((environments, *seen.image.shape), dtype=np.uint8)
    steps = np.zeros(environments, dtype=np.int64)
    poses = np.zeros((environments, 4), dtype=np.float32)
    if policy is None:
        oracle.begin(simulation)
    with _Filming(simulation, size) as filming:
        filming.shoot(PAUSE)
        while True:
            images[row], steps[row] = seen.image, seen.step
            poses[row] = seen.gripper_pose
            if policy is None:
                action = oracle.act(seen, np.random.default_rng(0))
            else:
                action = policy.decide(images, steps, rngs, poses).actions[row]
            outcome = simulation.step(action)
            seen = outcome.observation
            if outcome.terminated:
                break
        filming.shoot(2 * PAUSE)
    success = bool(outcome.info["success"])
    return _bordered(np.stack(filming.frames), success), success


def _bordered(frames: np.ndarray, success: bool) -> np.ndarray:
    """Mark the end of an episode with a border: green for success, red for failure."""
    width = max(2, frames.shape[1] // 64)
    for frame in frames[-2 * PAUSE :]:
        for edge in (frame[:width], frame[-width:], frame[:, :width], frame[:, -width:]):
            edge[:] = _BORDER[success]
    return frames


def write_video(
    path: Path, stage: Stage, policy: Policy | None, *, episodes: int, environments: int, size: int
) -> list[bool]:
    """Film the first episodes of an evaluation into an MP4 or GIF; return which of them succeeded.

    Raises:
        UserError: the ending is unknown or the file cannot be written.
    """
    check_video_path(path)
    from graspq.evaluate.workers import quiet_errors

    with quiet_errors():
        from graspq.sim.episode import GraspSimulation
    from graspq.objects.object_set import ObjectSet
    from graspq.sim.task import task_from_json

    reels, successes = [], []
    with GraspSimulation(task_from_json(stage.task), ObjectSet.load(Path(stage.objects))) as simulation:
        for episode in range(episodes):
            frames, success = film_episode(simulation, stage, policy, episode, environments, size)
            reels.append(frames)
            successes.append(success)
    try:
        with committed(path) as temporary:
            _encode(temporary, np.concatenate(reels))
    except OSError as error:
        raise UserError(f"{path}: cannot write the video here ({error}); choose another --video") from None
    return successes


def _encode(path: Path, frames: np.ndarray) -> None:
    """Write uint8 [F, H, W, 3] in the format that the path's ending names."""
    import imageio.v2 as imageio

    if path.suffix.lower() == ".gif":
        # GIF counts in hundredths of a second and players slow down below two: every second frame, at 15 a second.
        imageio.mimsave(path, list(frames[::2]), format="GIF", duration=2000 / FRAMES_PER_SECOND, loop=0)
    else:
        imageio.mimsave(path, list(frames), format="FFMPEG", fps=FRAMES_PER_SECOND, codec="libx264", macro_block_size=2)
