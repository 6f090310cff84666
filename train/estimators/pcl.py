"""`pcl`: Trust-PCL. V and a Gaussian policy are made consistent along logged paths, near a lagged copy of the policy.

Dimensions: n real steps of a batch, B batch, T steps, A action. Bias, limits and measurements: docs/estimators/pcl.md.
"""

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor, nn

from graspq.common.action_space import ActionSpace
from graspq.common.options import setting
from graspq.datasets.pool import ShardPool
from graspq.train.acting import ActorNetwork
from graspq.train.batch import Batch
from graspq.train.estimator import LOSSES, EpisodeSettings, Estimator, LaggedSettings, Metrics, TargetValue
from graspq.train.networks import state_network
from graspq.train.recipe import DEFAULT, PAPER
from graspq.train.selection import pointed
from graspq.train.state import Networks, TrainState
from graspq.train.targets import path_consistent

LEAST_DEVIATION, MOST_DEVIATION, FIRST_DEVIATION = 0.1, 1.0, 0.5
LEAST_PENALTY, MOST_PENALTY, FIRST_PENALTY = 0.01, 100.0, 1.0
# Of log λ a step, at most: a factor of e in 50 steps.
TUNING_RATE = 0.02
# Of a batch, at least, whose statistics count; the running ones average over ten batches.
STATISTICS_STATES = 64


@dataclasses.dataclass(frozen=True)
class PclSettings(LaggedSettings, EpisodeSettings):
    """Options of `pcl`."""

    actor_rate: float = setting(0.1, help="Learning rate of the actor over that of V.", minimum=0, maximum=10)
    path_steps: int | None = setting(
        None, help="Steps d of a path; all: the rest of the episode.", minimum=1, none="all"
    )
    penalty: float | None = setting(
        None,
        help="Weight of the relative entropy to the lagged policy; tuned: to --kl-bound.",
        minimum=1e-6,
        none="tuned",
    )
    kl_bound: float = setting(
        0.02, help="Mean relative entropy to the lagged policy that the weight is tuned to, nats.", minimum=1e-6
    )


class Gaussian(NamedTuple):
    """A policy at n states: independent normal distributions, not truncated at the box; both float32 [n, A]."""

    mean: Tensor
    log_deviation: Tensor


def policy_of(output: Tensor, action: ActionSpace) -> Gaussian:
    """Return the policy that an actor's outputs mean.

        μ = pointed(output₁..A),  log σ = log σ_min + (log σ_max - log σ_min) / (1 + exp(-(output_{A+1}..2A + c)))

    c makes σ 0.5 where the output is 0. σ_min = 0.1, a tenth of the action limits; σ_max = 1.

    Args:
        output: raw outputs of a state network, float [n, 2 A].
        action: says where the mean starts.
    """
    raw_mean, raw_deviation = output.float().chunk(2, dim=-1)
    low, high, first = torch.tensor([LEAST_DEVIATION, MOST_DEVIATION, FIRST_DEVIATION], device=output.device).log()
    offset = torch.logit((first - low) / (high - low))
    return Gaussian(pointed(raw_mean, action), low + (high - low) * torch.sigmoid(raw_deviation + offset))


def log_density(policy: Gaussian, action: Tensor) -> Tensor:
    """Return log π(a|s) less the constant ½ A log 2π, float32 [n].

    Σᵢ -½ ((aᵢ - μᵢ) / σᵢ)² - log σᵢ
    """
    standard = (action - policy.mean) * (-policy.log_deviation).exp()
    return (-0.5 * standard.square() - policy.log_deviation).sum(-1)


def relative_entropy(policy: Gaussian, other: Gaussian) -> Tensor:
    """Return KL(π‖π') at each state, nats, float32 [n].

    Σᵢ log(σ'ᵢ / σᵢ) + ½ (σᵢ² + (μᵢ - μ'ᵢ)²) / σ'ᵢ² - ½
    """
    variance = (2 * policy.log_deviation).exp() + (policy.mean - other.mean).square()
    wider = other.log_deviation - policy.log_deviation
    return (wider + 0.5 * variance * (-2 * other.log_deviation).exp() - 0.5).sum(-1)


def first_penalty(pool: ShardPool, settings: PclSettings) -> dict[str, Tensor]:
    """Return what is kept besides the networks: λ, where it is tuned."""
    return {"penalty": torch.tensor(FIRST_PENALTY)}


def target(batch: Batch, networks: Networks, settings: PclSettings, random: torch.Generator, progress: float) -> Tensor:
    """Return what V(s_t) should be by the path that follows; float [B, T]. See `targets.path_consistent`.

    Source: Quillen et al. 2018, section "Path Consistency Learning"; Nachum et al. 2018, "Trust-PCL".
    Differs: the authors' code for grasping was not released. 1. The loss is the mean squared residual (`--loss` is no
    option). 2. A path is the rest of the episode (their configuration: 10 steps; `--preset paper`). 3. λ is tuned to a
    mean KL(π‖π') (`--penalty 3` in their configuration; `--preset paper`); Trust-PCL computes it from the policy's own
    last episodes, of which there are none here. 4. π' is a copy every `--lag-steps` steps, as in their configuration;
    in their code for other tasks it is a moving average. 5. The deviation is learned, between 0.1 and 1; theirs is
    fixed. 6. The mean lies within 1.25 times the box. 7. Both policies run with the same running statistics, see
    `_share_statistics`. 8. Residuals are not clipped (to ±1 in their configuration); gradients of π are divided by λ,
    see `path_consistency`. 9. The policy's rate is a tenth of V's (1 with `--preset paper`). 10. The step is in the
    state. 11. With `--path-steps`, V(s_{t+d}) is of the same pass as V(s_t). 12. A batch counts transitions (their 64
    counts episodes; `--batch-of episodes`, with `--preset paper`).
    """
    return _value_and_target(batch, networks, settings)[1]


def path_consistency(
    estimator: Estimator[PclSettings],
    state: TrainState,
    batch: Batch,
    settings: PclSettings,
    random: torch.Generator,
    progress: float,
) -> Metrics:
    """Take one gradient step on the mean squared residual, with π and V alike.

        δ_t = V(s_t) - γᵈ V(s_{t+d}) - Σ_{i=0}^{d-1} γⁱ (r_{t+i} - λ (log π - log π')(a_{t+i}|s_{t+i}))
        V ← V - optimiser(∇_V mean ½ δ_t²),  π ← π - optimiser(∇_π mean ½ δ_t² / λ),  through every V and π in δ

    π' is the lagged copy. The policy's gradient is proportional to λ, which Adam undoes; divided by it, it stays
    undone where λ is tuned: Adam's long memory of the steps under a larger λ would stop the policy.
    """
    networks = state.networks
    _share_statistics(batch, networks)
    networks.online["v"].train()
    value, wanted, divergence = _value_and_target(batch, networks, settings)
    loss = _mean_square(batch, value, wanted)
    for optimizer in state.optimizers.values():
        optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    state.slow_down("actor", settings.actor_rate)
    _divide_gradients(networks.online["actor"], _penalty(networks, settings))
    for optimizer in state.optimizers.values():
        optimizer.step()
    if settings.penalty is None:
        networks.kept["penalty"].copy_(tuned(networks.kept["penalty"], divergence, settings.kl_bound))
    v, targets = batch.real(value).detach().abs().mean(), batch.real(wanted).detach().abs().mean()
    return {"loss": loss.detach(), "v": v, "target": targets, "kl": divergence}


def residual(
    estimator: Estimator[PclSettings],
    batch: Batch,
    networks: Networks,
    settings: PclSettings,
    random: torch.Generator,
    progress: float,
) -> Tensor:
    """Return the mean of ½ δ_t² as the networks stand; see `path_consistency`."""
    return _mean_square(batch, *_value_and_target(batch, networks, settings)[:2])


def tuned(penalty: Tensor, divergence: Tensor, bound: float) -> Tensor:
    """Return λ after a step: larger where the policy has left its lagged copy by more than the bound, else smaller.

        λ ← clip(λ exp(0.02 clip(KL / bound - 1, -1, 1)), 0.01, 100)

    Args:
        penalty: λ, a scalar.
        divergence: mean KL(π‖π') over the batch, nats, a scalar.
        bound: what it should be on average over the steps between copies of the lagged networks.
    """
    step = TUNING_RATE * (divergence / bound - 1).clamp(-1, 1)
    return (penalty * step.exp()).clamp(LEAST_PENALTY, MOST_PENALTY)


def _share_statistics(batch: Batch, networks: Networks) -> None:
    """Note the batch's statistics in the policy's running ones, and give the lagged copy the same.

    Both policies then run in evaluation mode, and log π - log π' tells their weights apart and nothing else. With the
    batch's own statistics in π alone the penalty drove the mean into a corner of the box before V had learned anything.
    """
    actor, lagged = networks.online["actor"].train(), networks.lagged["actor"]
    if any(name.endswith("running_mean") for name, _ in actor.named_buffers()):
        image, step = batch.real(batch.image), batch.real(batch.step)
        # Evenly spread states of the batch do: a pass over all of them takes an eighth of a step's time.
        every = max(1, len(image) // STATISTICS_STATES)
        with torch.no_grad(), networks.autocast():
            actor(image[::every], step[::every])
            for old, new in zip(lagged.buffers(), actor.buffers(), strict=True):
                old.copy_(new)
    actor.eval()


def _value_and_target(batch: Batch, networks: Networks, settings: PclSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Return V(s_t) and its target, [B, T] each and 0 on padding, and mean KL(π‖π'), without gradient."""
    image, step, action = batch.real(batch.image), batch.real(batch.step), batch.real(batch.action)
    space = networks.specification.action
    with networks.autocast():
        value = networks.online["v"](image, step).squeeze(-1).float()
        policy = policy_of(networks.online["actor"](image, step), space)
        with torch.no_grad():
            lagged = policy_of(networks.lagged["actor"](image, step), space)
    log_ratio = log_density(policy, action) - log_density(lagged, action)
    padded = batch.in_place(value)
    wanted = path_consistent(
        batch.reward,
        padded,
        batch.in_place(log_ratio),
        _penalty(networks, settings),
        settings.discount,
        settings.path_steps,
        batch.mask,
    )
    with torch.no_grad():
        return padded, wanted, relative_entropy(policy, lagged).mean()


def _penalty(networks: Networks, settings: PclSettings) -> Tensor | float:
    return networks.kept["penalty"] if settings.penalty is None else settings.penalty


def _divide_gradients(network: nn.Module, divisor: Tensor | float) -> None:
    for parameter in network.parameters():
        if parameter.grad is not None:
            parameter.grad.div_(divisor)


def _mean_square(batch: Batch, value: Tensor, target: Tensor) -> Tensor:
    return 0.5 * batch.mean(batch.real(value - target).square())


row = Estimator(
    summary="Trust-PCL: V and a Gaussian policy, made consistent along logged paths near its lagged copy",
    settings=PclSettings,
    target_value=TargetValue(
        "corrected episode value (Trust-PCL: relative entropy to a lagged policy)",
        target,
        view="episodes",
        needs_return=False,
    ),
    action_selection=ActorNetwork(),
    paper=PclSettings(discount=0.95, actor_rate=1.0, path_steps=10, penalty=3.0, batch_of="episodes"),
    recipe=dataclasses.replace(DEFAULT, learning_rate=1e-3),
    paper_recipe=dataclasses.replace(PAPER, learning_rate=1e-4, batch_size=64),
    loss=lambda settings: LOSSES["squared"],
    parts={"v": state_network(1), "actor": state_network(lambda specification: 2 * specification.actions)},
    update=path_consistency,
    objective=residual,
    kept=first_penalty,
)
