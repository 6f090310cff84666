import io
import json

import duckdb
import numpy as np
import pandas
import polars
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from graspq.datasets.dataset import open_shards
from graspq.datasets.tables import episodes_schema, steps_schema
from graspq.datasets.verify import verify


@pytest.fixture
def steps_path(dataset):
    return dataset / "shards/blocks-000000-000004.parquet"


def test_the_columns_of_the_steps_table_are_those_of_the_design(drawn):
    schema = steps_schema(drawn.manifest(size=64))
    assert {name: str(schema.field(name).type) for name in schema.names} == {
        "episode_id": "int64",
        "step": "int32",
        "image": "binary",
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
    assert schema.metadata[b"graspq.format_version"] == b"2"


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


def pixels(file):
    return np.asarray(Image.open(io.BytesIO(file)))


@pytest.fixture
def first(drawn):
    return drawn.episode(0)


def test_duckdb_reads_both_tables_and_joins_them(dataset, drawn, first):
    episodes = drawn.episodes(0, 12)
    connection = duckdb.connect()
    found = connection.sql(
        f"""select ended_by, count(*), sum(reward), avg(mc_return) from '{dataset}/shards/*.parquet'
        join '{dataset}/episodes/*.parquet' using (episode_id) group by ended_by order by ended_by"""
    ).fetchall()
    for (ending, rows, reward, value), name in zip(found, ("T", "height"), strict=True):
        those = [episode for episode in episodes if episode.ended_by == name]
        assert (ending, rows) == (name, sum(episode.steps for episode in those))
        assert reward == sum(episode.success for episode in those)
        assert value == pytest.approx(sum(episode.success * episode.steps for episode in those) / rows)
    ((image, action),) = connection.sql(
        f"select image, action from '{dataset}/shards/*.parquet' where episode_id = 0 and step = 0"
    ).fetchall()
    assert np.array_equal(pixels(image), first.images[0]) and np.array_equal(np.float32(action), first.actions[0])


def test_polars_reads_both_tables(dataset, drawn, first):
    steps = polars.read_parquet(dataset / "shards/*.parquet")
    assert len(steps) == sum(episode.steps for episode in drawn.episodes(0, 12))
    assert np.array_equal(pixels(steps["image"][0]), first.images[0])
    assert np.array_equal(steps["action"].to_numpy()[: first.steps], first.actions)
    episodes = polars.scan_parquet(dataset / "episodes/*.parquet").filter(polars.col("success")).collect()
    assert episodes["episode_id"].to_list() == [e.episode_id for e in drawn.episodes(0, 12) if e.success]


def test_pandas_reads_both_tables(dataset, drawn, first):
    steps = pandas.read_parquet(dataset / "shards")
    assert np.array_equal(np.stack([pixels(file) for file in steps["image"][: first.steps]]), first.images)
    assert np.array_equal(np.stack(steps["action"][: first.steps]), first.actions)
    episodes = pandas.read_parquet(dataset / "episodes").set_index("episode_id")
    assert np.array_equal(pixels(episodes["final_image"][0]), first.final_image)
    assert episodes["success"].tolist() == [episode.success for episode in drawn.episodes(0, 12)]


def test_data_of_format_1_are_checked_and_give_the_same_batches(dataset, drawn, tmp_path):
    old = drawn.dataset(tmp_path, format_version=1)
    assert str(steps_schema(old).field("image").type) == "fixed_size_binary[192]"
    assert b"encoding" not in steps_schema(old).field("image").metadata
    names = episodes_schema(old).names
    assert "end" in names and "ended_by" not in names and "final_image" not in names
    assert verify(tmp_path).faults == ()
    one, two = open_shards([tmp_path]), open_shards([dataset])
    with one.batches(64, 5) as former, two.batches(64, 5) as current:
        ours, theirs = next(former).arrays(), next(current).arrays()
    assert all(np.array_equal(array, theirs[name]) for name, array in ours.items())
    episode, expected = one[3], drawn.episode(3)
    assert (episode.ended_by, episode.final_image) == (expected.ended_by, None)
    assert np.array_equal(episode.images, expected.images)
