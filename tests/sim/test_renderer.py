"""Pictures, depths and masks of scenes whose answer is known; nothing here needs PyBullet."""

import hashlib
import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from graspq.sim.camera import Camera
from graspq.sim.observation import STILL
from graspq.sim.renderer import Part, Renderer, box

CAMERA = Camera()
FLOOR = box((0.3, 0.3, 0.01), (0.55, 0.0, -0.01), (0.8, 0.8, 0.8))
WALL = box((0.2, 0.01, 0.03), (0.55, 0.15, 0.03), (0.4, 0.5, 0.6))
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# Of `digests`, on every x86-64 machine.
PINNED = "936d8ad4ba8ac9bcd5a4665ce8164bba4c9b5c95530a07d07acb13e65fcb4213"


def tumbling(count, seed):
    """Return boxes and lopsided tetrahedra of all colours, and their poses."""
    rng = np.random.default_rng(seed)
    parts, poses = [], []
    for label in range(count):
        color = rng.uniform(0, 1, 3)
        if label % 2:
            parts.append(replace(box(rng.uniform(0.005, 0.04, 3), (0, 0, 0), color), label=label))
        else:
            corners = rng.uniform(-0.06, 0.06, (4, 3))
            a, b, c, d = corners
            faces = np.array([(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)])
            outward = np.dot(np.cross(b - a, c - a), d - a) < 0
            parts.append(Part(corners, faces if outward else faces[:, ::-1], color, label))
        turn = rng.normal(size=4)
        poses.append([*rng.uniform((0.4, -0.2, 0.0), (0.7, 0.2, 0.3)), *(turn / np.linalg.norm(turn))])
    return parts, np.array(poses)


def mirrored(part):
    return replace(part, vertices=np.asarray(part.vertices) * (1, -1, 1), faces=np.asarray(part.faces)[:, ::-1])


def digests():
    """Return one digest of pictures, depths and masks of three sizes."""
    digest = hashlib.sha256()
    renderer = Renderer(CAMERA, [FLOOR, WALL])
    for seed, size in enumerate((64, 48, 100)):
        parts, poses = tumbling(12, seed)
        renderer.hold(parts)
        for found in (renderer.image(poses, size), *renderer.depth_and_mask(poses, size)):
            digest.update(found.tobytes())
    return digest.hexdigest()


def ray(size):
    """Return the direction of each pixel's ray, for a way of 1 along the camera's axis, float [size, size, 3]."""
    x, z = CAMERA.target[0] - CAMERA.eye[0], CAMERA.target[2] - CAMERA.eye[2]
    forward = np.array([x, 0.0, z]) / math.hypot(x, z)
    down = np.array([-forward[2], 0.0, forward[0]])
    slope = (2 * np.arange(size) + 1 - size) / size * CAMERA.half_view
    return forward + slope[:, None, None] * down + slope[None, :, None] * np.array([0.0, 1.0, 0.0])


@pytest.mark.parametrize("size", [64, 50, 256])
def test_a_mirrored_scene_gives_the_mirrored_picture_depth_and_mask_bit_for_bit(size):
    sign = np.array([1, -1, 1, -1, 1, -1, 1])
    for seed in range(6):
        parts, poses = tumbling(24, seed)
        usual, other = Renderer(CAMERA, [FLOOR, WALL]), Renderer(CAMERA, [mirrored(FLOOR), mirrored(WALL)])
        usual.hold(parts)
        other.hold([mirrored(part) for part in parts])
        seen = (usual.image(poses, size), *usual.depth_and_mask(poses, size))
        there = (other.image(poses * sign, size), *other.depth_and_mask(poses * sign, size))
        for one, two in zip(seen, there, strict=True):
            assert np.array_equal(one, two[:, ::-1])
        assert not np.array_equal(seen[0], seen[0][:, ::-1])


def test_a_box_in_the_middle_looks_the_same_from_both_sides():
    renderer = Renderer(CAMERA, [FLOOR])
    renderer.hold([box((0.03, 0.05, 0.02), (0, 0, 0), (0.9, 0.2, 0.1))])
    image = renderer.image(np.array([[0.55, 0.0, 0.02, *UPRIGHT]]), 64)
    assert np.array_equal(image, image[:, ::-1])


def test_depth_is_the_way_along_the_axis_to_the_planes_of_a_floor_and_a_box():
    renderer = Renderer(CAMERA, [FLOOR])
    renderer.hold([box((0.05, 0.05, 0.04), (0, 0, 0), (1, 0, 0))])
    depth, _ = renderer.depth_and_mask(np.array([[0.55, 0.0, 0.04, *UPRIGHT]]), 64)
    assert depth.dtype == np.float32 and depth.shape == (64, 64)
    rays, eye, best = ray(64), np.array(CAMERA.eye), np.full((64, 64), 10.0)
    floor, top, front = (2, 0.0), (2, 0.08), (0, 0.6)
    for (axis, place), x, y, z in (
        (floor, (0.25, 0.85), (-0.3, 0.3), (-1, 1)),
        (top, (0.5, 0.6), (-0.05, 0.05), (-1, 1)),
        (front, (-1, 1), (-0.05, 0.05), (0.0, 0.08)),
    ):
        way = (place - eye[axis]) / rays[..., axis]
        there = eye + way[..., None] * rays
        low, high = np.array([x, y, z]).T
        best = np.where(((there > low) & (there < high)).all(axis=-1), np.minimum(best, way), best)
    wrong = np.abs(np.minimum(depth, 10.0) - best) > 5e-5
    assert wrong.sum() <= 2, "pixels whose middle lies within 1/512 of a pixel of an edge"
    assert best.min() == pytest.approx(0.85, abs=0.01) and np.isinf(depth[best == 10.0]).any()


def test_the_mask_says_which_part_is_seen_and_nearer_parts_hide_others_in_any_order():
    parts = [replace(box((0.05, 0.05, 0.01), (0, 0, 0), (1, 0, 0)), label=label) for label in (7, 3)]
    poses = np.array([[0.55, 0.0, 0.05, *UPRIGHT], [0.55, 0.05, 0.10, *UPRIGHT]])
    masks, images = [], []
    for order in ([0, 1], [1, 0]):
        renderer = Renderer(CAMERA, [FLOOR])
        renderer.hold([parts[index] for index in order])
        masks.append(renderer.depth_and_mask(poses[order], 64)[1])
        images.append(renderer.image(poses[order], 64))
    assert np.array_equal(masks[0], masks[1]) and np.array_equal(images[0], images[1])
    assert set(np.unique(masks[0])) == {STILL, 3, 7}
    assert masks[0].dtype == np.int32
    alone = Renderer(CAMERA, [FLOOR])
    for label, index in ((7, 0), (3, 1)):
        alone.hold([parts[index]])
        covered = alone.depth_and_mask(poses[[index]], 64)[1] == label
        seen = masks[0] == label
        assert not (seen & ~covered).any()
        assert (seen.sum() < covered.sum()) == (label == 7), "the lower one is partly hidden, the higher one is not"


def test_a_shadow_falls_away_from_the_light_and_darkens_what_it_falls_on():
    camera = replace(CAMERA, light=(-1.0, 0.0, 1.0))
    renderer, unshaded = Renderer(camera, [FLOOR]), Renderer(replace(camera, shaded=1.0), [FLOOR])
    floating = [box((0.03, 0.03, 0.005), (0, 0, 0), (0.2, 0.9, 0.3))]
    renderer.hold(floating)
    unshaded.hold(floating)
    pose = np.array([[0.60, 0.0, 0.1, *UPRIGHT]])
    dark = (renderer.image(pose, 128) != unshaded.image(pose, 128)).any(axis=-1)
    way = CAMERA.eye[2] / -ray(128)[..., 2]
    x, y = (np.array(CAMERA.eye)[:2] + way[..., None] * ray(128)[..., :2]).transpose(2, 0, 1)
    assert dark.sum() > 100
    # The light comes at 45 degrees: what is 0.1 above the floor throws its shadow 0.1 towards +x.
    assert abs(x[dark].mean() - 0.70) < 0.01 and abs(y[dark].mean()) < 0.002
    assert x[dark].max() - x[dark].min() == pytest.approx(0.07, abs=0.015)
    lit, shadowed = unshaded.image(pose, 128)[dark].mean(), renderer.image(pose, 128)[dark].mean()
    facing = math.sqrt(0.5)
    expected = (camera.ambient + camera.diffuse * camera.shaded * facing) / (camera.ambient + camera.diffuse * facing)
    assert shadowed / lit == pytest.approx(expected, abs=0.05)


def test_what_faces_the_light_does_not_shade_itself():
    for turn in (0.0, 0.1, 0.3, -0.2):
        pose = np.array([[0.55, 0.02, 0.2, math.sin(turn), 0.0, 0.0, math.cos(turn)]])
        part = box((0.1, 0.1, 0.03), (0, 0, 0), (0.9, 0.9, 0.9))
        usual, unshaded = Renderer(CAMERA, []), Renderer(replace(CAMERA, shaded=1.0), [])
        for renderer in (usual, unshaded):
            renderer.hold([part])
        assert np.abs(usual.image(pose, 64).astype(int) - unshaded.image(pose, 64)).max() <= 1


def test_a_face_that_reaches_behind_the_camera_is_left_out():
    renderer = Renderer(replace(CAMERA, shaded=1.0), [FLOOR])
    alone = renderer.image(np.zeros((0, 7)), 64)
    renderer.hold([box((0.005, 0.005, 0.005), (0, 0, 0), (1, 0, 0)), box((0.01, 0.01, 0.01), (0, 0, 0), (1, 0, 0))])
    poses = np.array([[*CAMERA.eye, *UPRIGHT], [1e9, 1e9, 1e9, *UPRIGHT]])
    assert np.array_equal(renderer.image(poses, 64), alone)


def test_poses_and_faces_that_do_not_fit_are_refused():
    renderer = Renderer(CAMERA, [FLOOR])
    renderer.hold([FLOOR])
    for draw in (renderer.image, renderer.depth_and_mask):
        with pytest.raises(ValueError, match=r"shape \[1, 7\], got \[2, 7\]"):
            draw(np.zeros((2, 7)), 64)
    with pytest.raises(ValueError, match=r"corners 0 \.\. 9 of 3"):
        renderer.hold([Part(np.eye(3), np.array([[0, 1, 9]]), (1, 1, 1))])


def test_pictures_are_smooth_at_edges_and_of_the_parts_colours_inside():
    renderer = Renderer(replace(CAMERA, ambient=1.0, diffuse=0.0), [])
    renderer.hold([box((0.04, 0.04, 0.04), (0, 0, 0), (1.0, 0.5, 0.0))])
    image = renderer.image(np.array([[0.55, 0.0, 0.05, 0.0, 0.0, math.sin(0.2), math.cos(0.2)]]), 64)
    colours = {tuple(colour) for colour in image.reshape(-1, 3).tolist()}
    assert colours == {(2, 2, 2), (62, 30, 2), (126, 62, 2), (190, 94, 2), (254, 126, 2)}


def test_the_bytes_are_the_pinned_ones():
    assert digests() == PINNED


SCRIPT = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("scenes", sys.argv[1])
scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(scenes)
from graspq.sim import rasteriser
print(scenes.digests(), sum(sum(f.stats.cache_misses.values()) for f in (rasteriser.fill, rasteriser.shade)))
"""


def in_another_process(folder, **environment):
    command = [sys.executable, "-c", SCRIPT, __file__]
    environment = {**os.environ, "NUMBA_CACHE_DIR": "", "XDG_CACHE_HOME": str(folder), **environment}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    digest, compiled = done.stdout.split()
    return digest, int(compiled)


def test_a_process_compiled_for_the_plainest_processor_gives_the_same_bytes_and_the_next_one_compiles_nothing(tmp_path):
    plainest = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""}
    assert in_another_process(tmp_path, **plainest) == (PINNED, 2)
    assert in_another_process(tmp_path, **plainest) == (PINNED, 0)
    assert (tmp_path / "graspq" / "numba").is_dir()
