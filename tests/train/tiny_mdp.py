"""Tiny stochastic decision processes after the grasping task, with continuous actions, that are solved exactly.

The gripper is far from an object, near it, or over it; it may descend, which closes the gripper and ends the episode,
or stay up and move, or wait. Dimensions: B episodes, T = 15 steps, X = 3 places, A = 4 action, G × G grid of the two
that matter.

    close:    c(a) = σ(-8 dz - 5), and surely at the last step
    reward:   1 with chance g = (0.05, 0.35, 0.9) where the gripper closes far, near, over; else 0;
              at the last step with chance g (1 + c(a)) / 2: a gripper that was made to close grasps worse
    approach: far → near with chance m(dx), near → over with chance m(-dx), m(u) = 0.05 + 0.85 σ(10 u - 5); else it
              stays: an action that stays up and does not approach waits
    slip:     over → near with chance 0.2
    start:    far, near or over with chances 0.6, 0.25, 0.15, half of them at the first step, half at any
    behaviour: uniform actions, and dz = -1 in 2 of 100: it approaches and then closes over the object by luck alone
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.targets import discounted_return

Floats = npt.NDArray[np.float64]
STEPS, PLACES, GRID, SIZE = 15, 3, 201, 16
DISCOUNT = 0.9
SUCCESS = np.array([0.05, 0.35, 0.9])
START = np.array([0.6, 0.25, 0.15])
DIRECTION = np.array([1.0, -1.0, 0.0])
SLIP, DESCENDS = 0.2, 0.02
HOLDS = (0.9, 0.2)
BASE, SLOPE = np.array([0.3, 0.5]), np.array([0.2, 0.4])
AXIS = np.linspace(-1, 1, GRID)


def closes(dz: Floats) -> Floats:
    """Return c(a)."""
    return 1 / (1 + np.exp(8 * dz + 5))


def approaches(place: int | npt.NDArray[np.int64], dx: Floats) -> Floats:
    """Return the chance to come one place nearer, from the places far and near."""
    return 0.05 + 0.85 / (1 + np.exp(5 - 10 * DIRECTION[place] * dx))


def moved(value: Floats, dx: Floats) -> Floats:
    """Return E[value(x')] of an action that stays up, [X] and [G] -> [X, G]."""
    far, near = approaches(0, dx), approaches(1, dx)
    over = np.full_like(dx, (1 - SLIP) * value[2] + SLIP * value[1])
    return np.stack([far * value[1] + (1 - far) * value[0], near * value[2] + (1 - near) * value[1], over])


def solve(value_of: Callable[[Floats], Floats], discount: float = DISCOUNT) -> Floats:
    """Return Q of a policy by backward induction, [T, X, G, G] over places, dx and dz.

        Q_t(x, a) = c g(x) + (1 - c) γ E[V_{t+1}(x')],  Q_T(x, a) = g(x) (1 + c) / 2

    Args:
        value_of: Q_t [X, G, G] -> V_t [X]: the largest, or the mean under a policy.
        discount: γ.
    """
    q = np.empty((STEPS, PLACES, GRID, GRID))
    q[-1] = SUCCESS[:, None, None] * (1 + closes(AXIS)) / 2
    for t in reversed(range(STEPS - 1)):
        q[t] = before(value_of(q[t + 1]), discount)
    return q


def before(value: Floats, discount: float) -> Floats:
    """Return c g + (1 - c) γ E[value(x')] of a step that is not the last, [X] -> [X, G, G]."""
    close = closes(AXIS)
    return close * SUCCESS[:, None, None] + (1 - close) * discount * moved(value, AXIS)[:, :, None]


def solve_n_step(n: int) -> Floats:
    """Return what the n-step target of the behaviour's data has as its fixed point, [T, X, G, G].

    Q_t(x, a) = c g(x) + (1 - c) γ E[U_{t+1}^{n-1}(x')],
    Uᵏ: the behaviour acts k times more, and the best of 16 actions is taken from there
    """
    q = np.empty((STEPS, PLACES, GRID, GRID))
    q[-1] = SUCCESS[:, None, None] * (1 + closes(AXIS)) / 2
    for t in reversed(range(STEPS - 1)):
        reached = min(t + n, STEPS - 1)
        value = behaviour_mean(q[-1]) if t + n > STEPS - 1 else best_of_16(q[reached])
        for _ in range(t + 1, reached):
            value = behaviour_mean(before(value, DISCOUNT))
        q[t] = before(value, DISCOUNT)
    return q


def largest(q: Floats) -> Floats:
    """Return max over actions, [X, G, G] -> [X]."""
    return q.max((1, 2))


def best_of_16(q: Floats) -> Floats:
    """Return the mean of the largest Q of 16 uniform actions, [X, G, G] -> [X]: what double Q's V is when Q is right.

    It is Σ q ΔF(q)¹⁶ over the grid's values in rising order, F their distribution function.
    """
    weight = np.outer(uniform_weights(), uniform_weights()).ravel()
    values = q.reshape(len(q), -1)
    order = values.argsort(1)
    below = np.cumsum(weight[order], 1) ** 16
    return (np.take_along_axis(values, order, 1) * np.diff(below, axis=1, prepend=0)).sum(1)


def uniform_weights() -> Floats:
    """Return the weights of the trapezium rule for a mean over the axis, [G]."""
    weights = np.full(GRID, 1.0)
    weights[[0, -1]] = 0.5
    return weights / weights.sum()


def behaviour_mean(q: Floats) -> Floats:
    """Return the mean over the behaviour's actions, [X, G, G] -> [X]; the trapezium rule on the grid."""
    uniform = uniform_weights()
    over_dx = np.einsum("xij,i->xj", q, uniform)
    return (1 - DESCENDS) * over_dx @ uniform + DESCENDS * over_dx[:, 0]


def expectile(q: Floats, part: float) -> Floats:
    """Return the expectile of Q over the behaviour's actions, [X, G, G] -> [X], by bisection."""
    low, high = np.zeros(PLACES), np.ones(PLACES)
    for _ in range(40):
        middle = (low + high) / 2
        error = q - middle[:, None, None]
        above = behaviour_mean(np.where(error > 0, part, 1 - part) * error) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return low


def floor_mean() -> Floats:
    """Return Q of the larger of bootstrapped target and return, [T, X, G, G].

    Q_t(x, a) = c g + (1 - c) E[max(R, γ V_{t+1}(x'))],  R = γᵏ with the chance that the behaviour succeeds k later
    """
    q = np.empty((STEPS, PLACES, GRID, GRID))
    q[-1] = SUCCESS[:, None, None] * (1 + closes(AXIS)) / 2
    # Chance to succeed k steps after step t by the behaviour, for each place: [K, X].
    later = behaviour_mean(q[-1])[None]
    for t in reversed(range(STEPS - 1)):
        value = best_of_16(q[t + 1])
        returns = DISCOUNT ** np.arange(1, len(later) + 1)[:, None]
        floor = DISCOUNT * value
        expected = (later * np.maximum(returns, floor)).sum(0) + (1 - later.sum(0)) * floor
        q[t] = before(expected / DISCOUNT, DISCOUNT)
        ends = behaviour_mean(np.broadcast_to(closes(AXIS), q[t].shape)) * SUCCESS
        onward = [behaviour_mean((1 - closes(AXIS)) * moved(chance, AXIS)[:, :, None]) for chance in later]
        later = np.stack([ends, *onward])
    return q


def supervised_mean() -> Floats:
    """Return the chance of success given the place, the step and the displacement to the last place, [T, X, X_last].

    Entries that cannot happen are NaN.
    """
    ends = np.zeros((STEPS, PLACES, PLACES))
    wins = np.zeros((STEPS, PLACES, PLACES))
    ends[-1] = np.eye(PLACES)
    close = np.broadcast_to(closes(AXIS), (PLACES, GRID, GRID))
    wins[-1] = np.diag(SUCCESS * behaviour_mean((1 + close) / 2))
    for t in reversed(range(STEPS - 1)):
        for table, now in ((ends, np.ones(PLACES)), (wins, SUCCESS)):
            for last in range(PLACES):
                going = moved(table[t + 1, :, last], AXIS)[:, :, None]
                here = (np.arange(PLACES) == last)[:, None, None] * now[:, None, None]
                table[t, :, last] = behaviour_mean(close * here + (1 - close) * going)
    with np.errstate(invalid="ignore"):
        return wins / ends


def pictures() -> Tensor:
    """Return one image for each place, uint8 [X, H, W, C]: a bright bar at its own height."""
    image = torch.full((PLACES, SIZE, SIZE, 3), 60, dtype=torch.uint8)
    for place in range(PLACES):
        image[place, 5 * place : 5 * place + 5] = 200
    return image


@dataclasses.dataclass(frozen=True)
class Data:
    """Episodes, padded as the loader pads.

    `place` is int64 [B, T]; `columns` are those of a `Batch` without its images, [B, T, ...]; `real` is int64 [n, 2],
    episode and step of every real step.
    """

    place: Tensor
    columns: dict[str, Tensor]
    real: Tensor

    def whole_episodes(self, rows: Tensor) -> Batch:
        """Return some episodes whole."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return Batch(image=pictures()[self.place[rows]], **columns)

    def transitions(self, rows: Tensor) -> Batch:
        """Return transitions, numbered along the real steps, with T = 1."""
        episode, step = self.real[rows].unbind(1)
        after = (step + 1).clamp(max=self.place.shape[1] - 1)
        columns = {name: values[episode, step].unsqueeze(1) for name, values in self.columns.items() if name != "mask"}
        here, there = (pictures()[self.place[episode, now]].unsqueeze(1) for now in (step, after))
        next_step = (columns["step"] + 1).clamp(max=self.max_steps - 1)
        return Batch(image=here, next_image=there, next_step=next_step, **columns)

    # What `kept` of an estimator reads of a `ShardPool`, as one block.
    blocks = (0,)

    @property
    def max_steps(self) -> int:
        return self.place.shape[1]

    @property
    def rows(self) -> int:
        return len(self.real)

    @property
    def episodes(self) -> int:
        return len(self.place)

    def read_columns(self, block: int, names: tuple[str, ...]) -> dict[str, npt.NDArray[np.float32]]:
        return {name: self.columns[name][self.columns["mask"]].numpy() for name in names}


def collect(episodes: int, seed: int, discount: float = DISCOUNT) -> Data:
    """Return episodes under the behaviour policy."""
    rng = np.random.default_rng(seed)
    shape = (episodes, STEPS)
    action = rng.uniform(-1, 1, (*shape, 4))
    action[..., 2] = np.where(rng.random(shape) < DESCENDS, -1, action[..., 2])
    place = np.zeros(shape, np.int64)
    terminal, reward = np.zeros(shape, bool), np.zeros(shape)
    x, alive = rng.choice(PLACES, episodes, p=START), np.ones(episodes, bool)
    first = np.where(rng.random(episodes) < 0.5, 0, rng.integers(0, STEPS, episodes))
    step = first[:, None] + np.arange(STEPS)
    mask = np.zeros(shape, bool)
    for t in range(STEPS):
        place[:, t], mask[:, t] = x, alive
        last, close = step[:, t] == STEPS - 1, closes(action[:, t, 2])
        ends = alive & ((rng.random(episodes) < close) | last)
        terminal[:, t] = ends
        reward[:, t] = ends & (rng.random(episodes) < SUCCESS[x] * np.where(last, (1 + close) / 2, 1))
        nearer = rng.random(episodes) < approaches(x, action[:, t, 0])
        slips = rng.random(episodes) < SLIP
        alive = alive & ~ends
        x = np.where(alive, np.where(x == 2, x - slips, x + nearer), x)
    displacement = (x[:, None] - place) / 2
    synthetic = np.concatenate([displacement[..., None], rng.uniform(-1, 1, (*shape, 3))], -1)
    data = as_data(place, action, reward, terminal, synthetic, mask, discount)
    return dataclasses.replace(data, columns=data.columns | {"step": torch.from_numpy(step).clamp(max=STEPS - 1)})


def as_data(
    place: npt.NDArray[np.int64],
    action: Floats,
    reward: Floats,
    terminal: npt.NDArray[np.bool_],
    synthetic: Floats,
    mask: npt.NDArray[np.bool_],
    discount: float,
) -> Data:
    """Return episodes with their returns, Σ γ^{t' - t} r_t'."""
    returns = discounted_return(torch.from_numpy(reward), discount, torch.from_numpy(mask))
    columns = {
        "step": torch.arange(place.shape[1]).expand(place.shape).contiguous(),
        "action": torch.from_numpy(action.astype(np.float32)),
        "reward": torch.from_numpy(reward.astype(np.float32)),
        "terminal": torch.from_numpy(terminal),
        "mc_return": returns.float(),
        "synthetic_action": torch.from_numpy(synthetic.astype(np.float32)),
        "mask": torch.from_numpy(mask),
    }
    return Data(torch.from_numpy(place), columns, torch.from_numpy(np.argwhere(mask)))


def collect_hidden(episodes: int, seed: int) -> Data:
    """Return episodes of a process whose pictures do not show what matters; see `hidden_values`.

    Three steps. At the first, dx > 0 leaves the object where a share h = 0.9 of grasps holds, any other action where
    h = 0.2 does; no picture shows which. At the second nothing matters. At the third the reward is 1 with chance
    h (1 + dx) / 2. Actions are uniform.
    """
    rng = np.random.default_rng(seed)
    shape = (episodes, 3)
    action = rng.uniform(-1, 1, (*shape, 4))
    chance = np.where(action[:, 0, 0] > 0, *HOLDS) * (1 + action[:, 2, 0]) / 2
    reward = np.zeros(shape)
    reward[:, 2] = rng.random(episodes) < chance
    terminal = np.broadcast_to([False, False, True], shape).copy()
    return as_data(np.zeros(shape, np.int64), action, reward, terminal, action, np.ones(shape, bool), DISCOUNT)


def hidden_values() -> dict[str, tuple[float, float]]:
    """Return Q of the first step where dx < 0 and where dx > 0, by what it is learned from.

    At the third step Q is the mean over what is hidden, h̄ (1 + dx) / 2: the best of 16 uniform actions has V = 16/17 h̄,
    the logged ones h̄ / 2 on average. At the second all are as good. A bootstrap cannot tell what the first action did.
    """
    good, bad = HOLDS
    mean, best, faded = (good + bad) / 2, 16 / 17, DISCOUNT**2
    return {
        "return": (faded * bad / 2, faded * good / 2),
        "corrected": tuple(faded * (held / 2 + mean * (best - 1 / 2)) for held in (bad, good)),
        "bootstrapped": (faded * mean * best, faded * mean * best),
    }


def collect_mirrored(episodes: int, seed: int, discount: float = DISCOUNT) -> Data:
    """Return episodes of a process in which the regularised optimum of `pcl` is a normal distribution; see `mirrored`.

    Two places, mirror images of each other: what +dx is worth at the first, -dx is worth at the second. Two steps; both
    are rewarded, with chance bₜ + kₜ d(x) dx, b = (0.3, 0.5), k = (0.2, 0.4); the next place is the same with chance
    (1 + dx) / 2. Actions are uniform.
    """
    rng = np.random.default_rng(seed)
    shape = (episodes, len(BASE))
    action = rng.uniform(-1, 1, (*shape, 4))
    place = np.zeros(shape, np.int64)
    place[:, 0] = rng.integers(0, 2, episodes)
    place[:, 1] = place[:, 0] ^ (rng.random(episodes) > (1 + action[:, 0, 0]) / 2)
    reward = (rng.random(shape) < BASE + SLOPE * DIRECTION[place] * action[..., 0]).astype(np.float64)
    terminal = np.broadcast_to([False, True], shape).copy()
    return as_data(place, action, reward, terminal, action, np.ones(shape, bool), discount)


def mirrored(mean: Floats, deviation: Floats, penalty: float, discount: float = DISCOUNT) -> tuple[Floats, Floats]:
    """Return V and the policy's mean dx at the regularised optimum, [T, X] each, near a normal policy π'.

        V_t(x) = λ log E_{a ~ π'} exp(Q_t(x, a) / λ),  π_t ∝ π' exp(Q_t / λ),  Q_t = bₜ + kₜ d dx + γ E[V_{t+1}]

    Q is linear in dx, so π is π' moved by σ'² kₜ d / λ, and V = Q(μ') + σ'² kₜ² / (2 λ). V is the same at both places
    where π' is mirrored too; `pcl` squares residuals of random transitions, whose variance it would else lower as well.

    Args:
        mean: μ' of dx, [T, X].
        deviation: σ' of dx, [T, X].
        penalty: λ.
        discount: γ.
    """
    slope = SLOPE[:, None] * DIRECTION[None, :2]
    value = BASE[:, None] + slope * mean + deviation**2 * slope**2 / (2 * penalty)
    value[0] += discount * value[1].mean()
    return value, mean + deviation**2 * slope / penalty
