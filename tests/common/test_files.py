import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.common.files import (
    cache_folder,
    committed,
    committed_folder,
    locked,
    read_json,
    remove_folder,
    remove_temporaries,
    sha256_of,
    temporary_folder,
    writable_folder,
    write_json,
)


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "file.txt"
    with committed(path) as temporary:
        temporary.write_text("all of it")
        assert not path.exists()
    assert path.read_text() == "all of it"
    with pytest.raises(RuntimeError, match="midway"), committed(path) as temporary:
        temporary.write_text("part")
        raise RuntimeError("midway")
    assert path.read_text() == "all of it"
    assert [entry.name for entry in path.parent.iterdir()] == ["file.txt"]


def test_what_does_not_verify_is_not_committed(tmp_path):
    def refuse(temporary):
        raise OSError("not what was written")

    with pytest.raises(OSError, match="not what was written"), committed(tmp_path / "file", refuse) as temporary:
        temporary.write_bytes(b"x")
    assert not list(tmp_path.iterdir())


def test_json_is_read_back_and_bad_json_is_the_users_mistake(tmp_path):
    write_json(tmp_path / "a.json", {"key": [1, 2.5, "é"]})
    assert read_json(tmp_path / "a.json", "manifest") == {"key": [1, 2.5, "é"]}
    (tmp_path / "b.json").write_text("{")
    with pytest.raises(UserError, match="not a readable manifest"):
        read_json(tmp_path / "b.json", "manifest")
    with pytest.raises(UserError, match="no manifest here"):
        read_json(tmp_path / "c.json", "manifest")


def test_only_our_own_temporaries_are_removed(tmp_path):
    (tmp_path / ".tmp-1-shard").touch()
    (tmp_path / ".tmp-1-checkpoint").mkdir()
    (tmp_path / ".tmp-1-checkpoint" / "weights").touch()
    (tmp_path / "notes.tmp").touch()
    remove_temporaries(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["notes.tmp"]


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot write the dataset here"):
        writable_folder(tmp_path / "file" / "folder", "dataset")


def test_the_digest_is_that_of_the_bytes(tmp_path):
    (tmp_path / "file").write_bytes(b"abc")
    assert sha256_of(tmp_path / "file").startswith("ba7816bf8f01cfea")


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "folder"
    with committed_folder(path) as temporary:
        (temporary / "a").write_text("1")
        (temporary / "deep").mkdir()
        (temporary / "deep" / "b").write_text("2")
        assert not path.exists()
    assert (path / "deep" / "b").read_text() == "2"
    with pytest.raises(RuntimeError, match="midway"), committed_folder(path, replace=True) as temporary:
        raise RuntimeError("midway")
    assert (path / "a").read_text() == "1"
    assert [entry.name for entry in path.parent.iterdir()] == ["folder"]


def test_a_folder_that_is_there_is_kept_replaced_or_compared(tmp_path):
    path = tmp_path / "folder"

    def make(text, **how):
        with committed_folder(path, **how) as temporary:
            (temporary / "a").write_text(text)

    def differ(made, there):
        if (made / "a").read_text() != (there / "a").read_text():
            raise ValueError("another one")

    make("first")
    make("second")
    assert (path / "a").read_text() == "first"
    with pytest.raises(ValueError, match="another one"):
        make("second", compare=differ)
    make("first", compare=differ)
    make("second", replace=True)
    assert (path / "a").read_text() == "second"
    remove_folder(path)
    assert not list(tmp_path.iterdir())


def test_what_a_killed_maker_left_is_removed_by_the_next(tmp_path):
    code = """
import os, signal, sys
from pathlib import Path
from graspq.common.files import committed_folder
with committed_folder(Path(sys.argv[1])) as temporary:
    (temporary / "half").touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""
    path = tmp_path / "folder"
    assert subprocess.run([sys.executable, "-c", code, path], check=False).returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    with committed_folder(path) as temporary:
        (temporary / "whole").touch()
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


def test_what_a_killed_writer_of_a_file_left_is_removed_by_the_next_and_the_living_are_let_be(tmp_path):
    code = """
import os, signal, sys
from pathlib import Path
from graspq.common.files import committed
with committed(Path(sys.argv[1])) as temporary:
    temporary.touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""
    path = tmp_path / "file"
    assert subprocess.run([sys.executable, "-c", code, path], check=False).returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    of_the_living = left.with_name(left.name.replace(left.name.split("-")[-2], str(os.getppid())))
    of_the_living.touch()
    write_json(path, 1)
    assert {entry.name for entry in tmp_path.iterdir()} == {"file", of_the_living.name}


def test_one_process_holds_a_folder_and_a_killed_one_holds_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("graspq.common.files.LOCK_SECONDS", 0.1)
    code = """
import sys, time
from pathlib import Path
from graspq.common.files import locked
with locked(Path(sys.argv[1]), "holder"):
    print("held", flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code, tmp_path], stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(UserError, match="another grasp-datagen works here"), locked(tmp_path, "grasp-datagen"):
            pass
        holder.kill()
    with locked(tmp_path, "grasp-datagen"), pytest.raises(UserError), locked(tmp_path, "grasp-datagen"):
        pass
    waited = f"{tmp_path}: another grasp-datagen works here; waiting 0.1 s for its end"
    assert capsys.readouterr().err.splitlines() == [waited, waited]


def test_a_folder_that_is_let_go_soon_is_waited_for(tmp_path, capsys):
    holding = locked(tmp_path, "first")
    holding.__enter__()
    timer = threading.Timer(0.3, holding.__exit__, (None, None, None))
    started = time.monotonic()
    timer.start()
    with locked(tmp_path, "second"):
        assert 0.2 < time.monotonic() - started < 8
    assert capsys.readouterr().err.count("\n") == 1


def test_temporary_folders_of_killed_processes_are_removed_by_the_next_and_no_others(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code = """
import os, signal, sys, time
from graspq.common.files import temporary_folder
with temporary_folder("workers") as folder:
    print(folder, flush=True)
    sys.stdin.read(1) or os.kill(os.getpid(), signal.SIGKILL)
"""
    (tmp_path / "graspq-workers-file").write_text("of somebody")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "graspq-workers-link").symlink_to(tmp_path / "elsewhere")
    kept = {"graspq-workers-file", "elsewhere", "graspq-workers-link"}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as other:  # fmt: skip
        theirs = Path(other.stdout.readline().strip())
        with temporary_folder("workers") as ours:
            assert theirs.is_dir() and ours.parent == theirs.parent and ours.stat().st_mode & 0o777 == 0o700
        assert not ours.exists()
        other.stdin.close()
    assert other.returncode == -signal.SIGKILL and theirs.is_dir()
    with temporary_folder("workers") as ours:
        assert {path.name for path in tmp_path.iterdir()} == kept | {ours.name}
    assert {path.name for path in tmp_path.iterdir()} == kept
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / ("x" * 100)))
    with temporary_folder("workers", 80) as ours:
        assert ours.parent == Path("/tmp")


def test_a_name_of_two_hundred_letters_leaves_room_for_a_temporary_one(tmp_path):
    for name in ("n" * 230, "[a]*?"):
        with committed_folder(tmp_path / name) as temporary:
            (temporary / "file").touch()
        remove_folder(tmp_path / name)
        write_json(tmp_path / name, 1)
    assert len(list(tmp_path.iterdir())) == 2


def test_the_cache_is_where_the_user_says_and_private_where_home_is_not_to_be_written(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cache_folder("a", "b") == tmp_path / "cache" / "graspq" / "a" / "b"
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    private = cache_folder()
    assert private == tmp_path / f"graspq-cache-{os.getuid()}" and private.stat().st_mode & 0o777 == 0o700
    private.chmod(0o777)
    with pytest.raises(UserError, match="open to others"):
        cache_folder()


def test_a_forked_child_that_drops_its_copy_leaves_the_temporary_folder_of_its_parent():
    kept = temporary_folder("tests")
    folder = kept.__enter__()
    if (child := os.fork()) == 0:
        # As multiprocessing's children do, which forget what their parent would do at its end.
        kept.gen.close()
        os._exit(0)
    os.waitpid(child, 0)
    assert folder.is_dir()
    kept.__exit__(None, None, None)
    assert not folder.exists()
