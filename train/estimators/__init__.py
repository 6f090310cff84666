"""The table of estimators: a file each; a user's own is `--algo module:row`.

Differs, for all rows with default options (`--preset paper` undoes it all):
1. The loss is the cross-entropy of Q in [0, 1]. 2. Batches of 256, shifted and mirrored images, weight decay, a rate
that falls to 0. 3. Policies use a moving average of the weights. 4. The network is `DefaultNetwork`.
"""

from typing import Any

from graspq.common.named_objects import named_row
from graspq.common.text import markdown
from graspq.train.estimator import Estimator
from graspq.train.estimators import (
    blend,
    corr_mc,
    ddpg,
    dql,
    iql,
    mc,
    mc_floor,
    nstep,
    pcl,
    supervised,
    td3_bc,
    td_lambda,
)

ESTIMATORS: dict[str, Estimator[Any]] = {
    "supervised": supervised.row,
    "dql": dql.row,
    "mc": mc.row,
    "corr-mc": corr_mc.row,
    "ddpg": ddpg.row,
    "pcl": pcl.row,
    "nstep": nstep.row,
    "td-lambda": td_lambda.row,
    "mc-floor": mc_floor.row,
    "blend": blend.row,
    "iql": iql.row,
    "td3-bc": td3_bc.row,
}


def estimator_named(name: str) -> Estimator[Any]:
    """Return the row of `--algo`: one of the table's, or a user's own as `module:row`.

    Raises:
        UserError: there is none of that name, or what is there is no row.
    """
    return named_row("--algo", name, ESTIMATORS, Estimator, "row")


def as_markdown() -> str:
    """Return the table in Markdown, as the README shows it."""
    cells = ((f"`{name}`", row.target_value.words, row.action_selection.words) for name, row in ESTIMATORS.items())
    return markdown(("`--algo`", "target value", "action selection"), cells)
