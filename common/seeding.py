"""Random generators that are pure functions of a purpose and integer keys.

Two purposes never share a stream, whatever their keys: the scenes of an evaluation cannot meet those of a collection.
"""

import hashlib

import numpy as np


def seed_sequence(purpose: str, *keys: int) -> np.random.SeedSequence:
    """Return the seed sequence of `(purpose, *keys)`.

    Args:
        purpose: what the numbers are for, such as `"datagen/block"`; different purposes give independent streams.
        keys: whole numbers ≥ 0, such as a seed and an episode index; 0 is a seed like any other.

    Raises:
        ValueError: a key is negative.
    """
    if any(key < 0 for key in keys):
        raise ValueError(f"seeds and indices are whole numbers of at least 0, got {keys}")
    digest = hashlib.sha256(purpose.encode()).digest()
    words = [int.from_bytes(digest[start : start + 4], "little") for start in range(0, 16, 4)]
    # The number of keys takes part: SeedSequence pads with zeros, so (3,) and (3, 0) would else coincide.
    return np.random.SeedSequence([*words, len(keys), *keys])


def generator(purpose: str, *keys: int) -> np.random.Generator:
    """Return a fresh PCG64 generator that depends on `(purpose, *keys)` alone; see `seed_sequence`."""
    return np.random.Generator(np.random.PCG64(seed_sequence(purpose, *keys)))


def integer_seed(purpose: str, *keys: int) -> int:
    """Return a 63-bit whole number that depends on `(purpose, *keys)` alone, for libraries that take one integer."""
    return int(seed_sequence(purpose, *keys).generate_state(1, np.uint64)[0] >> 1)
