"""Plans: what is done is skipped, a failure is reported or raised, a folder's plan can grow but not change."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.common.files import write_json
from graspq.engine.plan import Ending, carry_out, older_units


@dataclass(frozen=True)
class Word:
    """Writes a file, or fails; needs the file of another one, if any."""

    folder: Path
    name: str
    needs: str | None = None
    raises: Exception | None = None

    def done(self) -> bool:
        return (self.folder / self.name).exists()

    def run(self) -> None:
        if self.raises is not None:
            raise self.raises
        before = (self.folder / self.needs).read_text() if self.needs is not None else ""
        (self.folder / self.name).write_text(f"{before}{self.name} ")


def carried(units: Sequence[Word], **options: Any) -> list[tuple[str, bool, str | None]]:
    endings: list[Ending[Word]] = []
    with contextlib.suppress(UserError, ValueError):
        carry_out(units, endings.append, **options)
    return [(one.unit.name, one.skipped, one.error) for one in endings]


def test_units_run_in_order_and_what_is_done_is_reported_as_skipped(tmp_path: Path) -> None:
    units = [Word(tmp_path, "a"), Word(tmp_path, "b", needs="a"), Word(tmp_path, "c", needs="b")]
    units[0].run()
    assert carried(units) == [("a", True, None), ("b", False, None), ("c", False, None)]
    assert (tmp_path / "c").read_text() == "a b c "
    assert [skipped for _, skipped, _ in carried(units)] == [True] * 3
    assert [skipped for _, skipped, _ in carried(units, again=True)] == [False] * 3


@pytest.mark.parametrize(
    ("error", "said"), [(UserError("no disk"), "no disk"), (ValueError("defect"), "ValueError: defect")]
)
def test_a_failure_is_reported_and_the_others_go_on_or_it_ends_the_plan(
    error: Exception, said: str, tmp_path: Path
) -> None:
    units = [Word(tmp_path, "a", raises=error), Word(tmp_path, "b")]
    assert carried(units) == [("a", False, said), ("b", False, None)]
    (tmp_path / "b").unlink()
    assert carried(units, keep_going=False) == []
    with pytest.raises(type(error)):
        carry_out(units, lambda ending: None, keep_going=False)
    assert not (tmp_path / "b").exists()


def test_workers_are_handed_what_is_not_done_and_closed_when_a_report_fails(tmp_path: Path) -> None:
    handed: list[list[str]] = []
    closed: list[bool] = []

    def hand_out(units: Sequence[Word]) -> Iterator[tuple[Word, str | None]]:
        handed.append([unit.name for unit in units])
        try:
            yield from ((unit, None if unit.name == "c" else "lost") for unit in reversed(units))
        finally:
            closed.append(True)

    units = [Word(tmp_path, name) for name in "abc"]
    units[0].run()
    assert carried(units, hand_out=hand_out) == [("a", True, None), ("c", False, None), ("b", False, "lost")]

    def report(ending: Ending[Word]) -> None:
        if not ending.skipped:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        carry_out(units, report, hand_out=hand_out)
    assert (handed, closed) == ([["b", "c"]] * 2, [True] * 2)
    units[1].run()
    units[2].run()
    carried(units, hand_out=hand_out)
    assert len(handed) == 2


def test_a_folders_plan_gives_its_units_and_refuses_another_kind(tmp_path: Path) -> None:
    shared, word = {"format_version": 1, "steps": 3, "shards": ["here"]}, Word(tmp_path, "a")

    def older(**changed: Any) -> list[Word]:
        return older_units(tmp_path, "study", shared | changed, ("steps",), lambda one: replace(word, name=one["id"]))

    assert older() == []
    write_json(tmp_path / "plan.json", shared | {"jobs": [{"id": "b"}]})
    assert older() == older(shards=["moved"]) == [Word(tmp_path, "b")]
    with pytest.raises(UserError, match="holds a study with steps = 3, not 4; choose another --out"):
        older(steps=4)
    with pytest.raises(UserError, match="holds a study with format_version = 1, not 2"):
        older(format_version=2)
    for broken in ({"jobs": [{}]}, {"jobs": None}):
        write_json(tmp_path / "plan.json", shared | broken)
        with pytest.raises(UserError, match=r"plan\.json: not a whole plan of a study"):
            older()
