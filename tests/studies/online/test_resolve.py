import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.common.errors import UserError
from graspq.studies.online.resolve import Plan, resolve
from graspq.train.settings import complete

Make = Callable[..., Plan]


def test_a_start_run_gives_its_settings_and_its_step(make_plan: Make, tmp_path: Path, base: Path) -> None:
    plan = make_plan(tmp_path / "out")
    assert (plan.train.algo, plan.train.network, plan.train.batch_size) == ("dql", "paper", 8)
    assert plan.train.shards == (str(base),) and plan.train.average_decay == 0.9
    assert [plan.border(number) for number in range(4)] == [6, 12, 18, 24] and plan.train.steps == 24


def test_options_given_stand_above_those_of_the_start_run(make_plan: Make, tmp_path: Path) -> None:
    plan = make_plan(tmp_path / "out", batch_size=4, seed=3, schedule="cosine", warmup=0.5, learning_rate=0.1)
    train = plan.train
    assert (train.batch_size, train.seed, train.schedule, train.warmup, train.learning_rate) == (
        4,
        3,
        "cosine",
        0.5,
        0.1,
    )
    assert plan.split_seed == 0


def test_training_goes_on_at_the_constant_rate_of_its_run(make_plan: Make, tmp_path: Path) -> None:
    train = make_plan(tmp_path / "out").train
    assert (train.schedule, train.warmup, train.learning_rate) == ("constant", 0.0, 1e-3)


def test_the_correction_of_corr_mc_stays_risen(make_plan: Make, start: Path, tmp_path: Path, base: Path) -> None:
    settings = complete({"algo": "corr-mc", "shards": (str(base),)}, "paper")
    copy = shutil.copytree(start, tmp_path / "corr-mc")
    config = read_checked_json(copy / "config.json", "run", "") | {"settings": settings.to_json()}
    write_checked_json(copy / "config.json", config)
    assert settings.own.anneal == 0.05
    assert make_plan(tmp_path / "out", start=copy).train.own.anneal == 0.0


def test_after_a_rate_that_fell_to_zero_it_goes_on_at_a_tenth(make_plan: Make, start: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(start, tmp_path / "cosine")
    config = read_checked_json(copy / "config.json", "run", "")
    config["settings"] |= {"schedule": "cosine", "learning_rate": 0.02}
    write_checked_json(copy / "config.json", config)
    train = make_plan(tmp_path / "out", start=copy).train
    assert (train.schedule, train.learning_rate) == ("constant", 0.002)


def test_from_scratch_the_preset_decides_all_but_the_schedule(base: Path) -> None:
    plan = resolve({"algo": "mc", "shards": (str(base),), "rounds": 2, "steps_per_round": 10})
    assert plan.start is None and plan.train.steps == 20 and plan.border(0) == 0
    assert (plan.train.schedule, plan.train.learning_rate, plan.train.batch_size) == ("constant", 2e-3, 256)
    paper = resolve({"algo": "mc", "shards": (str(base),), "preset": "paper"})
    assert (paper.train.learning_rate, paper.train.batch_size, paper.train.own.loss) == (1e-3, 32, "huber")
    assert str(paper.train.run_folder) == "runs/online-mc-base-seed0"


def test_an_earlier_checkpoint_can_be_the_start(make_plan: Make, tmp_path: Path) -> None:
    plan = make_plan(tmp_path / "out", checkpoint=3)
    assert plan.border(0) == 3 and plan.train.steps == 21
    assert plan.described() != make_plan(tmp_path / "out").described()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"algo": "mc"}, r"--algo: .* was trained with dql, got mc; leave the option out"),
        ({"width": 16}, r"--width: .* was trained with 8, got 16"),
        ({"loss": "cross-entropy"}, r"--loss: .* was trained with huber, got cross-entropy"),
        ({"preset": "paper"}, r"--preset: .* has its settings already"),
        ({"anneal": 0.5}, r"--anneal belongs to --algo corr-mc; it is no option of --algo dql"),
        ({"network": "default"}, r"--network: .* was trained with paper, got default"),
        ({"checkpoint": 5}, "has no checkpoint of step 5, only of 3, 6"),
        ({"start": Path("nowhere")}, "nowhere"),
        ({"start": None}, "--algo: is needed from scratch"),
        ({"start": None, "algo": "mc"}, "--shards: is needed from scratch"),
        ({"start": None, "algo": "mc", "shards": ("x",), "checkpoint": 3}, "--checkpoint: is that of a start run"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(
    make_plan: Make, tmp_path: Path, given: dict[str, object], message: str
) -> None:
    with pytest.raises(UserError, match=message) as error:
        make_plan(tmp_path / "out", **given)
    assert "\n" not in error.value.message
