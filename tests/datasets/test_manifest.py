import dataclasses
import json

import pytest

from graspq.common.errors import UserError
from graspq.datasets.manifest import Manifest, _digest_of, shard_name


def test_a_manifest_survives_saving_and_loading(dataset):
    manifest = Manifest.load(dataset)
    assert Manifest.from_json(manifest.to_json()) == manifest
    assert manifest.digest() == Manifest.from_json(manifest.to_json()).digest()
    assert (len(manifest.shards), manifest.episodes) == (3, 24)


def test_the_same_manifest_gives_the_same_bytes(dataset, tmp_path):
    Manifest.load(dataset).save(tmp_path)
    assert (tmp_path / "manifest.json").read_bytes() == (dataset / "manifest.json").read_bytes()


def test_every_flipped_bit_is_caught(dataset, tmp_path):
    content = (dataset / "manifest.json").read_bytes()
    for position in range(0, len(content), 11):
        flipped = bytearray(content)
        flipped[position] ^= 1 << position % 8
        (tmp_path / "manifest.json").write_bytes(flipped)
        with pytest.raises(UserError):
            Manifest.load(tmp_path)


def test_every_truncation_is_caught(dataset, tmp_path):
    content = (dataset / "manifest.json").read_bytes()
    for length in (0, 1, len(content) // 2, len(content) - 2, len(content) - 1):
        (tmp_path / "manifest.json").write_bytes(content[:length])
        with pytest.raises(UserError):
            Manifest.load(tmp_path)


def test_a_folder_that_is_no_dataset_gives_one_line_that_names_it(tmp_path):
    with pytest.raises(UserError, match=r"empty.*no such dataset folder"):
        Manifest.load(tmp_path / "empty")
    with pytest.raises(UserError, match=r"not a dataset, it has no manifest\.json"):
        Manifest.load(tmp_path)


def test_another_format_version_is_named(drawn, tmp_path):
    dataclasses.replace(drawn.manifest(), format_version=99).save(tmp_path)
    with pytest.raises(UserError, match="format version 99, expected 1 or 2"):
        Manifest.load(tmp_path)


def test_json_that_is_no_manifest_is_refused(tmp_path):
    for value in ([], {"format_version": 1}, {"a": 1}, None):
        (tmp_path / "manifest.json").write_text(json.dumps(value))
        with pytest.raises(UserError):
            Manifest.load(tmp_path)


def test_a_shard_that_starts_at_the_same_block_is_replaced(dataset):
    manifest = Manifest.load(dataset)
    last = manifest.shards[-1]
    name = shard_name(10, 3, 6, 2)
    longer = dataclasses.replace(
        last,
        name=name,
        blocks=3,
        files={f"{part}/{name}.parquet": "0" * 64 for part in ("shards", "episodes")},
        sizes={f"{part}/{name}.parquet": 1000 for part in ("shards", "episodes")},
    )
    assert [entry.name for entry in manifest.with_shard(longer).shards] == [
        "blocks-000000-000004",
        "blocks-000005-000009",
        "blocks-000010-000012",
    ]


def test_overlapping_shards_are_refused(dataset):
    manifest = Manifest.load(dataset)
    with pytest.raises(ValueError, match="overlap"):
        dataclasses.replace(manifest, shards=manifest.shards[::-1])


def test_a_short_last_block_shows_in_the_name():
    assert shard_name(0, 50, 1000, 20) == "blocks-000000-000049"
    assert shard_name(0, 50, 990, 20) == "blocks-000000-000049-short-990"


def test_a_shard_cannot_name_files_elsewhere(dataset):
    entry = Manifest.load(dataset).shards[0]
    with pytest.raises(ValueError, match="expected the files"):
        dataclasses.replace(entry, files={"../../elsewhere": "0"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"blocks": 10**18}, "expected whole numbers"),
        ({"rows": True}, "expected whole numbers"),
        ({"blocks": 10**9, "episodes": 10**9, "rows": 10**9}, "1000000000 blocks"),
        ({"rows": 1}, "1 rows"),
    ],
)
def test_counts_that_cannot_be_are_not_believed(dataset, change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(Manifest.load(dataset).shards[0], **change)


@pytest.mark.parametrize(
    "change",
    [
        {"task": {"name": "regular"}},
        {"settings": {"block_size": 0}},
        {"image_shape": (10**9, 64, 3)},
        {"discount": float("nan")},
        {"files": {"../secret": "0"}},
        {"files": {"/etc/passwd": "0"}},
        {"phi_range": (1.0,)},
    ],
)
def test_what_no_command_writes_is_refused_before_anything_is_allocated(dataset, change):
    with pytest.raises(ValueError, match="expected"):
        dataclasses.replace(Manifest.load(dataset), **change)


def test_a_signed_manifest_of_anything_gives_one_line(dataset, tmp_path):
    values = json.loads((dataset / "manifest.json").read_text())
    for change in ({"shards": 5}, {"action": [1]}, {"more": 1}, {"shards": [5]}, {"action": {"limits": [10**400] * 4}}):
        changed = {name: value for name, value in {**values, **change}.items() if name != "digest"}
        changed["digest"] = _digest_of(changed)
        (tmp_path / "manifest.json").write_text(json.dumps(changed, indent=2, ensure_ascii=False) + "\n")
        with pytest.raises(UserError, match=r"not a dataset manifest of this version|action space"):
            Manifest.load(tmp_path)


def test_a_manifest_of_before_keeps_its_digest_and_means_grasping_actions(dataset, tmp_path):
    manifest = Manifest.load(dataset)
    before = dataclasses.replace(manifest, tells_action=False)
    before.save(tmp_path)
    written = json.loads((tmp_path / "manifest.json").read_text())
    assert written["action_limits"] == list(manifest.action.limits) and "action" not in written
    opened = Manifest.load(tmp_path)
    assert opened.action == manifest.action and opened.digest() == written["digest"] != manifest.digest()
