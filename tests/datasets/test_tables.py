import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from graspq.datasets.tables import steps_schema


@pytest.fixture
def steps_path(dataset):
    return dataset / "shards/blocks-000000-000004.parquet"


def test_the_columns_of_the_steps_table_are_those_of_the_design(drawn):
    schema = steps_schema(drawn.manifest(size=64))
    assert {name: str(schema.field(name).type) for name in schema.names} == {
        "episode_id": "int64",
        "step": "int32",
        "image": "fixed_size_binary[12288]",
        "action": "fixed_size_list<element: float not null>[4]",
        "reward": "float",
        "terminal": "bool",
        "gripper_pose": "fixed_size_list<element: float not null>[4]",
        "mc_return": "float",
        "synthetic_action": "fixed_size_list<element: float not null>[4]",
    }


def test_shape_limits_discount_and_version_stand_in_the_file(steps_path, drawn):
    schema = pq.read_schema(steps_path)
    assert json.loads(schema.field("image").metadata[b"shape"]) == [8, 8, 3]
    assert json.loads(schema.field("mc_return").metadata[b"discount"]) == 1.0
    assert tuple(json.loads(schema.metadata[b"graspq.action_limits"])) == drawn.limits
    assert schema.metadata[b"graspq.format_version"] == b"1"


def test_images_have_zstd_and_neither_dictionary_nor_statistics(steps_path):
    footer = pq.read_metadata(steps_path)
    for group in range(footer.num_row_groups):
        column = footer.row_group(group).column(2)
        assert (column.path_in_schema, column.compression) == ("image", "ZSTD")
        assert not column.has_dictionary_page
        assert not column.is_stats_set


def test_there_is_one_row_group_per_block(steps_path, drawn):
    footer = pq.read_metadata(steps_path)
    expected = [sum(drawn.episode(2 * block + i).steps for i in range(2)) for block in range(5)]
    assert [footer.row_group(i).num_rows for i in range(footer.num_row_groups)] == expected


def test_a_flipped_bit_in_an_image_page_fails_the_page_checksum(steps_path):
    content = bytearray(steps_path.read_bytes())
    column = pq.read_metadata(steps_path).row_group(1).column(2)
    content[column.data_page_offset + column.total_compressed_size - 5] ^= 4
    reader = pa.BufferReader(bytes(content))
    with pytest.raises(OSError, match="CRC"):
        pq.ParquetFile(reader, page_checksum_verification=True).read_row_group(1)
