"""Triangles to pixels: projecting, filling with a depth test, shading with a shadow map; compiled, and PyBullet-free.

A scene mirrored in y = 0 gives the mirrored picture bit by bit: y meets nothing but products and sums that keep its
sign, and a sample on an edge belongs to the side of the middle column.
Dimension key: P parts, V corners, F faces, S samples across a picture, T texels across a shadow map.
"""

import math

import numpy as np

from graspq.sim.compiled import compiled, part_of_compiled

_SUBSAMPLE = 256  # a corner's place on the picture is rounded to this part of a sample, so that edges are exact
_FARTHEST = 2.0**24  # of a corner from the middle, in these parts: sums of products of two stay below 2^52
# Entries of `view`: the camera's place, its axes, slopes and least distance, then the light's axes and its map.
EYE_X, EYE_Z, FORWARD_X, FORWARD_Z, HALF_VIEW, NEAR, LIGHT_X, LIGHT_Z, MAP_CENTRE, MAP_HALF, MAP_BIAS = range(11)


@compiled("void(f8[:, ::1], i4[::1], f8[:, ::1], f8[::1], i8, i8, f8[:, ::1], f8[:, ::1])")
def project(
    poses: np.ndarray,
    starts: np.ndarray,
    vertices: np.ndarray,
    view: np.ndarray,
    samples: int,
    texels: int,
    seen: np.ndarray,
    lit: np.ndarray,
) -> None:
    """Place corners in the world and project them, for the camera and for the light.

    Args:
        poses: float64 [P, 7], position (metres) and quaternion (xyzw) of each part.
        starts: int32 [P + 1], each part's first corner.
        vertices: float64 [V, 3], metres, in the part's frame.
        view: float64 [11], see above.
        samples: S.
        texels: T.
        seen: float64 [V, 3], filled: column and row from the middle of the picture in 1/256 of a sample, whole
            numbers, and 1/distance along the camera's axis; the last is not a number where that is too near or far.
        lit: float64 [V, 3], filled likewise: on the shadow map, and the height towards the light, metres.
    """
    ex, ez, fx, fz = view[EYE_X], view[EYE_Z], view[FORWARD_X], view[FORWARD_Z]
    lx, lz = view[LIGHT_X], view[LIGHT_Z]
    seen_scale = samples * 0.5 * _SUBSAMPLE / view[HALF_VIEW]
    lit_scale = texels * 0.5 * _SUBSAMPLE / view[MAP_HALF]
    for part in range(len(poses)):
        x, y, z, w = poses[part, 3], poses[part, 4], poses[part, 5], poses[part, 6]
        r00, r01, r02 = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        r10, r11, r12 = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        r20, r21, r22 = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
        for index in range(starts[part], starts[part + 1]):
            a, b, c = vertices[index, 0], vertices[index, 1], vertices[index, 2]
            px = r00 * a + r01 * b + r02 * c + poses[part, 0]
            py = r10 * a + r11 * b + r12 * c + poses[part, 1]
            pz = r20 * a + r21 * b + r22 * c + poses[part, 2]
            along = (px - ex) * fx + (pz - ez) * fz
            near = 1.0 / along
            down = (px - ex) * -fz + (pz - ez) * fx
            column, row = np.rint(py * near * seen_scale), np.rint(down * near * seen_scale)
            good = along >= view[NEAR] and abs(column) < _FARTHEST and abs(row) < _FARTHEST
            seen[index, 0], seen[index, 1], seen[index, 2] = column, row, near if good else math.nan
            column = np.rint(py * lit_scale)
            row = np.rint((px * lz - pz * lx - view[MAP_CENTRE]) * lit_scale)
            good = abs(column) < _FARTHEST and abs(row) < _FARTHEST
            lit[index, 0], lit[index, 1] = column, row
            lit[index, 2] = px * lx + pz * lz if good else math.nan


@compiled("void(f8[:, ::1], i4[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], i8[:, ::1])")
def colour(
    poses: np.ndarray,
    starts: np.ndarray,
    normals: np.ndarray,
    base: np.ndarray,
    view: np.ndarray,
    light: np.ndarray,
    colours: np.ndarray,
) -> None:
    """Give each face its colour in the light and its colour in the shadow.

    colour = base · (ambient + diffuse · max(0, normal · light)); in the shadow diffuse is `shaded` times that.

    Args:
        poses: float64 [P, 7].
        starts: int32 [P + 1], each part's first face.
        normals: float64 [F, 3], of length 1, in the part's frame.
        base: float64 [P, 3], red, green, blue in [0, 1].
        view: float64 [11].
        light: float64 [3], ambient, diffuse and shaded.
        colours: int64 [F, 2], filled: in the light and in the shadow, 16 times red, green and blue in 0 .. 255, in
            20 bits each, red the lowest.
    """
    lx, lz = view[LIGHT_X], view[LIGHT_Z]
    for part in range(len(poses)):
        x, y, z, w = poses[part, 3], poses[part, 4], poses[part, 5], poses[part, 6]
        a = lx * (1 - 2 * (y * y + z * z)) + lz * (2 * (x * z - y * w))
        b = lx * (2 * (x * y - z * w)) + lz * (2 * (y * z + x * w))
        c = lx * (2 * (x * z + y * w)) + lz * (1 - 2 * (x * x + y * y))
        for face in range(starts[part], starts[part + 1]):
            facing = max(0.0, a * normals[face, 0] + b * normals[face, 1] + c * normals[face, 2])
            for shadow in range(2):
                strength = light[0] + light[1] * facing * (light[2] if shadow else 1.0)
                packed = 0
                for channel in range(3):
                    value = min(4080.0, np.rint(base[part, channel] * strength * 4080.0))
                    packed |= int(value) << (20 * channel)
                colours[face, shadow] = packed


@part_of_compiled
def _lost(right: int, down: int, toward: int) -> int:
    """Return 1 if a sample on an edge is outside: moved a little to the middle column, or else down, it would be."""
    return 0 if right * toward > 0 or (right == 0 and down > 0) else 1


@part_of_compiled
def _narrowed(edge: int, gain: int, low: int, high: int) -> tuple[int, int]:
    """Return the part of the columns low .. high - 1 where edge + gain · column is 0 or more.

    Quotients of whole numbers below 2^52 are rounded down rightly as float64.
    """
    if gain > 0:
        low = max(low, math.ceil(-edge / gain))
    elif gain < 0:
        high = min(high, math.floor(edge / -gain) + 1)
    elif edge < 0:
        high = 0
    return low, high


@compiled("void(f8[:, ::1], i4[:, ::1], i8, i8, f4[:, ::1], i4[:, ::1])")
def fill(corners: np.ndarray, faces: np.ndarray, first: int, side: int, depth: np.ndarray, owner: np.ndarray) -> None:
    """Draw faces over what is there; in front is what has the greater depth value.

    A sample on an edge belongs to the face on the side of the middle column, or else to the lower one: to exactly one
    of two neighbours, and in the mirrored picture to the mirrored one. A face with a corner that is not a number is
    left out.

    Args:
        corners: float64 [V, 3] of `project`.
        faces: int32 [F, 3], indices into `corners`, outward by the right-hand rule.
        first: number of the first face.
        side: 1 draws the faces that are turned towards the viewer, -1 those turned away.
        depth: float32 [S, S], updated.
        owner: int32 [S, S], updated: the number of the face that a sample shows; shape [0, 0] if nobody asks.
    """
    size = len(depth)
    owned = len(owner) > 0
    middle, origin = size // 2, (size - 1) * (_SUBSAMPLE // 2)
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        if side > 0:
            # Rows run downwards.
            b, c = c, b
        za, zb, zc = corners[a, 2], corners[b, 2], corners[c, 2]
        if math.isnan(za + zb + zc):
            continue
        ax, ay = int(corners[a, 0]), int(corners[a, 1])
        bx, by = int(corners[b, 0]), int(corners[b, 1])
        cx, cy = int(corners[c, 0]), int(corners[c, 1])
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area <= 0:
            continue
        # Sample i lies at 256 i - origin.
        left = max(0, (min(ax, bx, cx) + origin + _SUBSAMPLE - 1) // _SUBSAMPLE)
        right = min(size - 1, (max(ax, bx, cx) + origin) // _SUBSAMPLE)
        top = max(0, (min(ay, by, cy) + origin + _SUBSAMPLE - 1) // _SUBSAMPLE)
        bottom = min(size - 1, (max(ay, by, cy) + origin) // _SUBSAMPLE)
        if left > right or top > bottom:
            continue
        across = ((zb - za) * (cy - ay) - (zc - za) * (by - ay)) / area
        along = ((zc - za) * (bx - ax) - (zb - za) * (cx - ax)) / area
        for side_of_middle in range(2):
            if side_of_middle == 0:
                start, stop, toward = left, min(right, middle - 1), 1
            else:
                start, stop, toward = max(left, middle), right, -1
            if start > stop:
                continue
            # Edge functions, positive inside, and what they gain by a sample to the right and one down.
            x, y = start * _SUBSAMPLE - origin, top * _SUBSAMPLE - origin
            e0 = (cx - bx) * (y - by) - (cy - by) * (x - bx) - _lost(by - cy, cx - bx, toward)
            e1 = (ax - cx) * (y - cy) - (ay - cy) * (x - cx) - _lost(cy - ay, ax - cx, toward)
            e2 = (bx - ax) * (y - ay) - (by - ay) * (x - ax) - _lost(ay - by, bx - ax, toward)
            dx0, dx1, dx2 = (by - cy) * _SUBSAMPLE, (cy - ay) * _SUBSAMPLE, (ay - by) * _SUBSAMPLE
            dy0, dy1, dy2 = (cx - bx) * _SUBSAMPLE, (ax - cx) * _SUBSAMPLE, (bx - ax) * _SUBSAMPLE
            count = stop + 1 - start
            for row in range(top, bottom + 1):
                low, high = 0, count
                low, high = _narrowed(e0, dx0, low, high)
                low, high = _narrowed(e1, dx1, low, high)
                low, high = _narrowed(e2, dx2, low, high)
                base = za + along * (row * _SUBSAMPLE - origin - ay)
                for column in range(start + low, start + high):
                    value = np.float32(base + across * (column * _SUBSAMPLE - origin - ax))
                    front = value > depth[row, column]
                    depth[row, column] = value if front else depth[row, column]
                    if owned:
                        owner[row, column] = np.int32(first + face) if front else owner[row, column]
                e0 += dy0
                e1 += dy1
                e2 += dy2


@compiled("void(f4[:, ::1], i4[:, ::1], f4[:, ::1], i8[:, ::1], f8[::1], u1[:, :, ::1])")
def shade(
    depth: np.ndarray,
    owner: np.ndarray,
    shadows: np.ndarray,
    colours: np.ndarray,
    view: np.ndarray,
    image: np.ndarray,
) -> None:
    """Colour the samples, in the shadow where the map has something nearer to the light, and average four a pixel.

    Pixels take 64 values, 2, 6, .. 254: nobody sees it, and pictures take a fifth less room on disk.

    Args:
        depth: float32 [S, S] of `fill`.
        owner: int32 [S, S] of `fill`.
        shadows: float32 [T, T], height towards the light, metres; its border is lost.
        colours: int64 [F, 2] of `colour`.
        view: float64 [11].
        image: uint8 [H, H, 3], filled; S = 2 H.
    """
    samples, texels = len(depth), len(shadows)
    last = texels - 1
    shadows[0], shadows[last], shadows[:, 0], shadows[:, last] = -math.inf, -math.inf, -math.inf, -math.inf
    lx, lz = view[LIGHT_X], view[LIGHT_Z]
    fx, fz, half_view = view[FORWARD_X], view[FORWARD_Z], view[HALF_VIEW]
    scale = texels * 0.5 / view[MAP_HALF]
    height = np.float32(view[EYE_X] * lx + view[EYE_Z] * lz + view[MAP_BIAS])
    place = np.float32((view[EYE_X] * lz - view[EYE_Z] * lx - view[MAP_CENTRE]) * scale + texels // 2)
    # A ray's way to the side in texels for a metre of distance, from the middle.
    aside = np.empty(samples, np.float32)
    for j in range(samples):
        aside[j] = abs((2 * j + 1 - samples) * half_view / samples) * scale
    texel, level = np.empty((2, samples), np.int32), np.empty((2, samples), np.float32)
    for row in range(len(image)):
        for k in range(2):
            i = 2 * row + k
            # Its way along the two axes of the light.
            slope = (2 * i + 1 - samples) * half_view / samples
            rx, rz = fx - slope * fz, fz + slope * fx
            rise, run = np.float32(rx * lx + rz * lz), np.float32((rx * lz - rz * lx) * scale)
            for j in range(samples):
                far = np.float32(1.0) / max(depth[i, j], np.float32(0.001))
                v = min(max(np.int32(place + far * run), np.int32(0)), np.int32(last))
                u = min(np.int32(far * aside[j]), np.int32(texels // 2 - 1))
                u = np.int32(texels // 2) + u if 2 * j >= samples else np.int32(texels // 2 - 1) - u
                texel[k, j] = v * np.int32(texels) + u
                level[k, j] = height + far * rise
        flat = shadows.ravel()
        for column in range(len(image)):
            total = 0
            for k in range(2):
                for j in range(2 * column, 2 * column + 2):
                    dark = 1 if flat[texel[k, j]] > level[k, j] else 0
                    total += colours[owner[2 * row + k, j], dark]
            # Of 64 steps the middle.
            image[row, column, 0] = (total >> 6 & 252) + 2
            image[row, column, 1] = (total >> 26 & 252) + 2
            image[row, column, 2] = (total >> 46 & 252) + 2
