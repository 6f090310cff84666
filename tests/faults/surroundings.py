"""Where and how a command is started: locale, hash seed, paths, links, working folder, variables, a wrong clock."""

import os
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from tests.faults.commands import LINES, MAKING, STUDY, TRAIN, Line
from tests.faults.harness import HERE, Fault, NotHereError, Tried, Work
from tests.faults.system_calls import NO_COMPILER, compiled

LOCALES = {
    "LANG=C": {"LANG": "C", "LC_ALL": "C"},
    "no UTF-8": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "a locale that is not there": {"LC_ALL": "tlh_KX.ISO-8859-1", "LANG": "tlh_KX"},
    "PYTHONHASHSEED=0": {"PYTHONHASHSEED": "0"},
    "PYTHONHASHSEED=4711": {"PYTHONHASHSEED": "4711"},
    "PYTHONOPTIMIZE=2": {"PYTHONOPTIMIZE": "2"},
    "another time zone": {"TZ": "Pacific/Kiritimati"},
    "COLUMNS=1": {"COLUMNS": "1"},
    "no HOME": {"HOME": "/nowhere/at/all"},
}
FOLDERS = {
    "spaces": "a folder with  two spaces ",
    "a newline": "a\nfolder",
    "two hundred letters": "f" * 200,
    "letters of a pattern": "[a-z]*?{x}",
    "quotes": 'it\'s "so" $HOME `x` \\ %s {0}',
    "no text": os.fsdecode(b"\xff\xfe"),
    "a hyphen first": "-rf",
    "letters of other scripts": "données-数据-данные",
}
PLACES = ("through a link", "from another working folder", "a link as its result", "a temporary folder of 200 letters")
CLOCKS = ("past", "future", "jumping")


class Surroundings:
    """Variables that a command is started with."""

    name = "surroundings"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each command with each of them."""
        for line in () if short else LINES:
            for name in LOCALES:
                yield Fault(self.name, line.name, name)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run the command and compare."""
        line = _line(fault)
        with line.case(work) as case:
            return _run(line, case, work, LOCALES[fault.name])


class Paths:
    """Folders of unusual names, links, and another working folder."""

    name = "paths"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each command with each of them."""
        for line in (TRAIN,) if short else LINES:
            for name in ("a newline",) if short else (*FOLDERS, *PLACES):
                # What a plan names is looked for in the working folder.
                if (name != PLACES[2] or line in MAKING) and (name != PLACES[1] or line is not STUDY):
                    yield Fault(self.name, line.name, name)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run the command there and compare."""
        line = _line(fault)
        with line.case(work) as case:
            if fault.name in FOLDERS:
                place = case / FOLDERS[fault.name]
                _move(case, place)
                # Both ways: a folder that the command is in, and one that its words name.
                there = _run(line, place, work)
                if there.outcome not in ("survived", "detected"):
                    return there
                made = place / line.result
                if line.result and made.is_dir():
                    shutil.rmtree(made)
                elif line.result:
                    made.unlink(missing_ok=True)  # what was refused has made nothing
                return _run(_named(line, Path(FOLDERS[fault.name])), place, work, inside=place)
            return _elsewhere(fault.name, line, case, work)


def _elsewhere(name: str, line: Line, case: Path, work: Work) -> Tried:
    if name == "through a link":
        _move(case, case / "real")
        (case / "link").symlink_to("real")
        return _run(line, case / "link", work)
    if name == "from another working folder":
        (case / "else").mkdir()
        return _run(_named(line, case), case / "else", work, inside=case)
    if name == "a link as its result":
        (case / "real").mkdir()
        result = case / line.result
        result.parent.mkdir(parents=True, exist_ok=True)
        result.symlink_to(case / "real")
        ran = work.forked(line.words, case)
        broken = ran.broken()
        if broken is not None:
            return broken
        if ran.rc != 0:
            left = list((case / "real").iterdir())
            return Tried("lost", f"left {left[0]}") if left else Tried("detected", ran.line)
        return line.fits(case, work, ran) if result.is_symlink() else Tried("lost", "the link was replaced")
    long = case / ("t" * 200)
    long.mkdir()
    return _run(line, case, work, {"TMPDIR": str(long)})


def _named(line: Line, folder: Path) -> Line:
    """Return the command with its paths named from another working folder."""
    inside = Path("..") / folder if not folder.is_absolute() else folder
    paths = {"objects", "data/regular-24", "runs/mc", "runs/online", "scores", "sweep", "study", "plan.toml"}
    paths |= {"report.html", "results", "page.md"}
    words = [str(inside / word) if word in paths else word for word in line.words[1:]]
    return replace(line, words=(line.words[0], *words))


class Clock:
    """A wall clock that is wrong, and one that jumps."""

    name = "clock"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each command with each clock."""
        if self._library(work) is None:
            raise NotHereError(NO_COMPILER)
        for line in () if short else LINES:
            for how in CLOCKS:
                yield Fault(self.name, line.name, how)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run the command with that clock and compare."""
        line = _line(fault)
        with line.case(work) as case:
            return _run(line, case, work, {"LD_PRELOAD": str(self._library(work)), "GRASPQ_CLOCK": fault.name})

    def _library(self, work: Work) -> Path | None:
        with work.alone():
            made = work.folder / "clock.so"
            return made if made.exists() else compiled(HERE / "clock.c", work.folder)


def _line(fault: Fault) -> Line:
    return next(line for line in LINES if line.name == fault.command)


def _move(case: Path, place: Path) -> None:
    found = list(case.iterdir())
    place.mkdir()
    for path in found:
        path.rename(place / path.name)


def _run(line: Line, cwd: Path, work: Work, env: dict[str, str] | None = None, inside: Path | None = None) -> Tried:
    """Run a command and compare what it makes, in the working folder unless `inside` says where.

    A name of a folder may be refused; a locale, a clock and a variable of the environment may not.
    """
    new = env is not None
    ran = work.run(line.words, cwd, env=env) if new else work.forked(line.words, cwd)
    broken = ran.broken()
    if broken is not None:
        return broken
    if ran.rc != 0:
        return Tried("detected" if ran.one_line and not new else "lost", f"exit status {ran.rc}: {ran.line}")
    return line.fits(inside if inside is not None else cwd, work, ran)
