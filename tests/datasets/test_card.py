import contextlib
import dataclasses

import numpy as np
import pytest

import datasets as hugging_face
from graspq.datasets.card import card_text
from graspq.datasets.columns import EPISODES, STEPS
from graspq.datasets.manifest import Manifest
from graspq.datasets.tables import episodes_schema, steps_schema


@pytest.fixture
def header(dataset):
    """The YAML header as lines; what it says is compared with the schemas."""
    return (dataset / "README.md").read_text().split("---\n")[1].splitlines()


def test_five_lines_of_the_card_read_the_images_into_numpy(dataset, drawn):
    code = (dataset / "README.md").read_text().split("```python\n")[1].split("```")[0]
    assert len(code.splitlines()) == 5
    names = {}
    with contextlib.chdir(dataset):
        exec(code, names)
    expected = np.concatenate([episode.images for episode in drawn.episodes(0, 5)])
    assert np.array_equal(names["images"], expected)


def test_the_header_names_both_tables_and_their_files(header):
    configs = header[header.index("configs:") + 1 : header.index("dataset_info:")]
    names = [line.removeprefix("- config_name: ") for line in configs if line.startswith("- ")]
    paths = [line.strip().removeprefix("path: ") for line in configs if "path: " in line]
    assert dict(zip(names, paths, strict=True)) == {"steps": "shards/*.parquet", "episodes": "episodes/*.parquet"}
    for line in ("license: mit", "- robotics", "- n<1K", "- reinforcement-learning"):
        assert line in header


def test_the_header_declares_the_columns_of_the_schemas(dataset, header):
    manifest = Manifest.load(dataset)
    declared = [line.removeprefix("  - name: ") for line in header if line.startswith("  - name: ")]
    assert declared == steps_schema(manifest).names + episodes_schema(manifest).names
    for name in ("image", "final_image"):
        assert header[header.index(f"  - name: {name}") + 1] == "    dtype: image"
    start = header.index("  - name: action")
    assert header[start + 1 : start + 3] == ["    list: float32", "    length: 4"]
    start = header.index("  - name: object_poses")
    assert header[start + 1 : start + 4] == ["    list:", "      list: float32", "      length: 7"]


@pytest.mark.parametrize(("rows", "category"), [(999, "n<1K"), (1000, "1K<n<10K"), (5_600_000, "1M<n<10M")])
def test_the_size_category_follows_the_rows(dataset, rows, category):
    manifest = Manifest.load(dataset)
    entry = dataclasses.replace(manifest.shards[0], rows=rows)
    assert f"\n- {category}\n" in card_text(dataclasses.replace(manifest, shards=(entry,)))


def test_every_column_is_described(dataset):
    text = card_text(Manifest.load(dataset)).split("---\n")[2]
    assert [column.name for column in (*STEPS, *EPISODES) if f"| `{column.name}` |" not in text] == []


@pytest.mark.parametrize("streaming", [False, True])
def test_hugging_face_datasets_reads_both_tables_with_images(dataset, drawn, tmp_path, streaming):
    def read(table):
        options = {"split": "train", "streaming": streaming, "cache_dir": str(tmp_path)}
        return hugging_face.load_dataset(str(dataset), table, **options)

    episodes = drawn.episodes(0, 12)
    images = np.concatenate([episode.images for episode in episodes])
    steps, attempts = read("steps"), read("episodes")
    assert np.array_equal(np.stack([np.asarray(step["image"]) for step in steps]), images)
    rows = list(attempts)
    finals = np.stack([np.asarray(row["final_image"]) for row in rows])
    assert np.array_equal(finals, np.stack([episode.final_image for episode in episodes]))
    assert [row["ended_by"] for row in rows] == [episode.ended_by for episode in episodes]
    tensors = next(iter(steps.with_format("torch")))
    assert np.array_equal(tensors["image"].numpy().transpose(1, 2, 0), images[0])
    assert np.array_equal(tensors["action"].numpy(), episodes[0].actions[0])
