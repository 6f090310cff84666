"""Images in Parquet: each a PPM file, a line of header before the raw RGB, so that any library decodes it.

With zstd that is smaller than PNG and decodes ten times as fast (DESIGN, section 3); what is behind the headers is read
without a copy. Format 1 holds the raw RGB alone. Dimension key: N images, H W C of one.
"""

import math
from typing import Any

import numpy as np
import pyarrow as pa

from graspq.datasets.episode import UInt8


def header(image_shape: tuple[int, int, int]) -> bytes:
    """Return what stands before the pixels: 13 bytes for 64 x 64."""
    height, width, _ = image_shape
    return f"P6 {width} {height} 255\n".encode()


def to_arrow(images: UInt8, kind: pa.DataType) -> pa.Array:
    """Return images, uint8 [N, H, W, 3], as an array of PPM files, or of raw RGB where `kind` has a fixed size."""
    flat = np.ascontiguousarray(images).reshape(len(images), -1)
    if pa.types.is_fixed_size_binary(kind):
        return pa.Array.from_buffers(kind, len(flat), [None, pa.py_buffer(flat)])
    first = np.frombuffer(header(images.shape[1:]), np.uint8)
    files = np.concatenate([np.broadcast_to(first, (len(flat), len(first))), flat], axis=1)
    ends = np.arange(len(files) + 1, dtype=np.int32) * files.shape[1]
    return pa.Array.from_buffers(kind, len(files), [None, pa.py_buffer(ends), pa.py_buffer(files)])


def from_arrow(array: pa.Array, image_shape: tuple[int, int, int]) -> UInt8:
    """Return the images of an array of either format, uint8 [N, H, W, C]: a read-only view of its memory.

    Raises:
        ValueError: one is no PPM of this shape.
    """
    if pa.types.is_fixed_size_binary(array.type):
        width = array.type.byte_width
        flat = np.frombuffer(array.buffers()[1], np.uint8, len(array) * width, array.offset * width)
        images = flat.reshape(len(array), *image_shape)
    else:
        first = header(image_shape)
        width = len(first) + math.prod(image_shape)
        starts = np.frombuffer(array.buffers()[1], np.int32, len(array) + 1, array.offset * 4)
        if (starts[1:] - starts[:-1] != width).any():
            raise ValueError(f"image: expected a PPM of {width} bytes")
        flat = np.frombuffer(array.buffers()[2], np.uint8, len(array) * width, int(starts[0]))
        files = flat.reshape(len(array), width)
        if files[:, : len(first)].tobytes() != first * len(array):
            raise ValueError(f"image: expected a PPM that begins with {first!r}")
        images = files[:, len(first) :].reshape(len(array), *image_shape)
    images.flags.writeable = False
    return images


def encoded(image: UInt8) -> bytes:
    """Return an image, uint8 [H, W, 3], as a PPM file."""
    return header(image.shape) + image.tobytes()


def decoded(file: bytes, image_shape: tuple[int, int, int]) -> UInt8:
    """Return the image of a PPM file, a read-only view of it.

    Raises:
        ValueError: it is no PPM of this shape.
    """
    image: UInt8 = from_arrow(pa.array([file], pa.binary()), image_shape)[0]
    return image


def only(column: pa.ChunkedArray) -> Any:
    """Return a column as one array; without a copy where it is one."""
    return column.chunk(0) if column.num_chunks == 1 else pa.concat_arrays(column.chunks)
