"""Rivals of a decision do the same job, on a network whose Q tells candidates apart."""

import dataclasses

import pytest
import torch

from graspq.benchmarks import decision
from graspq.benchmarks.harness import TOLERANCE
from graspq.benchmarks.rivals import ONCE, TILED, WAYS
from graspq.common.errors import UserError
from graspq.train.networks import build, q_network
from graspq.train.state import seeded

BATCH = 2


@pytest.fixture(autouse=True)
def no_gradients():
    with torch.no_grad():
        yield


def fresh(name):
    specification = dataclasses.replace(decision.SPECIFICATION, name=name)
    return build(q_network, specification, seeded("tests/benchmarks/decision")).eval()


@pytest.fixture(scope="module", params=["default", "paper"])
def network(request):
    made = fresh(request.param)
    decision.spread_out(made)
    return made


@pytest.mark.parametrize("name", ["default", "paper"])
def test_fresh_weights_prove_nothing_and_scaled_ones_tell_candidates_apart(name):
    network = fresh(name)
    with pytest.raises(UserError, match="would prove nothing"):
        decision.check_rivals(network, 8)
    decision.spread_out(network)
    # Raw outputs of deviation 1 about 0: Q of about a fifth.
    deviation = network.at(*decision.states(8))(decision.candidates(8, 192)).std(dim=1)
    assert 0.1 < float(deviation.min()) < 0.3


def test_the_scaled_network_sees_the_step(network):
    image, step = decision.states(BATCH)
    actions = decision.candidates(BATCH, 16)
    difference = network.at(image, step)(actions) - network.at(image, step + 1)(actions)
    assert difference.abs().max() > 10 * TOLERANCE


def test_rivals_give_the_same_q_and_find_the_same_action(network):
    decision.check_rivals(network, BATCH)
    first, *others = (decision.search(way, network, BATCH)().action for way in WAYS.values())
    for other in others:
        torch.testing.assert_close(other, first, atol=1e-3, rtol=0)


def of_other_states(network, image, step):
    """What `repeat` in place of `repeat_interleave` gives: candidates of one state judged in another."""

    def q_of_actions(action):
        count = action.shape[1]
        copies = image.repeat(count, 1, 1, 1), step.repeat(count)
        return network.value_of(network(*copies, action.flatten(0, 1))).view(action.shape[:2])

    return q_of_actions


def of_the_next_step(network, image, step):
    return network.at(image, step + 1)


def of_raw_outputs(network, image, step):
    """The search finds the same action: the order is the same."""
    return lambda action: network.head(network.trunk(image, step), action)


@pytest.mark.parametrize("wrong", [of_other_states, of_the_next_step, of_raw_outputs])
def test_a_rival_that_computes_something_else_is_refused(monkeypatch, network, wrong):
    monkeypatch.setitem(WAYS, TILED, wrong)
    with pytest.raises(UserError, match=r"64 tiled copies: differs from ours by .*, expected at most 0\.0001"):
        decision.check_rivals(network, BATCH)


def test_a_candidate_whose_q_depends_on_the_others_is_refused(monkeypatch, network):
    head = network.head
    monkeypatch.setattr(network, "head", lambda features, action: head(features, action - action.mean(1, keepdim=True)))
    with pytest.raises(UserError, match="Q of 16 candidates: differs"):
        decision.candidate_rows(network, BATCH, 1)


def test_the_published_ratio_is_that_of_one_state():
    result = decision.measure(decision.DecisionSettings(turns=1, many=(1, 8)))
    rows = {row["decision"]: row for row in result.tables["Decisions of a policy"]}
    assert list(rows) == [*WAYS, decision.ACTOR]
    assert result.ratios[0].value == pytest.approx(rows[ONCE][f"times {TILED}"])
    costs = result.tables["Q of N candidates for a state, trunk once"]
    assert [(row["batch"], row["candidates"]) for row in costs] == [
        (batch, str(count)) for batch in (1, 8) for count in decision.CANDIDATES
    ]
