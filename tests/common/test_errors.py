"""What a user is told of a folder that was made otherwise, and of a machine that fails."""

import errno
import os
from pathlib import Path

import click
import pytest

from graspq.common.checksums import DamagedError
from graspq.common.errors import MachineError, UserError, failure_of_machine, naming, refuse_other, said_of
from graspq.common.files import committed
from graspq.common.options import Command
from graspq.datasets.blocks import readable
from graspq.objects.mesh_files import read_obj_parts


def test_the_setting_that_differs_is_named_with_its_place(tmp_path: Path) -> None:
    refuse_other(tmp_path, "data", {"a": {"b": 1}}, {"a": {"b": 1}}, "go")
    with pytest.raises(UserError, match=r"holds data with a\.b\.c = 1, not None; go"):
        refuse_other(tmp_path, "data", {"a": {"b": {"c": 1}}}, {"a": {"b": {}}}, "go")


def test_failures_of_the_machine_say_what_to_do_and_defects_are_none() -> None:
    full = failure_of_machine(OSError(errno.ENOSPC, "", "data/shard"))
    assert full is not None and full.message.startswith("data/shard: No space left on device; free some space")
    memory = failure_of_machine(MemoryError())
    assert memory is not None and "not enough memory" in memory.message
    threads = failure_of_machine(RuntimeError("can't start new thread"))
    assert threads is not None and "not enough memory or threads" in threads.message
    assert failure_of_machine(threads) is threads
    assert failure_of_machine(SystemError("error return without exception set")) is not None
    assert failure_of_machine(SystemError("bad argument to internal function")) is None
    library = failure_of_machine(ImportError("x.so: failed to map segment from shared object"))
    assert library is not None and "not enough memory" in library.message
    assert failure_of_machine(ImportError("No module named x")) is None
    for defect in (KeyError("x"), FileNotFoundError(errno.ENOENT, "", "x"), RuntimeError("x"), OSError("x")):
        assert failure_of_machine(defect) is None


def test_a_failed_write_names_the_file_that_it_was_for_and_not_its_temporary_name(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with pytest.raises(OSError) as error, committed(path) as temporary:
        temporary.touch()
        raise OSError(errno.EIO, "of a write, which names no file")
    assert error.value.filename == str(path) and not list(tmp_path.iterdir())
    with pytest.raises(OSError) as error, committed(path) as temporary:
        temporary.mkdir()
        (temporary / "a" / "b").touch()
    assert error.value.filename == str(path / "a" / "b")
    with pytest.raises(OSError) as error, naming(path, path):
        raise OSError(errno.EIO, "", str(tmp_path / "other"))
    assert error.value.filename == str(tmp_path / "other")


def test_a_mistake_names_the_file_that_it_stands_in_once() -> None:
    with pytest.raises(DamagedError, match=r"^plan\.toml: no such row$"), said_of("plan.toml"), said_of("plan.toml"):
        raise DamagedError("no such row")


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs a file that answers EIO")
def test_a_disk_that_does_not_answer_is_no_damaged_file(tmp_path: Path) -> None:
    with pytest.raises(MachineError, match=r"not a readable mesh .*Input/output error"):
        read_obj_parts(Path("/proc/self/mem"))
    with pytest.raises(MachineError, match=r"shard: cannot be read .*Input/output error"), readable("shard:"):
        Path("/proc/self/mem").read_bytes()
    for missing in (lambda: read_obj_parts(tmp_path / "a.obj"), (tmp_path / "a").read_bytes):
        with pytest.raises(UserError), readable("shard"):
            missing()


def test_a_command_ends_in_one_line_where_the_machine_fails_and_in_a_traceback_where_it_is_wrong(
    capsys: pytest.CaptureFixture[str],
) -> None:
    raised: list[BaseException] = [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out"), RuntimeError("a defect")]

    @click.command(cls=Command)
    def main() -> None:
        raise raised.pop(0)

    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 74
    said = "error: out: No space left on device; free some space, then run the same command again\n"
    assert capsys.readouterr().err == said
    with pytest.raises(RuntimeError, match="a defect"):
        main([])
