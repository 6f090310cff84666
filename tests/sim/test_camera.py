"""What is not drawn, to save time, is nothing that the camera could see."""

import numpy as np
import pytest

from graspq.sim import cell, robot_model
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import TASKS

TASK = TASKS["regular"]


def frames(objects, sizes=(64, 256)):
    """Return frames with the gripper in all corners of the workspace, and in places inside it."""
    rng = np.random.default_rng(0)
    low, high = np.array(TASK.settings.workspace_bounds)
    corners = [np.where([corner >> axis & 1 for axis in range(4)], high, low) for corner in range(16)]
    with GraspSimulation(TASK, objects) as simulation:
        simulation.load(TASK.draw(objects, "test", rng))
        simulation.reset(rng)
        found = {size: [] for size in sizes}
        for pose in [*corners, *rng.uniform(low, high, (8, 4))]:
            simulation.arm.place(pose)
            for size in sizes:
                found[size].append(simulation.render(size))
        return {size: np.stack(pictures) for size, pictures in found.items()}


@pytest.fixture
def anew():
    robot_model.panda_urdf.cache_clear()
    yield
    robot_model.panda_urdf.cache_clear()


def test_the_whole_arm_over_a_whole_table_gives_the_same_pictures_bit_for_bit(regular_objects, monkeypatch, anew):
    usual = frames(regular_objects)
    monkeypatch.setattr(robot_model, "_OUT_OF_VIEW", ())
    robot_model.panda_urdf.cache_clear()

    def whole_table(world, x, bin_half):
        world.add_picture([((*cell._TABLE, 0.01), (0, 0, 0))], (x - cell._TABLE_BEHIND, 0, -0.022), cell._TABLE_COLOR)

    monkeypatch.setattr(cell, "_add_table", whole_table)
    for size, pictures in frames(regular_objects).items():
        assert np.array_equal(pictures, usual[size]), f"{size} pixels"


def test_the_next_link_is_seen_from_some_places(regular_objects, monkeypatch, anew):
    usual = frames(regular_objects, sizes=(64,))[64]
    monkeypatch.setattr(robot_model, "_OUT_OF_VIEW", (*robot_model._OUT_OF_VIEW, "link3", "link4"))
    robot_model.panda_urdf.cache_clear()
    assert not np.array_equal(frames(regular_objects, sizes=(64,))[64], usual)


def test_a_window_shows_the_arm_down_to_its_base():
    assert 'filename="link0.obj"' in robot_model.panda_urdf(whole=True).read_text()
    assert 'filename="link0.obj"' not in robot_model.panda_urdf().read_text()
    assert 'filename="link3.obj"' in robot_model.panda_urdf().read_text()
