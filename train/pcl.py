"""Trust-PCL: V and a Gaussian policy are made consistent along logged paths, and the policy pays for leaving its lagged
copy.

Dimensions: n real steps of a batch, B batch, T steps, A action.

Differs, for `pcl` (what all rows share stands in `estimators`). The authors' code for grasping was not released; "its
configuration" is what the release holds of it, and where that is silent their code for other tasks.
1. `--loss` does not apply: the loss is the mean squared residual, as V(s) + λ Σ (log π - log π') has no bounds that a
   cross-entropy could use. With either value of `--loss` V is an unbounded number on the scale of returns.
2. A path is the rest of the episode (their configuration: 10 steps, which few episodes exceed; `--preset paper`).
3. λ is tuned to a mean KL(π‖π') of 0.02 nats (`--kl-bound`), measured on the batch's states; `--penalty` fixes it
   (their configuration: 3; `--preset paper`). Trust-PCL computes λ from the returns of the policy's own last episodes,
   of which there are none here. In the tests' tiny process, where the best policy is worth 0.63 and the first one 0.05,
   20 lagged copies came to 0.08 with λ = 3, to 0.17, 0.52 and 0.63 with a bound of 0.002, 0.01 and 0.05; 60 copies to
   0.63 with 0.01.
4. π' is a copy every `--lag-steps` steps, as for all rows; in Trust-PCL it is a moving average.
5. The deviation is learned, between 0.1 and 1, for each state and dimension; in their code it is fixed. With a fixed
   one log π - log π' is linear in the action; the best linear fit of the advantage over data that are not the policy's
   own has the same slope whatever the mean is, so that the mean runs past the best action to its bound. The same
   happens here once the deviation is at its own bound.
6. The mean lies within 1.25 times the box (`selection.pointed`) and starts straight down.
7. Both policies run with the same running statistics of batch normalisation; see `_share_statistics`.
8. Adam's gradients of π are divided by λ; see `path_consistency`. No clipping of advantages or gradients.
9. The policy's learning rate is a tenth of V's (`--actor-rate`, as for `ddpg`; 1 with `--preset paper`). At V's rate
   and with 256 transitions of the 10k dataset a batch, KL(π‖π') rose to 0.28 within one lagged copy while V had learned
   nothing, the mean of dphi swung from 1.0 to -1.1, and all states had the same action.
10. The step is in the state, as for all rows (their configuration: not). Discount 0.9, batch and V's learning rate as
    for all (their configuration: 0.95, 64 and 1e-4; `--preset paper`).
11. With `--path-steps` V(s_{t+d}), through which gradient flows too, is of the same pass as V(s_t), with the batch's
    statistics; of an own pass it would cost as much again.

Bias: the square of a residual also counts the chance in transitions and rewards (as for every residual-gradient
method); what a lucky transition brought is in part laid to the actions after it.

dz = -1 exactly in 90 % of the logged actions: a normal distribution puts a density, not a mass, there, and half of its
mass beyond the box where its mean is -1. Likelihood would then grow without end as σ falls; the residual does not, for
it sees log π - log π' and V takes up whatever is common to all logged actions. Measured: with rewards that do not
depend on the action μ and σ of dz stay at (-1, 0.5) to 0.001 where V is right from the start; where V starts 0.25 too
low they drift with the data to (-0.91, 0.45) until V has caught up. Where dz = -1 alone succeeds σ falls to its bound
(0.103 after 40 lagged copies) and μ to its own (-1.24, acting as -1). All numbers are finite: the two bounds keep
log π - log π' below 1,100 for any action. The tests hold these to be true. On the 10k dataset, after 3,000 steps, over
held-back states: μ of dz -0.86 on average (between -1.00 and -0.49), σ 0.42 (of dx and dy 0.22), log density at dz = -1
of -0.10, and 0.38 of the mass below -1.
"""

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch
from graspq.train.selection import pointed
from graspq.train.targets import path_consistent
from graspq.train.updates import slow_down

if TYPE_CHECKING:
    from graspq.train.estimators import Estimator
    from graspq.train.state import Context, TrainState

LEAST_DEVIATION, MOST_DEVIATION, FIRST_DEVIATION = 0.1, 1.0, 0.5
LEAST_PENALTY, MOST_PENALTY, FIRST_PENALTY = 0.01, 100.0, 1.0
# Of log λ a step, at most: a factor of e in 50 steps.
TUNING_RATE = 0.02
# Of a batch, at least, whose statistics count; the running ones average over ten batches.
STATISTICS_STATES = 64


class Gaussian(NamedTuple):
    """A policy at n states: independent normal distributions, not truncated at the box; both float32 [n, A]."""

    mean: Tensor
    log_deviation: Tensor


def policy_of(output: Tensor) -> Gaussian:
    """Return the policy that an actor's outputs mean.

        μ = pointed(output₁..₄),  log σ = log σ_min + (log σ_max - log σ_min) / (1 + exp(-(output₅..₈ + c)))

    c makes σ 0.5 where the output is 0. σ_min = 0.1: a tenth of the action limits, 6 mm; σ_max = 1.

    Args:
        output: raw outputs of a state network, float [n, 2 A].
    """
    raw_mean, raw_deviation = output.float().chunk(2, dim=-1)
    low, high, first = torch.tensor([LEAST_DEVIATION, MOST_DEVIATION, FIRST_DEVIATION], device=output.device).log()
    offset = torch.logit((first - low) / (high - low))
    return Gaussian(pointed(raw_mean), low + (high - low) * torch.sigmoid(raw_deviation + offset))


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


def first_penalty(pool: ShardPool) -> dict[str, Tensor]:
    """Return what `pcl` keeps besides its networks: λ, where it is tuned."""
    return {"penalty": torch.tensor(FIRST_PENALTY)}


def consistent_value(batch: Batch, context: "Context") -> Tensor:
    """Return what V(s_t) should be by the path that follows; float [B, T]. See `targets.path_consistent`."""
    return _value_and_target(batch, context)[1]


def path_consistency(state: "TrainState", batch: Batch, estimator: "Estimator", context: "Context") -> Tensor:
    """Take one gradient step on the mean squared residual, with π and V alike; return the loss.

        δ_t = V(s_t) - γᵈ V(s_{t+d}) - Σ_{i=0}^{d-1} γⁱ (r_{t+i} - λ (log π - log π')(a_{t+i}|s_{t+i}))
        V ← V - optimiser(∇_V mean ½ δ_t²),  π ← π - optimiser(∇_π mean ½ δ_t² / λ),  through every V and π in δ

    π' is the lagged copy. The policy's gradient is proportional to λ, which Adam undoes; divided by it, it stays
    undone where λ is tuned: Adam's long memory of the steps under a larger λ would stop the policy.

    Source: Quillen et al. 2018, section "Path Consistency Learning"; Nachum et al. 2018, "Trust-PCL".
    """
    _share_statistics(state, batch, context)
    state.learned["v"].train()
    value, target, divergence = _value_and_target(batch, context)
    loss = _mean_square(batch, value, target)
    for optimizer in state.optimizers.values():
        optimizer.zero_grad(set_to_none=True)
    (loss * context.part.share).backward()  # type: ignore[no-untyped-call]
    slow_down(state.optimizers["actor"], context.actor_rate)
    _divide_gradients(state.learned["actor"], _penalty(context))
    for optimizer in state.optimizers.values():
        optimizer.step()
    if context.penalty is None:
        context.extra["penalty"].copy_(tuned(context.extra["penalty"], context.part.mean(divergence), context.kl_bound))
    context.watched.update({"V": batch.real(value).abs().mean(), "target": batch.real(target).abs().mean()})
    return loss.detach()


def residual(batch: Batch, estimator: "Estimator", context: "Context") -> Tensor:
    """Return the mean of ½ δ_t² as the networks stand; see `path_consistency`."""
    return _mean_square(batch, *_value_and_target(batch, context)[:2])


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


def _share_statistics(state: "TrainState", batch: Batch, context: "Context") -> None:
    """Note the batch's statistics in the policy's running ones, and give the lagged copy the same.

    Both policies then run in evaluation mode, and log π - log π' tells their weights apart and nothing else. With the
    batch's own statistics in π alone the ratio was 2 nats at equal weights in the first steps (measured), and the
    penalty drove the mean into a corner of the box before V had learned anything. Evenly spread states of the batch do:
    this pass over all of them took an eighth of a step's time.
    """
    actor, lagged = state.learned["actor"].train(), state.lagged["actor"]
    if any(name.endswith("running_mean") for name, _ in actor.named_buffers()):
        image, step = batch.real(batch.image), batch.real(batch.step)
        every = max(1, len(image) // STATISTICS_STATES)
        with torch.no_grad(), context.autocast():
            actor(image[::every], step[::every])
            for old, new in zip(lagged.buffers(), actor.buffers(), strict=True):
                old.copy_(new)
    actor.eval()


def _value_and_target(batch: Batch, context: "Context") -> tuple[Tensor, Tensor, Tensor]:
    """Return V(s_t) and its target, [B, T] each and 0 on padding, and mean KL(π‖π'), without gradient."""
    image, step, action = batch.real(batch.image), batch.real(batch.step), batch.real(batch.action)
    with context.autocast():
        value = context.networks["v"](image, step).squeeze(-1).float()
        policy = policy_of(context.networks["actor"](image, step))
        with torch.no_grad():
            lagged = policy_of(context.lagged_networks["actor"](image, step))
    log_ratio = log_density(policy, action) - log_density(lagged, action)
    padded = _padded(value, batch)
    target = path_consistent(
        batch.reward,
        padded,
        _padded(log_ratio, batch),
        _penalty(context),
        context.discount,
        context.path_steps,
        batch.mask,
    )
    with torch.no_grad():
        return padded, target, relative_entropy(policy, lagged).mean()


def _penalty(context: "Context") -> Tensor | float:
    return context.extra["penalty"] if context.penalty is None else context.penalty


def _divide_gradients(network: nn.Module, divisor: Tensor | float) -> None:
    for parameter in network.parameters():
        if parameter.grad is not None:
            parameter.grad.div_(divisor)


def _padded(values: Tensor, batch: Batch) -> Tensor:
    """Return values of the real steps, [n], in their places in [B, T], 0 elsewhere."""
    if batch.mask is None:
        return values.view_as(batch.reward)
    return torch.zeros_like(batch.reward).masked_scatter(batch.mask, values)


def _mean_square(batch: Batch, value: Tensor, target: Tensor) -> Tensor:
    return 0.5 * batch.real(value - target).square().mean()
