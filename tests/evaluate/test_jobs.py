"""Jobs from command lines and TOML files: lists are multiplied out, bad keys are refused in one line."""

from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.evaluate.jobs import jobs_from_settings
from graspq.evaluate.settings import EvalSettings
from graspq.train.search_settings import CemSettings


def make_run(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    return folder


def jobs_of(tmp_path: Path, text: str, **settings: object) -> list:  # type: ignore[type-arg]
    path = tmp_path / "jobs.toml"
    path.write_text(text)
    return jobs_from_settings(EvalSettings(jobs=path, **settings))  # type: ignore[arg-type]


def test_a_command_line_names_runs_then_policies(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name) for name in ("b", "a")]
    settings = EvalSettings(runs=(str(runs[0]), str(runs[1])), policy=("random", "oracle", "mine:make"), episodes=7)
    jobs = jobs_from_settings(settings)
    assert [job.label for job in jobs] == ["b", "a", "random", "oracle", "mine:make"]
    assert {job.episodes for job in jobs} == {7}


def test_globs_find_runs_alone_each_once_and_in_order(tmp_path: Path) -> None:
    for name in ("mc-1", "mc-0", "dql-0"):
        make_run(tmp_path / name)
    (tmp_path / "mc-notes").mkdir()
    jobs = jobs_from_settings(EvalSettings(runs=(f"{tmp_path}/mc-*", f"{tmp_path}/*-0")))
    assert [job.label for job in jobs] == ["mc-0", "mc-1", "dql-0"]


def test_a_file_multiplies_its_lists_out(tmp_path: Path) -> None:
    make_run(tmp_path / "mc")
    jobs = jobs_of(
        tmp_path,
        f"""
        episodes = 500
        [[jobs]]
        runs = ["{tmp_path}/m*"]
        policies = ["random"]
        seeds = [0, 1]
        splits = ["test", "train"]
        cem = {{ samples = 128 }}
        [[jobs]]
        policies = ["oracle"]
        tasks = ["targeted"]
        objects = ["data/objects/targeted"]
        episodes = 20
        """,
    )
    assert len(jobs) == 2 * 2 * 2 + 1
    assert {(job.split, job.seed) for job in jobs[:8]} == {
        (split, seed) for split in ("test", "train") for seed in (0, 1)
    }
    assert {job.episodes for job in jobs[:8]} == {500}
    assert jobs[0].cem == CemSettings(samples=128)
    assert (jobs[8].policy, jobs[8].task, jobs[8].episodes) == ("oracle", "targeted", 20)
    assert jobs[8].objects == Path("data/objects/targeted")


def test_a_file_without_tables_is_one_table_and_takes_the_rest_from_the_command_line(tmp_path: Path) -> None:
    (job,) = jobs_of(tmp_path, 'policies = ["random"]', episodes=11, seed=4, split="train")
    assert (job.policy, job.episodes, job.seed, job.split) == ("random", 11, 4, "train")


def test_the_same_job_named_twice_counts_once(tmp_path: Path) -> None:
    table = '[[jobs]]\npolicies = ["random"]\n'
    assert len(jobs_of(tmp_path, table + table)) == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('policy = ["random"]', "unknown key 'policy'; expected some of runs, policies"),
        ('policies = "random"', "policies = 'random'; expected a list of strings"),
        ('policies = ["random"]\nseeds = [1.5]', r"seeds = \[1.5\]; expected a list of whole numbers"),
        ('policies = ["random"]\nseeds = [-1]', "a seed is at least 0"),
        ('policies = ["random"]\nseeds = [true]', "expected a list of whole numbers"),
        ('policies = ["random"]\nepisodes = 0', "episodes = 0; expected a whole number"),
        ('policies = ["random"]\nepisodes = "10k"', "episodes = '10k'; expected a whole number"),
        ('policies = ["random"]\nsplits = []', r"splits = \[\]; expected a list of strings"),
        ('policies = ["random"]\ncem = { sample = 3 }', "unknown setting 'sample'"),
        ('policies = ["random"]\ncem = { elites = 99 }', "expected at most as many as samples"),
        ('policies = ["greedy"]', "'greedy' is unknown; choose random, oracle, or module:factory"),
        ("seeds = [0]", "neither runs nor policies"),
        ('runs = ["no/such/*"]', "no/such/\\*: no run folder matches"),
        ("jobs = 3", r"write each as \[\[jobs\]\]"),
        ("policies = [", "not a readable TOML file"),
    ],
)
def test_a_mistake_in_a_file_is_one_line_that_names_it(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        jobs_of(tmp_path, text)


def test_no_jobs_and_jobs_from_two_sources_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nothing to evaluate"):
        jobs_from_settings(EvalSettings())
    with pytest.raises(UserError, match="no such jobs file"):
        jobs_from_settings(EvalSettings(jobs=tmp_path / "absent.toml"))
    with pytest.raises(UserError, match="leave out RUN and --policy"):
        jobs_from_settings(EvalSettings(jobs=tmp_path / "jobs.toml", policy=("random",)))
