"""Videos of evaluated episodes: the same scenes and decisions as in the evaluation, filmed while the arm moves.

Filming changes nothing: the camera reads the world, and decisions are still made on the small observation.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from graspq.common.errors import UserError
from graspq.common.files import committed
from graspq.common.machine import one_thread
from graspq.evaluate.rollout import Rollouts
from graspq.objects.object_set import ObjectSet

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


def film_episode(simulation: "GraspSimulation", rollouts: Rollouts, episode: int, size: int) -> tuple[np.ndarray, bool]:
    """Play one episode as the evaluation did, and film it.

    Args:
        simulation: of the scenes' task and objects.
        rollouts: scenes and policy.
        episode: index of the episode.
        size: width and height in pixels.

    Returns:
        uint8 [F, size, size, 3] frames, and whether the grasp succeeded.
    """
    frames: list[np.ndarray] = []
    steps = 0

    def film() -> None:
        nonlocal steps
        steps += 1
        if steps % STEPS_PER_FRAME == 0:
            frames.append(simulation.render(size))

    rollouts.scenes.begin(simulation, episode)
    frames += [simulation.render(size)] * PAUSE
    with simulation.world.watched(film):
        played = rollouts.play(simulation, episode)
    frames += [simulation.render(size)] * 2 * PAUSE
    return _bordered(np.stack(frames), played.success), played.success


def _bordered(frames: np.ndarray, success: bool) -> np.ndarray:
    """Mark the end of an episode with a border: green for success, red for failure."""
    width = max(2, frames.shape[1] // 64)
    for frame in frames[-2 * PAUSE :]:
        for edge in (frame[:width], frame[-width:], frame[:, :width], frame[:, -width:]):
            edge[:] = _BORDER[success]
    return frames


def write_video(path: Path, rollouts: Rollouts, *, episodes: int, size: int) -> list[bool]:
    """Film the first episodes of an evaluation into an MP4 or GIF; return which of them succeeded.

    Raises:
        UserError: the ending is unknown or the file cannot be written.
    """
    check_video_path(path)
    from graspq.sim.episode import GraspSimulation

    objects = ObjectSet.load(rollouts.scenes.objects)
    with one_thread(), GraspSimulation(rollouts.scenes.task, objects) as simulation:
        filmed = [film_episode(simulation, rollouts, episode, size) for episode in range(episodes)]
    try:
        with committed(path) as temporary:
            _encode(temporary, np.concatenate([frames for frames, _ in filmed]))
    except OSError as error:
        raise UserError(f"{path}: cannot write the video here ({error}); choose another --video") from None
    return [success for _, success in filmed]


def _encode(path: Path, frames: np.ndarray) -> None:
    """Write uint8 [F, H, W, 3] in the format that the path's ending names."""
    import imageio.v2 as imageio

    if path.suffix.lower() == ".gif":
        # GIF counts in hundredths of a second and players slow down below two: every second frame, at 15 a second.
        imageio.mimsave(path, list(frames[::2]), format="GIF", duration=2000 / FRAMES_PER_SECOND, loop=0)
    else:
        imageio.mimsave(path, list(frames), format="FFMPEG", fps=FRAMES_PER_SECOND, codec="libx264", macro_block_size=2)
