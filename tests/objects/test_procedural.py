import collections
import colorsys
import hashlib
from pathlib import Path

import networkx
import numpy as np
import pytest
import scipy.optimize

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.objects import procedural
from graspq.objects.geometry import Array, convex_hull, half_spaces, union_mass_properties
from graspq.objects.graspable import graspable_share
from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import COUNTS, LIMITS, main_family, make_procedural, procedural_object, thickness
from graspq.objects.shapes import FAMILIES, cuboid, rotation

SEED, TRAIN, TEST, VALIDATION = 7, 48, 8, 8


def _bytes(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _points(object_set: ObjectSet, object_id: str) -> Array:
    return np.concatenate([part.vertices for part in object_set.parts_of(object_id)])


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(small_set: ObjectSet, tmp_path: Path) -> None:
    again = make_procedural(tmp_path / "again", seed=SEED, train=TRAIN, test=TEST, validation=VALIDATION)
    assert _bytes(again.folder) == _bytes(small_set.folder)
    other = make_procedural(tmp_path / "other", seed=SEED + 1, train=1, test=1, validation=0)
    assert other["train_000"].sha256 != small_set["train_000"].sha256


def test_seed_zero_is_a_seed_and_a_smaller_set_is_the_beginning_of_a_larger_one(tmp_path: Path) -> None:
    small = make_procedural(tmp_path / "small", seed=0, train=2, test=1, validation=1)
    large = make_procedural(tmp_path / "large", seed=0, train=4, test=2, validation=2)
    for object_id in small.ids():
        assert small[object_id] == large[object_id]
    assert small.seed == 0


def test_the_first_object_of_each_family_has_the_bytes_that_published_numbers_were_made_with(tmp_path: Path) -> None:
    made = make_procedural(tmp_path / "set", seed=procedural.SEED, train=16, test=1, validation=0)
    digests = "".join(made[name].sha256[file] for name in made.ids("train") for file in sorted(made[name].sha256))
    assert hashlib.sha256(digests.encode()).hexdigest().startswith("ee2748ceb077d233")


def test_the_splits_have_the_asked_sizes_and_share_no_object(small_set: ObjectSet) -> None:
    assert small_set.ids("train") == tuple(f"train_{index:03d}" for index in range(TRAIN))
    assert small_set.ids("test") == tuple(f"test_{index:03d}" for index in range(TEST))
    assert small_set.ids("validation") == tuple(f"validation_{index:03d}" for index in range(VALIDATION))
    assert small_set.splits == ("train", "test", "validation")
    shapes = {(record.volume, record.inertia) for record in small_set.objects}
    meshes = {record.sha256[record.mesh] for record in small_set.objects}
    assert len(shapes) == len(meshes) == TRAIN + TEST + VALIDATION


def test_each_family_is_at_least_5_percent_of_each_split() -> None:
    for split, count in COUNTS.items():
        shares = collections.Counter(main_family(SEED, split, index) for index in range(count))
        assert set(shares) == set(FAMILIES)
        assert min(shares.values()) >= 0.05 * count


def test_held_out_families_have_no_part_in_training_and_the_test_is_of_them_alone(tmp_path: Path) -> None:
    names = ("cylinder", "bar")
    made = make_procedural(tmp_path / "set", seed=SEED, train=20, test=6, validation=6, held_out=names)
    families = {split: [made[name].families for name in made.ids(split)] for split in made.splits}
    seen = {family for of_object in families["train"] + families["validation"] for family in of_object}
    assert seen.isdisjoint(names)
    assert {of_object[0] for of_object in families["train"]} == set(FAMILIES) - set(names)
    assert {of_object[0] for of_object in families["test"]} == set(names)
    assert made.name == "procedural-without-bar-cylinder"


def test_an_unfiltered_set_has_objects_that_the_jaw_cannot_take(tmp_path: Path) -> None:
    made = make_procedural(tmp_path / "set", seed=SEED, train=24, test=1, validation=0, graspable=0.0)
    shares = [graspable_share(made.parts_of(name)) for name in made.ids("train")]
    assert min(shares) < 0.5 and max(shares) > 0.85
    assert made.name == "procedural-graspable0"


@pytest.mark.parametrize("held_out", [["egg"], list(FAMILIES)])
def test_an_unknown_family_and_holding_out_all_are_refused(tmp_path: Path, held_out: list[str]) -> None:
    with pytest.raises(UserError, match=r"--held-out-family.*choose some of box"):
        make_procedural(tmp_path / "set", seed=0, held_out=held_out)
    assert not list(tmp_path.iterdir())


def test_most_objects_are_unions_of_several_parts_but_of_few(small_set: ObjectSet) -> None:
    parts = [record.parts for record in small_set.objects]
    assert np.median(parts) in (2, 3)
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
        assert 0.999 * LIMITS.density[0] <= density <= 1.001 * LIMITS.density[1]


def test_principal_moments_obey_the_triangle_inequality(small_set: ObjectSet) -> None:
    for record in small_set.objects:
        assert 2 * max(record.inertia) < sum(record.inertia)


def test_sizes_masses_thicknesses_and_triangle_counts_are_within_the_limits_and_wide(small_set: ObjectSet) -> None:
    triangles = []
    for record in small_set.objects:
        parts = small_set.parts_of(record.object_id)
        assert 0.04 <= max(record.extents) <= 0.16
        assert 0.015 <= record.mass <= 0.15
        assert min(thickness(part) for part in parts) > 0.006
        triangles.append(sum(len(part.faces) for part in parts))
    lengths, masses = [max(record.extents) for record in small_set.objects], [r.mass for r in small_set.objects]
    assert np.quantile(lengths, 0.9) > 1.8 * np.quantile(lengths, 0.1)
    assert np.quantile(masses, 0.9) > 4 * np.quantile(masses, 0.1)
    assert np.median(triangles) <= 150
    assert max(triangles) <= 400


def test_the_thickness_of_a_bar_is_its_least_side() -> None:
    turned = cuboid((0.09, 0.03, 0.05)).vertices @ rotation(generator("tests/thickness")).T
    assert thickness(convex_hull(turned)) == pytest.approx(0.03)


def test_colours_are_dark_and_pale_grey_and_saturated_of_all_hues(small_set: ObjectSet) -> None:
    hue, saturation, value = np.array([colorsys.rgb_to_hsv(*record.color[:3]) for record in small_set.objects]).T
    assert {round(6 * angle) % 6 for angle in hue} == set(range(6))
    for share in (saturation, value):
        assert np.quantile(share, 0.1) < 0.45
        assert np.quantile(share, 0.9) > 0.75


def test_an_object_does_not_depend_on_the_others_made_before_it(small_set: ObjectSet) -> None:
    alone = procedural_object(SEED, "train", 17)
    assert alone.mass == small_set["train_017"].mass
    assert alone.inertia == small_set["train_017"].inertia


@pytest.mark.parametrize(("train", "test", "seed"), [(0, 1, 0), (1, 0, 0), (1, 1, -1)])
def test_counts_below_one_and_negative_seeds_are_refused(tmp_path: Path, train: int, test: int, seed: int) -> None:
    with pytest.raises(UserError, match="expected"):
        make_procedural(tmp_path / "set", seed=seed, train=train, test=test)
    assert not list(tmp_path.iterdir())
