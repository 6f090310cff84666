import shutil
from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.objects.defaults import default_object_set
from graspq.objects.procedural import GENERATOR_VERSION, SEED, make_procedural


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The place of object sets in a cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "graspq" / "objects"


def test_the_own_set_is_made_in_the_cache_once(cache: Path) -> None:
    made = default_object_set("targeted")
    assert made.folder == cache / f"targeted-{GENERATOR_VERSION}"
    before = (made.folder / "object_set.json").stat().st_mtime_ns
    assert default_object_set("targeted") == made
    assert (made.folder / "object_set.json").stat().st_mtime_ns == before


def test_the_targeted_set_has_the_bytes_that_published_numbers_were_made_with(cache: Path) -> None:
    assert default_object_set("targeted").digest().startswith("1b694e0c88e33c75")


@pytest.mark.parametrize("change", ["another generator version", "half a set", "a file"])
def test_a_folder_that_holds_anything_else_is_made_again(cache: Path, change: str) -> None:
    made = default_object_set("targeted")
    manifest = made.folder / "object_set.json"
    if change == "another generator version":
        manifest.write_text(manifest.read_text().replace('"generator_version": "', '"generator_version": "0.'))
    elif change == "half a set":
        manifest.unlink()
    else:
        shutil.rmtree(made.folder)
        made.folder.write_text("")
    again = default_object_set("targeted")
    assert again.digest() == made.digest()
    again.verify()


def test_the_regular_set_is_the_procedural_one_of_the_projects_seed(cache: Path) -> None:
    small = make_procedural(cache / f"regular-{GENERATOR_VERSION}", seed=SEED, train=1, test=1, validation=1)
    assert default_object_set("regular") == small


def test_an_unknown_name_is_refused_with_what_there_is(cache: Path) -> None:
    with pytest.raises(UserError, match=r"'stacking'.*regular, targeted"):
        default_object_set("stacking")
