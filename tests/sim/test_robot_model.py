import numpy as np
import pytest
import trimesh

from graspq.sim import robot_model
from graspq.sim.bullet import bullet
from graspq.sim.world import World


@pytest.mark.parametrize("normals", list(robot_model._SYMMETRY.values()))
def test_a_symmetric_hull_equals_its_mirror_image(normals):
    points = np.random.default_rng(0).normal(size=(200, 3)) * [0.05, 0.03, 0.08]
    hull = robot_model.symmetric_hull(points, normals)
    for normal in normals:
        direction = np.asarray(normal, dtype=float)
        mirrored = hull.vertices - 2 * (hull.vertices @ direction)[:, None] * direction
        distances = np.linalg.norm(mirrored[:, None] - hull.vertices[None], axis=2).min(axis=1)
        assert distances.max() < 1e-6


def test_the_light_panda_has_few_faces_and_collides_with_hand_and_fingers_alone():
    folder = robot_model.panda_urdf().parent
    faces = [len(trimesh.load(path, force="mesh").faces) for path in folder.glob("*.obj")]
    assert len(faces) == 10
    assert max(faces) <= 100
    text = robot_model.panda_urdf().read_text()
    assert text.count("<collision") == 3
    assert text.count("<box") == 2


def test_what_is_drawn_are_the_links_of_the_urdf_with_its_colours_and_one_finger_is_the_others_mirror_image():
    drawn = robot_model.visible_links()
    assert [visible.link for visible in drawn] == [0, 1, 2, 3, 4, 5, 6, 8, 9, 10]
    colors = {visible.link: visible.color for visible in drawn}
    world = World(time_step=1 / 240, solver_iterations=1)
    number = world.load_urdf(robot_model.panda_urdf(), fixed=True).number
    shapes = {shape[1]: shape for shape in bullet.getVisualShapeData(number, physicsClientId=world.client)}
    assert set(shapes) == {-1, *colors}
    for link, color in colors.items():
        assert shapes[link][7] == pytest.approx(color)
    first, second = drawn[-2:]
    assert {tuple(corner) for corner in first.vertices * (1, -1, 1)} == {tuple(corner) for corner in second.vertices}
    world.close()


def test_the_model_is_made_once_in_the_users_cache_and_is_the_same_when_made_again(tmp_path, monkeypatch):
    made = robot_model.panda_urdf()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    robot_model.panda_urdf.cache_clear()
    again = robot_model.panda_urdf()
    assert again.is_relative_to(tmp_path) and again.parent.name == made.parent.name
    for path in made.parent.iterdir():
        assert (again.parent / path.name).read_bytes() == path.read_bytes()
    before = again.stat()
    robot_model.panda_urdf.cache_clear()
    assert robot_model.panda_urdf().stat() == before
    monkeypatch.undo()
    robot_model.panda_urdf.cache_clear()
