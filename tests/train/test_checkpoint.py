"""Checkpoints: what is saved comes back, and what is damaged or foreign is refused in one line."""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.torch
import torch
from plain import FLOAT32

from graspq.common.errors import UserError
from graspq.train.checkpoint import describe, load_acting, load_checkpoint, save_checkpoint
from graspq.train.loop import train
from graspq.train.networks.network import NetworkSpecification
from graspq.train.run import Run
from graspq.train.settings import TrainSettings
from graspq.train.state import TrainState, new_state

Make = Callable[..., TrainSettings]


def fresh_state(specification: NetworkSpecification, settings: TrainSettings) -> TrainState:
    lagged = settings.own.lag is not None
    return new_state(
        specification, settings.estimator.parts_of(settings.own), settings, settings.seed, FLOAT32, lagged=lagged
    )


@pytest.fixture
def run(settings: Make) -> Run:
    return train(settings("dql", steps=2))


def flip(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)


def test_a_checkpoint_restores_every_tensor_and_its_layout(settings: Make, run: Run) -> None:
    chosen = settings("dql", steps=2)
    specification = NetworkSpecification.from_json(run.config["network"])
    state = fresh_state(specification, chosen)
    load_checkpoint(run.checkpoint(), state)
    assert state.step == 2
    fresh = fresh_state(specification, chosen)
    assert not torch.equal(state.networks.online["q"].last.weight, fresh.networks.online["q"].last.weight)  # type: ignore[arg-type]
    again = save_checkpoint(run.folder / "again", state)
    for path in run.checkpoint().iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name
    for (name, ours), theirs in zip(
        state.networks.online["q"].named_parameters(), fresh.networks.online["q"].parameters(), strict=True
    ):
        assert ours.stride() == theirs.stride(), name
        assert state.optimizers["q"].state[ours]["exp_avg"].stride() == ours.stride(), name


def test_a_policy_gets_the_averaged_network_in_evaluation_mode(run: Run) -> None:
    loaded = load_acting(run.folder)
    network = loaded.networks["q"]
    averaged = (run.checkpoint() / "averaged-q.safetensors").read_bytes()
    assert not network.training and not any(parameter.requires_grad for parameter in network.parameters())
    assert loaded.step == 2 and loaded.config["settings"]["algo"] == "dql"
    for name, tensor in safetensors.torch.load(averaged).items():
        assert torch.equal(network.state_dict()[name], tensor)


def test_a_policy_is_loaded_from_a_run_or_from_one_of_its_checkpoints(settings: Make) -> None:
    run = train(settings(steps=20))
    assert [path.name for path in run.checkpoints()] == ["step-00000010", "step-00000020"]
    newest, older = load_acting(run.folder), load_acting(run.folder, step=10)
    same = load_acting(run.checkpoints()[0])
    first, second, third = (loaded.networks["q"].state_dict()["last.weight"] for loaded in (older, same, newest))
    assert older.step == same.step == 10 and newest.step == 20
    assert torch.equal(first, second) and older.sha256 == same.sha256
    assert not torch.equal(first, third) and older.sha256 != newest.sha256
    with pytest.raises(UserError, match="no checkpoint of step 7, only of 10, 20"):
        load_acting(run.folder, step=7)


@pytest.mark.parametrize("name", ["averaged-q.safetensors", "kept.safetensors", "state.json"])
def test_a_single_flipped_bit_anywhere_is_noticed(run: Run, name: str) -> None:
    path = run.checkpoint() / name
    original = path.read_bytes()
    for position in {0, 5, len(original) // 3, len(original) // 2, len(original) - 2}:
        flip(path, position)
        with pytest.raises(UserError) as error:
            load_acting(run.folder)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
        path.write_bytes(original)
    load_acting(run.folder)


def test_training_goes_on_from_the_newest_whole_checkpoint_and_says_so(
    settings: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    run = train(settings("dql", steps=6, save_every=2))
    whole, metrics = load_acting(run.folder).sha256, [row for row in run.metrics() if "validation" in row]
    newest, before, first = reversed(run.checkpoints())
    flip(newest / "lagged-q.safetensors", -1)
    (before / "optimizer-q.safetensors").unlink()
    with pytest.raises(UserError, match="delete this checkpoint's folder to go on from the one before it"):
        load_checkpoint(newest, fresh_state(NetworkSpecification.from_json(run.config["network"]), settings("dql")))
    capsys.readouterr()
    train(settings("dql", steps=6, save_every=2))
    said = [line for line in capsys.readouterr().err.splitlines() if "checkpoint before it" in line]
    assert [str(newest) in said[0], str(before) in said[1], len(said)] == [True, True, 2]
    assert load_acting(run.folder).sha256 == whole
    assert [row for row in run.metrics() if "validation" in row] == metrics
    for checkpoint in (newest, before, first):
        flip(checkpoint / "state.json", 40)
    with pytest.raises(UserError, match="no checkpoint is whole"):
        train(settings("dql", steps=6, save_every=2))


def test_a_checkpoint_names_no_files_but_its_own_and_its_weights_are_finite(run: Run, settings: Make) -> None:
    state = fresh_state(NetworkSpecification.from_json(run.config["network"]), settings("dql"))
    parameter = next(state.networks.online["q"].parameters())
    parameter.data.fill_(torch.nan)
    broken = save_checkpoint(run.folder / "again", state)
    with pytest.raises(UserError, match=r"q\.safetensors: .* is not finite"):
        load_checkpoint(broken, state)
    description = describe(run.checkpoint())
    for change in ({"files": {"../../config.json": "0" * 64}}, {"files": []}, {"step": "2"}, {"parts": [1]}):
        changed = description | change
        digest = hashlib.sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()
        (run.checkpoint() / "state.json").write_text(json.dumps(changed | {"digest": digest}))
        with pytest.raises(UserError, match="not the description of a checkpoint"):
            load_acting(run.folder)


def test_a_truncated_or_missing_file_is_refused(run: Run) -> None:
    path = run.checkpoint() / "averaged-q.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(UserError, match="damaged"):
        load_acting(run.folder)
    path.unlink()
    with pytest.raises(UserError, match="cannot be read"):
        load_acting(run.folder)


def test_a_checkpoint_of_another_network_is_refused(settings: Make, run: Run, tmp_path: Path) -> None:
    other = train(settings("dql", steps=2, network="paper", out=tmp_path / "other"))
    shutil.rmtree(run.checkpoint())
    shutil.copytree(other.checkpoint(), run.checkpoints_folder / "step-00000002")
    with pytest.raises(UserError, match="of another network than its run"):
        load_acting(run.folder)
    with pytest.raises(UserError, match="of another network: expected"):
        train(settings("dql", steps=2))


def test_weights_of_another_network_are_refused_even_with_fitting_digests(run: Run, settings: Make) -> None:
    ours = NetworkSpecification.from_json(run.config["network"])
    state = fresh_state(dataclasses.replace(ours, name="paper"), settings("dql"))
    networks = dataclasses.replace(state.networks, specification=ours)
    save_checkpoint(run.checkpoints_folder, dataclasses.replace(state, networks=networks))
    with pytest.raises(UserError, match=r"action\.weight should be absent, is \[33, 4\]"):
        load_acting(run.folder, step=0)


def test_what_an_estimator_keeps_besides_comes_back_and_is_part_of_the_digest(settings: Make) -> None:
    run = train(settings("blend", steps=4, save_every=2))
    later, earlier = load_acting(run.folder), load_acting(run.folder, step=2)
    assert later.kept.keys() == {"blend_errors", "blend_rows"} and later.kept["blend_errors"].dtype == torch.float64
    assert not torch.equal(later.kept["blend_errors"], earlier.kept["blend_errors"])
    assert later.sha256 != earlier.sha256


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no training run"):
        load_acting(tmp_path / "nothing")
    (tmp_path / "config.json").write_text(json.dumps({"settings": {}}))
    with pytest.raises(UserError, match="no checkpoint yet"):
        load_acting(tmp_path)
