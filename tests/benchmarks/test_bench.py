"""The command that runs all benchmarks, and the table of ratios that it writes."""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any

import pytest

from graspq.benchmarks import bench
from graspq.benchmarks.harness import Ratio
from graspq.common.errors import UserError

ROOT = Path(__file__).resolve().parents[2]


def figures(value: float) -> dict[str, Any]:
    return {
        "ratios": [dataclasses.asdict(Ratio("x against y", value, bar=4)), dataclasses.asdict(Ratio("… z", 2.0))],
        "tables": {},
    }


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "page.md").write_text(f"before\n{bench.BEGIN}\nold\n{bench.END}\nafter\n")
    (tmp_path / "work").mkdir()
    published = {"decision": figures(20.0), "estimators": figures(5.0)}
    (tmp_path / "bench.json").write_text(
        json.dumps({"parts": published, "commands": dict.fromkeys(published, "as it was")})
    )
    return tmp_path


def run(place: Path, *more: str) -> int:
    given = ["--work", str(place / "work"), "--out", str(place / "bench.json"), "--page", str(place / "page.md")]
    with pytest.raises(SystemExit) as ended:
        bench.main.main([*given, *more], prog_name="bench")
    return int(ended.value.code or 0)


def test_every_part_is_a_script_that_takes_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    for template in bench.PARTS.values():
        script, *words = template.format(shards="s", run="r", work="w").split()
        main = importlib.import_module(f"graspq.benchmarks.{script}").main
        options = {name for parameter in main.params for name in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options


def test_a_finished_part_is_not_run_again_and_the_page_shows_all(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "PARTS", {name: bench.PARTS[name] for name in ("estimators", "decision")})
    for name, value in (("estimators", 5.0), ("decision", 30.0)):
        (place / "work" / f"{name}.json").write_text(json.dumps(figures(value)))
    assert run(place, "--shards", "d") == 0
    parts = json.loads((place / "bench.json").read_text())["parts"]
    assert parts == {"estimators": figures(5.0), "decision": figures(30.0)}
    text = (place / "page.md").read_text()
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
    assert "| x against y | 30 | ≥ 4 |  | yes | `python benchmarks/decision.py` |" in text
    assert "| x against y | 5 | ≥ 4 |  | yes | `python benchmarks/estimators.py --shards d` |" in text
    assert text.count("`python benchmarks/decision.py`") == 1, "the command stands at a part's first line alone"


def test_a_part_that_is_named_is_measured_anew_and_the_others_stay_as_published(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(bench.PARTS, "decision", "decision --turns 1 --many 1")
    (place / "work" / "decision.json").write_text(json.dumps(figures(30.0)))
    assert run(place, "--part", "decision") == 0
    parts = json.loads((place / "bench.json").read_text())["parts"]
    assert list(parts) == ["estimators", "decision"] and parts["estimators"] == figures(5.0)
    assert parts["decision"] == json.loads((place / "work" / "decision.json").read_text()) != figures(30.0)
    assert parts["decision"]["settings"] == {"turns": 1, "many": [1]} and parts["decision"]["measured"]["versions"]
    text = (place / "page.md").read_text()
    assert "| x against y | 5 | ≥ 4 |  | yes | `as it was` |" in text
    assert "`python benchmarks/decision.py --turns 1 --many 1`" in text


def test_a_part_that_fails_leaves_what_was_measured_but_nothing_that_it_would_go_on_from(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "work" / "decision").mkdir()
    (place / "work" / "decision" / "half").touch()
    (place / "work" / "decision.json").write_text(json.dumps(figures(30.0)))
    text = (place / "page.md").read_text()
    monkeypatch.setitem(bench.PARTS, "decision", "decision --turns 0")
    assert run(place, "--part", "decision") == 2
    assert [path.name for path in (place / "work").iterdir()] == ["decision.json"]
    assert (place / "page.md").read_text() == text


def test_the_published_page_is_made_from_the_stored_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "RESULTS.md"
    page.write_text((ROOT / "RESULTS.md").read_text())
    monkeypatch.chdir(ROOT)
    bench.write_page(page, Path("results/bench.json"))
    assert page.read_text() == (ROOT / "RESULTS.md").read_text()


def test_a_part_that_does_not_exist_is_one_clear_line(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(place, "--part", "speed") == 2
    assert "'speed' is no part of the benchmarks" in capsys.readouterr().err


def test_a_page_without_marks_is_refused() -> None:
    with pytest.raises(UserError, match="lacks"):
        bench.with_section("no marks", "| a |")
