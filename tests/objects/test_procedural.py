import collections
import colorsys
import hashlib
from pathlib import Path

import networkx
import numpy as np
import pytest
import scipy.optimize

from graspq.common.errors import UserError
from graspq.objects.geometry import Array, half_spaces, union_mass_properties
from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import LIMITS, main_family, make_procedural, procedural_object
from graspq.objects.resting import resting_poses
from graspq.objects.shapes import FAMILIES
from graspq.objects.targeted import PURPLE

GRIPPER_OPENING = 0.08
SEED, TRAIN, TEST = 7, 40, 8


def _bytes(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _points(object_set: ObjectSet, object_id: str) -> Array:
    return np.concatenate([part.vertices for part in object_set.parts_of(object_id)])


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(small_set: ObjectSet, tmp_path: Path) -> None:
    again = make_procedural(tmp_path / "again", seed=SEED, train=TRAIN, test=TEST)
    assert _bytes(again.folder) == _bytes(small_set.folder)
    other = make_procedural(tmp_path / "other", seed=SEED + 1, train=1, test=1)
    assert other["train_000"].sha256 != small_set["train_000"].sha256


def test_seed_zero_is_a_seed_and_a_smaller_set_is_the_beginning_of_a_larger_one(tmp_path: Path) -> None:
    small = make_procedural(tmp_path / "small", seed=0, train=2, test=1)
    large = make_procedural(tmp_path / "large", seed=0, train=4, test=2)
    for object_id in small.ids():
        assert small[object_id] == large[object_id]
    assert small.seed == 0


def test_the_first_object_of_each_family_has_the_bytes_that_published_numbers_were_made_with(tmp_path: Path) -> None:
    made = make_procedural(tmp_path / "set", seed=0, train=8, test=1)
    digests = "".join(made[name].sha256[file] for name in made.ids("train") for file in sorted(made[name].sha256))
    assert hashlib.sha256(digests.encode()).hexdigest().startswith("96fbbda6e7e3c14d")


def test_the_splits_have_the_asked_sizes_and_share_no_object(small_set: ObjectSet) -> None:
    assert small_set.ids("train") == tuple(f"train_{index:03d}" for index in range(TRAIN))
    assert small_set.ids("test") == tuple(f"test_{index:03d}" for index in range(TEST))
    assert small_set.splits == ("train", "test")
    shapes = {(record.volume, record.inertia) for record in small_set.objects}
    meshes = {record.sha256[record.mesh] for record in small_set.objects}
    assert len(shapes) == len(meshes) == TRAIN + TEST


def test_each_family_is_at_least_8_percent_of_the_full_set_and_of_each_split() -> None:
    for split, count in (("train", 900), ("test", 100)):
        shares = collections.Counter(main_family(0, split, index) for index in range(count))
        assert set(shares) == set(FAMILIES)
        assert min(shares.values()) >= 0.08 * count


def test_most_objects_are_unions_of_several_parts(small_set: ObjectSet) -> None:
    parts = collections.Counter(record.parts for record in small_set.objects)
    assert parts[1] < len(small_set) / 2
    assert set(parts) >= {1, 2, 3, 4}
    assert max(parts) <= 8


def test_every_part_on_disk_is_convex_watertight_and_outward(small_set: ObjectSet) -> None:
    for object_id in small_set.ids():
        parts = small_set.parts_of(object_id)
        assert len(parts) == small_set[object_id].parts
        for part in parts:
            planes = half_spaces(part)
            assert (planes[:, :3] @ part.vertices.T + planes[:, 3:]).max() < 1e-9
            assert part.is_watertight
            assert part.volume > 0
            # Each corner is a corner of the hull, to the grid of the file.
            normals = part.face_normals
            inward = (normals[:, None] * (part.vertices[None] - part.triangles[:, :1])).sum(axis=2)
            assert inward.max() < 5e-6


def test_the_parts_of_an_object_hang_together(small_set: ObjectSet) -> None:
    for object_id in small_set.ids():
        planes = [half_spaces(part) for part in small_set.parts_of(object_id)]
        graph = networkx.Graph()
        graph.add_nodes_from(range(len(planes)))
        for one in range(len(planes)):
            for two in range(one):
                both = np.vstack([planes[one], planes[two]])
                # A point within 1 micrometre of both: neighbouring pieces of a ring share a face.
                meets = scipy.optimize.linprog(np.zeros(3), both[:, :3], 1e-6 - both[:, 3], bounds=(None, None)).success
                graph.add_edges_from([(one, two)] * meets)
        assert networkx.is_connected(graph), object_id


def test_the_frame_is_the_centre_of_mass_with_principal_axes_and_the_record_tells_the_truth(
    small_set: ObjectSet,
) -> None:
    for record in small_set.objects:
        properties = union_mass_properties(small_set.parts_of(record.object_id))
        density = record.mass / record.volume
        inertia = density * properties.inertia
        assert properties.volume == pytest.approx(record.volume, rel=5e-5)
        np.testing.assert_allclose(properties.centre, 0, atol=1e-6)
        np.testing.assert_allclose(inertia, np.diag(record.inertia), atol=1e-4 * max(record.inertia))
        np.testing.assert_allclose(record.extents, np.ptp(_points(small_set, record.object_id), axis=0), atol=1e-9)
        assert LIMITS.density[0] <= density <= LIMITS.density[1]


def test_principal_moments_obey_the_triangle_inequality(small_set: ObjectSet) -> None:
    for record in small_set.objects:
        assert 2 * max(record.inertia) < sum(record.inertia)


def test_a_gripper_of_8_cm_can_take_the_objects_as_they_rest(small_set: ObjectSet) -> None:
    widths, heights, weights = [], [], []
    for object_id in small_set.ids():
        for pose in resting_poses(_points(small_set, object_id), np.zeros(3)):
            widths.append(pose.width)
            heights.append(pose.height)
            weights.append(pose.probability)
    share = np.array(weights) / sum(weights)
    assert max(widths) < GRIPPER_OPENING
    assert share[np.array(widths) <= 0.058].sum() > 0.95
    assert share[(np.array(widths) > 0.02) & (np.array(widths) < 0.05)].sum() > 0.7
    assert share[np.array(heights) >= 0.022].sum() > 0.95


def test_sizes_masses_and_triangle_counts_are_within_the_limits(small_set: ObjectSet) -> None:
    for record in small_set.objects:
        assert 0.045 <= max(record.extents) <= 0.11
        assert 0.018 <= record.mass <= 0.15
        assert sum(len(part.faces) for part in small_set.parts_of(record.object_id)) <= 200


def test_colours_are_bright_varied_and_never_the_purple_of_the_target(small_set: ObjectSet) -> None:
    hues = []
    for record in small_set.objects:
        hue, saturation, value = colorsys.rgb_to_hsv(*record.color[:3])
        assert saturation > 0.5
        assert value > 0.7
        assert not 0.65 < hue < 0.91
        hues.append(hue)
    assert 0.65 < colorsys.rgb_to_hsv(*PURPLE[:3])[0] < 0.91
    assert len({round(6 * hue) for hue in hues}) >= 5


def test_an_object_does_not_depend_on_the_others_made_before_it(small_set: ObjectSet) -> None:
    alone = procedural_object(SEED, "train", 17)
    assert alone.mass == small_set["train_017"].mass
    assert alone.inertia == small_set["train_017"].inertia


@pytest.mark.parametrize(("train", "test", "seed"), [(0, 1, 0), (1, 0, 0), (1, 1, -1)])
def test_counts_below_one_and_negative_seeds_are_refused(tmp_path: Path, train: int, test: int, seed: int) -> None:
    with pytest.raises(UserError, match="expected"):
        make_procedural(tmp_path / "set", seed=seed, train=train, test=test)
    assert not list(tmp_path.iterdir())
