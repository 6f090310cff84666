import io

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from graspq.datasets.images import decoded, encoded, from_arrow, header, to_arrow

FORMATS = {1: pa.binary(5 * 7 * 3), 2: pa.binary()}


def pictures(count, height=5, width=7):
    return np.random.default_rng(0).integers(0, 256, (count, height, width, 3), np.uint8)


@pytest.mark.parametrize("kind", FORMATS.values())
def test_what_was_stored_is_read_whole_or_sliced_without_a_copy(kind):
    images = pictures(6)
    array = to_arrow(images, kind)
    assert array.type == kind
    for part, expected in ((array, images), (array[2:5], images[2:5]), (array[:0], images[:0])):
        read = from_arrow(part, (5, 7, 3))
        assert np.array_equal(read, expected) and not read.flags.writeable
    memory = np.frombuffer(array.buffers()[-1], np.uint8)
    assert np.shares_memory(from_arrow(array, (5, 7, 3)), memory)


@pytest.mark.parametrize("shape", [(64, 64, 3), (5, 7, 3), (256, 128, 3)])
def test_any_image_library_decodes_them(shape):
    (image,) = pictures(1, *shape[:2])
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encoded(image)))), image)
    assert np.array_equal(decoded(encoded(image), shape), image)


def test_the_header_of_a_frame_has_13_bytes():
    assert header((64, 64, 3)) == b"P6 64 64 255\n" and len(header((64, 64, 3))) == 13


@pytest.mark.parametrize("file", [b"", b"P6 5 7 255\n" + bytes(105), b"P6 7 5 255\n" + bytes(104), bytes(116)])
def test_what_is_no_image_of_the_shape_is_refused(file):
    with pytest.raises(ValueError, match="image: expected a PPM"):
        decoded(file, (5, 7, 3))
    with pytest.raises(ValueError, match="image: expected a PPM"):
        from_arrow(pa.array([encoded(pictures(1)[0]), file]), (5, 7, 3))
