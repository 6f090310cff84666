"""Rivals of a decision do the same job, on a network whose Q tells candidates apart; and the tables it writes."""

import json

import click
import decision
import pytest
import torch

from graspq.train.networks import NetworkSpecification, make_network
from graspq.train.selection import uniform_actions
from graspq.train.state import seeded

BATCH = 2


@pytest.fixture(autouse=True)
def no_gradients():
    with torch.no_grad():
        yield


def fresh(name):
    specification = NetworkSpecification(name, (64, 64, 3), 4, decision.STEPS, "logistic")
    return make_network(specification, seeded("tests/benchmarks/decision")).eval()


def scaled(name):
    network = fresh(name)
    decision.spread_out(network)
    return network


@pytest.fixture(scope="module", params=["default", "paper"])
def network(request):
    return scaled(request.param)


@pytest.fixture(scope="module")
def light():
    return scaled("paper")


@pytest.mark.parametrize("name", ["default", "paper"])
def test_fresh_weights_prove_nothing_and_scaled_ones_tell_candidates_apart(name):
    network = fresh(name)
    with pytest.raises(click.ClickException, match="would prove nothing"):
        decision.deviation_of_q(network, 8)
    decision.spread_out(network)
    # Raw outputs of deviation 1 about 0: Q of about a fifth.
    assert 0.1 < decision.deviation_of_q(network, 8) < 0.3


def test_the_scaled_network_sees_the_step(network):
    image, step = decision.states(BATCH)
    actions = uniform_actions(seeded("tests/benchmarks/actions"), BATCH)
    difference = network.at(image, step)(actions) - network.at(image, step + 1)(actions)
    assert difference.abs().max() > 10 * decision.TOLERANCE


def test_rivals_give_the_same_q_and_find_the_same_action(network):
    q = decision.q_by_way(network, BATCH)
    assert len(q) == 3
    assert all(of_way.shape == (BATCH, 64 + 1) for of_way in q.values())
    assert decision.greatest_difference(q) <= decision.TOLERANCE
    actions = [decide().action for decide in decision.searches(network, BATCH).values()]
    for other in actions[1:]:
        torch.testing.assert_close(other, actions[0], atol=1e-3, rtol=0)


def of_other_states(network, image, step):
    """What `repeat` in place of `repeat_interleave` gives: candidates of one state judged in another."""

    def q_of_actions(action):
        count = action.shape[1]
        copies = image.repeat(count, 1, 1, 1), step.repeat(count)
        return network.value_of(network(*copies, action.flatten(0, 1))).view(action.shape[:2])

    return q_of_actions


def of_the_next_step(network, image, step):
    return network.at(image, step + 1)


def of_one_action(network, image, step):
    return lambda action: network.at(image, step)(action[:, :1].expand_as(action))


def of_raw_outputs(network, image, step):
    """The search finds the same action: the order is the same."""
    return lambda action: network.head(network.trunk(image, step), action)


@pytest.mark.parametrize("wrong", [of_other_states, of_the_next_step, of_one_action, of_raw_outputs])
def test_a_rival_that_computes_something_else_is_refused(monkeypatch, light, wrong):
    monkeypatch.setitem(decision.WAYS, "cem, 64 tiled copies", wrong)
    with pytest.raises(click.ClickException, match=r"64 tiled copies: Q differs by .*, expected at most 0\.0001"):
        decision.decision_rows(light, torch.nn.Identity(), BATCH, 1)


def test_q_that_is_no_number_is_refused():
    q = {"ours": torch.tensor([0.5]), "broken": torch.tensor([float("nan")])}
    with pytest.raises(click.ClickException, match="broken: Q differs by nan"):
        decision.greatest_difference(q)


def test_the_greatest_difference_is_that_of_the_worst_rival():
    q = {"ours": torch.tensor([0.5, 0.5]), "near": torch.tensor([0.5, 0.49995]), "equal": torch.tensor([0.5, 0.5])}
    assert decision.greatest_difference(q) == pytest.approx(5e-5, rel=1e-2)


def test_candidates_have_a_row_for_each_count_and_cost_is_in_times_of_one(light):
    rows, difference = decision.candidate_rows(light, BATCH, 1)
    assert [(row["batch"], row["candidates"]) for row in rows] == [(BATCH, count) for count in (1, 16, 192)]
    assert rows[0]["times of 1 candidate"] == 1.0
    for row in rows:
        assert row["ms a state"] > 0
        # One turn: the ratio of the medians is the median of the ratios.
        assert row["times of 1 candidate"] == pytest.approx(row["ms a state"] / rows[0]["ms a state"])
    assert 0 <= difference <= decision.TOLERANCE


def test_a_candidate_whose_q_depends_on_the_others_is_refused(monkeypatch, light):
    head = light.head
    monkeypatch.setattr(light, "head", lambda features, action: head(features, action - action.mean(1, keepdim=True)))
    with pytest.raises(click.ClickException, match="16 candidates: Q differs"):
        decision.candidate_rows(light, BATCH, 1)


def run(arguments):
    with pytest.raises(SystemExit) as ended:
        decision.main.main(arguments, prog_name="decision")
    return ended.value.code


def test_the_command_writes_the_rows_that_are_published_and_the_difference_that_was_measured(
    monkeypatch, tmp_path, capsys
):
    assert decision.BATCHES == (1, 32), "the README and the table of ratios name them"
    assert decision.LARGE_BATCHES == (1, 256)
    monkeypatch.setattr(decision, "BATCHES", (1, BATCH))
    monkeypatch.setattr(decision, "LARGE_BATCHES", (1, 8))
    out = tmp_path / "decision.json"
    assert run(["--network", "paper", "--turns", "1", "--threads", "1", "--out", str(out)]) == 0
    found = json.loads(out.read_text())
    names = ["cem, trunk once", "cem, trunk each iteration", "cem, 64 tiled copies", "actor network"]
    assert [(row["batch"], row["decision"]) for row in found["rows"]] == [(b, name) for b in (1, 2) for name in names]
    candidates = found["Q of N candidates for a state, trunk once"]
    assert [(row["batch"], row["candidates"]) for row in candidates] == [(b, n) for b in (1, 8) for n in (1, 16, 192)]
    assert 0 < found["greatest difference of Q"] <= decision.TOLERANCE
    assert found["standard deviation of Q over candidates, least of all states"] >= decision.LEAST_DEVIATION
    assert "| 8 | 192 |" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "said"), [(["--turns", "0"], "--turns"), (["--network", "large"], "'large'")])
def test_a_mistake_is_one_line_and_exit_status_2(capsys, arguments, said):
    assert run(arguments) == 2
    printed = capsys.readouterr().err
    assert len(printed.splitlines()) == 1
    assert said in printed
