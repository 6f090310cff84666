"""Commands with streams, folders and keyboards as nobody would wish them."""

import os
import signal
import subprocess
import sys
import time

import pytest

from graspq.common import streams
from graspq.common.streams import ended_in_order

# A command that prints what it is told, says how its descriptors are, opens a file and waits.
COMMAND = """
import os, sys, time
from pathlib import Path
import click
from graspq.common.options import Command

@click.command(cls=Command)
@click.argument("words", nargs=-1)
def main(words):
    with open("opened", "w") as file:
        number = file.fileno()
        print("to the terminal", file=sys.stderr)
        os.write(2, b"from a library")
        file.write(f"{number > 2}")
    for word in words:
        print(word, flush=True)
        if word == "wait":
            time.sleep(60)
        if word == "swallow":
            try:
                print("on", flush=True)
                time.sleep(60)
            except BaseException as error:  # as a library does with one that it may do without
                raise TypeError("broken later") from error
        if word == "pipe":
            raise BrokenPipeError(32, "Broken pipe")
main()
"""


def started(tmp_path, *words, before="", **options):
    script = tmp_path / "grasp-tried"
    script.write_text(before + COMMAND)
    # Where the suite runs in the background, its processes would ignore interrupts.
    options = {"stderr": subprocess.PIPE, "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)} | options
    return subprocess.Popen([sys.executable, script, *words], cwd=tmp_path, text=True, **options)


@pytest.mark.parametrize("closed", ["1>&-", "0<&- 1>&- 2>&-"])
def test_a_closed_stream_is_none_that_a_file_is_mistaken_for(tmp_path, closed):
    (tmp_path / "script").write_text(COMMAND)
    done = subprocess.run(
        f"{sys.executable} script word {closed}", shell=True, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr
    assert (tmp_path / "opened").read_text() == "True"
    assert done.stdout == ("" if "1>" in closed else "word\n")


def test_a_character_that_the_terminal_lacks_is_written_as_its_code(tmp_path):
    ascii_alone = {**os.environ, "PYTHONIOENCODING": "ascii"}
    with started(tmp_path, "± é", env=ascii_alone, stdout=subprocess.PIPE) as process:
        assert process.communicate()[0].splitlines() == ["\\xb1 \\xe9"]
    assert process.returncode == 0


def test_a_name_that_is_no_text_is_refused(tmp_path):
    with started(tmp_path, os.fsdecode(b"folder-\xff"), stdout=subprocess.PIPE) as process:
        assert process.communicate()[1] == "error: b'folder-\\xff': a name that is no text (UTF-8); rename it\n"
    assert process.returncode == 2


def test_a_reader_that_goes_away_ends_a_command_without_a_word(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    with started(tmp_path, "word", stdout=writing) as process:
        os.close(writing)
        assert process.communicate()[1] == "to the terminal\nfrom a library" and process.returncode == 1


def test_a_broken_pipe_of_another_kind_is_a_defect(tmp_path):
    with started(tmp_path, "pipe", stdout=subprocess.PIPE) as process:
        assert "a pipe to another process is broken" in process.communicate()[1]


def test_a_working_folder_that_was_removed_is_one_line(tmp_path):
    (tmp_path / "gone").mkdir()
    leave = "import os; os.chdir('gone'); os.rmdir('../gone')\n"
    with started(tmp_path, before=leave) as process:
        assert process.communicate()[1] == (
            "error: the working folder is gone (No such file or directory); change to another folder\n"
        )
    assert process.returncode == 2


def test_an_interrupt_while_a_script_is_importing_is_one_word(tmp_path):
    with started(tmp_path, before="import graspq.common.options, time\nprint('on', flush=True); time.sleep(60)\n",
                 stdout=subprocess.PIPE) as process:  # fmt: skip
        assert process.stdout.readline() == "on\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate()[1] == "interrupted\n" and process.returncode == -signal.SIGINT


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_a_library_swallows_and_breaks_on_is_one_word_too(tmp_path, number):
    with started(tmp_path, "swallow", stdout=subprocess.PIPE) as process:
        assert [process.stdout.readline() for _ in range(2)] == ["swallow\n", "on\n"]
        process.send_signal(number)
        said = process.communicate()[1]
    assert process.returncode == 130 and said.endswith("interrupted\n") and "Traceback" not in said
    swallowed = """if True:
        import graspq.common.options, time
        try:
            print("on", flush=True)
            time.sleep(60)
        except BaseException as error:
            raise TypeError("broken later")
    """
    with started(tmp_path, before=swallowed, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == "on\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate()[1] == "interrupted\n" and process.returncode == 1


@pytest.mark.parametrize("ignored", ["", "signal.signal(signal.SIGINT, signal.SIG_IGN)"])
def test_sigterm_ends_a_command_as_an_interrupt_does_in_the_background_too(tmp_path, ignored):
    with started(tmp_path, "wait", before=f"import signal\n{ignored}\n", stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == "wait\n"
        process.send_signal(signal.SIGTERM)
        said = process.communicate()[1]
    assert process.returncode == 130 and said.endswith("interrupted\n") and "Traceback" not in said


@pytest.mark.parametrize(
    ("before", "meanwhile"),
    [
        (signal.SIG_DFL, streams._interrupt),
        (signal.SIG_IGN, signal.SIG_IGN),
        (signal.getsignal, signal.getsignal),  # somebody's own
    ],
)
def test_only_the_usual_answer_to_sigterm_is_replaced_and_comes_back(before, meanwhile):
    ours = signal.signal(signal.SIGTERM, before)
    try:
        with ended_in_order():
            assert signal.getsignal(signal.SIGTERM) == meanwhile
        assert signal.getsignal(signal.SIGTERM) == before
    finally:
        signal.signal(signal.SIGTERM, ours)


def test_a_second_interrupt_at_the_end_leaves_no_traceback(tmp_path):
    slow_end = (
        "import threading, time; threading._register_atexit(lambda: (print('ending', flush=True), time.sleep(60)))\n"
    )
    with started(tmp_path, "wait", before=slow_end, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == "wait\n"
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "ending\n"
        process.send_signal(signal.SIGINT)
        said = process.communicate()[1]
    assert process.returncode == -signal.SIGINT and said.endswith("interrupted\n") and "Traceback" not in said
