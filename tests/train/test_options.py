"""The options of training on a command line, of our estimators and of a user's own."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest

from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.train.cli import main
from graspq.train.estimator import RegressionSettings
from graspq.train.estimators import ESTIMATORS, estimator_named
from graspq.train.options import value_of
from graspq.train.run import Run
from graspq.train.settings import complete


def grasp_train(capture: pytest.CaptureFixture[str], *options: str) -> SimpleNamespace:
    with pytest.raises(SystemExit) as ended:
        main(options, prog_name="grasp-train")
    output = capture.readouterr()
    return SimpleNamespace(returncode=ended.value.code, stdout=output.out, stderr=output.err)


def flags(text: str) -> list[str]:
    return re.findall(r"^  (--[a-z-]+)", text, flags=re.MULTILINE)


@pytest.mark.parametrize("algo", ESTIMATORS)
def test_the_help_has_the_common_options_and_then_those_of_the_estimator_and_the_network(
    capsys: pytest.CaptureFixture[str], algo: str
) -> None:
    shown = grasp_train(capsys, "--algo", algo, "--network", "paper", "--help").stdout
    common, _, rest = shown.partition(f"Options of --algo {algo}:")
    own, _, network = rest.partition("Options of --network paper:")
    assert flags(common)[:6] == ["--version", "--algo", "--shards", "--out", "--seed", "--preset"]
    expected = [
        "--" + name.replace("_", "-") for name in (f.name for f in dataclasses.fields(ESTIMATORS[algo].settings))
    ]
    assert sorted(flags(own)) == sorted(expected) and flags(network) == ["--width"]
    assert not set(flags(common)) & set(expected)


def test_the_help_without_an_estimator_names_them_all(capsys: pytest.CaptureFixture[str]) -> None:
    shown = grasp_train(capsys, "--help").stdout
    for name, row in ESTIMATORS.items():
        assert re.search(rf"^  {name} ", shown, flags=re.MULTILINE) and row.summary.split()[0] in shown
    assert "--lag-steps" not in shown


def test_the_help_says_what_either_preset_gives(capsys: pytest.CaptureFixture[str]) -> None:
    shown = " ".join(grasp_train(capsys, "--algo", "pcl", "--help").stdout.split())
    for text in ("default: tuned; paper: 3]", "default: all; paper: 10]", "default: 256; paper: 64]"):
        assert text in shown
    assert "default: 256; paper: 32]" in " ".join(grasp_train(capsys, "--algo", "mc", "--help").stdout.split())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--anneal", "0.5"], "--anneal belongs to --algo corr-mc; it is no option of --algo mc"),
        (["--no-centred"], "--no-centred belongs to --algo corr-mc, --algo blend; it is no option of --algo mc"),
        (["--width", "8"], "--width belongs to --network paper; it is no option of --algo mc with --network default"),
        (["--beta", "1"], "No such option: --beta (with --algo mc and --network default)"),
    ],
)
def test_an_option_of_another_is_refused_in_one_line_that_names_whose_it_is(
    capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    done = grasp_train(capsys, "--algo", "mc", "--shards", "x", *options)
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1


OWN_ROW = """
import dataclasses
import torch
from torch import nn
from graspq.common.options import setting
from graspq.train.estimator import Loss, RegressionSettings, TargetValue, loss_of, squared, targets_of
from graspq.train.estimators.mc import row
from graspq.train.networks.network import QNetwork

@dataclasses.dataclass(frozen=True)
class Settings(RegressionSettings):
    part: float = setting(0.5, help="Part of the return.", minimum=0, maximum=1)

class Network(QNetwork):
    link = "identity"

    def __init__(self, specification):
        super().__init__()
        self.last = nn.Linear(specification.actions, 1)

    def trunk(self, image, step):
        return (image.float().mean((1, 2, 3)) / 255,)

    def head(self, features, action):
        return self.last(action).squeeze(-1) + features[0].unsqueeze(1)

def target(batch, networks, settings, random, progress):
    return settings.part * batch.mc_return

def update(row, state, batch, settings, random, progress):
    wanted = targets_of(row, batch, state.networks, settings, random, progress)
    metrics = loss_of(row, batch, wanted, state.networks, settings)
    state.descend("q", metrics["loss"])
    return {name: value.detach() for name, value in metrics.items()} | {"part": torch.tensor(settings.part)}

def doubled(output, target):
    return 2 * squared(output, target)

class Still:
    words = "no motion"

    def act(self, acting, state, random, cem):
        still = torch.zeros(1, acting.action.size)
        return still, acting.q.at(state.image, state.step)(still.unsqueeze(1)).squeeze(1)

row = dataclasses.replace(
    row, summary="Part of the return", settings=Settings, paper=Settings(loss="squared", part=0.25),
    target_value=TargetValue("part of the episode value", target), action_selection=Still(),
    loss=lambda settings: Loss("identity", doubled), parts={"q": Network}, update=update)
wrong = "mc"
"""
SHORT = ["--steps", "4", "--save-every", "2", "--batch-size", "16", "--threads", "1", "--out", "run"]


def test_a_row_of_ones_own_has_options_networks_update_loss_and_selection_of_its_own(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rows_of_options.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    words = ["--algo", "rows_of_options:row", "--shards", str(dataset)]
    shown = grasp_train(capsys, *words, "--help").stdout
    own = shown.partition("Options of --algo rows_of_options:row:")[2]
    assert flags(own) == ["--part", "--loss"] and "default: 0.5; paper: 0.25]" in " ".join(own.split())
    refused = grasp_train(capsys, *words, *SHORT, "--part", "2")
    assert refused.returncode == 2 and "--part: expected a number of at least 0 and at most 1, got 2" in refused.stderr
    assert not (tmp_path / "run").exists()

    run = [*words, *SHORT, "--part", "0.75"]
    assert grasp_train(capsys, *run).returncode == 0
    config = Run.open(tmp_path / "run").config
    assert config["settings"]["own"] == {"loss": "cross-entropy", "part": 0.75}
    assert config["network"]["link"] == "identity"
    assert {row["part"] for row in Run.open(tmp_path / "run").metrics() if "loss" in row} == {0.75}
    assert grasp_train(capsys, *run).returncode == 0
    other = grasp_train(capsys, *words, *SHORT)
    assert other.returncode == 2 and "holds a run with part = 0.75, not 0.5; choose another folder" in other.stderr
    named = complete({"algo": "rows_of_options:row", "shards": (str(dataset),), "part": 0.1})
    assert named.run_folder == Path("runs/rows_of_options-row-two-states-seed0")


def test_what_is_no_row_is_refused_and_the_path_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "wrong_rows.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    assert estimator_named("wrong_rows:row").summary == "Part of the return"
    with pytest.raises(UserError, match="--algo wrong_rows:wrong: expected Estimator, got str"):
        estimator_named("wrong_rows:wrong")
    with pytest.raises(UserError, match="--algo wrong_rows:none: wrong_rows has no 'none'"):
        estimator_named("wrong_rows:none")
    with pytest.raises(UserError, match="--algo absent_rows:row: cannot be imported"):
        estimator_named("absent_rows:row")


def named_like(name: str) -> Any:
    """Return a row with one option of this name."""
    kind = dataclasses.make_dataclass(
        "Settings", [(name, int, setting(1, help="A number."))], bases=(RegressionSettings,), frozen=True
    )
    return dataclasses.replace(ESTIMATORS["mc"], settings=kind, paper=kind())


@pytest.mark.parametrize("name", ["steps", "batch_size", "own", "preset", "help", "version"])
def test_an_option_of_an_estimator_may_not_take_a_common_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    monkeypatch.setitem(ESTIMATORS, "mine", named_like(name))
    message = f"--algo mine: Settings.{name} is the name of a common option; give it another"
    with pytest.raises(UserError, match=re.escape(message)):
        complete({"algo": "mine", "shards": ("data",)})
    done = grasp_train(capsys, "--algo", "mine", "--shards", "data", "--seed", "1")
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1


def test_an_option_of_an_estimator_may_not_take_the_name_of_one_of_its_networks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(ESTIMATORS, "mine", named_like("width"))
    assert complete({"algo": "mine", "shards": ("data",), "width": 3}).own.to_json()["width"] == 3
    with pytest.raises(UserError, match=r"Settings\.width is the name of an option of --network paper"):
        complete({"algo": "mine", "shards": ("data",), "network": "paper"})


def test_several_shards_may_follow_their_option_and_no_words_name_no_estimator() -> None:
    for words in (
        ["--algo", "mc", "--shards", "a", "b", "--seed", "1"],
        ["--algo", "mc", "--shards", "a", "--shards", "b"],
    ):
        context = main.make_context("grasp-train", words)
        assert context.params["shards"] == ("a", "b")
    assert value_of("--algo", []) is None
    with pytest.raises(click.UsageError):
        main.make_context("grasp-train", ["a"])
