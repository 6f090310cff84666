import numpy as np
import pytest

from graspq.common.seeding import generator, integer_seed


def test_the_same_purpose_and_keys_give_the_same_numbers():
    np.testing.assert_array_equal(generator("a", 1, 2).random(5), generator("a", 1, 2).random(5))


def test_purposes_keys_and_their_number_give_different_streams():
    streams = [generator(*keys).random() for keys in (("a", 0), ("b", 0), ("a", 1), ("a", 0, 0), ("a",), ("a", 1, 0))]
    assert len(set(streams)) == len(streams)


def test_seed_zero_is_a_seed_and_negative_ones_are_refused():
    assert generator("a", 0).random() == generator("a", 0).random()
    with pytest.raises(ValueError, match="at least 0"):
        generator("a", -1)


def test_integer_seeds_fit_in_63_bits():
    seeds = [integer_seed("a", key) for key in range(1000)]
    assert len(set(seeds)) == 1000
    assert min(seeds) >= 0 and max(seeds) < 2**63
